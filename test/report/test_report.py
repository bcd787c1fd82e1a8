# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The report of a simulated stage: what it says, that it is whole, and that it is safe to open."""

from dataclasses import replace
from html import escape
import json
from pathlib import Path
import re
import subprocess
import sys

from matplotlib.image import imread
import numpy as np
from piezo_ident.common.errors import ConfigError, DataError
from piezo_ident.excitation.program import parse_program
from piezo_ident.identification.identify import identify
from piezo_ident.identification.results import Settings
from piezo_ident.model.files import load
from piezo_ident.model.free_run import free_run, SineError
from piezo_ident.model.simulated_stage import SimulatedStage
from piezo_ident.record.record import Fault, Record, Segment
from piezo_ident.report import (
    error_table_for_sines,
    table_one,
    text_summary,
    to_json,
    verdict,
    write_report,
)
from piezo_ident.report.figures import NAMES, write_prediction_plot
from piezo_ident.report.figures.style import envelope, safe
from piezo_ident.report.numbers import modes, number
import pytest

CONFIG = Path(__file__).resolve().parents[2] / 'config'

HOSTILE = '<script>alert("$x^$")</script>\x1b[31m'

IDENTIFICATION = """
limits: [0, 10]
seed: 1
slew: 100
segments:
  - {signal: idle, duration: 0.1}
  - {signal: step, bias: 5, size: 1, hold: 0.03, count: 6}
  - {signal: settle, bias: 5, amplitude: 0.48, cycles: 8, frequency: 20}
  - {signal: noise, bias: 5, amplitude: 0.4, cutoff: 3000, duration: 1}
  - {signal: triangle, slope: 30}
  - {signal: idle, duration: 0.1}
"""

VALIDATION = """
limits: [0, 10]
slew: 100
segments:
  - {signal: idle, duration: 0.05}
  - {signal: sine, bias: 5, amplitude: 5, frequency: 20, duration: 1.2}
  - {signal: sine, bias: 5, amplitude: 5, frequency: 100, duration: 1.2}
  - {signal: idle, duration: 0.05}
"""


def measured(text: str, name: str) -> Record:
    stage = SimulatedStage.load(CONFIG / 'stage_paper.yaml')
    sequence = parse_program(text, name).build(20_000.0)
    return stage.play(sequence, np.random.default_rng(5), name)


def relabelled(record: Record, old: str, new: str) -> Record:
    (piece,) = record.pieces
    segments = tuple(
        Segment(new if s.label == old else s.label, s.start, s.stop) for s in piece.segments
    )
    return replace(record, pieces=(replace(piece, segments=segments),))


@pytest.fixture(scope='module')
def records():
    first = measured(IDENTIFICATION, 'identification')
    second = relabelled(measured(VALIDATION, HOSTILE), 'idle', HOSTILE)
    fault = Fault('repeats', f'in {HOSTILE}', 3, 'dropped')
    return [first, replace(second, faults=(fault,))]


@pytest.fixture(scope='module')
def found(records):
    return identify(records, Settings(max_order=8, thresholds=10, solver='swarm'))


@pytest.fixture(scope='module')
def folder(found, records, tmp_path_factory):
    path = write_report(found, records, tmp_path_factory.mktemp('out') / 'deep' / 'report')
    assert path.name == 'report.html'
    return path.parent


@pytest.fixture(scope='module')
def html(folder):
    return (folder / 'report.html').read_text(encoding='utf-8')


@pytest.fixture(scope='module')
def unlabelled():
    record = measured(VALIDATION, 'bare')
    (piece,) = record.pieces
    slow = replace(piece.cut(0, 24_000), segments=())
    record = replace(record, pieces=(slow,))
    found = identify(record, Settings(thresholds=10, delay=3, order=(1, 1)))
    return found, record


def test_folder_is_whole(folder):
    pictures = {f'{name}.png' for name in NAMES if not name.startswith('overview')}
    pictures |= {'overview_1.png', 'overview_2.png'}
    expected = {'report.html', 'identification.json', 'model.yaml'} | pictures
    assert {path.name for path in folder.iterdir()} == expected


def test_pictures_are_not_blank(folder):
    for path in folder.glob('*.png'):
        image = imread(path)[..., :3]
        assert min(image.shape[:2]) > 300, path
        inked = np.any(image < 0.9, axis=-1)
        assert 0.01 < inked.mean() < 0.9, path
        # ink reaches into every quarter
        h, w = inked.shape
        for rows in (slice(0, h // 2), slice(h // 2, h)):
            for columns in (slice(0, w // 2), slice(w // 2, w)):
                assert inked[rows, columns].any(), path


def test_page_embeds_every_picture_and_loads_nothing(html, folder):
    assert html.count('<img src="data:image/png;base64,') == len(list(folder.glob('*.png')))
    assert not re.search(r'(?:src|href)="(?!data:)', html)
    assert '<link' not in html
    assert '@import' not in html


def test_page_escapes_what_is_foreign(html):
    assert '<script' not in html
    assert '&lt;script&gt;alert(&quot;$x^$&quot;)&lt;/script&gt;' in html


def test_page_says_what_was_found(html, found):
    assert escape(verdict(found)) in html
    for text in (
        '100 rms(y - y_hat) / (max y - min y)',
        'held out',
        'selection',
        'fitted',
        'hysteresis alone',
        'NRMSE fit',
        'Poles of G as modes',
        'instrumental variables',
        'particle swarm',
        'evaluations',
        '0.6411',
        'Faults in the data',
        'repeats',
        'doi:10.1109/TMECH.2015.2465868',
        '3 ± 0.29 samples',
    ):
        assert text in html, text


def test_page_tells_warnings_and_what_is_missing(unlabelled, tmp_path):
    found, record = unlabelled
    found = replace(found, not_identified=(('delay', 'no <step>'),))
    page = write_report(found, record, tmp_path).read_text(encoding='utf-8')
    assert 'no segments labelled noise and triangle' in page
    assert 'delay: no &lt;step&gt;' in page
    assert 'Pictures that these data do not allow' in page
    for reason in (
        'Orders of G: orders are compared on a noise segment, and there is none',
        'Delay: the delay was given, not measured',
        'Error over frequency: no segment is labelled',
        'Segments: no segment is labelled with a kind of the programmes',
    ):
        assert reason in page
    assert 'overview_1.png' in {path.name for path in tmp_path.iterdir()}


def test_an_earlier_report_leaves_no_pictures_behind(unlabelled, tmp_path):
    found, record = unlabelled
    (tmp_path / 'identification.json').write_text('{}')
    (tmp_path / 'orders.png').write_bytes(b'old')
    (tmp_path / 'mine.png').write_bytes(b'mine')
    write_report(found, record, tmp_path)
    names = {path.name for path in tmp_path.iterdir()}
    assert 'orders.png' not in names
    assert 'mine.png' in names
    assert not [name for name in names if name.startswith('.')]


@pytest.mark.parametrize('name', ['model.yaml', 'orders.png', 'sines.png', 'report.html'])
def test_what_is_of_no_report_stays(unlabelled, tmp_path, name):
    (tmp_path / name).write_text('mine')
    with pytest.raises(DataError, match=f'{name}: is there already, and of no earlier report'):
        write_report(*unlabelled, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_text() == 'mine'


def test_numbers_are_strict_json(folder, found, records):
    def refuse(constant: str) -> float:
        raise ValueError(constant)

    text = (folder / 'identification.json').read_text(encoding='utf-8')
    data = json.loads(text, parse_constant=refuse)
    assert data['delay']['samples'] == 3
    assert data['delay']['seconds'] == pytest.approx(150e-6)
    assert data['dynamics']['order'] == list(found.dynamics.order)
    assert len(data['dynamics']['a_std']) == len(data['dynamics']['a'])
    assert data['errors']['held_out'] == pytest.approx(found.error('held out'))
    assert len(data['errors']['rows']) == len(found.errors)
    assert [row['frequency'] for row in data['sines']] == [20.0, 100.0]
    assert data['data_faults'][0]['count'] == 3
    assert data['records'] == [record.name for record in records]
    assert data['hysteresis']['thresholds_volt'][0] == pytest.approx(1.0)


def test_what_is_unknown_is_null(found):
    rows = (replace(found.errors[0], fit=float('-inf'), percent=float('nan')),)
    delay = replace(found.delay, std=float('inf'))
    data = to_json(replace(found, errors=rows, delay=delay, noise_floor=None))
    json.dumps(data, allow_nan=False)
    assert data['errors']['rows'][0]['fit'] is None
    assert data['errors']['selection'] is None
    assert data['delay']['std'] is None
    assert data['noise_floor']['percent_of_stroke'] is None


def test_model_is_copied(folder, found):
    model = load(folder / 'model.yaml')
    assert np.array_equal(model.hysteresis.weights, found.model.hysteresis.weights)


def test_a_folder_that_cannot_be_written(unlabelled, tmp_path):
    taken = tmp_path / 'file'
    taken.write_text('', encoding='utf-8')
    with pytest.raises(DataError, match='choose a folder'):
        write_report(*unlabelled, taken)
    with pytest.raises(DataError, match='choose a folder'):
        write_report(*unlabelled, taken / 'below')


def test_summary_for_a_terminal(found):
    text = text_summary(found)
    assert 'sine:100Hz, held out' in text
    assert '71.3' in text
    assert 'warning: ' in text
    assert '\x1b' not in text
    assert text.startswith('On data it did not fit, the model errs by')


def test_verdict_does_not_boast_with_rest_and_ramps(found):
    rows = tuple(row for row in found.errors if row.record == 'identification')
    assert verdict(replace(found, errors=rows)).startswith(
        'On the parts of steps, noise and triangle'
    )
    rows = tuple(row for row in rows if row.data == 'fitted')
    assert verdict(replace(found, errors=rows)).startswith('Nothing was held out')


def test_table_of_sines(found, records):
    rows = [SineError(1.0, 1.03, 1.03, 10), SineError(120.0, 3.59, 10.06, 10)]
    lines = table_one(rows).splitlines()
    assert lines[0].split() == ['frequency', '/', 'Hz', '1', '120']
    assert lines[1].split()[-2:] == ['1.03', '3.59']
    assert lines[2].split()[-2:] == ['1.03', '10.1']
    assert '100 rms(y - y_hat) / (max y - min y)' in lines[3]
    assert 'no sine segment' in table_one([])
    assert error_table_for_sines(found.model, records).split()[3:5] == ['20', '100']


def test_modes_and_their_uncertainty():
    model = SimulatedStage.load(CONFIG / 'stage_paper.yaml').model
    G, n = model.dynamics, model.dynamics.a.size
    rng = np.random.default_rng(2)
    root = 1e-7 * rng.standard_normal((n, n))
    covariance = np.zeros((2 * n, 2 * n))
    covariance[:n, :n] = root @ root.T
    given = [m for m in modes(G, model.sample_rate, covariance) if m.oscillates]
    expected = np.array(G.modes(model.sample_rate))
    assert np.allclose([(m.frequency, m.damping) for m in given], expected)
    # against a sample of models drawn from that covariance
    draws = [
        [m[0] for m in replace(G, a=G.a + root @ rng.standard_normal(n)).modes(model.sample_rate)]
        for _ in range(2000)
    ]
    assert [m.frequency_std for m in given] == pytest.approx(np.std(draws, axis=0), rel=0.1)


@pytest.mark.parametrize(
    ('value', 'text'),
    [
        (None, '–'),
        (float('nan'), '–'),
        (float('inf'), '∞'),
        (0.0, '0'),
        (0.00323456, '0.00323'),
        (12.3456, '12.3'),
        (-1234.5, '-1234'),
        (3.2e-7, '3.20e-07'),
    ],
)
def test_numbers_for_people(value, text):
    assert number(value) == text


def test_decimated_traces_keep_their_extremes():
    y = np.sin(np.arange(300_007) / 50.0)
    y[123_456], y[300_006] = 9.0, -7.0
    k = envelope(y)
    assert k.size < 3100
    assert {0, 123_456, 300_006} <= set(k.tolist())
    assert np.all(np.diff(k) > 0)
    # every stretch between drawn samples lies within what is drawn around it
    assert y[k].max() == 9.0
    assert y[k].min() == -7.0
    assert np.array_equal(envelope(y[:100]), np.arange(100))


def test_labels_in_pictures_are_plain_text():
    assert safe('a$b\x07') == r'a\$b?'
    assert len(safe('x' * 500)) == 60


def test_prediction_picture(found, records, tmp_path):
    run = free_run(found.model, records[1])
    write_prediction_plot(run, tmp_path / 'p.png')
    assert np.any(imread(tmp_path / 'p.png')[..., :3] < 0.5)
    write_prediction_plot(run, tmp_path / 'p.svg')
    with pytest.raises(ConfigError, match=r'\.png'):
        write_prediction_plot(run, tmp_path / 'p.gif')
    with pytest.raises(DataError, match='cannot be written'):
        write_prediction_plot(run, tmp_path / 'nowhere' / 'p.png')


def test_pictures_leave_global_settings_alone():
    code = (
        'import sys; import piezo_ident.report; print("matplotlib" in sys.modules); '
        'import piezo_ident.report.figures; print("matplotlib.pyplot" in sys.modules)'
    )
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ['False', 'False']
