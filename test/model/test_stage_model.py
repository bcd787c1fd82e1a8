# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The model: a stream is the batch, scaling with either sign, rates, ranges."""

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from paper_stage import FS, PAPER
from piezo_ident.common.errors import DataError, ModelError
from piezo_ident.model.free_run import free_run
from piezo_ident.model.scaling import Scaling
from piezo_ident.model.stage_model import EffectSetting
from piezo_ident.model.stream import CHUNK
from piezo_ident.operators.dynamics import Delay, Dynamics
from piezo_ident.record.record import Piece, Record
import pytest


def long_signal(n=3 * CHUNK + 100):
    t = np.arange(n) / FS
    return 5 - 5 * np.cos(2 * np.pi * 20 * t) * np.minimum(1, 0.5 + t)


def test_prediction_does_not_show_its_own_chunks():
    v = long_signal()
    assert_array_equal(PAPER.stream().process(v), PAPER.simulate(v))


def test_chain_is_h_then_g_then_delay():
    model = replace(PAPER, delay=Delay(4))
    v = long_signal(2000)
    w = model.hysteresis(v / 10)
    x = np.zeros(v.size)
    a, b = model.dynamics.a, model.dynamics.b
    delayed = np.concatenate([np.full(4, w[0]), w[:-4]])
    pad = np.concatenate([np.full(20, w[0]), delayed])
    out = np.full(pad.size, w[0] * model.dynamics.gain)
    # eq. (4), as it is printed
    for k in range(20, pad.size):
        out[k] = -sum(a[i] * out[k - 1 - i] for i in range(10))
        out[k] += sum(b[j] * pad[k - j] for j in range(10))
    x = out[20:]
    assert_allclose(model.stream().process(v), 75e-6 * x, atol=1e-12 * 75e-6)


def test_stage_that_retracts_is_the_mirror_image():
    v = long_signal(2000)
    s = PAPER.scaling
    mirrored = replace(PAPER, scaling=Scaling(s.v0, s.V, 1e-5, -s.Y, s.range))
    assert_allclose(
        mirrored.stream().process(v), 1e-5 - PAPER.stream().process(v), atol=1e-17, rtol=1e-12
    )


def test_scaling_goes_both_ways():
    s = Scaling(v0=-150.0, V=300.0, y0=2e-6, Y=-40e-6, range=(-150, 150))
    assert_allclose(s.u([-150, 0, 150]), [0, 0.5, 1])
    y = np.linspace(-1e-5, 1e-5, 7)
    assert_allclose(s.y(s.x(y)), y, atol=1e-20)
    assert float(s.y(1.0)) == pytest.approx(-38e-6)


@pytest.mark.parametrize(
    ('key', 'value'),
    [
        *(('V', 0.0), ('V', -1.0), ('Y', 0.0), ('v0', float('nan'))),
        *(('range', ends) for ends in ((1.0, 1.0), (2.0, 1.0), (0.0, float('inf')))),
    ],
)
def test_scaling_that_cannot_be_is_refused(key, value):
    known = {'v0': 0.0, 'V': 10.0, 'y0': 0.0, 'Y': 1e-5, 'range': (0.0, 10.0)}
    with pytest.raises(ModelError, match='scaling'):
        Scaling(**{**known, key: value})


def test_unstable_dynamics_and_bad_rates_are_refused():
    with pytest.raises(ModelError, match='unstable'):
        replace(PAPER, dynamics=Dynamics([-1.01], [1.0]))
    for rate in (0.0, -1.0, float('nan'), float('inf')):
        with pytest.raises(ModelError, match='sample_rate'):
            replace(PAPER, sample_rate=rate)


def record(v, rate=FS, name='mine'):
    v = np.asarray(v, dtype=float)
    return Record((Piece(v, np.zeros(v.size), rate),), name)


def test_other_rates_are_refused_unless_nothing_depends_on_them():
    v = np.linspace(0, 10, 100)
    with pytest.raises(ModelError, match='5000 Hz'):
        free_run(PAPER, record(v, 5000.0))
    free_run(PAPER, record(v, FS * (1 + 1e-8)))
    static = replace(PAPER, dynamics=Dynamics.unit(), delay=Delay(0))
    assert static.is_static
    assert static.without_dynamics().is_static
    free_run(static, record(v, 5000.0))
    assert not PAPER.is_static


def test_leaving_the_identified_range_warns_with_numbers():
    assert free_run(PAPER, record(np.linspace(0, 10, 100))).warnings == ()
    # rounding at the ends is no extrapolation
    assert free_run(PAPER, record([0, -1e-3, 10.004])).warnings == ()
    (warning,) = free_run(PAPER, record([0, 5, 10, 12])).warnings
    assert 'mine' in warning and '25.0%' in warning
    assert '0 .. 10 V' in warning
    assert '12 V' in warning


def test_simulate_says_what_a_free_run_says_of_the_voltage(recwarn):
    PAPER.simulate(np.linspace(0, 10, 100))
    # an inverse judges its own voltage
    PAPER.inverse(np.full(100, 30e-6))
    assert not recwarn.list
    with pytest.warns(UserWarning, match=r'25\.0% .* range') as told:
        PAPER.simulate([0, 5, 10, 12e3])
    # the line of the caller
    assert told[0].filename == __file__
    assert len(told) == 1


def test_millivolts_are_taken_for_what_they_are():
    (warning,) = free_run(PAPER, record([0, 5e-3, 10e-3])).warnings
    assert 'mine: ' in warning
    assert 'in volts?' in warning
    # a small signal is a signal, and a stage at 0 V is at rest
    assert free_run(PAPER, record([0, 0.05, 0.03])).warnings == ()
    assert free_run(PAPER, record([0, 0, 0])).warnings == ()


def test_hysteresis_alone_keeps_the_static_gain():
    model = replace(
        PAPER, effects=(EffectSetting('creep', {'gain': [0.01], 'time_constant': [1.0]}),)
    )
    alone = model.without_dynamics()
    assert alone.effects == ()
    assert alone.delay.total == 0.0
    v = np.linspace(0, 10, 50)
    expected = 75e-6 * PAPER.dynamics.gain * PAPER.hysteresis(v / 10)
    assert_allclose(alone.stream().process(v), expected, rtol=1e-13)


def test_stream_comes_to_rest_where_it_is_told():
    stream = PAPER.stream()
    rest = stream.reset(4.0)
    assert_allclose(stream.process(np.full(500, 4.0)), rest, rtol=1e-12)
    stream.process(long_signal(500))
    assert stream.reset(4.0) == rest
    assert stream.process([]).size == 0


def test_simulate_starts_from_rest_or_from_the_memory_given():
    v = 5 + np.linspace(0, 2, 200)
    top = v[0] / 10 - 0 * PAPER.hysteresis.thresholds
    one, two = PAPER.simulate(v), PAPER.simulate(v, start=top)
    assert_array_equal(one, PAPER.stream().process(v))
    assert_array_equal(two, PAPER.stream(top).process(v))
    assert np.abs(one - two).max() > 1e-6
    assert PAPER.simulate([]).size == 0
    for wrong in ([[1.0, 2.0]], [1.0, np.nan], 3.0):
        with pytest.raises(DataError, match='voltage'):
            PAPER.simulate(wrong)


def test_simulate_takes_real_numbers_without_a_mask():
    v = np.ma.masked_greater(np.linspace(0, 10, 100), 5.0)
    with pytest.raises(DataError, match=r'voltage .*\(100,\) .* 50 bad'):
        PAPER.simulate(v)
    with pytest.raises(DataError, match=r'voltage: .* complex128'):
        PAPER.simulate(v.data + 1j)
    with pytest.raises(DataError, match=r"channel 'heat': .* complex128"):
        PAPER.simulate(v.data, channels={'heat': v.data + 1j})
    with pytest.raises(DataError, match=r'channels: .* list'):
        PAPER.simulate(v.data, channels=[v.data])
    assert np.array_equal(PAPER.simulate(v[:20]), PAPER.simulate(v.data[:20]))


def test_simulate_warns_of_a_channel_that_nothing_uses():
    v = np.linspace(0, 10, 100)
    with pytest.warns(UserWarning, match=r' channel heat$'):
        y = PAPER.simulate(v, channels={'heat': v})
    assert_array_equal(y, PAPER.simulate(v))
    with pytest.raises(DataError, match=r'heat .* 50 bad'):
        PAPER.simulate(v, channels={'heat': np.ma.masked_greater(v, 5.0)})
