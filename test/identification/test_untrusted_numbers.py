# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Numbers that cannot be trusted are refused, or give a model without NaN; never a traceback."""

from dataclasses import replace
from functools import cache
import math

import numpy as np
from piezo_ident.common.errors import DataError, ModelError, PiezoIdentError
from piezo_ident.excitation.program import parse_program
from piezo_ident.identification.identify import identify
from piezo_ident.identification.results import Settings
from piezo_ident.model.files import model_from_dict, model_to_dict
from piezo_ident.model.free_run import free_run
from piezo_ident.model.simulated_stage import Sensor, SimulatedStage
from piezo_ident.record.assemble import assemble
from piezo_ident.record.record import Piece, Record
import pytest

RATE = 2000.0
SETTINGS = Settings(order=(2, 2), solver='least_squares', thresholds=5)
PROGRAM = """
limits: [0, 10]
seed: 1
slew: 40
segments:
  - {signal: idle, duration: 0.3}
  - {signal: step, bias: 5, size: 1, hold: 0.15, count: 6}
  - {signal: settle, bias: 5, amplitude: 0.48, cycles: 10}
  - {signal: noise, bias: 5, amplitude: 0.4, cutoff: 600, duration: 3}
  - {signal: triangle, slope: 20}
"""


def stage() -> SimulatedStage:
    """Return the stage of all cases."""
    model = model_from_dict(
        {
            'sample_rate': RATE,
            'input': {'v0': 0.0, 'V': 10.0, 'range': [0, 10]},
            'output': {'y0': 0.0, 'Y': 75e-6},
            'delay': {'samples': 3},
            'hysteresis': {
                'thresholds': [0.1, 0.2, 0.4, 0.6, 0.8],
                'weights': [0.2, 0.1, 0.1, 0.05, 0.05],
                'p1': -0.1,
                'p2': 0.6,
            },
            'dynamics': {'a': [-1.2, 0.5], 'b': [0.2, 0.1]},
        }
    )
    return SimulatedStage(model, Sensor(noise_rms=2e-9))


@cache
def sound() -> Record:
    sequence = parse_program(PROGRAM).build(RATE)
    return stage().play(sequence, np.random.default_rng(0))


def changed(piece: Piece, kind: str, level: float) -> Piece:
    """Hold the voltage in the segments of a kind; the stage responds to that."""
    v = piece.v.copy()
    for segment in piece.find(kind):
        v[segment.start : segment.stop] = level
    return replace(piece, v=v, y=stage().run(np.random.default_rng(0)).process(v))


def noise(piece: Piece) -> np.ndarray:
    return np.random.default_rng(3).standard_normal(piece.n)


REFUSED = {
    'volts denormal': lambda p: replace(p, v=1e-310 * p.v),
    'volts x 1e300': lambda p: replace(p, v=1e300 * p.v),
    'metres x 1e-12': lambda p: replace(p, y=1e-12 * p.y),
    'metres x 1e6': lambda p: replace(p, y=1e6 * p.y),
    'volts offset by 1e12': lambda p: replace(p, v=p.v + 1e12),
    'metres offset by 1e6': lambda p: replace(p, y=p.y + 1e6),
    'constant voltage': lambda p: replace(p, v=np.full(p.n, 5.0)),
    'constant displacement': lambda p: replace(p, y=np.full(p.n, 1e-6)),
    'displacement is noise': lambda p: replace(p, y=1e-6 * noise(p)),
    'noise is constant': lambda p: changed(p, 'noise', 5.0),
    'steps are missing': lambda p: changed(p, 'step', 5.0),
    'triangle is constant': lambda p: changed(p, 'triangle', 5.0),
    'one sample': lambda p: p.cut(0, 1),
    'ten samples': lambda p: p.cut(600, 610),
    'hundred samples': lambda p: p.cut(600, 700),
}
TAKEN = {
    'as measured': lambda p: p,
    'volts x 1e6': lambda p: replace(p, v=1e6 * p.v),
    'displacement is the voltage': lambda p: replace(p, y=7.5e-6 * p.v),
    'saturated at both ends': lambda p: replace(p, y=np.clip(p.y, 20e-6, 45e-6)),
    'unlabelled': lambda p: replace(p, segments=()),
}


def record_of(piece: Piece) -> Record:
    """Return a record by the way of a file."""
    columns = {'t': piece.t, 'v': piece.v, 'y': piece.y}
    record = assemble(**columns, name='r')
    (whole,) = record.pieces
    return Record((replace(whole, segments=piece.segments),), 'r')


@pytest.mark.parametrize('case', REFUSED)
def test_a_record_that_carries_no_model_is_refused(case):
    with pytest.raises(PiezoIdentError), np.errstate(all='raise', under='ignore'):
        identify(record_of(REFUSED[case](sound().pieces[0])), SETTINGS)


@pytest.mark.parametrize('case', TAKEN)
def test_a_model_has_no_nan(case):
    model = identify(record_of(TAKEN[case](sound().pieces[0])), SETTINGS).model

    def numbers(x: object) -> bool:
        if isinstance(x, dict):
            return all(map(numbers, x.values()))
        if isinstance(x, list):
            return all(map(numbers, x))
        return not isinstance(x, float) or math.isfinite(x)

    data = model_to_dict(model)
    assert numbers([data[k] for k in ('input', 'output', 'delay', 'hysteresis', 'dynamics')])


def test_a_model_that_overflows_is_no_prediction():
    data = model_to_dict(stage().model)
    data['output']['Y'] = 1e308
    data['hysteresis']['p2'] = 1e10
    with np.errstate(over='ignore'), pytest.raises(ModelError, match='diverges'):
        free_run(model_from_dict(data), sound())


@pytest.mark.parametrize(
    ('v', 'y', 'words'),
    [
        (1e-320, 1e-6, 'no voltage'),
        (1e13, 1e-6, 'no voltage'),
        (1.0, 1e-320, 'no piezo stage'),
        (1.0, float('1e300'), 'no piezo stage'),
    ],
)
def test_scales_that_are_none(v, y, words):
    k = np.arange(100.0)
    with pytest.raises(DataError, match=words):
        assemble(k / 1000, v * np.sin(k), y * np.sin(k), name='r')


@pytest.mark.parametrize('column', ['v', 'y'])
def test_digits_that_an_offset_has_used_up(column):
    k = np.arange(100.0)
    columns = {'v': np.sin(k), 'y': 1e-6 * np.sin(k)}
    x = columns[column]
    assemble(k / 1000, **{**columns, column: x + 100 * np.ptp(x)}, name='r')
    columns[column] = x + 1e11 * np.ptp(x)
    with pytest.raises(DataError, match=f'{column} lies at .* used up by the offset'):
        assemble(k / 1000, **columns, name='r')
