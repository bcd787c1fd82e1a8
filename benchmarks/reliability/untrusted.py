# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0
"""
Numbers that cannot be trusted: what identify, predict and diagnose make of them.

    .venv/bin/python benchmarks/reliability/untrusted.py     prints the table, a minute

Every record is read from a file first, as a lab would.  A case ends in a refusal of one line that
names the reason, or in finite numbers; `EXPECTED` says which, and the tests hold it.
"""

from __future__ import annotations

import os

os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

from collections.abc import Callable
from dataclasses import replace
from functools import cache
import math
from pathlib import Path
import sys
import tempfile
import warnings

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import numpy as np
from piezo_ident.common.errors import PiezoIdentError
from piezo_ident.diagnosis import diagnose, DiagnosisSettings
from piezo_ident.excitation.program import parse_program
from piezo_ident.identification.identify import identify
from piezo_ident.identification.results import Settings
from piezo_ident.model.files import model_from_dict, model_to_dict
from piezo_ident.model.free_run import free_run
from piezo_ident.model.simulated_stage import Sensor, SimulatedStage
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.io import read_record
from piezo_ident.record.record import Piece, Record
from reliability.rows import write_rows

__all__ = ['CASES', 'EXPECTED', 'outcomes']

RATE = 2000.0
SETTINGS = Settings(order=(2, 2), solver='least_squares', thresholds=5)
DIAGNOSIS = DiagnosisSettings(effects=('creep',), most_effects=1)
PROGRAMME = """
limits: [0, 10]
seed: 1
slew: 40
segments:
  - {signal: idle, duration: 0.3}
  - {signal: step, bias: 5, size: 1, hold: 0.15, count: 6}
  - {signal: settle, bias: 5, amplitude: 0.48, cycles: 10}
  - {signal: noise, bias: 5, amplitude: 0.4, cutoff: CUTOFF, duration: 3}
  - {signal: triangle, slope: 20}
"""
CHECK = """
limits: [0, 10]
slew: 40
segments:
  - {signal: idle, duration: 0.5}
  - {signal: sine, bias: 5, amplitude: 5, frequency: 5, periods: 15}
  - {signal: sine, bias: 5, amplitude: 3, frequency: 50, periods: 50}
  - {signal: hold, level: 7, duration: 2}
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
def measured(programme: str) -> Record:
    """Return what the stage answers to a programme."""
    sequence = parse_program(programme).build(RATE)
    return stage().play(sequence, np.random.default_rng(0))


@cache
def whole(programme: str) -> Piece:
    """Return its one piece."""
    return measured(programme).pieces[0]


Change = Callable[[Piece], Piece]


def _v(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    return lambda p: replace(p, v=change(p.v))


def _y(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    return lambda p: replace(p, y=change(p.y))


def _in(kind: str, change: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Change the command in the segments of a kind alone; the stage answers to that."""

    def changed(p: Piece) -> Piece:
        v = p.v.copy()
        for s in p.find(kind):
            v[s.start : s.stop] = change(v[s.start : s.stop])
        y = stage().run(np.random.default_rng(0)).process(v)
        return replace(p, v=v, y=y)

    return changed


def _noise(p: Piece) -> np.ndarray:
    return np.random.default_rng(3).standard_normal(p.n)


#: what is done to a sound record
CASES: dict[str, Change] = {
    'as measured': lambda p: p,
    'volts x 1e-12': _v(lambda v: 1e-12 * v),
    'volts x 1e+6': _v(lambda v: 1e6 * v),
    'volts denormal': _v(lambda v: 1e-310 * v),
    'volts x 1e+300': _v(lambda v: 1e300 * v),
    'metres x 1e-12': _y(lambda y: 1e-12 * y),
    'metres x 1e+6': _y(lambda y: 1e6 * y),
    'metres denormal': _y(lambda y: 1e-310 * y),
    'volts offset by 1e+12': _v(lambda v: v + 1e12),
    'metres offset by 1e+6': _y(lambda y: y + 1e6),
    'constant voltage': _v(lambda v: np.full(v.size, 5.0)),
    'constant displacement': _y(lambda y: np.full(y.size, 1e-6)),
    'both constant': lambda p: replace(p, v=np.full(p.n, 5.0), y=np.full(p.n, 1e-6)),
    'displacement is noise': lambda p: replace(p, y=1e-6 * _noise(p)),
    'displacement is the voltage': lambda p: replace(p, y=7.5e-6 * p.v),
    'voltage and displacement swapped': lambda p: replace(p, v=1e5 * p.y, y=1e-5 * p.v),
    'saturated at 60 %': _y(lambda y: np.minimum(y, y.min() + 0.6 * (y.max() - y.min()))),
    'saturated both ends': _y(lambda y: np.clip(y, 20e-6, 45e-6)),
    'two levels only': _y(lambda y: np.where(y > 35e-6, 50e-6, 0.0)),
    'noise up to 3 Hz only': _in(
        'noise',
        lambda v: 5 + 0.4 * np.sin(2 * np.pi * np.cumsum(np.linspace(0, 3, v.size)) / RATE),
    ),
    'noise is one sine': _in('noise', lambda v: 5 + 0.4 * np.sin(0.3 * np.arange(v.size))),
    'noise is constant': _in('noise', lambda v: np.full(v.size, 5.0)),
    'steps are missing': _in('step', lambda v: np.full(v.size, 5.0)),
    'triangle is constant': _in('triangle', lambda v: np.full(v.size, 5.0)),
    'one sample': lambda p: p.cut(0, 1),
    'two samples': lambda p: p.cut(0, 2),
    'ten samples': lambda p: p.cut(600, 610),
    'hundred samples': lambda p: p.cut(600, 700),
    'unlabelled, 200 samples': lambda p: replace(p.cut(7000, 7200), segments=()),
    'unlabelled': lambda p: replace(p, segments=()),
}


def _read(piece: Piece, folder: Path) -> Record:
    columns = {'t': piece.t, 'v': piece.v, 'y': piece.y}
    if piece.segments:
        names = [x for s in piece.segments for x in (s.label, '')]
        starts = [i for s in piece.segments for i in (s.start, s.stop)]
        columns |= {'segment_name': np.array(names), 'segment_start': np.array(starts)}
    np.savez(folder / 'r.npz', **columns)
    return read_record(folder / 'r.npz')


def _finite(model: StageModel) -> bool:
    data = model_to_dict(model)

    def numbers(x: object) -> bool:
        if isinstance(x, dict):
            return all(map(numbers, x.values()))
        if isinstance(x, list):
            return all(map(numbers, x))
        return not isinstance(x, float) or math.isfinite(x)

    return all(numbers(data[k]) for k in ('input', 'output', 'delay', 'hysteresis', 'dynamics'))


def _identify(record: Record) -> str:
    found = identify(record, SETTINGS)
    if not _finite(found.model):
        return 'NOT FINITE'
    error = free_run(found.model, record).errors.percent
    missing = ', '.join(what for what, _ in found.not_identified)
    warned = ', warns' if found.warnings or record.faults else ''
    lacking = f', not identified: {missing}' if missing else ''
    return f'model, errs by {error:.2g} % of stroke{lacking}{warned}'


def _predict(record: Record) -> str:
    run = free_run(stage().model, record)
    said = ', warns' if run.warnings else ''
    if not np.all(np.isfinite(run.predicted)):
        return 'NOT FINITE'
    return f'errs by {run.errors.percent:.2g} % of stroke{said}'


def _diagnose(record: Record) -> str:
    found = diagnose(stage().model, record, DIAGNOSIS)
    if not _finite(found.model) or not math.isfinite(found.after.overall):
        return 'NOT FINITE'
    warned = ', warns' if found.warnings or found.faults else ''
    before, after = found.before.overall, found.after.overall
    return f'{found.verdict}, errs by {before:.2g}, then {after:.2g} % of stroke{warned}'


def outcomes(name: str, folder: Path) -> dict[str, str]:
    """
    Return what becomes of a case.

    Returns
    -------
    dict of str to str
        By verb; a refusal begins with ``refused``, and is the same for all three when already
        the file is.
    """
    said = {}
    for verb, use, programme in (
        ('identify', _identify, PROGRAMME.replace('CUTOFF', '500')),
        ('predict', _predict, CHECK),
        ('diagnose', _diagnose, CHECK),
    ):
        with warnings.catch_warnings(record=True) as heard:
            warnings.simplefilter('always')
            try:
                said[verb] = use(_read(CASES[name](whole(programme)), folder))
            except PiezoIdentError as error:
                said[verb] = f'refused: {error}'.replace(str(folder), '').replace('/r.npz: ', '')
        if heard:
            said[verb] += f' [{heard[0].category.__name__}: {heard[0].message}]'
    return said


_GOOD = ('model, errs by 0.4 %', 'errs by 0.0031 %', 'none, errs by 0.0031, then 0.0031 %')
_KNOWN = _GOOD[1:]
_STROKE, _SPAN = ('refused: a stroke of',) * 3, ('refused: v spans',) * 3
_DIGITS, _ONE = ('refused: {} lies at',) * 3, ('refused: one sample only',) * 3
_SHORT = 'refused: r.npz: {} samples'
_STILL = 'refused: r.npz: the voltage never moves'
#: how the outcomes begin, by case: of identify, predict and diagnose
EXPECTED: dict[str, tuple[str, ...]] = {
    'as measured': _GOOD,
    # one span of the voltage is as good as another, if the model came from it
    'volts x 1e-12': (
        _GOOD[0],
        'errs by 61 % of stroke, warns',
        'none, errs by 61, then 0.0031 % of stroke, warns',
    ),
    'volts x 1e+6': (
        _GOOD[0],
        'errs by 4.4e+18 % of stroke, warns',
        'none, errs by 4.4e+18, then 0.0031 % of stroke, warns',
    ),
    'volts denormal': _SPAN,
    'volts x 1e+300': _SPAN,
    'metres x 1e-12': _STROKE,
    'metres x 1e+6': _STROKE,
    'metres denormal': _STROKE,
    'volts offset by 1e+12': tuple(x.format('v') for x in _DIGITS),
    'metres offset by 1e+6': tuple(x.format('y') for x in _DIGITS),
    'constant voltage': (_STILL, 'errs by 32 % of stroke, warns', 'refused: the voltage never'),
    'constant displacement': ('refused: the displacement never changes',) * 3,
    'both constant': (_STILL, 'errs by inf % of stroke, warns', 'refused: the voltage never'),
    'displacement is noise': (
        'refused: delay: no step rises above',
        'errs by 5e+02 %',
        'refused: r.npz: the displacement does not follow',
    ),
    'displacement is the voltage': ('model, errs by', 'errs by 10 %', 'unexplained, errs by 10'),
    'voltage and displacement swapped': (
        'model, errs by 3.5 % of stroke, warns',
        'errs by 36 %',
        'unexplained, errs by 36, then 36 %',
    ),
    'saturated at 60 %': (
        'model, errs by 2.8 % of stroke, warns',
        'errs by 25 %',
        'unexplained, errs by 25, then 3.2 % of stroke, warns',
    ),
    'saturated both ends': (
        'model, errs by 8.1 % of stroke, warns',
        'errs by 41 %',
        'unexplained, errs by 41, then 41 % of stroke, warns',
    ),
    'two levels only': (
        'refused: r.npz: from 0 to 5 s the voltage moves',
        'errs by 25 %',
        'unexplained, errs by 25, then 25 % of stroke, warns',
    ),
    'noise up to 3 Hz only': ('model, errs by 0.41 % of stroke, warns', *_KNOWN),
    'noise is one sine': ('model, errs by 0.44 %', *_KNOWN),
    'noise is constant': ('refused: r.npz: voltage or displacement is constant', *_KNOWN),
    'steps are missing': ('refused: delay: no step rises above', *_KNOWN),
    'triangle is constant': ('refused: hysteresis: the voltage never moves', *_KNOWN),
    'one sample': _ONE,
    'two samples': (_STILL, 'errs by 50 %', _SHORT.format(2)),
    'ten samples': (_SHORT.format(10), 'errs by 30 %', _SHORT.format(10)),
    'hundred samples': (_SHORT.format(100), 'errs by 21 %', _SHORT.format(100)),
    'unlabelled, 200 samples': (
        'model, errs by 42 % of stroke, not identified: delay, hysteresis, warns',
        'errs by 0.01 %',
        _SHORT.format(200),
    ),
    'unlabelled': ('model, errs by 0.84 % of stroke, warns', *_KNOWN),
}


def main() -> int:
    """Print the table and write the rows; 1 when a case ends otherwise than it should."""
    rows, wrong = [], 0
    with tempfile.TemporaryDirectory() as name:
        for case in CASES:
            said = outcomes(case, Path(name))
            print(f'{case}')
            for (verb, x), start in zip(said.items(), EXPECTED[case], strict=True):
                as_stated = x.startswith(start) and 'Warning' not in x
                wrong += not as_stated
                print(f'    {verb:10s} {x}{"" if as_stated else f"   INSTEAD OF: {start}"}')
            rows.append(
                {
                    'what': f'numbers: {case}',
                    'how_often': 'identify, predict, diagnose',
                    'result': _joined(said),
                    'command': 'python benchmarks/reliability/untrusted.py',
                }
            )
    write_rows('untrusted', rows)
    return 1 if wrong else 0


def _joined(said: dict[str, str]) -> str:
    if len(set(said.values())) == 1:
        return f'all: {said["identify"]}'
    return '; '.join(f'{verb}: {x}' for verb, x in said.items())


if __name__ == '__main__':
    sys.exit(main())
