# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The effects behind G, against their equations: modes, sensor, play, other axis, time, delay."""

from dataclasses import replace
from itertools import pairwise

from effect_table import alone, FS, H, other, PAPER, played, signal, VISIBLE, with_effects
from hypothesis import assume, given, settings
from hypothesis import strategies as st
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from piezo_ident.common.errors import ModelError
from piezo_ident.effects import find_effect
from piezo_ident.model.free_run import free_run
from piezo_ident.model.stage_model import EffectSetting
from piezo_ident.operators.chain import Block
from piezo_ident.operators.dynamics import Delay, Dynamics
from piezo_ident.record.record import Piece, Record
import pytest
from scipy.signal import lfilter

#: G = 1 without delay: what is left is H and the effects
STATIC = replace(PAPER, dynamics=Dynamics.unit(), delay=Delay(0))


def response(name: str, values: dict, f: np.ndarray, n: int = 100_000, **channels) -> np.ndarray:
    """Return the frequency response of one effect, from its response to an impulse."""
    u = np.zeros(n)
    u[1] = 1.0
    y = alone(name, values, u, **channels)[1:]
    k = np.arange(y.size)
    return np.array([y @ np.exp(-2j * np.pi * x / FS * k) for x in f])


def mode(f: np.ndarray, own: float, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """Return M and R at some frequencies, with the frequency axis of the bilinear transform."""
    s = 1j * np.tan(np.pi * f / FS) / np.tan(np.pi * own / FS)
    below = s * s + 2 * damping * s + 1
    return 1 / below, s / below


def test_changed_dynamics_have_their_frequency_response():
    f = np.array([1.0, 50.0, 390.0, 400.0, 410.0, 1000.0, 2500.0, 6000.0])
    values = VISIBLE['changed_dynamics']
    expected = np.ones(f.size, complex)
    for own, damping, gain, rate in zip(*values.values(), strict=True):
        M, R = mode(f, own, damping)
        expected += gain * (M - 1) + rate * R
    assert_allclose(response('changed_dynamics', values, f), expected, atol=1e-9)
    # at its own frequency the discrete mode is the continuous one
    M, R = mode(np.array([400.0]), 400.0, 0.05)
    assert_allclose([M[0], R[0]], [1 / 0.1j, 1 / 0.1], rtol=1e-12)


def second_order(own: float, damping: float, c: float) -> tuple[np.ndarray, np.ndarray]:
    """Return b and a of a mode by the bilinear transform s -> c (1 - z)/(1 + z), w in radians."""
    w = 2 * np.pi * own
    a = np.array(
        [
            c * c + 2 * damping * w * c + w * w,
            2 * w * w - 2 * c * c,
            c * c - 2 * damping * w * c + w * w,
        ]
    )
    return w * w * np.array([1.0, 2.0, 1.0]) / a[0], a / a[0]


@settings(deadline=None, max_examples=30)
@given(
    old=st.tuples(st.floats(200.0, 2000.0), st.floats(0.005, 0.2)),
    ratio=st.floats(0.5, 2.0),
    damping=st.floats(0.005, 0.2),
)
def test_a_resonance_that_moved_is_of_this_form(old, ratio, damping):
    new = (ratio * old[0], damping)
    c = 2 * np.pi * new[0] / np.tan(np.pi * new[0] / FS)
    u = signal(3000) / 10
    # from rest: the sine starts at zero
    before, after = (lfilter(*second_order(*x, c), u) for x in (old, new))
    values = {
        'frequency': [new[0]],
        'damping': [new[1]],
        'gain': [1 - ratio**2],
        'rate_gain': [2 * old[1] * ratio - 2 * new[1] * ratio**2],
    }
    # within the bounds of the effect
    assume(max(map(abs, (*values['gain'], *values['rate_gain']))) <= 100.0)
    scale = 1 + abs(values['gain'][0])
    assert_allclose(alone('changed_dynamics', values, before), after, atol=1e-9 * scale)


def test_sensor_is_its_polynomial_of_the_displacement():
    model = with_effects('sensor_nonlinearity')
    v = signal()
    y = played(PAPER, v) / 75e-6
    law = y + 0.004 * y**2 - 0.002 * y**3
    assert_allclose(played(model, v) / 75e-6, law, atol=1e-13)


def test_backlash_loses_a_way_of_twice_its_width_after_a_turn():
    u = np.concatenate([np.linspace(0, 1, 101), np.linspace(1, 0, 101), np.linspace(0, 1, 101)])
    y = alone('backlash', {'width': 0.05, 'gain': 1.0}, u)
    # pushed up, it follows behind by the half-width; pulled down, ahead by it
    assert_allclose(y[20:101], u[20:101] - 0.05, atol=1e-12)
    assert_allclose(y[101:111], 0.95, atol=1e-12)
    assert_allclose(y[115:202], u[115:202] + 0.05, atol=1e-12)
    assert np.ptp(y[110:]) == pytest.approx(np.ptp(u) - 2 * 0.05, abs=0.011)
    half = alone('backlash', {'width': 0.05, 'gain': 0.5}, u)
    assert_allclose(half, (u + y) / 2, atol=1e-12)
    # symmetric: upside down it is the same
    assert_allclose(alone('backlash', {'width': 0.05, 'gain': 1.0}, -u), -y, atol=1e-12)


def test_cross_coupling_has_its_static_gain_and_its_resonance():
    values = {'channel': 'other_axis', 'gain': 0.02, 'frequency': 300.0, 'damping': 0.3}
    still = np.full(100, 0.4)
    y = alone('cross_coupling', {**values, 'offset': 1.0}, still, other_axis=np.full(100, 3.0))
    assert_allclose(y, 0.4 + 0.02 * 2.0, atol=1e-13)

    n, f = 20_000, 300.0
    t = np.arange(n) / FS
    y = alone('cross_coupling', values, np.zeros(n), other_axis=np.sin(2 * np.pi * f * t))[
        n // 2 :
    ]
    line = np.fft.rfft(y)[int(f / 2)] / (n / 4)
    # M at its own frequency: -i / (2 zeta)
    assert abs(line) == pytest.approx(0.02 / 0.6, rel=1e-6)


def test_cross_coupling_of_the_rate_is_the_derivative():
    n, f = 20_000, 10.0
    other_axis = np.sin(2 * np.pi * f * np.arange(n) / FS)
    values = {'channel': 'other_axis', 'frequency': 3000.0, 'damping': 0.7}
    plain = alone('cross_coupling', {**values, 'gain': 1.0}, np.zeros(n), other_axis=other_axis)
    rate = alone(
        'cross_coupling', {**values, 'rate_gain': 1e-3}, np.zeros(n), other_axis=other_axis
    )
    expected = 1e-3 * np.gradient(plain) * FS
    assert_allclose(rate[2000:-1], expected[2000:-1], atol=2e-6)


def test_cross_coupling_says_which_channel_is_missing_and_what_there_is():
    model, v = with_effects('cross_coupling'), signal()
    with pytest.raises(ModelError, match=r"'other_axis'; .*none"):
        model.stream().process(v)
    piece = Piece(v, v, FS, channels={'temperature': v, 'b': v})
    with pytest.raises(ModelError, match=r"'other_axis'; .* b, temperature;"):
        free_run(model, Record((piece,)))


def test_cross_coupling_in_a_record_is_that_of_the_stream():
    model, v = with_effects('cross_coupling'), signal()
    record = Record((Piece(v, np.zeros(v.size), FS, channels={'other_axis': other(v.size)}),))
    assert_array_equal(free_run(model, record).pieces[0], played(model, v))


def test_hum_has_the_lines_and_phases_it_was_given():
    n = 20_000
    x = alone('periodic_disturbance', VISIBLE['periodic_disturbance'], np.zeros(n))
    spectrum = np.fft.rfft(x) / (n / 2)
    assert_array_equal(np.flatnonzero(np.abs(spectrum) > 1e-9), [50, 150])
    assert_allclose(np.abs(spectrum[[50, 150]]), [1e-3, 3e-4], rtol=1e-9)
    assert_allclose(np.angle(spectrum[[50, 150]]) + np.pi / 2, [0.4, 1.1], atol=1e-9)


def test_drift_goes_on_through_a_gap():
    static = with_effects('thermal_drift', model=STATIC)
    zero = np.zeros(100)
    early, late = Piece(zero, zero, FS), Piece(zero, zero, FS, start_time=2.0)
    first, second = free_run(static, Record((early, late))).pieces
    assert first[0] == 0.0

    def law(t):
        return 75e-6 * (1e-3 * t + 0.01 * (1 - np.exp(-t / 0.5)))

    assert_allclose(first, law(early.t), rtol=1e-9)
    assert_allclose(second, law(late.t), rtol=1e-9)


def test_drift_does_not_look_at_the_command():
    one = alone('thermal_drift', VISIBLE['thermal_drift'], np.zeros(100), t0=-1e-3)
    two = alone('thermal_drift', VISIBLE['thermal_drift'], np.full(100, 0.7), t0=-1e-3)
    assert_allclose(two - one, 0.7, atol=1e-15)
    # before the clock starts nothing has drifted
    assert_array_equal(one[:20], np.zeros(20))


def test_gain_is_that_of_its_knots_and_of_the_last_one_beyond():
    values = {'time': [1.0, 2.0, 4.0], 'gain': [0.0, 0.1, -0.1]}
    for t0, gain in ((0.0, 0.0), (1.0, 0.0), (1.5, 0.05), (3.0, 0.0), (4.0, -0.1), (9.0, -0.1)):
        assert alone('gain_drift', values, np.full(1, 0.6), t0=t0)[0] == pytest.approx(
            0.6 * (1 + gain), abs=1e-15
        )


def test_feedthrough_is_command_and_rate_without_the_delay():
    model = with_effects('input_feedthrough', model=replace(PAPER, delay=Delay(40)))
    v = np.where(np.arange(200) >= 50, 1.0, 0.0)
    more = (played(model, v) - played(replace(model, effects=()), v)) / 75e-6
    expected = 0.003 * v / 10
    expected[50] += 1e-6 * 0.1 * FS
    assert_allclose(more, expected, atol=1e-15)


def moved(delta: float, delay: Delay, *, v: np.ndarray) -> np.ndarray:
    model = replace(
        PAPER, delay=delay, effects=(EffectSetting('delay_change', {'samples': delta}),)
    )
    return played(model, v)


@pytest.mark.parametrize(
    ('delta', 'delay', 'same'),
    [
        (2.0, Delay(3), Delay(5)),
        (-2.0, Delay(3), Delay(1)),
        (-3.0, Delay(3), Delay(0)),
        (0.25, Delay(3), Delay(3, 0.25)),
        (-0.75, Delay(3, 0.5), Delay(2, 0.75)),
        (0.5, Delay(3, 0.5), Delay(4)),
        (-0.125, Delay(3, 0.125), Delay(3)),
    ],
)
def test_delay_changes_either_way_by_samples_and_fractions(delta, delay, same):
    v = signal()
    assert_array_equal(moved(delta, delay, v=v), played(replace(PAPER, delay=same), v))


def test_changes_of_the_delay_add_up_and_one_below_nothing_is_refused():
    effects = tuple(EffectSetting('delay_change', {'samples': x}) for x in (1.5, -0.5))
    model, v = replace(PAPER, effects=effects), signal()
    assert model.total_delay == Delay(4)
    assert_array_equal(played(model, v), played(replace(PAPER, delay=Delay(4)), v))
    model = replace(PAPER, effects=(EffectSetting('delay_change', {'samples': -3.1}),))
    with pytest.raises(ModelError, match=r'\b3 samples .* -3\.1'):
        model.stream()


def test_delay_change_leaves_what_joins_behind_it():
    v = signal()
    effects = (
        EffectSetting('delay_change', {'samples': 2.0}),
        EffectSetting('input_feedthrough', VISIBLE['input_feedthrough']),
    )
    for order in (effects, effects[::-1]):
        model = replace(PAPER, effects=order)
        same = with_effects('input_feedthrough', model=replace(PAPER, delay=Delay(5)))
        assert_array_equal(played(model, v), played(same, v))


@pytest.mark.parametrize('name', ['gain_drift', 'periodic_disturbance', 'thermal_drift'])
def test_what_time_drives_follows_the_clock_and_not_the_count(name):
    u = signal(2000) / 10
    t = np.concatenate([np.arange(1000), 5000 + np.arange(1000)]) / FS
    effect = find_effect(name)(FS, VISIBLE[name], H)
    effect.reset(u[0], u[0])
    parts = [
        effect.process(Block(t[a:b], u[a:b], u[a:b])).x for a, b in pairwise([0, 700, 1200, 2000])
    ]
    late = find_effect(name)(FS, VISIBLE[name], H)
    late.reset(u[0], u[0])
    whole = late.process(Block(t, u, u)).x
    assert_array_equal(np.concatenate(parts), whole)
    again = find_effect(name)(FS, VISIBLE[name], H).process(Block(t[1000:], u[1000:], u[1000:])).x
    assert_array_equal(again, whole[1000:])
