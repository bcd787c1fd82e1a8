# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What the jobs of the identifier say beside the numbers."""

from dataclasses import replace
import json

from axes_scanner import play, scanner, sweeps
import numpy as np
from piezo_ident.common.errors import DataError
from piezo_ident.common.files import parse_yaml
from piezo_ident.diagnosis import DiagnosisSettings
from piezo_ident.excitation.program import parse_program
from piezo_ident.identification.results import Settings
from piezo_ident.live.capture import Capture
from piezo_ident.model.axes_file import from_dict
from piezo_ident.model.multi_axis import MultiAxisModel
from piezo_ident.model.simulated_stage import SimulatedStage
from piezo_ident.nodes.identifier.jobs import diagnose_capture, identify_capture, percent_of
from piezo_ident.record.blocks import Samples
from programs import identification_program
import pytest

STAGE = SimulatedStage.load('paper')


@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_a_displacement_that_has_changed_its_sign_is_told(sign):
    program = identification_program(steps=8, cycles=4, frequency=100, noise=0.5, slope=100)
    (piece,) = STAGE.play(parse_program(program).build(), np.random.default_rng(0))
    capture = Capture()
    for s in piece.segments:
        rows = slice(s.start, s.stop)
        for key, x in (('voltage', piece.v), ('displacement', sign * piece.y)):
            capture.add(key, Samples(piece.t[rows], x[rows], s.label, key), s.start)
    settings = Settings(thresholds=3, max_order=2, solver='swarm', swarm_size=4)
    settings = replace(settings, swarm_iterations=100)
    outcome = identify_capture(
        capture.snapshot(), settings, 'all', None, STAGE.model, (), lambda *_: None
    )
    told = [w for w in json.loads(outcome.report)['warnings'] if 'sign' in w]
    assert len(told) == (sign < 0.0)
    if told:
        assert (
            outcome.warnings and f'{1e6 * outcome.identification.model.scaling.Y:.4g}' in told[0]
        )


def captured(record, axes=('', '_b')):
    """Return a capture with the streams of a record of several axes."""
    capture = Capture()
    (piece,) = record
    columns = {**piece.channels, 'v': piece.v, 'y': piece.y}
    for tail in axes:
        for key, name in (('voltage', 'v'), ('displacement', 'y')):
            samples = Samples(piece.t, columns[f'{name}{tail}'], 'sweep', f'{key}{tail}')
            capture.add(f'{key}{tail}', samples, 0)
    return capture.snapshot()


def test_several_axes_are_identified_as_by_the_front_door():
    rng = np.random.default_rng(0)
    first, rest = sweeps(2000, rng), np.zeros(2000)
    record = play(np.append(first, rest), np.append(rest, sweeps(2000, rng)))
    settings, steps = Settings(thresholds=6, max_order=2), []
    done = identify_capture(
        captured(record), settings, 'all', None, None, ('b',), lambda *step: steps.append(step)
    )
    assert list(done.identification) == ['y', 'y_b']
    model = from_dict(parse_yaml(done.model, 'it'), 'it')
    assert list(model.axes) == list(json.loads(done.report)['axes']) == ['y', 'y_b']
    assert {'error_percent', 'error_percent_b'} <= done.figures.keys()
    assert done.message.count('the model errs by') == 2 and 'y_b: ' in done.message
    # the second axis begins where the first ended
    percents = [percent_of(*step, ['y', 'y_b']) for step in steps if ': ' in step[0]]
    assert 0.0 < percents[0] < 50.0 < percents[-1] < 100.0


def test_several_axes_are_diagnosed_as_by_the_front_door():
    rng = np.random.default_rng(1)
    given = MultiAxisModel({axis: scanner().own(axis) for axis in ('y', 'y_b')})
    few = DiagnosisSettings(effects=('cross_coupling', 'backlash'))
    both = captured(play(sweeps(2500, rng), sweeps(2500, rng)))
    told = diagnose_capture(both, given, ('sweeps', 'holds'), few, lambda *_: None)
    refined = from_dict(parse_yaml(told.model, 'it'), 'it')
    for axis, source in (('y', 'motion_b'), ('y_b', 'motion')):
        (effect,) = refined.axes[axis].effects
        assert (effect.name, effect.channel) == ('cross_coupling', source)
    assert float(told.figures['after_percent_b']) < float(told.figures['before_percent_b'])
    # nothing moves: there is nothing to diagnose
    still = diagnose_capture(captured(play(*np.zeros((2, 500)))), given, (), few, lambda *_: None)
    assert still.diagnosis is None and still.wanted is not None


def test_an_axis_that_was_not_captured_is_named():
    record = play(sweeps(500, np.random.default_rng(0)), np.zeros(500))
    with pytest.raises(DataError, match='voltage_b, displacement_b'):
        identify_capture(
            captured(record, ('',)), Settings(), 'all', None, None, ('b',), lambda *_: None
        )
