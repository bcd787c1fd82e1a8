# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The fit finds a known truth, keeps its bounds, and tells what it would leave of other blocks."""

from dataclasses import replace

import numpy as np
from piezo_ident.common.errors import Cancelled, IdentificationError
from piezo_ident.fitting.free_run import fit
from piezo_ident.fitting.stage import LEAST_SLOPE, PARTS, Stage
from piezo_ident.fitting.stretch import Stretch
from piezo_ident.operators.dynamics import Dynamics
from piezo_ident.operators.hysteresis_law import HysteresisLaw
import pytest

RATE, N = 1000.0, 4000
R = np.arange(1, 6) / 6.0
LAW = HysteresisLaw('plays', R)
G = Dynamics([-1.5, 0.8], [0.2, 0.1]).normalised()
NOISE = 1e-4


def truth(records=1):
    one = Stage.linear(LAW, G, 3, np.full((records, PARTS), 0.5))
    c = np.array([0.2, 0.0, 0.15, 0.1, 0.05, -0.1, 0.6])
    rng = np.random.default_rng(5)
    return replace(
        one,
        coefficients=c,
        offsets=0.01 * np.arange(records),
        starts=rng.uniform(0.1, 0.9, (records, PARTS)),
    )


def motion(i, seed=0):
    rng = np.random.default_rng([seed, i])
    t = np.arange(N) / RATE
    slow = 1.0 - np.cos(2.0 * np.pi * (0.7 + 0.2 * i) * t)
    u = slow + np.cumsum(rng.standard_normal(N)) * 0.02
    return (u - u.min()) / np.ptp(u)


def measured(stage, seed=0):
    found = []
    for i in range(stage.offsets.size):
        u = motion(i, seed)
        whole, block = np.ones(N, dtype=bool), np.arange(N) // 200 + 20 * i
        s = Stretch(u, np.zeros(N), whole, block, RATE, i, i)
        noise = NOISE * np.random.default_rng([seed, 9, i]).standard_normal(N)
        found.append(replace(s, x=stage.signals(s)[2] + stage.added(s) + noise))
    return found


def rough(stage):
    return Stage.linear(LAW, Dynamics([-1.3, 0.6], [0.2, 0.1]), 3, stage.guesses)


@pytest.mark.parametrize('records', [1, 2])
def test_everything_is_found_from_a_line(records):
    stage = truth(records)
    found = fit(rough(stage), measured(stage), iterations=30)
    assert found.rms == pytest.approx(NOISE, rel=0.05)
    np.testing.assert_allclose(found.stage.dynamics.a, G.a, atol=1e-3)
    np.testing.assert_allclose(found.stage.coefficients, stage.coefficients, atol=5e-3)
    np.testing.assert_allclose(
        np.diff(found.stage.offsets), np.diff(stage.offsets), atol=5 * NOISE
    )


def test_samples_that_do_not_count_change_nothing():
    stage = truth()
    [s] = measured(stage)
    out = np.zeros(N, dtype=bool)
    out[500:900] = True
    spoilt = replace(s, x=np.where(out, 7.0, s.x), use=~out)
    clean = replace(s, use=~out)
    both = [fit(rough(stage), [one], iterations=5).stage.values for one in (spoilt, clean)]
    np.testing.assert_array_equal(*both)


def test_held_out_blocks_err_as_a_fit_without_them_does():
    stage = truth()
    [s] = measured(stage)
    whole = fit(rough(stage), [s], iterations=30)
    sets = np.where(np.arange(20) == 11, 0, 1)
    sets[sets == 1] = -1
    promised = whole.held_out(sets)[11]
    without = fit(whole.stage, [replace(s, use=s.block != 11)], iterations=10)
    e = s.x - without.stage.signals(s)[2] - without.stage.added(s)
    assert promised == pytest.approx(np.sum(e[s.block == 11] ** 2), rel=0.1)


def test_weights_stay_above_zero_and_the_loss_never_grows():
    stage = truth()
    losses = [fit(rough(stage), measured(stage), iterations=n).loss for n in (0, 1, 3, 8)]
    assert losses == sorted(losses, reverse=True)
    assert fit(rough(stage), measured(stage)).stage.coefficients[:5].min() >= 0.0


def test_a_slope_below_its_bound_is_no_end():
    # as a gain of G that went into H leaves it, or a wider law makes of the same powers of v
    c = np.array([0.2, 0.0, 0.15, 0.1, 0.05, 0.0, 0.6 * LEAST_SLOPE])
    stage = replace(truth(), coefficients=c)
    start = replace(stage, coefficients=np.r_[0.5 * c[:5], c[5:]])
    found = fit(start, measured(stage), iterations=30)
    assert found.rms == pytest.approx(NOISE, rel=0.05)


def test_H_rises_with_lags_along_the_path_that_would_let_it_fall():
    law = HysteresisLaw('duhem', R)
    stage = truth().with_law(law)
    falls = replace(stage, coefficients=stage.coefficients.copy())
    falls.coefficients[law.densities] += 0.3
    assert falls.hysteresis.lowest_slope() < -0.1
    start, found = (fit(stage, measured(falls), iterations=n) for n in (0, 8))
    assert found.stage.hysteresis.lowest_slope() > 0.0
    assert found.rms < 0.2 * start.rms


def test_deviations_are_those_of_repeated_noise():
    stage, fits, at = truth(), [], LAW.size
    for k in range(12):
        noise = NOISE * np.random.default_rng(k).standard_normal(N)
        fits.append(fit(stage, [replace(s, x=s.x + noise) for s in measured(stage)]))
    a1 = [one.stage.dynamics.a[0] for one in fits]
    std = np.sqrt(fits[0].covariance()[at, at])
    assert 0.4 < np.std(a1) / std < 1.6


def test_nothing_to_fit_is_refused_and_the_work_can_be_stopped():
    stage = truth()
    [s] = measured(stage)
    with pytest.raises(IdentificationError, match=f'none of {N} samples'):
        fit(rough(stage), [s.with_use(np.zeros(N, dtype=bool))])

    def stop():
        raise Cancelled('stopped')

    with pytest.raises(Cancelled):
        fit(rough(stage), [s], tick=stop)


def test_a_fit_that_has_not_converged_promises_no_less_than_it_leaves():
    stage = truth()
    start = fit(rough(stage), measured(stage), iterations=0)
    assert start.held_out(np.arange(20) % 5).sum() >= start.loss
