# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The report folder of both kinds of result: whole, harmless, and careful with other files."""

from dataclasses import replace
from html import escape
from html.parser import HTMLParser
import json
import re

from diagnosis_examples import example, HOSTILE, hostile
from matplotlib.image import imread
import numpy as np
import piezo_ident as pi
from piezo_ident.diagnosis.results import Diagnosis, Unseen
from piezo_ident.report import check_report_folder, headline, to_json
from piezo_ident.report.diagnosis import headline as diagnosis_headline
from piezo_ident.report.folder import PICTURES
import pytest

UNSEEN = Unseen('other.csv', 0.8, 0.1, 0.7, 0.05, 20_000, ((1.0, 0.9, 0.2), (120.0, 3.2, 0.3)))


class Outline(HTMLParser):
    """The pictures and cells of a page; fails where a tag is not closed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.pictures: list[str] = []
        self.cells: set[str] = set()
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        if tag == 'figure':
            self.pictures.append(dict(attrs)['id'])
        if tag not in ('meta', 'img'):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] in ('td', 'dd'):
            self.cells.add(data)


@pytest.fixture(scope='module')
def folders(identified, tmp_path_factory):
    """Return a result of each kind with its report."""
    diagnosis = replace(example('class'), unseen=(UNSEEN,))
    result = []
    for each in (identified, diagnosis):
        folder = tmp_path_factory.mktemp('out') / 'deep' / 'report'
        assert pi.write_report(each, folder) == folder / 'report.html'
        result.append((each, folder))
    return result


def test_folder_is_whole(folders):
    names = ['identification.json', 'diagnosis.json']
    for (result, folder), numbers in zip(folders, names, strict=True):
        last = {'_3', '_4'} if result is folders[0][0] else {'_2', '_3', '_4'}
        pictures = {name for name in PICTURES[type(result)] if name[-2:] not in last}
        expected = {'report.html', 'model.yaml', numbers, *(f'{name}.png' for name in pictures)}
        assert {path.name for path in folder.iterdir()} == expected
        model = pi.load(folder / 'model.yaml')
        assert np.array_equal(model.hysteresis.weights, result.model.hysteresis.weights)
        assert [e.name for e in model.effects] == [e.name for e in result.model.effects]
        data = json.loads((folder / numbers).read_text(encoding='utf-8'))
        expected = to_json(result)
        assert {**data, 'sines': None} == {**expected, 'sines': None}


def test_pictures_are_not_blank(folders):
    for path in [path for _, folder in folders for path in folder.glob('*.png')]:
        image = imread(path)[..., :3]
        assert min(image.shape[:2]) > 300, path
        inked = np.any(image < 0.9, axis=-1)
        assert 0.01 < inked.mean() < 0.9, path
        h, w = inked.shape
        for half in (inked[: h // 2], inked[h // 2 :], inked[:, : w // 2], inked[:, w // 2 :]):
            assert half.any(), path


def test_page_is_one_file_with_every_picture(folders):
    for _, folder in folders:
        html = (folder / 'report.html').read_text(encoding='utf-8')
        page = Outline(html)
        assert set(page.pictures) == {path.stem for path in folder.glob('*.png')}
        assert html.count('<img src="data:image/png;base64,') == len(page.pictures)
        assert not re.search(r'(?:src|href)="(?!data:)', html)
        assert '<link' not in html
        assert '@import' not in html


def test_page_is_legible_on_a_phone_and_in_the_dark(folders):
    html = (folders[0][1] / 'report.html').read_text(encoding='utf-8')
    # a picture scrolls rather than shrinks to illegible letters
    widths = re.findall(r'width="(\d+)" style="min-width: (\d+)px"', html)
    assert len(widths) == len(Outline(html).pictures)
    assert all(0.6 * int(width) < int(least) <= int(width) for width, least in widths)
    # what is dark in one scheme is light in the other: text has no colour of its own
    style = html[html.index('body {') : html.index('</style>')]
    assert 'prefers-color-scheme: dark' in html
    assert not re.search(r'[{;\s]color: #', style)
    # an empty line of headings is none
    assert not re.search(r'<thead>\s*<tr>(?:\s*<th[^>]*></th>)+\s*</tr>', html)


def test_page_begins_with_the_headline(folders):
    for (result, folder), text in zip(folders, (headline, diagnosis_headline), strict=True):
        html = (folder / 'report.html').read_text(encoding='utf-8')
        assert html.index(str(escape(text(result))).replace('&quot;', '&#34;')) < html.index(
            '<h2>'
        )


def test_everything_foreign_is_harmless(folders, coarse, tmp_path):
    page = pi.write_report(replace(hostile(), unseen=(replace(UNSEEN, record=HOSTILE),)), tmp_path)
    for path, most in ((folders[0][1] / 'report.html', 5), (page, 10)):
        text = path.read_text(encoding='utf-8')
        Outline(text)
        assert '<script' not in text
        assert text.count('&lt;script&gt;alert(&#34;$x^$&#34;)&lt;/script&gt;') > most
    assert json.loads((tmp_path / 'diagnosis.json').read_text())['records'] == [HOSTILE]


def test_names_that_are_no_text(coarse, tmp_path):
    # of a file whose name is not UTF-8
    page = pi.write_report(replace(example('none'), records=('\udcff.csv',)), tmp_path)
    assert '?.csv' in page.read_text(encoding='utf-8')


def test_missing_steps_and_pictures_are_listed(unlabelled, blank_pictures, tmp_path):
    result = replace(unlabelled, not_identified=(('delay', 'no <step>'),))
    html = pi.write_report(result, tmp_path).read_text(encoding='utf-8')
    assert 'delay: no &lt;step&gt;' in html
    for title in ('Orders of G: ', 'Delay: ', 'Error over frequency: ', 'Segments: '):
        assert f'<li>{title}' in html
    assert (tmp_path / 'overview_1.png').exists()
    assert 'not identified' in Outline(html).cells


def test_an_earlier_report_is_replaced_and_other_files_stay(unlabelled, blank_pictures, tmp_path):
    for result, old in ((unlabelled, 'orders.png'), (example('none'), 'residual_3.png')):
        folder = tmp_path / old
        folder.mkdir()
        numbers = 'identification.json' if result is unlabelled else 'diagnosis.json'
        for name in (numbers, 'model.yaml', old, 'mine.png'):
            (folder / name).write_bytes(b'old')
        pi.write_report(result, folder)
        names = {path.name for path in folder.iterdir()}
        assert old not in names
        assert not [name for name in names if name.startswith('.')]
        assert (folder / 'mine.png').read_bytes() == b'old'
        assert pi.load(folder / 'model.yaml').sample_rate == result.model.sample_rate


@pytest.mark.parametrize('name', ['model.yaml', 'errors.png', 'residual_3.png', 'report.html'])
def test_a_file_of_no_report_stays(blank_pictures, tmp_path, name):
    (tmp_path / name).write_text('mine')
    with pytest.raises(pi.DataError, match=name):
        check_report_folder(tmp_path, Diagnosis)
    with pytest.raises(pi.DataError, match=name):
        pi.write_report(example('none'), tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_text() == 'mine'


def test_a_folder_that_cannot_be_written(blank_pictures, tmp_path):
    taken = tmp_path / 'file'
    taken.write_text('', encoding='utf-8')
    for folder in (taken, taken / 'below'):
        with pytest.raises(pi.DataError, match='file'):
            pi.write_report(example('none'), folder)


def test_it_can_be_stopped_before_anything_is_written(blank_pictures, tmp_path):
    def stop(step: str, share: float) -> None:
        if share > 0.5:
            raise pi.Cancelled('stopped')

    with pytest.raises(pi.Cancelled):
        pi.write_report(example('none'), tmp_path / 'report', progress=stop)
    assert list(tmp_path.iterdir()) == []
