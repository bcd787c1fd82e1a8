# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A quick part of the study of hysteretic springs: a short record and few candidates."""

import bouc_wen as study
import numpy as np
import piezo_ident as pi
from piezo_ident.model.scaling import Scaling
from piezo_ident.operators.dynamics import Delay, Dynamics
from piezo_ident.operators.hysteresis import Hysteresis
import pytest
from scipy.signal import lfilter

#: samples of the record, and of the end that is not fitted
FITTED, JUDGED = 5000, 2000
CANDIDATES = pi.DiagnosisSettings(effects=('loop_hysteresis', 'changed_dynamics', 'delay_change'))


def surrogate(u, y, frequency, damping):
    """Return the linear model of a mode, with the numerator that fits best."""
    pole = np.exp(2 * np.pi * frequency / study.RATE * (-damping + 1j * np.sqrt(1 - damping**2)))
    a = np.array([-2 * pole.real, abs(pole) ** 2])
    low, high = float(u.min()), float(u.max())
    ringing = lfilter([1.0], [1.0, *a], u)
    columns = np.array([np.concatenate([np.zeros(k), ringing[: u.size - k]]) for k in range(4)]).T
    b = np.linalg.lstsq(columns, y, rcond=None)[0]
    gain = b.sum() / (1 + a.sum())
    G = Dynamics(a=a, b=b / gain)
    size = high - low
    scaling = Scaling(low, size, gain * low, gain * size, (low, high))
    H = Hysteresis(np.empty(0), np.empty(0), 0.0, 1.0)
    return pi.StageModel(study.RATE, scaling, H, G, Delay(0))


def linear_of(u, y):
    """Return the surrogate with the smallest error on a grid of modes."""
    modes = [(f, z) for f in np.arange(26.0, 44.0, 1.0) for z in (0.03, 0.05, 0.08, 0.12)]
    models = [surrogate(u, y, *mode) for mode in modes]
    errors = [np.std(model.simulate(u) - y) for model in models]
    return models[int(np.argmin(errors))]


@pytest.fixture(scope='module')
def spring():
    """Return force and displacement on a spring, the linear model, and noise."""
    rng = np.random.default_rng(3)
    n = FITTED + JUDGED
    u, y = study.respond(study.multisine(rng, 1)[: n * study.FINE], study.SPRINGS['Bouc-Wen'])
    noise = study.NOISE * rng.standard_normal(FITTED)
    return u, y, linear_of(u[:FITTED], y[:FITTED]), noise


def diagnosed(model, u, y):
    record = pi.Record.from_arrays(u, y, sample_rate=study.RATE, name='spring')
    return pi.diagnose(model, [record], CANDIDATES)


@pytest.mark.filterwarnings('ignore')
def test_a_hysteretic_spring_is_named_and_modelled(spring):
    u, y, linear, noise = spring
    found = diagnosed(linear, u[:FITTED], y[:FITTED] + noise)
    assert [effect.name for effect in found.effects] == ['loop_hysteresis']
    before, after = (
        np.sqrt(np.mean((model.simulate(u) - y)[FITTED:] ** 2)) for model in (linear, found.model)
    )
    # the noise of the record is 8e-6 m
    assert before > 1e-4
    assert after < 8e-6


def test_nothing_is_named_for_the_linear_model_of_a_spring(spring):
    u, _, linear, noise = spring
    found = diagnosed(linear, u[:FITTED], linear.simulate(u[:FITTED]) + noise)
    assert not found.effects
