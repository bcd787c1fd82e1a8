# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The report of a diagnosis: what it says, that it is whole, and that it is safe to open."""

from dataclasses import replace
from html import escape
from html.parser import HTMLParser
import json
import re

from diagnosis_examples import base_model, example, HOSTILE, hostile, refined_model
from matplotlib.image import imread
import numpy as np
from piezo_ident.common.errors import Cancelled, DataError
from piezo_ident.diagnosis.diagnosis_json import to_json
from piezo_ident.diagnosis.results import Errors, FORMULA, FoundParameter
from piezo_ident.model.files import load
from piezo_ident.model.stage_model import EffectSetting
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.report import changes, diagnosis_summary, Unseen, write_diagnosis_report
from piezo_ident.report.diagnosis_page import diagnosis_page
from piezo_ident.report.diagnosis_tables import error_rows, value_text
from piezo_ident.report.figures.diagnosis import DIAGNOSIS_NAMES, draw_diagnosis
from piezo_ident.report.figures.refinement_bars import ranking_figure
from piezo_ident.report.figures.residual_traces import residual_figure
from piezo_ident.report.figures.style import NothingToDraw
from piezo_ident.report.numbers import number
import pytest

UNSEEN = Unseen('other.csv', 0.8, 0.1, 0.7, 0.05, 20_000, ((1.0, 0.9, 0.2), (120.0, 3.2, 0.3)))


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    target = tmp_path_factory.mktemp('out') / 'deep' / 'report'
    page = write_diagnosis_report(example('class'), target, unseen=[UNSEEN])
    assert page == target / 'report.html'
    return target


@pytest.fixture(scope='module')
def html(folder):
    return (folder / 'report.html').read_text(encoding='utf-8')


@pytest.fixture
def coarse(monkeypatch):
    """Have pictures drawn with few pixels, where nobody looks at them."""
    monkeypatch.setattr('piezo_ident.report.figures.DPI', 30)


class Outline(HTMLParser):
    """Headings and pictures of a page, and whether every tag is closed."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.headings: list[str] = []
        self.pictures: list[str] = []

    def handle_starttag(self, tag, attrs):
        if tag == 'figure':
            self.pictures.append(dict(attrs)['id'])
        if tag not in ('meta', 'img'):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] == 'h2':
            self.headings.append(data)


def outline(text: str) -> Outline:
    found = Outline()
    found.feed(text)
    assert found.open == []
    return found


def test_folder_is_whole(folder):
    pictures = {f'{name}.png' for name in DIAGNOSIS_NAMES if name[-1] not in '234'}
    names = {path.name for path in folder.iterdir()}
    assert names == {'report.html', 'diagnosis.json', 'model.yaml'} | pictures
    data = json.loads((folder / 'diagnosis.json').read_text(encoding='utf-8'))
    assert data == to_json(example('class'))
    assert [e.name for e in load(folder / 'model.yaml').effects] == ['creep']


def test_pictures_are_not_blank(folder):
    for path in folder.glob('*.png'):
        image = imread(path)[..., :3]
        assert min(image.shape[:2]) > 300, path
        inked = np.any(image < 0.9, axis=-1)
        assert 0.01 < inked.mean() < 0.9, path
        # ink reaches into every half
        h, w = inked.shape
        for half in (inked[: h // 2], inked[h // 2 :], inked[:, : w // 2], inked[:, w // 2 :]):
            assert half.any(), path


def test_page_is_one_file_in_the_order_in_which_it_is_read(html, folder):
    found = outline(html)
    assert [title for title in found.headings if title != 'Warnings'] == [
        'These data cannot tell apart',
        'Error before and after',
        'The residual before and after',
        'What was added',
        'What was not, and why',
        'What remains',
        'Origin',
    ]
    assert set(found.pictures) == {path.stem for path in folder.glob('*.png')}
    assert html.count('<img src="data:image/png;base64,') == len(found.pictures)
    assert not re.search(r'(?:src|href)="(?!data:)', html)
    assert '<link' not in html
    assert '@import' not in html


def test_page_says_what_was_found(html):
    found = example('class')
    # the verdict stands before everything else
    assert html.index(escape(found.sentence)) < html.index('<h2>')
    for text in (
        escape(FORMULA),
        'as given',
        'H refitted',
        'refined',
        'staircase',
        '50 Hz',
        'held out',
        '40 blocks',
        'time_constant',
        '0.01200 ± 0.00040, 0.01000 ± 0.00060',
        'share c_i of each element',
        '10.00 V',
        '75.00 µm',
        'creep explains more',
        'a hold of 10 s after a step',
        'no line, no dependence on v or its rate beyond chance',
        '2 idle stretches',
        'An effect of 0.0200 % of stroke rms',
        'a recorded voltage of another axis',
        'outliers',
        'left out',
        'no repeated periods',
        'other.csv, 120 Hz',
        'doi:10.1109/TMECH.2015.2465868',
    ):
        assert text in html, text
    for row in (found.before, found.refit, found.after):
        assert number(row.overall) in html


def test_page_and_summary_hold_for_every_verdict():
    for verdict in ('named', 'partly_explained', 'unexplained', 'none'):
        found = example(verdict)
        text = diagnosis_page(found, [], [])
        outline(text)
        assert escape(found.sentence) in text
        assert found.sentence in diagnosis_summary(found)
        assert ('the same as the one that was given' in text) == (not found.effects)
        assert ('<h3>Parameters</h3>' in text) == bool(found.effects)


def test_what_is_unknown_is_said():
    found = replace(
        example('none'),
        noise_floor=None,
        noise_source='no repeats',
        smallest_detectable=None,
        candidates=(),
        untestable=(),
        faults=(),
        warnings=(),
        before=Errors(0.5, {}, {}),
        refit=Errors(0.5, {'hold': 0.1}, {}),
        after=Errors(float('nan'), {}, {}),
    )
    text = diagnosis_page(found, [], [('Errors', 'no <segment>')])
    assert 'unknown (no repeats)' in text
    assert 'no &lt;segment&gt;' in text
    assert 'unknown (no repeats)' in diagnosis_summary(found)
    assert 'An effect of' not in text
    drawn = draw_diagnosis(found)
    assert 'Ranking of the candidates' in dict(drawn.left_out)
    with pytest.raises(NothingToDraw, match='no candidate'):
        ranking_figure(found)


def test_everything_foreign_is_harmless(coarse, tmp_path):
    found = hostile()
    page = write_diagnosis_report(found, tmp_path, unseen=[replace(UNSEEN, record=HOSTILE)])
    text = page.read_text(encoding='utf-8')
    outline(text)
    assert '<script' not in text
    assert text.count(escape(HOSTILE)) > 10
    # names in files must not steer a terminal
    assert '\x1b' not in diagnosis_summary(found, [replace(UNSEEN, record=HOSTILE)])
    assert json.loads((tmp_path / 'diagnosis.json').read_text())['records'] == [HOSTILE]


def test_names_that_are_no_text(coarse, tmp_path):
    # of a file whose name is not UTF-8
    page = write_diagnosis_report(replace(example('none'), records=('\udcff.csv',)), tmp_path)
    assert '?.csv' in page.read_text(encoding='utf-8')


def test_an_earlier_report_leaves_no_pictures_behind(coarse, tmp_path):
    for name in ('diagnosis.json', 'residual_3.png', 'mine.png'):
        (tmp_path / name).write_bytes(b'old')
    write_diagnosis_report(example('none'), tmp_path)
    names = {path.name for path in tmp_path.iterdir()}
    assert 'residual_3.png' not in names
    assert 'mine.png' in names
    assert not [name for name in names if name.startswith('.')]


def test_a_folder_that_cannot_be_written(coarse, tmp_path):
    (tmp_path / 'file').write_text('')
    with pytest.raises(DataError, match='choose a folder'):
        write_diagnosis_report(example('none'), tmp_path / 'file')


def test_it_can_be_stopped_before_anything_is_written(coarse, tmp_path):
    def stop(step: str, share: float) -> None:
        if share > 0.5:
            raise Cancelled('stopped')

    with pytest.raises(Cancelled):
        write_diagnosis_report(example('none'), tmp_path / 'report', progress=stop)
    assert list(tmp_path.iterdir()) == []


def test_without_a_refinement_nothing_is_drawn_as_refined():
    (given,), (refined,) = example('unexplained').residuals, example('named').residuals
    assert len(residual_figure(given).axes) == 2
    # on the same scale, and enlarged
    assert len(residual_figure(refined).axes) == 4
    deaf = replace(given, sound=np.zeros(given.piece.n, dtype=bool))
    with pytest.raises(NothingToDraw, match='no sample counts'):
        residual_figure(deaf)
    drawn = draw_diagnosis(replace(example('unexplained'), residuals=(deaf,)))
    assert 'Spectrum of the residual' in dict(drawn.left_out)


def test_errors_in_rows():
    overall, segments, frequencies = error_rows(example('named'))
    assert [row[0] for row in overall] == ['overall']
    # rest and ramps come last
    assert [row[0] for row in segments][-2:] == ['idle', 'ramp']
    assert [row[0] for row in frequencies] == ['5 Hz', '50 Hz']
    found = example('named')
    assert float(overall[0][4]) == pytest.approx(
        found.before.overall / found.after.overall, rel=0.05
    )


def test_values_for_people():
    inf = float('inf')
    for found, text in (
        (FoundParameter(0.5, '1', 0.01), '0.5000 ± 0.010'),
        (FoundParameter(-inf, '1', None), '-∞'),
        (FoundParameter((1.0, 2.0), 's', (0.1, inf)), '1.000 ± 0.10, 2.000'),
        (FoundParameter((1.0, 2.0), 's', 0.1), '1.000, 2.000'),
        (FoundParameter('x', '', None), 'x'),
    ):
        assert value_text(found) == text


def test_what_changed_in_a_model():
    given, refined = base_model(), refined_model()
    assert changes(given, given) == ()
    assert changes(given, refined) == ('with creep',)
    assert changes(refined, given) == ('without creep',)
    # what follows time is not carried over to another record
    idle = EffectSetting('creep', {'gain': [0.0], 'time_constant': [1.0]})
    assert changes(given, replace(given, effects=(idle,))) == ('with creep, switched off',)
    h = given.hysteresis
    dull = Hysteresis(np.append(h.thresholds, 0.9), np.append(h.weights, 0.0), h.p1, h.p2)
    assert changes(replace(given, hysteresis=dull), given) == ()
    other = replace(
        refined,
        hysteresis=Hysteresis(h.thresholds, h.weights, h.p1, h.p2 + 0.1),
        scaling=replace(given.scaling, y0=1e-9),
        effects=(EffectSetting('creep', {'gain': [0.01], 'time_constant': [1.0]}),),
    )
    assert changes(refined, other) == ('H refitted', 'offset refitted', 'creep refitted')
