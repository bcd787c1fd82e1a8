# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Inversion of a motion, for each law of H and with effects.

    .venv-bench/bin/python benchmarks/bench_inverse.py [--quick]

The motion is a raster that starts and ends at rest, so that every play turns back; each model is
asked for its own answer to one voltage.
"""

from __future__ import annotations

from dataclasses import replace

import alone  # noqa: F401 - one thread of BLAS
import numpy as np
import piezo_ident as pi
from piezo_ident.common.arrays import Array
from piezo_ident.model.stage_model import EffectSetting, StageModel
from piezo_ident.operators.hysteresis_law import HysteresisLaw, LawName, LAWS
from side_by_side import markdown, ratio, show, take_turns

RATE = 20_000.0
#: plays of each law, and what they add together beside a line of slope 1
PLAYS, SHARE = 40, 0.3
EFFECTS = (
    EffectSetting('amplifier_lag', {'time_constant': 2e-4}),
    EffectSetting('creep', {'gain': [0.012, 0.02], 'time_constant': [0.1, 1.0]}),
    EffectSetting('sensor_nonlinearity', {'square': 0.004, 'cubic': -0.002}),
)
RATE_DEPENDENT = EffectSetting(
    'rate_dependent_hysteresis', {'gain': 1e-4, 'exponent': 1.0, 'cutoff': 1000.0}
)


def of_law(name: LawName, plain: StageModel) -> StageModel:
    """Return a stage with an H of a law."""
    law = HysteresisLaw(name, np.arange(1, PLAYS + 1) / (PLAYS + 1))
    n = law.densities
    theta = np.zeros(law.size)
    theta[:n] = 1.0
    theta[:n] *= SHARE / float(law.hysteresis(theta)([0.0, 1.0])[1])
    theta[n : n + law.lags] = 0.003 * (-1.0) ** np.arange(law.lags)
    theta[-2:] = -0.1, 1.0
    return replace(plain, hysteresis=law.hysteresis(theta))


def models() -> dict[str, StageModel]:
    """Return what is inverted, by what it is."""
    plain = pi.SimulatedStage.load('paper').model
    found = {f'law `{name}`, {PLAYS} plays': of_law(name, plain) for name in LAWS}
    with_effects = replace(plain, effects=EFFECTS)
    return {
        "the paper's stage": plain,
        **found,
        'with amplifier lag, creep and a bent sensor': with_effects,
        'with plays that widen with speed': replace(plain, effects=(RATE_DEPENDENT,)),
    }


def motion(model: StageModel, n: int) -> Array:
    """Return where a raster of voltage takes a model [m]."""
    t = np.arange(n) / RATE
    soft = np.minimum(1.0, np.minimum(t, t[::-1]) / 0.05)
    v = 5.0 + soft * (3.0 * np.sin(2 * np.pi * 2.0 * t) + 1.2 * np.sin(2 * np.pi * 40.0 * t))
    return model.without_dynamics().simulate(v)


def of_models(n: int, runs: int) -> str:
    """Return a table over the models."""
    rows = []
    for name, model in models().items():
        y = motion(model, n)
        v = model.inverse(y).v
        works = {
            'inverse': lambda k, m=model, y=y: m.inverse(y),
            'prediction': lambda k, m=model, v=v: m.simulate(v),
        }
        inverse, prediction = take_turns(works, runs).values()
        drive = inverse.results[0]
        times = (f'{1e9 * inverse.median / n:.0f}', ratio(inverse.over(prediction)))
        rows.append([name, *times, drive.passes, f'{drive.error:.2g}'])
    heads = ['model', 'ns a sample', 'times a prediction']
    return markdown([*heads, 'passes', 'left, % of stroke'], rows)


def sections(quick: bool = False) -> list[tuple[str, str]]:
    """Return titles and texts."""
    n, runs = (100_000, 3) if quick else (400_000, 7)
    about = (
        f'A raster of {n / RATE:g} s at 20 kHz, offline. The inversion leaves this error of the '
        'model itself.'
    )
    return [('Inversion of a motion', f'{about}\n\n{of_models(n, runs)}')]


if __name__ == '__main__':
    show(sections)
