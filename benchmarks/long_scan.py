# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Show that hours of one scan leave the adapted model where it was, if the stage does not change.

    python benchmarks/long_scan.py --samples 1e9

The scan repeats, so its responses are computed once and only the noise is new: 1e9 samples, 14
hours at 20 kHz, take two to three minutes.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
import sys

import numpy as np
import piezo_ident as pi
from piezo_ident.common.arrays import Array
from piezo_ident.fitting.adaptation import Adaptation
from piezo_ident.model.stage_model import EffectSetting, StageModel

RATE = 20_000
#: a scan of 60 % of the range at 10 Hz [samples], and periods that are taken at once
PERIOD, PERIODS = RATE // 10, 100
#: time after which creep follows the scan [s]: twenty of its slowest time constants
SETTLED = 100.0
#: noise, in spans
NOISE = 2e-5
CREEP = EffectSetting('creep', {'gain': [0.01, 0.01], 'time_constant': [0.1, 5.0]})


def scan(seconds: float, swing: float = 6.0) -> Array:
    """Make the voltage of a scan that begins at rest [V]."""
    t = np.arange(round(seconds * RATE)) / RATE
    fade = np.minimum(t / 0.5, 1.0)
    return fade * (5.0 - 0.5 * swing * np.cos(2.0 * np.pi * 10.0 * t))


def moved(model: StageModel, other: StageModel, swing: float) -> float:
    """Return the rms difference of two models over a scan, in spans."""
    v = scan(4.0, swing)
    e = (model.simulate(v) - other.simulate(v))[v.size // 2 :]
    return float(np.std(e)) / abs(model.scaling.Y)


def main() -> int:
    """Scan, and print what was learnt."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--samples', type=float, default=1e9)
    samples = parser.parse_args().samples
    model = pi.SimulatedStage.load('paper').model.without_dynamics()
    known = {'errors': {'held_out': 0.01}}
    model = replace(model, sample_rate=float(RATE), effects=(CREEP,), identification=known)
    adaptation, v = Adaptation(model, 'hysteresis'), scan(SETTLED)
    t, free = np.arange(v.size) / RATE, model.simulate(v)
    rows = np.tile(adaptation.responses(v, t, free)[:, -PERIOD:], PERIODS)
    before = np.roll(rows, adaptation.horizon, axis=1)
    rng, done, told = np.random.default_rng(3), 0, 1e7
    while done < samples:
        y = before[0] + NOISE * rng.standard_normal(before.shape[1])
        adaptation.learn(y, before, rows)
        done += y.size
        if done >= min(told, samples):
            told *= 10.0
            learnt = adaptation.learnt_model
            at, wide = (moved(model, learnt, swing) for swing in (6.0, 10.0))
            sys.stdout.write(
                f'{done:.1e} samples, {done / RATE / 3600:.2f} h: the model has moved by '
                f'{at:.1e} spans over the scan, {wide:.1e} over the range\n'
            )
    return 0


if __name__ == '__main__':
    sys.exit(main())
