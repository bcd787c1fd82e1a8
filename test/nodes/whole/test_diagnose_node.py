# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The hysteresis of a stage depends on the rate, and nobody tells the identifier: it finds out.

The stage is identified and then diagnosed from nothing: what data that takes, the identifier asks
for on the running graph.
"""

import json

from course import paper, SETTINGS
import numpy as np
from programs import identification_program
import pytest

pytest.importorskip('rclpy', reason='rclpy cannot be imported: no ROS here')

from graph import ENDS, Graph
from piezo_ident.common.config import find_config
from piezo_ident.common.files import parse_yaml
from piezo_ident.excitation.program import parse_program
from piezo_ident.model.files import load, model_from_dict
import yaml

TRUTH = 'rate_dependent_hysteresis'
#: a quarter of the usual rate is enough for what is told apart here
FS = 5000.0
LEARN = identification_program(
    rate=5000, steps=8, cycles=8, frequency=20, cutoff=1500, noise=1, slope=40
)
#: eight seconds with two amplitudes, minor loops and a multisine, but no hold
SWEEPS = """
limits: [0, 10]
seed: 3
slew: 80
segments:
  - {signal: idle, duration: 1}
  - {signal: sine, name: 1Hz-first, bias: 5, amplitude: 5, frequency: 1, periods: 2}
  - {signal: sine, name: 80Hz-large, bias: 5, amplitude: 4.5, frequency: 80, duration: 0.4}
  - {signal: sine, name: 80Hz-small, bias: 5, amplitude: 1.5, frequency: 80, duration: 0.4}
  - {signal: minor_loops, biases: [2.5, 5, 7.5], amplitude: 1.5, cycles: 1, slope: 40}
  - signal: multisine
    bias: 5
    amplitude: 4.5
    lowest: 2
    highest: 200
    period: 0.5
    periods: 2
  - {signal: sine, name: 1Hz-last, bias: 5, amplitude: 5, frequency: 1, periods: 1}
  - {signal: idle, duration: 1}
"""
#: nine seconds, most of them at rest
HOLDS = """
limits: [0, 10]
slew: 200
segments:
  - {signal: idle, duration: 1}
  - {signal: hold, level: 5, duration: 1}
  - {signal: hold, level: 10, duration: 3}
  - {signal: hold, level: 5, duration: 2}
  - {signal: idle, duration: 2}
"""
IDENTIFIER = {
    **SETTINGS,
    'program': LEARN,
    'sweeps_program': SWEEPS,
    'holds_program': HOLDS,
    'nice': 0,
}
#: a diagnosis on a machine that does other things [s]
LONG = 240.0


@pytest.fixture(scope='module')
def lab(tmp_path_factory):
    """Return a graph with the stage, the identifier and all that they need."""
    data = yaml.safe_load(find_config('effects', 'stage').read_text())
    data['effects'] = [e for e in data['effects'] if e['name'] == TRUTH]
    data |= {'sample_rate': FS, 'dynamics': {'a': [-1.2, 0.5], 'b': [0.13, 0.06]}}
    path = tmp_path_factory.mktemp('stage') / 'stage.yaml'
    path.write_text(yaml.safe_dump(data))
    excitation = {'sample_rate': FS, 'rate_factor': 4.0, 'program': LEARN, 'subscribers': 3}
    with Graph() as g:
        g.start_all(
            # longer than a busy machine keeps a program from its next block
            ('stage', {'stage': str(path), 'seed': 3, 'silence': 5.0}),
            ('excitation', excitation),
            ('identifier', IDENTIFIER),
            ('model',),
        )
        g.matched('residual')
        g.texts('model')
        g.texts('report')
        yield g


def begin(g, service):
    """Call a service of the identifier, and return how much of its status was heard before."""
    seen = len(g.statuses('identifier'))
    ok, message = g.call(f'identifier/{service}')
    assert ok, message
    return seen


def end_of(g, seen):
    """Wait for the end of what the identifier does, and return all that it said until then."""
    last = g.until('identifier', *ENDS, since=seen, timeout=LONG)
    said = g.statuses('identifier')[seen:]
    return said[: said.index(last) + 1]


def rms(blocks):
    """Return the rms of a residual in % of the stroke of 71 um."""
    e = np.concatenate([b.values for b in blocks])
    return 100.0 * float(np.sqrt(np.mean(e**2))) / 71e-6


def play(g, program):
    """Have a program played while nobody asks for it, and return its residual."""
    residual = g.collect('residual')
    samples = len(residual)
    assert g.set('excitation', 'program', program) == (True, '')
    assert g.finish('excitation/start')['state'] == 'done'
    end = parse_program(program).build(FS).duration
    g.wait(lambda: abs(residual[-1].t[-1] - end) < 2 / FS, 'its last residual')
    return residual[samples:]


@pytest.fixture(scope='module')
def story(lab):
    """Return what the identifier said from ~/diagnose on; it was only told to ~/run."""
    ok, reason = lab.call('identifier/diagnose')
    assert not ok and 'no model to diagnose' in reason
    assert end_of(lab, begin(lab, 'run'))[-1]['state'] == 'done'
    lab.wait(lambda: lab.texts('model'), 'the model')
    lab.wait(lambda: lab.status('model')['state'] == 'predicting', 'the model to be taken over')
    return end_of(lab, begin(lab, 'diagnose'))


def test_it_asks_for_what_it_lacks_and_names_the_rate_dependence(lab, story):
    assert story[-1]['state'] == 'done', story[-1]
    exciting = [s['text'] for s in story if s['state'] == 'exciting']
    # how much was captured follows
    asked = list(dict.fromkeys(': '.join(m.split(': ')[:2]) for m in exciting))
    assert [a.split(':')[0] for a in asked] == ['asking for sweeps', 'asking for holds']
    assert TRUTH in asked[1] and 'hold' in asked[1]
    assert {s['state'] for s in story} == {'exciting', 'diagnosing', 'done'}
    report = json.loads(lab.texts('report')[-1])
    assert report['records'] == ['capture 1', 'capture 2']
    assert (report['verdict'], [e['name'] for e in report['effects']]) == ('named', [TRUTH])
    count = len(report['warnings']) + len(report['data_faults'])
    caveats = f'; {count} warning{"s" * (count > 1)} in the report' if count else ''
    assert story[-1]['text'] == report['sentence'].rstrip('.') + caveats
    error = report['error']
    assert error['after']['overall'] < 0.3 * error['before']['overall']


def test_the_residual_falls_when_the_refined_model_is_taken_over(lab, story):
    models = lab.texts('model')
    assert len(models) == 2
    first, refined = (model_from_dict(parse_yaml(text, TRUTH)) for text in models)
    assert not first.effects and [e.name for e in refined.effects] == [TRUTH]
    lab.wait(lambda: lab.status('model')['models'] == '2', 'the refined model')
    residual = lab.collect('residual')
    starts = [i for i, b in enumerate(residual) if b.t[0] == 0.0]
    # sweeps and holds were played with the first model
    before = rms(residual[starts[-2] : starts[-1]])
    after = rms(play(lab, SWEEPS))
    print(f'residual {before:.3f} -> {after:.3f} % of stroke')
    assert after < 0.3 * before


def test_save_writes_both_reports(lab, story, tmp_path):
    assert lab.set('identifier', 'output', str(tmp_path / 'out'))[0]
    last = end_of(lab, begin(lab, 'save'))[-1]
    assert last['state'] == 'done' and last['text'].count('report.html') == 2, last
    folder = tmp_path / 'out'
    assert not load(folder / 'model.yaml').effects
    assert [e.name for e in load(folder / 'diagnosis/model.yaml').effects] == [TRUTH]
    written = json.loads((folder / 'diagnosis/diagnosis.json').read_text())
    assert written == json.loads(lab.texts('report')[-1])
    assert (folder / 'diagnosis/report.html').is_file()


def test_cancel_stops_the_work_and_changes_nothing(lab, story):
    models, reports = len(lab.texts('model')), len(lab.texts('report'))
    seen = begin(lab, 'diagnose')
    lab.wait(
        lambda: any(s['text'] == 'candidates' for s in lab.statuses('identifier')[seen:]),
        'the candidates',
        LONG,
    )
    ok, reason = lab.call('identifier/diagnose')
    assert not ok and 'busy: diagnosis' in reason
    assert lab.call('identifier/cancel')[0]
    last = end_of(lab, seen)[-1]
    assert last['state'] == 'cancelled' and 'nothing was changed' in last['text']
    assert (len(lab.texts('model')), len(lab.texts('report'))) == (models, reports)


def test_cancel_ramps_what_was_asked_for_to_rest(lab, story):
    assert lab.call('identifier/clear')[0]
    assert lab.set('excitation', 'rate_factor', 1.0) == (True, '')
    seen = len(lab.statuses('excitation'))
    begin(lab, 'diagnose')
    lab.wait(
        lambda: any(
            s.get('segment') == 'sine:1Hz-first' for s in lab.statuses('excitation')[seen:]
        ),
        'the sine',
    )
    assert lab.call('identifier/cancel')[0]
    lab.wait(lambda: lab.status('identifier')['state'] == 'cancelled', 'cancelled')
    lab.wait(lambda: lab.status('excitation')['state'] == 'stopped', 'stopped')
    assert lab.call('identifier/clear')[0]
    assert lab.set('identifier', 'requests', 0) == (True, '')
    ok, reason = lab.call('identifier/diagnose')
    assert not ok and 'nothing was captured' in reason and '0 requests' in reason


def test_a_model_file_can_be_judged_too(lab, tmp_path):
    file = tmp_path / 'model.yaml'
    file.write_text(paper())
    lab.start('identifier', {'model': str(file), 'excitation_limit': 1.0}, 'alone')
    ok, reason = lab.call('alone/identifier/diagnose')
    assert not ok and 'nothing was captured' in reason
    # an empty path takes the file away
    assert lab.set('alone/identifier', 'model', '') == (True, '')
    ok, reason = lab.call('alone/identifier/diagnose')
    assert not ok and 'there is no model to diagnose' in reason
