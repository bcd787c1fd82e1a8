# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The effects of the voltage and of H, against their equations written plainly."""

from effect_table import alone, FS, H, signal, VISIBLE
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from piezo_ident.effects import Effect, find_effect
from piezo_ident.operators.chain import Block
from piezo_ident.operators.hysteresis import Hysteresis, HysteresisOperator
from piezo_ident.operators.hysteresis_law import HysteresisLaw
from piezo_ident.operators.play import play_columns
import pytest


def step(n: int, at: int = 10) -> np.ndarray:
    """Return 0, and 1 from sample `at` on."""
    return (np.arange(n) >= at).astype(float)


@pytest.mark.parametrize('tau', [2e-5, 1e-3, 0.05])
def test_lag_rises_like_its_exponential(tau):
    y = alone('amplifier_lag', {'time_constant': tau}, step(3000))
    t = np.arange(1, 2991) / FS
    assert_array_equal(y[:10], 0.0)
    assert_allclose(y[10:], 1 - np.exp(-t / tau), atol=1e-12)


def test_slew_limit_is_a_ramp_and_then_nothing():
    y = alone('slew_limit', {'limit': 250.0}, step(200))
    ramp = np.minimum(1.0, 250.0 * np.arange(1, 191) / FS)
    assert_allclose(y[10:], ramp, atol=1e-12)
    # a motion slower than the limit passes unchanged, to the last bit
    slow = 0.5 - 0.5 * np.cos(2 * np.pi * 40 * np.arange(4000) / FS)
    assert_array_equal(alone('slew_limit', {'limit': 1.01 * np.pi * 40}, slow), slow)
    assert np.any(alone('slew_limit', {'limit': 0.9 * np.pi * 40}, slow) != slow)


@settings(deadline=None)
@given(
    u=st.lists(st.floats(-3.0, 3.0), min_size=1, max_size=30),
    ends=st.tuples(st.floats(-1.0, 0.4), st.floats(0.5, 2.0)),
    knee=st.floats(1e-6, 0.5),
)
def test_soft_saturation_lies_close_to_the_hard_one(u, ends, knee):
    u, (low, high) = np.array(u), ends
    hard = alone('saturation', {'low': low, 'high': high}, u)
    assert_array_equal(hard, np.clip(u, low, high))
    soft = alone('saturation', {'low': low, 'high': high, 'knee': knee}, u)
    # ln(1 + e^z) is off by ln 2 at most, at the end itself, and both ends act
    assert np.all(np.abs(soft - hard) <= knee * np.log(2) * (1 + 1e-9) + 1e-12)
    assert np.all(np.diff(soft[np.argsort(u)]) >= -1e-12)
    assert np.all((soft > low - 1e-9) & (soft < high + 1e-9))


def test_saturation_with_one_end_leaves_the_other():
    u = np.linspace(-50, 50, 1001)
    y = alone('saturation', {'high': 0.5, 'knee': 0.1}, u)
    assert_allclose(y, 0.5 - 0.1 * np.logaddexp(0, (0.5 - u) / 0.1), atol=1e-12)
    assert_allclose(y[u < -10], u[u < -10], atol=1e-12)


def test_creep_is_its_exponentials():
    values = {'gain': [0.02, 0.0, -0.01], 'time_constant': [0.01, 0.2, 3.0]}
    t = np.arange(1, 4001) / FS
    y = alone('creep', values, step(4010))[10:]
    law = 1.0 + 0.02 * -np.expm1(-t / 0.01) - 0.01 * -np.expm1(-t / 3.0)
    assert_allclose(y, law, atol=1e-11)


@pytest.mark.parametrize(
    ('gain', 'can_be'),
    [
        ([0.01, 0.02, 0.01], True),
        # neighbours trade, and the fastest one makes up for dynamics
        ([-0.05, 0.03, -0.002], True),
        ([0.01, -0.03, 0.02], False),
        ([-0.01, -0.02, -0.01], False),
    ],
)
def test_creep_goes_on_in_the_direction_of_the_step(gain, can_be):
    values = {'gain': gain, 'time_constant': [0.01, 0.3, 3.0]}
    assert find_effect('creep').is_plausible(values) == can_be
    # what one record alone shows has no such rule
    assert find_effect('thermal_drift').is_plausible({'rate': -0.1})


@pytest.mark.parametrize(
    ('frequency', 'damping', 'can_be'), [(70.0, 5.4, True), (1.0, 0.7, True), (70.0, 100.0, False)]
)
def test_coupling_is_no_drift(frequency, damping, can_be):
    values = {'frequency': frequency, 'damping': damping}
    assert find_effect('cross_coupling').is_plausible(values) == can_be


def plainly(u, fs, gain, exponent, cutoff, stretch=0.0, memory=None):
    """Return H with growing thresholds, written as in the text book."""
    pole = np.exp(-2 * np.pi * cutoff / fs)
    f = H.initial_memory(u[0]) if memory is None else memory
    s, last, w = 0.0, u[0], []
    for x in u:
        s = pole * s + (1 - pole) * (x - last) * fs
        last = x
        power = abs(s) ** exponent
        r = np.maximum(0.0, H.thresholds * (1 + stretch * power) + gain * power)
        f = np.maximum(x - r, np.minimum(x, f))
        w.append(H.p1 * x**3 + H.p2 * x + H.weights @ f)
    return np.array(w)


@pytest.mark.parametrize(
    'values',
    [
        (1e-4, 1.0, 1000.0, 0.0),
        (2e-3, 0.5, 200.0, 0.0),
        (0.0, 0.7, 500.0, 5e-3),
        (-2e-3, 1.0, 1000.0, -1e-3),
    ],
)
def test_rate_dependence_is_its_equation(values):
    u = signal(1500) / 10
    names = ('gain', 'exponent', 'cutoff', 'stretch')
    got = alone('rate_dependent_hysteresis', dict(zip(names, values, strict=True)), u)
    assert_allclose(got, plainly(u, FS, *values), atol=1e-13)


def test_rate_dependence_of_a_wide_hysteresis_moves_its_curves_too():
    r = np.array([0.1, 0.4])
    h = Hysteresis(r, [0.3, 0.2], -0.2, 1.0, 0.1, [[0.2, -0.1], [0.1, 0.3]], [0.1, -0.1])
    u, pole = signal(1500) / 10, np.exp(-2 * np.pi * 500 / FS)
    effect = find_effect('rate_dependent_hysteresis')
    values = effect.check({'gain': 1e-4, 'exponent': 1.0, 'cutoff': 500.0})
    operator = effect(FS, values, h, HysteresisOperator(h))
    operator.reset(u[0], u[0])
    got = operator.process(Block(np.arange(u.size) / FS, u, u)).x
    f, s, last, w = h.initial_memory(u[0]), 0.0, u[0], []
    for x in u:
        s, last = pole * s + (1 - pole) * (x - last) * FS, x
        f = np.maximum(x - r - 1e-4 * abs(s), np.minimum(x, f))
        t = np.clip(f, 0, 1 - r)
        curves = h.curves[:, 0] @ t**2 + h.curves[:, 1] @ t**3
        w.append((h.p1 * x + h.p0) * x**2 + h.p2 * x + (h.weights + h.bias * x) @ f + curves)
    assert_allclose(got, w, atol=1e-13)


@pytest.mark.parametrize('is_wide', [False, True])
def test_rate_dependence_knows_its_derivatives(is_wide):
    r = np.array([0.1, 0.4])
    bends = (0.1, [[0.2, -0.1], [0.1, 0.3]], [0.1, -0.1]) if is_wide else ()
    h = Hysteresis(r, [0.3, 0.2], -0.2, 1.0, *bends)
    effect = find_effect('rate_dependent_hysteresis')
    numbers = ('gain', 'exponent', 'levelling', 'cutoff', 'stretch', 'lead', 'lead_stretch')
    values = dict(zip(numbers, (1e-4, 0.8, 0.01, 500.0, 2e-3, 2e-5, -5e-5), strict=True))
    k = np.arange(1500)
    u = 0.5 - 0.45 * np.cos(0.013 * k) + 0.05 * np.sin(0.11 * k)
    block = Block(k / FS, u, u)

    def at_rest(**changed):
        operator = effect(FS, effect.check({**values, **changed}), h, HysteresisOperator(h))
        operator.reset(u[0], u[0])
        return operator

    slopes = at_rest().slopes(block)
    assert set(slopes) == set(values)
    for name, value in values.items():
        near = 1e-6 * abs(value)
        up, down = (at_rest(**{name: value + d}).process(block).x for d in (near, -near))
        difference = (up - down) / (2.0 * near)
        # a play that just leaves an edge, or just does not, is the rest
        assert np.quantile(np.abs(slopes[name] - difference), 0.98) < 1e-4 * np.ptp(difference)


@pytest.mark.parametrize('name', ['plays', 'bias', 'duhem'])
def test_rate_dependence_of_parts_of_h_adds_up(name):
    law = HysteresisLaw(name, [0.1, 0.4])
    theta = np.linspace(0.1, 0.3, law.size)
    h, start, u = law.hysteresis(theta), np.array([0.02, -0.1]), 0.1 + signal(1500) / 20
    effect = find_effect('rate_dependent_hysteresis')
    values = effect.check({'gain': 1e-4, 'stretch': 2e-3, 'exponent': 0.8, 'cutoff': 500.0})
    block = Block(np.arange(u.size) / FS, u, u)
    operator = effect(FS, values, h, HysteresisOperator(h, start))
    operator.reset(u[0], u[0])
    parts = ((part, start[own]) for part, own in law.parts(range(law.size)))
    found = np.array(list(operator.of_parts(block, u[0], parts)))
    again = ((part, start[own]) for part, own in law.parts(range(law.size)))
    assert_allclose(found, list(Effect.of_parts(operator, block, u[0], again)), atol=1e-12)
    # a link in front of H may rest elsewhere than its first output
    rest = u[0] + 0.05
    held = [
        (part, np.clip(start[own], rest - part.thresholds, rest))
        for part, own in law.parts(range(law.size))
    ]
    alone = list(Effect.of_parts(operator, block, rest, held))
    assert_allclose(list(operator.of_parts(block, rest, held)), alone, atol=1e-12)
    assert_allclose(theta @ found, operator.process(block).x, atol=1e-12)
    assert np.abs(theta @ found - h(u, start)).max() > 1e-3


def test_even_nonlinearity_is_its_powers():
    u = signal() / 10
    y = alone('even_nonlinearity', {'square': 0.02, 'fourth': -0.03}, u)
    assert_allclose(y - H(u), 0.02 * u**2 - 0.03 * u**4, atol=1e-14)


def test_minor_loops_are_plays_with_a_tilted_weight():
    u = signal() / 10
    values = {'threshold': [0.03, 0.2], 'slope': [0.04, -0.02], 'bias': 0.4}
    y = alone('noncongruent_minor_loops', values, u)
    plays = play_columns(u, values['threshold'])
    assert_allclose(y - H(u), (u - 0.4) * (np.array(values['slope']) @ plays), atol=1e-13)


@settings(deadline=None, max_examples=30)
@given(
    past=st.lists(st.floats(0.0, 1.0), min_size=2, max_size=6),
    r=st.sampled_from([0.1, 0.15, 0.5, 0.85]),
)
def test_minor_loops_start_from_the_memory_that_h_was_given(past, r):
    # a history that H's own thresholds saw; the play in between has to agree with it closely
    fine = Hysteresis(np.arange(1, 100) / 100, np.ones(99), 0.0, 1.0)
    u = np.array(past)
    memory = play_columns(u, fine.thresholds)[:, -1]
    values = {'threshold': [r], 'slope': [1.0], 'bias': 0.0}
    effect = find_effect('noncongruent_minor_loops')(
        FS, values, fine, HysteresisOperator(fine, memory)
    )
    x0 = float(u[-1])
    rest = effect.reset(0.0, x0) - HysteresisOperator(fine, memory).reset(0.0, x0)
    assert rest == pytest.approx(x0 * play_columns(u, [r])[0, -1], abs=0.011)


def test_preload_is_a_kink_at_one_voltage():
    u = signal() / 10
    x = alone('preload_loss', {'gain': 0.05, 'threshold': 0.3}, u)
    assert_allclose(x - u, -0.05 * np.maximum(0.0, 0.3 - u), atol=1e-15)
    # the kink is where the command is, whatever the signal does there
    effect = find_effect('preload_loss')(FS, {'gain': 0.05, 'threshold': 0.3})
    block = Block(np.arange(3) / FS, np.array([0.1, 0.3, 0.9]), np.array([7.0, 8.0, 9.0]))
    assert_allclose(effect.process(block).x, [6.99, 8.0, 9.0], atol=1e-15)


class Square(Effect):
    """Add 0.1 v^2."""

    name = 'square'
    slot = 'hysteresis'
    parameters = ()

    def reset(self, v0, x0):
        return self.inner.reset(v0, x0) + 0.1 * x0**2

    def process(self, block):
        inner = self.inner.process(block)
        return inner.with_signal(inner.x + 0.1 * block.x**2)


@pytest.mark.parametrize(
    'name', ['rate_dependent_hysteresis', 'even_nonlinearity', 'noncongruent_minor_loops']
)
def test_effects_of_the_slot_of_h_stack_in_any_order(name):
    effect, values = find_effect(name), VISIBLE[name]
    # a stage that came from above: every play at the lower end of its band
    u, memory = signal() / 10, -H.thresholds

    def run(operator):
        rest = operator.reset(u[0], u[0])
        y = operator.process(Block(np.arange(u.size) / FS, u, u)).x
        assert rest == pytest.approx(y[0], abs=1e-15)
        return y

    one = run(effect(FS, values, H, Square(FS, {}, H, HysteresisOperator(H, memory))))
    two = run(Square(FS, {}, H, effect(FS, values, H, HysteresisOperator(H, memory))))
    assert_allclose(one, two, atol=1e-14)
    alone_there = run(effect(FS, values, H, HysteresisOperator(H, memory)))
    assert_allclose(one - 0.1 * u**2, alone_there, atol=1e-13)
    if name == 'rate_dependent_hysteresis':
        # the memory that was given is the one that both kinds of plays start from
        assert_allclose(alone_there, plainly(u, FS, *values.values(), memory), atol=1e-13)
