# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Numbers that a free-run fit leaves in the model and in the results of the steps."""

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose
from paper_stage import FS, PAPER, with_mode
from piezo_ident.fitting.free_run import fit
from piezo_ident.fitting.stage import PARTS, Stage
from piezo_ident.fitting.stretch import Stretch
from piezo_ident.identification.free_run_fit import SPAN
from piezo_ident.identification.free_run_result import (
    _compact,
    _delay_result,
    _hysteresis_result,
    _missing,
    _warn_of_creep,
    FreeRunFits,
)
from piezo_ident.identification.prepare import Excerpt
from piezo_ident.identification.settings import Settings
from piezo_ident.model.files import model_from_dict, model_to_dict
from piezo_ident.operators.dynamics import Dynamics
from piezo_ident.operators.hysteresis_law import HysteresisLaw
from piezo_ident.selection.comparison import RatedFit
import pytest

LAW = HysteresisLaw('plays', np.array([0.3]), SPAN)


def test_a_sum_of_plays_is_the_same_from_its_file():
    model = replace(PAPER, hysteresis=_compact(LAW.hysteresis([0.2, 0.05, 0.8])))
    again = model_from_dict(model_to_dict(model)).hysteresis
    assert again.span == model.hysteresis.span
    assert again.flattest == model.hysteresis.flattest


def test_deviations_of_the_powers_are_those_of_a_linear_fit():
    n = 600
    v = 0.5 - 0.5 * np.cos(np.arange(n) / 30.0)
    X = np.column_stack([*LAW.columns(v), np.ones(n)])
    truth = np.array([0.2, 0.05, 0.8])
    x = X[:, :3] @ truth + 0.01 * np.random.default_rng(0).standard_normal(n)
    linear = Stage.linear(LAW, Dynamics.unit(), 0, np.zeros((1, PARTS)))
    block = np.arange(n) * 10 // n
    stretch = Stretch(v, x, np.ones(n, dtype=bool), block, 1000.0)
    last = fit(replace(linear, coefficients=truth), [stretch], iterations=0)
    best = RatedFit('plays', last, 1.0, 1.0)
    result = _hysteresis_result(FreeRunFits((), (), last, last, (best,), best))
    expected = np.sqrt(np.diag(np.linalg.inv(X.T @ X)) * last.loss / n)
    assert_allclose(result.std, expected[:3], rtol=1e-6)


def sine(frequency, n=2000):
    return 0.5 - 0.5 * np.cos(2.0 * np.pi * frequency * np.arange(n) / FS)


def fits_of(G, delay, u):
    """Return a fit with this G and delay to a voltage."""
    stage = Stage.linear(LAW, G, delay, np.zeros((1, PARTS)))
    use = np.ones(u.size, dtype=bool)
    last = fit(stage, [Stretch(u, u, use, np.arange(u.size) * 10 // u.size, FS)], iterations=0)
    best = RatedFit('plays', last, 1.0, 1.0)
    return FreeRunFits((Excerpt(u, u, use),), (use,), last, last, (best,), best)


def test_creep_that_the_model_lacks_is_no_merit_of_a_law():
    fits = fits_of(Dynamics.unit(), 0, sine(20.0))
    creeping = RatedFit('plays, creep', fits.last, 0.25, 0.25, effects=1)
    result = _hysteresis_result(replace(fits, candidates=(fits.best, creeping)))
    assert result.errors_of_laws == {'plays': 1.0}


#: a jump moves the voltage at all frequencies
JUMP = 0.1 * (np.arange(2000) > 1000)
MODE, LOW = (with_mode(frequency).dynamics for frequency in (700.0, 30.0))


@pytest.mark.parametrize(
    ('G', 'delay', 'given', 'u', 'what', 'said'),
    [
        (Dynamics.unit(), 0, None, sine(20.0), 'delay', 'no delay lowers the error'),
        (Dynamics.unit(), 0, 0, sine(20.0), 'delay', ''),
        (Dynamics.unit(), 3, None, sine(20.0), 'delay', ''),
        (MODE, 0, None, sine(20.0), 'delay', ''),
        (Dynamics.unit(), 3, None, sine(20.0), 'dynamics', 'up to 50 Hz'),
        (MODE, 3, None, sine(20.0), 'dynamics', 'up to 20 Hz, below the lowest mode of G at 700 '),
        (LOW, 3, None, sine(20.0), 'dynamics', 'up to 20 Hz, below the lowest mode of G at 30 Hz'),
        (LOW, 3, None, sine(40.0), 'dynamics', ''),
        (MODE, 3, None, 0.9 * sine(20.0) + JUMP, 'dynamics', ''),
    ],
)
def test_what_the_motion_does_not_tell_is_named(G, delay, given, u, what, said):
    fits = fits_of(G, delay, u)
    missing = _missing(fits, _delay_result(fits, Settings(delay=given), FS, 50.0), FS, 50.0)
    assert (what in missing) == bool(said)
    assert said in missing.get(what, '')


@pytest.mark.parametrize(
    ('chosen', 'with_creep', 'said'),
    [
        ((0.006, 0), (0.005, 1), ['0.5 % of stroke instead of 0.6 %']),
        # 5 % of an rms is nothing
        ((0.006, 0), (0.0058, 1), []),
        ((0.006, 0), (0.007, 1), []),
        # creep is in the model
        ((0.006, 1), (0.005, 1), []),
    ],
)
def test_creep_that_lowers_the_error_a_little_is_told(chosen, with_creep, said):
    fits = fits_of(Dynamics.unit(), 0, sine(20.0))
    best, other = (
        replace(fits.best, blocks=rms**2, kinds=rms**2, effects=effects)
        for rms, effects in (chosen, with_creep)
    )
    texts = _warn_of_creep(replace(fits, candidates=(best, other), best=best))
    assert len(texts) == len(said)
    assert all(words in text for words, text in zip(said, texts, strict=True))
    assert all(text.startswith('the stage may creep') for text in texts)
