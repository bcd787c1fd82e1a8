# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The safety contract: the voltage applied never leaves limits nor slew, whatever happens."""

from dataclasses import replace
import math

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from piezo_ident.common.errors import ConfigError
from piezo_ident.live.guard import Guard, GuardSettings
import pytest

FS = 1000.0
#: 1 V a sample, ramps of 20 mV a sample
USUAL = GuardSettings(0.0, 10.0, slew=1000.0, ramp_slew=20.0, rest=0.0, sample_rate=FS)


def within(voltage, before, setting=USUAL):
    """Assert limits and slew of what is applied after a voltage."""
    path = np.concatenate([[before], voltage])
    assert np.isfinite(path).all()
    assert path.min() >= setting.low
    assert path.max() <= setting.high
    assert np.abs(np.diff(path)).max(initial=0.0) <= setting.step * (1 + 1e-8)


def test_what_is_in_order_passes_bit_for_bit():
    guard = Guard(USUAL)
    v = 5 - 5 * np.cos(2 * np.pi * np.arange(3000) / 700)
    out = guard.process(v)
    assert out.voltage.tobytes() == v.tobytes()
    assert out.altered == {}
    # steps of just the slew too, whatever rounding makes of them
    v = v[-1] + np.array([0.0, 1.0, 0.0, 1.0])
    assert guard.process(v).voltage.tobytes() == v.tobytes()


def test_what_is_wrong_is_altered_and_counted_and_no_number_at_all_leaves_the_drive():
    guard = Guard(USUAL)
    out = guard.process([0.0, 0.5, math.nan, math.inf, 1.0, -1.0, 3.0])
    assert out.voltage.tolist() == [0.0, 0.5, 0.5, 0.5, 1.0, 0.0, 1.0]
    assert out.altered == {'not_finite': 2, 'outside_limits': 1, 'too_fast': 1}
    guard = Guard(USUAL, applied=4.0)
    out = guard.process([math.nan] * 3)
    assert out.voltage.tolist() == [4.0] * 3
    assert guard.process([5.0]).altered == {'joining': 1}


def test_a_new_stream_joins_softly_and_is_then_followed_exactly():
    guard = Guard(USUAL, applied=9.0)
    v = np.full(2000, 2.0)
    out = guard.process(v)
    # a raised cosine over 7 V with 20 V/s at its steepest
    assert out.altered == {'joining': 700}
    speed = np.diff(out.voltage) * FS
    assert out.voltage[0] == 9.0
    assert np.abs(speed).max() == pytest.approx(20.0, rel=1e-3)
    assert np.abs(speed[:10]).max() < 0.1
    assert np.array_equal(out.voltage[700:], v[700:])


def test_a_restart_on_the_spot_needs_no_ramp():
    guard = Guard(USUAL)
    guard.process(np.linspace(0, 5, 500))
    out = guard.process([5.0, 5.1], restarted=True)
    assert out.altered == {}
    assert guard.process([0.0], restarted=True).altered == {'joining': 1}


@pytest.mark.parametrize('level', [0.0, 3.3, 10.0])
def test_silence_ends_at_rest_exactly(level):
    guard = Guard(USUAL, applied=level)
    n = math.ceil(2 * level / 20.0 * FS)
    v = np.concatenate([guard.idle(7), guard.idle(n), guard.idle(5)])
    within(v, level)
    assert np.all(np.diff(v) <= 0)
    assert np.all(v[n:] == 0.0)
    assert guard.is_at_rest
    assert np.abs(np.diff(v, prepend=level)).max() <= 20.0 / FS * (1 + 1e-9)


def test_a_ramp_that_must_end_in_time_is_steeper_but_keeps_the_slew():
    for longest, end in ((0.1, 99), (0.001, 19)):
        v = Guard(USUAL, applied=10.0).idle(200, longest=longest)
        within(v, 10.0)
        assert np.flatnonzero(v == 0.0)[0] == end


@pytest.mark.parametrize(
    ('change', 'reason'),
    [
        ({'low': 10.0}, r'limits 10 \.\. 10 V'),
        ({'high': math.nan}, r'limits 0 \.\. nan V'),
        ({'rest': 11.0}, 'rest = 11 V .* 0 .. 10 V'),
        ({'rest': math.nan}, 'rest = nan V'),
        ({'slew': 0.0}, '^slew = 0 V/s'),
        ({'ramp_slew': math.nan}, 'ramp_slew = nan V/s'),
        ({'sample_rate': -1.0}, 'sample_rate = -1 Hz'),
    ],
)
def test_settings_that_make_no_sense_are_refused(change, reason):
    values = {'low': 0.0, 'high': 10.0, 'slew': 1.0, 'ramp_slew': 1.0, 'rest': 0.0}
    with pytest.raises(ConfigError, match=reason):
        GuardSettings(**{**values, 'sample_rate': FS, **change})


any_float = st.one_of(
    st.floats(-2, 12), st.floats(), st.sampled_from([0.0, 10.0, 10.0000001, -0.0, 1e308])
)
actions = st.lists(
    st.one_of(
        st.tuples(st.just('process'), st.lists(any_float, max_size=30), st.booleans()),
        st.tuples(st.just('level'), st.floats(-1, 11), st.integers(1, 800)),
        st.tuples(st.just('idle'), st.integers(0, 1200), st.sampled_from([math.inf, 0.01, 0.0])),
        st.tuples(st.just('hold'), st.integers(0, 50), st.none()),
    ),
    max_size=12,
)
settings_of_any_kind = st.builds(
    lambda low, span, rest, slew, ramp: GuardSettings(
        low, low + span, slew, ramp, min(max(low + rest * span, low), low + span), FS
    ),
    st.floats(-10, 10),
    st.floats(0.1, 200),
    st.floats(0, 1),
    st.floats(1, 1e6),
    st.floats(1, 1e6),
)


def act(guard, action):
    kind, what, how = action
    if kind == 'process':
        return guard.process(what, restarted=how).voltage
    if kind == 'level':
        return guard.process(np.full(how, what)).voltage
    if kind == 'idle':
        return guard.idle(what, how)
    return guard.hold(what)


@settings(max_examples=300, deadline=None)
@given(settings_of_any_kind, actions)
def test_limits_and_slew_hold_whatever_happens(setting, todo):
    guard = Guard(setting)
    for action in todo:
        before = guard.applied
        out = act(guard, action)
        within(out, before, setting)
        assert guard.applied == (out[-1] if out.size else before)
        if action[0] == 'idle':
            # never away from rest
            path = np.abs(np.concatenate([[before], out]) - setting.rest)
            assert np.all(np.diff(path) <= 1e-9 * (setting.high - setting.low))
    n = math.ceil(2 * (setting.high - setting.low) / setting.ramp_step) + 1
    if n < 10**6:
        guard.idle(n)
        assert guard.is_at_rest


@settings(max_examples=200, deadline=None)
@given(
    st.lists(any_float, max_size=120), st.lists(st.integers(0, 40), max_size=8), st.floats(0, 10)
)
def test_the_result_does_not_depend_on_the_cutting(v, cuts, applied):
    whole, pieces = Guard(USUAL, applied), Guard(USUAL, applied)
    expected = whole.process(v)
    parts, begin = [], 0
    for n in [*cuts, len(v)]:
        parts.append(pieces.process(v[begin : begin + n]))
        begin += n
    got = np.concatenate([p.voltage for p in parts])
    assert got.tobytes() == expected.voltage.tobytes()
    for why in ('not_finite', 'outside_limits', 'too_fast', 'joining'):
        assert sum(p.altered.get(why, 0) for p in parts) == expected.altered.get(why, 0)


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 600), st.integers(0, 600))
def test_a_ramp_does_not_depend_on_the_cutting(a, b):
    whole, pieces = Guard(USUAL, 7.3), Guard(USUAL, 7.3)
    got = np.concatenate([pieces.idle(a), pieces.idle(b)])
    assert got.tobytes() == whole.idle(a + b).tobytes()


@pytest.mark.parametrize('how', ['hold', 'idle', 'process'])
def test_limits_that_are_moved_away_are_followed_at_the_slew(how):
    guard = Guard(USUAL, applied=9.0)
    guard.process([9.0])
    guard.settings = GuardSettings(1.0, 6.5, slew=1000.0, ramp_slew=20.0, rest=1.0, sample_rate=FS)
    # no number leaves the last command in force, which is outside by now
    v = guard.process([math.nan] * 4).voltage if how == 'process' else getattr(guard, how)(4)
    assert v[:3].tolist() == [8.0, 7.0, 6.5]
    assert v[3] == pytest.approx(6.5, abs=0.01)


def test_silence_is_remembered_when_limits_are_moved_in_it():
    guard = Guard(USUAL, applied=8.0)
    guard.idle(10)
    guard.settings = GuardSettings(0.0, 9.0, slew=1000.0, ramp_slew=20.0, rest=0.0, sample_rate=FS)
    before = guard.applied
    # what comes next is a new stream all the same, and joined by a ramp
    assert guard.process([before - 0.9]).altered == {'joining': 1}


def test_equal_settings_do_not_begin_a_ramp_anew():
    guard, whole = Guard(USUAL, 7.3), Guard(USUAL, 7.3)
    first = guard.idle(100)
    guard.settings = replace(USUAL)
    got = np.concatenate([first, guard.idle(300)])
    assert got.tobytes() == whole.idle(400).tobytes()
