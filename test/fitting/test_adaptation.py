# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What a model learns of a stage that runs, and what it must not learn."""

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose
from paper_stage import PAPER
import piezo_ident as pi
from piezo_ident.common.files import parse_yaml
from piezo_ident.fitting.adaptation import Adaptation, LARGEST
from piezo_ident.model.files import model_from_dict, model_to_yaml
from piezo_ident.model.observer import GAIN_SIZE
from piezo_ident.model.stage_model import EffectSetting
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.operators.hysteresis_law import LAWS
import pytest
from random_models import random_hysteresis

#: a slow rate keeps long motions cheap
RATE = 2000
CREEP = EffectSetting('creep', {'gain': [0.01, 0.01], 'time_constant': [0.1, 5.0]})
H = PAPER.hysteresis
NOISE = 2e-5


def stage(h=H, error=1e-3, gain=1.0, **changes):
    """Return a stage, or the model of one, that knows its error as a share of its span."""
    return replace(
        PAPER.without_dynamics(),
        sample_rate=float(RATE),
        hysteresis=h.scaled(gain),
        effects=(CREEP,),
        identification={'errors': {'held_out': 100.0 * error}},
        **changes,
    )


def wider(h, share):
    return replace(h, weights=(1.0 + share) * h.weights)


#: no sum of the changes that are learnt makes this one of the model's
TRUE = wider(H, 0.08 * np.random.default_rng(2).standard_normal(H.weights.size))
MODEL = stage()


def scan(seconds, frequency=10.0, swing=6.0, bias=5.0):
    """Return the voltage of a scan that begins at rest [V]."""
    t = np.arange(round(seconds * RATE)) / RATE
    fade = 0.5 - 0.5 * np.cos(np.pi * np.minimum(t / 0.5, 1.0))
    return fade * (bias - 0.5 * swing * np.cos(2 * np.pi * frequency * t))


def scan_with_holds(seconds, dwell=0.5):
    """Return the voltage of moves to random levels, with a hold at each [V]."""
    levels = np.random.default_rng(0).uniform(1.0, 9.0, round(seconds / dwell))
    way = np.convolve(np.repeat(levels, round(dwell * RATE)), np.hanning(100))
    return way[:-99] / np.hanning(100).sum()


def learn(adaptation, v, y, block=1000):
    """Return what the model that is learnt says along a motion; of one that begins at rest."""
    t, n = np.arange(v.size) / RATE, adaptation.horizon
    free = adaptation.model.stream().process(v, t)
    noise = NOISE * abs(PAPER.scaling.Y) * np.random.default_rng(1).standard_normal(v.size)
    late = np.concatenate([np.full(n, np.nan), y + noise])[: v.size]
    parts = [slice(k, k + block) for k in range(0, v.size, block)]
    return np.concatenate([adaptation.process(v[c], t[c], free[c], late[c]) for c in parts])


def error(model, other, v):
    """Return the rms error beside a mean over the second half of a motion, in spans."""
    e = (model.simulate(v) - other.simulate(v))[v.size // 2 :]
    return float(np.std(e)) / abs(PAPER.scaling.Y)


@pytest.mark.parametrize(
    ('kind', 'changed'),
    [
        ('gain', stage(TRUE, gain=1.05)),
        ('hysteresis', stage(TRUE, gain=1.05)),
        ('hysteresis', stage(wider(TRUE, 0.1))),
    ],
)
def test_a_change_is_learnt_within_ten_seconds_of_a_scan(kind, changed):
    before, v = stage(TRUE), scan(4.0)
    own = error(MODEL, before, v)
    v = scan(15.0)
    y = np.where(np.arange(v.size) < 5 * RATE, before.simulate(v), changed.simulate(v))
    adaptation = Adaptation(stage(error=own), kind)
    estimate = learn(adaptation, v, y)
    late = (estimate - y)[-RATE:]
    assert np.std(late) / abs(PAPER.scaling.Y) < 1.2 * own
    # and so does the model that is written
    learnt = model_from_dict(parse_yaml(model_to_yaml(adaptation.learnt_model), 'it'), 'it')
    assert error(learnt, changed, scan(2.0)) < 1.2 * own < 0.3 * error(MODEL, changed, scan(2.0))
    (entry,) = learnt.identification['adaptation']
    assert entry['adapt'] == kind and entry['seconds'] > 9.0 and 'std' in entry['gain']


#: a stage after its change
CHANGED = replace(stage(TRUE), effects=())


@pytest.fixture(scope='module')
def identified():
    """Return a model that is identified afresh from a short record of the changed stage."""
    t = np.arange(2 * RATE) / RATE
    v = 5.0 - 5.0 * (1.0 - 0.5 * t) * np.cos(2 * np.pi * 3.0 * t)
    v = np.append(np.zeros(200), v * np.minimum(t / 0.1, 1.0))
    noise = NOISE * abs(PAPER.scaling.Y) * np.random.default_rng(0).standard_normal(v.size)
    record = pi.Record.from_arrays(v, CHANGED.simulate(v) + noise, sample_rate=RATE)
    return pi.identify(record, pi.Settings(max_order=1)).model


@pytest.mark.parametrize(('gain', 'width'), [(1.05, 0.0), (1.0, 0.1), (1.05, 0.1)])
def test_what_is_learnt_errs_as_a_fresh_identification(identified, gain, width):
    # before the change the stage had a smaller gain and a narrower loop
    h = wider(identified.hysteresis, 1.0 / (1.0 + width) - 1.0).scaled(1.0 / gain)
    model, v = replace(identified, hysteresis=h), scan(10.0)
    adaptation = Adaptation(model, 'hysteresis')
    learn(adaptation, v, CHANGED.simulate(v))
    fresh, learnt, old = (
        error(x, CHANGED, v) for x in (identified, adaptation.learnt_model, model)
    )
    assert learnt < 1.2 * fresh < 0.1 * old


@pytest.mark.parametrize('law', LAWS)
def test_laws_of_every_kind_are_learnt(law):
    h = random_hysteresis(np.random.default_rng(3), law)
    model, v = stage(h, error=1e-3), scan(4.0)
    changed = stage(h, gain=1.05)
    adaptation = Adaptation(model, 'hysteresis')
    learn(adaptation, v, changed.simulate(v))
    assert error(adaptation.learnt_model, changed, v) < 1e-4 < error(model, changed, v)


@pytest.mark.parametrize('share', [0.3, -0.3])
def test_other_shares_of_creep_are_learnt(share):
    gain = (1.0 + share) * np.array(CREEP.parameters['gain'])
    more = replace(CREEP, parameters={**CREEP.parameters, 'gain': gain.tolist()})
    changed, v = replace(MODEL, effects=(more,)), scan_with_holds(15.0)
    adaptation = Adaptation(MODEL, 'hysteresis')
    learn(adaptation, v, changed.simulate(v))
    value, std = adaptation.learnt['creep']
    assert value == pytest.approx(share, abs=0.02) and std < 0.1
    for w in (v, scan(4.0)):
        assert error(adaptation.learnt_model, changed, w) < 0.5 * error(MODEL, changed, w)


def test_nothing_is_learnt_at_rest_nor_of_what_does_not_move():
    adaptation = Adaptation(MODEL, 'hysteresis')
    v = scan(4.0, swing=0.0)
    v = np.append(v, np.full(20 * RATE, v[-1]))
    y = MODEL.simulate(v)
    at = 2 * RATE
    learn(adaptation, v[:at], y[:at])
    before = adaptation.learnt
    adaptation.begin()
    # drift and a zero that jumps, at rest
    rest = np.full(20 * RATE, v[-1])
    learn(adaptation, rest, y[-1] + np.linspace(0.0, 5e-6, rest.size) + 2e-6 * (rest > 0))
    for name, (value, std) in adaptation.learnt.items():
        assert_allclose((value, std), before[name], rtol=0.02, atol=1e-5, err_msg=name)
    # wide plays do not move in a scan of a tenth of the range
    adaptation.begin()
    learn(adaptation, scan(10.0, swing=1.0), stage(gain=1.02).simulate(scan(10.0, swing=1.0)))
    value, std = adaptation.learnt['weights_4']
    assert abs(value) < 1e-3 and std > 0.29


@pytest.mark.parametrize('kind', ['gain', 'hysteresis'])
def test_a_long_scan_leaves_the_model_where_it_is(kind):
    v, model = scan(120.0), stage(error=1e-4)
    adaptation = Adaptation(model, kind)
    learn(adaptation, v, model.simulate(v), 20_000)
    assert error(adaptation.learnt_model, model, scan(4.0)) < 2e-5
    assert error(adaptation.learnt_model, model, scan(4.0, 3.0, 10.0)) < 1e-4
    assert all(abs(x) < 0.02 for x, _ in adaptation.learnt.values())


def test_neither_drift_nor_a_zero_that_jumps_is_learnt():
    v = scan(16.0)
    t = np.arange(v.size) / RATE
    for more in (2e-6 * (t > 5.0), 3e-6 * (1.0 - np.exp(-t / 8.0))):
        adaptation = Adaptation(MODEL, 'hysteresis')
        learn(adaptation, v, MODEL.simulate(v) + more)
        # well below the error that the model has anyway
        assert error(adaptation.learnt_model, MODEL, scan(2.0)) < 2e-4


@pytest.mark.parametrize('seed', range(4))
def test_whatever_the_sensor_says_the_model_stays_one(seed):
    rng = np.random.default_rng(seed)
    v = scan(6.0, frequency=5.0, swing=8.0)
    y = MODEL.simulate(v)
    span = abs(PAPER.scaling.Y)
    wrong = (-y, 3.0 * y, span * rng.standard_normal(y.size), y + 0.3 * span * np.sin(v))[seed]
    y = np.where(rng.random(y.size) < 0.01, np.nan, wrong)
    adaptation = Adaptation(MODEL, 'hysteresis')
    estimate = learn(adaptation, v, y)
    learnt = adaptation.learnt_model
    assert np.isfinite(estimate).all()
    assert learnt.hysteresis.lowest_slope() > 0.0 and (learnt.hysteresis.weights >= 0.0).all()
    assert abs(adaptation.learnt['gain'][0]) <= LARGEST * GAIN_SIZE * (1 + 1e-6)


def test_how_it_is_cut_changes_nothing_and_restoring_goes_back():
    v = scan(2.0)
    y = stage(gain=1.03).simulate(v)
    one, other = Adaptation(MODEL, 'hysteresis'), Adaptation(MODEL, 'hysteresis')
    a, b = learn(one, v, y, v.size), learn(other, v, y, 77)
    assert_allclose(a, b, rtol=0, atol=1e-12 * abs(PAPER.scaling.Y))
    assert one.told['learnt/gain'] == pytest.approx(0.03, abs=1e-3)
    assert one.told['learnt/loop'] == pytest.approx(0.03, abs=3e-3)
    one.restore()
    one.begin()
    free = np.full(v.size, np.nan)
    again = one.process(v, np.arange(v.size) / RATE, y, free)
    assert np.array_equal(again, y)
    assert set(one.told.values()) == {0.0}


def test_a_model_without_plays_learns_its_gain():
    model = stage(Hysteresis([], [], 0.0, 1.0))
    v = scan(3.0)
    adaptation = Adaptation(model, 'hysteresis')
    learn(adaptation, v, stage(Hysteresis([], [], 0.0, 1.05)).simulate(v))
    assert adaptation.told == {'learnt/gain': pytest.approx(0.05, abs=1e-3)}
