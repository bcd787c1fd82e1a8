# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The records of the tutorial: a stage that nothing in the package is a model of.

    python benchmarks/tutorial_record.py examples/tutorial_data.zip

The hysteresis is a Preisach operator with an uneven density, the creep follows a power of time
over 60 relaxations, the mode and the sensor are continuous, the delay is no whole number of
samples, and the noise is 1/f and quantised (`truths`).  Written as a DAQ program would:
time in s, voltage in V, position in um, no labels.
"""

from __future__ import annotations

import argparse
from pathlib import Path
import zipfile

import numpy as np
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[1])
    parser.add_argument('out', type=Path)
    with zipfile.ZipFile(
        parser.parse_args().out, 'w', zipfile.ZIP_DEFLATED, compresslevel=9
    ) as out:
        for name in PROGRAMS:
            # with the time at which all archives begin: the same bytes each time
            out.writestr(zipfile.ZipInfo(f'{name}.csv'), table(name), zipfile.ZIP_DEFLATED)


if __name__ == '__main__':
    main()
