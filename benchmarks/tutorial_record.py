# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The records of the tutorial: a stage that nothing in the package is a model of.

    python benchmarks/tutorial_record.py examples/tutorial_data.zip
    python benchmarks/tutorial_record.py --scanner examples/tutorial_xy.zip

The hysteresis is a Preisach operator with an uneven density, the creep follows a power of time
over 60 relaxations, the mode and the sensor are continuous, the delay is no whole number of
samples, and the noise is 1/f and quantised (`truths`).  Written as a DAQ program would:
time in s, voltage in V, position in um, no labels.

The scanner has two such axes, one with a Bouc-Wen core.  Each moves the other by 1.5 % through a
mode of the guide.
"""

from __future__ import annotations

import argparse
from pathlib import Path
import zipfile

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.excitation.axes import build_axes
from piezo_ident.excitation.program import parse_program
from truths import FamilyStage
from truths.families import make_core
from truths.linear import Linear

RATE = 2000.0
LIMITS = (0.0, 100.0)
STROKE = 80e-6

HEAD = 'limits: [0, 100]\nsample_rate: 2000\nslew: 200\nsegments:\n'
#: file, name of the record in `truths`, and the signals that the generator played
PROGRAMS = {
    'calibration': (
        'identification',
        """
- {signal: idle, duration: 0.3}
- {signal: step, bias: 50, size: 10, hold: 0.15, count: 4}
- {signal: noise, bias: 50, amplitude: 12, cutoff: 400, duration: 1}
- {signal: triangle, base: 0, peaks: [30, 60, 90, 100], slope: 150}
- {signal: idle, duration: 0.3}
""",
    ),
    'check': (
        'diagnosis',
        """
- {signal: idle, duration: 0.3}
- {signal: staircase, levels: [60, 20, 80], hold: [2.1]}
- {signal: sine, bias: 50, amplitude: 45, frequency: 1, periods: 2}
- {signal: sine, bias: 50, amplitude: 40, frequency: 12, periods: 6}
- {signal: sine, bias: 30, amplitude: 20, frequency: 12, periods: 6}
- {signal: minor_loops, biases: [25, 75], amplitude: 12, cycles: 2, slope: 150}
- {signal: idle, duration: 0.3}
""",
    ),
    'scan': (
        'unseen',
        """
- {signal: idle, duration: 0.3}
- {signal: hold, level: 35, duration: 0.3}
- {signal: triangle, base: 35, peaks: [65, 65, 65, 65, 65, 65, 65, 65], slope: 3000}
- {signal: hold, level: 80, duration: 0.9}
""",
    ),
}


def stage(record: str) -> FamilyStage:
    """Return the stage; behind the calibration its amplifier is one of less current."""
    slew = {} if record == 'identification' else {'slew_limit': 20.0}
    return FamilyStage(
        core=make_core('preisach', np.random.default_rng(21)),
        linear=Linear(((210.0, 0.05, 0.9), (460.0, 0.03, 0.1)), 700.0, 1.3 / RATE),
        rate=RATE,
        limits=LIMITS,
        stroke=STROKE,
        offset=3.2e-6,
        noise='1/f',
        noise_rms=5e-5,
        gains={'creep': 0.006, **slew},
        variants={'creep': 1, **dict.fromkeys(slew, 0)},
        seed=7,
    )


def table(name: str) -> str:
    """Return one record as the text of a csv file."""
    record, signals = PROGRAMS[name]
    v = parse_program(HEAD + signals).build().v
    y = stage(record).respond(v, record)
    lines = [
        f'{k / RATE:.4f},{a:.3f},{1e6 * b:.3f}' for k, (a, b) in enumerate(zip(v, y, strict=True))
    ]
    return '\n'.join(['time_s,voltage_V,position_um', *lines, ''])


#: the scanner: its sampling [Hz], what either axis moves of the other, and the mode of its guide
SLOW, CROSS = 1000.0, 0.015
GUIDE = Linear(((150.0, 0.05, 1.0),), 1000.0, 0.0)
#: laws of the axes, and their modes [Hz]
AXES = {'preisach': 120.0, 'bouc-wen': 165.0}
#: what an axis plays alone, and what both play, each with random signals of its own
ALONE = """
- {signal: idle, duration: 0.2}
- {signal: step, bias: 50, size: 10, hold: 0.1, count: 4}
- {signal: settle, bias: 50, amplitude: 12, cycles: 10, frequency: 20}
- {signal: noise, bias: 50, amplitude: 10, cutoff: 300, duration: 1.5}
- {signal: triangle, base: 0, peaks: [30, 60, 100, 80], slope: 400}
"""
BOTH = """
- {signal: multisine, bias: 50, amplitude: 45, lowest: 0.5, highest: 30, period: 2, periods: 2}
"""
SCANS = ('alone', 'both', 'raster')


def scanner_voltages(name: str) -> Array:
    """Return the voltages of the scanner in a record [V], shape (n, 2)."""
    if name == 'raster':
        t = np.arange(round(2.5 * SLOW)) / SLOW
        lines = [1.0 - np.abs(1.0 - 2.0 * ((f * t) % 1.0)) for f in (4.0, 0.4)]
        soft = 0.5 * (1.0 - np.cos(np.pi * np.minimum(t / 0.25, 1.0)))
        return np.stack([soft * (15.0 + 70.0 * line) for line in lines], axis=1)
    head = HEAD.replace('2000', f'{SLOW:g}').replace('200\n', '400\n')
    program = parse_program(head + {'alone': ALONE, 'both': BOTH}[name])
    return np.stack([q.v for q in build_axes(program, 2, in_turn=name == 'alone')], axis=1)


def scan(name: str) -> str:
    """Return a record of the scanner as the text of a csv file."""
    v = scanner_voltages(name)
    record = {'alone': 'identification', 'both': 'diagnosis', 'raster': 'unseen'}[name]
    axes = [
        FamilyStage(
            core=make_core(core, np.random.default_rng(21)),
            linear=Linear(((mode, 0.04, 1.0),), 350.0, 1.2 / SLOW),
            rate=SLOW,
            limits=LIMITS,
            stroke=STROKE,
            offset=2e-6,
            noise='white',
            noise_rms=1e-4,
            seed=seed,
        )
        for seed, (core, mode) in enumerate(AXES.items())
    ]
    own = [axis.respond(v[:, k], record, clean=True) for k, axis in enumerate(axes)]
    y = [
        axis.offset + axis.stroke * axis.read(x + CROSS * GUIDE(other, SLOW), record)
        for axis, x, other in zip(axes, own, own[::-1], strict=True)
    ]
    rows = np.column_stack([v[:, 0], 1e6 * y[0], v[:, 1], 1e6 * y[1]])
    lines = [
        ','.join([f'{k / SLOW:.3f}', *(f'{x:.3f}' for x in row)]) for k, row in enumerate(rows)
    ]
    return '\n'.join(['t [s],v [V],y [um],v_b [V],y_b [um]', *lines, ''])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[1])
    parser.add_argument('out', type=Path)
    parser.add_argument('--scanner', action='store_true', help='the records of two axes')
    args = parser.parse_args()
    texts = {x: scan(x) for x in SCANS} if args.scanner else {x: table(x) for x in PROGRAMS}
    with zipfile.ZipFile(args.out, 'w', zipfile.ZIP_DEFLATED, compresslevel=9) as out:
        for name, text in texts.items():
            # with the time at which all archives begin: the same bytes each time
            out.writestr(zipfile.ZipInfo(f'{name}.csv'), text, zipfile.ZIP_DEFLATED)


if __name__ == '__main__':
    main()
