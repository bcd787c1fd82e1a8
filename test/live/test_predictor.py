# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A model beside a running stage, and what is made of its residual."""

from dataclasses import replace

import numpy as np
from piezo_ident.common.errors import ModelError
from piezo_ident.live.history import TurningPoints
from piezo_ident.live.monitor import LiveError, Matcher, Preview, TrackingError
from piezo_ident.live.predictor import Predictor
from piezo_ident.model.scaling import Scaling
from piezo_ident.model.stage_model import EffectSetting, StageModel
from piezo_ident.operators.dynamics import Delay, Dynamics
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.record.blocks import Samples
from piezo_ident.record.record import Piece
from piezo_ident.uncertainty.band import BandStream, KEY, PredictionBand
import pytest

RATE = 10_000.0


def model(seed=0, rate=RATE, v0=0.0, **kwargs):
    rng = np.random.default_rng(seed)
    return StageModel(
        sample_rate=rate,
        scaling=Scaling(v0, 10.0, 0.0, 75e-6, (v0, v0 + 10.0)),
        hysteresis=Hysteresis(
            thresholds=np.linspace(0.05, 0.95, 10), weights=rng.random(10), p1=-0.2, p2=0.5
        ),
        dynamics=Dynamics(a=np.array([-1.5, 0.6]), b=np.array([0.06, 0.04])),
        delay=Delay(3),
        **kwargs,
    )


def drive(n, seed=1):
    """Return a walk between 0 and 10 V that starts at 0, with loops of all sizes."""
    rng = np.random.default_rng(seed)
    corners = np.concatenate([[0.0], rng.uniform(0.0, 10.0, n // 300)])
    return np.interp(np.arange(n), np.arange(corners.size) * 300, corners)


def cut(v, size=100, start=0, rate=RATE):
    t = (start + np.arange(v.size)) / rate
    return [Samples(t[i : i + size], v[i : i + size], 'noise') for i in range(0, v.size, size)]


def running(m):
    predictor = Predictor()
    predictor.set_model(m)
    return predictor


def predicted(predictor, blocks):
    made = [predictor.process(b) for b in blocks]
    return np.concatenate([m.values for m in made if m is not None])


def memory(m, v):
    h, u = m.hysteresis, m.scaling.u(v)
    return h.follow(u, h.initial_memory(u[0]))[1]


@pytest.mark.parametrize('seed', range(5))
def test_turning_points_hold_the_memory_of_any_model_exactly(seed):
    v = drive(20_000, seed)
    t, points = np.arange(v.size) / RATE, TurningPoints()
    for rows in np.split(np.arange(v.size), [7, 100, 5000, 5001, 12_345]):
        points.add(t[rows], v[rows])
    assert len(points) < 30
    for m in (model(seed), model(seed + 1, v0=-2.0), model(seed, v0=3.0)):
        np.testing.assert_array_equal(memory(m, points.values), memory(m, v))


def test_turning_points_of_constant_and_monotone_voltage_are_its_ends():
    points = TurningPoints()
    points.add(np.arange(10.0), np.full(10, 2.0))
    assert points.values.tolist() == [2.0]
    points.add(np.arange(10.0, 14.0), np.array([2.0, 3.0, 3.0, 4.0]))
    assert points.values.tolist() == [2.0, 4.0]


def test_the_path_through_turning_points_holds_the_samples_before_them():
    t, points = np.arange(3001) / RATE, TurningPoints()
    v = np.interp(t, [0.0, 0.2, 0.21, 0.3], [0.0, 9.0, 3.0, 5.0])
    points.add(t, v)
    at, way = points.path(1 / RATE)
    # the rise takes as long as is kept, and what follows is there in full
    np.testing.assert_allclose(way[at > 0.15], v[t > 0.15], atol=1e-9)
    assert np.all(np.diff(at) > 0) and np.sum(at < 0.149999) == 500


def test_prediction_is_that_of_the_whole_piece_bit_for_bit():
    v, m = drive(20_000), model()
    predictor = running(m)
    blocks = cut(v[:10_000], 100) + cut(v[10_000:], 33, start=10_000)
    first = predictor.process(blocks[0])
    np.testing.assert_array_equal(first.t, blocks[0].t)
    assert (first.segment, first.quantity) == ('noise', 'displacement')
    made = np.concatenate([first.values, predicted(predictor, blocks[1:])])
    np.testing.assert_array_equal(made, m.predict_piece(Piece(v, np.zeros_like(v), RATE)))
    assert predictor.problem == '' and predictor.clock.lost == predictor.clock.late == 0
    assert predictor.memory_known


def test_the_band_of_a_stream_is_that_of_the_whole_voltage():
    band = PredictionBand(np.array([1e-3, 2e-3, 1e-5]), np.ones(5), 1e3)
    banded, v = model(identification={KEY: band.to_dict()}), drive(2000)
    predictor = Predictor(level=0.8)
    predictor.set_model(banded)
    halves = []
    for block in cut(v):
        y = predictor.process(block)
        assert y is not None and np.array_equal(predictor.half_width.t, y.t)
        halves.append(predictor.half_width.values)
    expected = BandStream(banded, 0.8, creep=False).follow(v, banded.simulate(v))
    np.testing.assert_array_equal(np.concatenate(halves), expected)
    damaged = model(identification={KEY: {**band.to_dict(), 'ratios': [None]}})
    with pytest.raises(ModelError, match=KEY):
        predictor.set_model(damaged)
    predictor.set_model(model())
    assert predictor.process(cut(v[:100], start=2000)[0]) is not None
    assert predictor.half_width is None


@pytest.mark.parametrize('n', [20_000, 120_000], ids=['whole run at hand', 'longer than kept'])
def test_a_new_model_is_where_it_would_be_had_it_run_all_along(n):
    v, old, new = drive(n + 5000), model(0), model(5)
    predictor = running(old)
    predicted(predictor, cut(v[:n]))
    predictor.set_model(new)
    made = predicted(predictor, cut(v[n:], start=n))
    whole = new.predict_piece(Piece(v, np.zeros_like(v), RATE))[n:]
    np.testing.assert_allclose(made, whole, rtol=0, atol=1e-12 * 75e-6)
    assert predictor.memory_known


EFFECTS = {
    'saturation': {'low': 0.1, 'high': 0.8},
    'amplifier_lag': {'time_constant': 2e-4},
    'slew_limit': {'limit': 25.0},
    'rate_dependent_hysteresis': {'gain': 0.01, 'exponent': 0.6, 'cutoff': 400.0},
}


@pytest.mark.parametrize('name', EFFECTS)
def test_plays_of_a_new_model_followed_the_voltage_that_arrives_at_them(name):
    # 20 s over the whole range, the last 6 s on a small part of it
    v = drive(260_000)
    v[200_000:] = np.interp(np.arange(60_000), [0, 3000], [v[199_999], 6.0])
    v[203_000:] += 0.3 * np.sin(2 * np.pi * 5.0 * np.arange(57_000) / RATE)
    m = model(effects=(EffectSetting(name, EFFECTS[name]),))
    predictor = Predictor()
    for block in cut(v[:259_000]):
        predictor.process(block)
    predictor.set_model(m)
    made = predicted(predictor, cut(v[259_000:], start=259_000))
    whole = m.simulate(v)[259_000:]
    assert np.abs(made - whole).max() < 2e-3 * 75e-6


def test_history_is_kept_without_a_model():
    v, m = drive(3000), model()
    predictor = Predictor()
    assert [predictor.process(b) for b in cut(v[:2000])] == [None] * 20
    assert not predictor.memory_known
    predictor.set_model(m)
    assert predictor.memory_known
    made = predicted(predictor, cut(v[2000:], start=2000))
    np.testing.assert_array_equal(made, m.predict_piece(Piece(v, v, RATE))[2000:])


def test_a_restart_begins_anew():
    v, m = drive(2000), model()
    predictor = running(m)
    blocks = cut(v)
    first = predicted(predictor, blocks)
    np.testing.assert_array_equal(predicted(predictor, blocks), first)
    assert predictor.clock.restarts == 1 and predictor.clock.late == 0


def test_a_lost_block_is_bridged_and_counted():
    v, m = 5.0 - 5.0 * np.cos(2 * np.pi * 5.0 * np.arange(6000) / RATE), model()
    predictor = running(m)
    blocks = cut(v)
    made = predicted(predictor, blocks[:25] + blocks[26:])
    assert predictor.clock.lost == 100
    assert '100 samples of voltage are missing before t = 0.26 s' in predictor.problem
    whole = m.predict_piece(Piece(v, v, RATE))
    # a straight line is close to 10 ms of a slow sine, and behind it nothing is left of the gap
    error = np.abs(made - np.delete(whole, slice(2500, 2600))) / 75e-6
    assert error.max() < 0.02 and error[2800:].max() < 1e-6


def test_memory_is_unknown_behind_a_gap_until_the_voltage_was_at_its_lowest():
    v = 5.0 - 5.0 * np.cos(2 * np.pi * 5.0 * np.arange(6000) / RATE)
    predictor = running(model())
    blocks = cut(v)
    predicted(predictor, blocks[:5] + blocks[6:12])
    assert not predictor.memory_known
    predicted(predictor, blocks[12:22])
    assert predictor.memory_known


def test_a_long_gap_is_another_run():
    v, m = drive(20_000), model()
    predictor = running(m)
    blocks = cut(v)
    predicted(predictor, blocks[:20])
    made = predicted(predictor, blocks[150:])
    alone = m.predict_piece(Piece(v[15_000:], v[15_000:], RATE, start_time=1.5))
    np.testing.assert_array_equal(made, alone)
    assert predictor.clock.lost == 13_000


def test_late_and_repeated_blocks_leave_no_trace():
    v, m = drive(3000), model()
    predictor = running(m)
    b = cut(v)
    made = predicted(predictor, [b[0], b[0], b[1], b[2], b[1], b[2], *b[3:]])
    np.testing.assert_array_equal(made, m.predict_piece(Piece(v, v, RATE)))
    assert predictor.clock.late == 300 and predictor.clock.restarts == 0
    # blocks of another size that overlap are cut to what is new
    more = Samples(np.arange(2950, 3050) / RATE, np.full(100, v[-1]))
    assert predictor.process(more).t.size == 50


def test_a_block_with_nan_is_left_out():
    v = drive(3000)
    predictor = running(model())
    blocks = cut(v)
    bad = Samples(blocks[5].t, np.where(np.arange(100) == 50, np.nan, blocks[5].values))
    made = predicted(predictor, [*blocks[:5], bad, *blocks[6:]])
    assert np.isfinite(made).all() and made.size == 2900
    assert predictor.clock.lost == 100


def test_a_prediction_that_overflows_is_none_and_begins_anew():
    v = drive(3000)
    predictor = running(model())
    blocks = cut(v)
    wild = Samples(blocks[5].t, np.where(np.arange(100) == 50, 1e300, blocks[5].values))
    predicted(predictor, blocks[:5])
    assert predictor.process(wild) is None
    assert predictor.problem == (
        'the prediction at t = 0.05 s is not finite; the prediction begins anew'
    )
    again = predicted(predictor, blocks[6:])
    assert np.array_equal(again, predicted(running(model()), cut(v[600:])))


def test_another_sampling_rate_is_refused():
    predictor = Predictor()
    predictor.process(cut(drive(300))[0])
    with pytest.raises(ModelError, match=r' 10000 Hz, .* 20000 Hz'):
        predictor.set_model(model(rate=20_000.0))
    other = running(model(rate=20_000.0))
    assert other.process(cut(drive(300))[0]) is None
    assert '10000 Hz' in other.problem and '20000 Hz' in other.problem


def block(first, n, value=0.0):
    return Samples(np.arange(first, first + n) / RATE, np.full(n, value), 'sine:50Hz')


def test_a_block_of_one_sample_does_not_set_the_rate():
    predictor = running(model())
    v = drive(1000)
    assert predictor.process(cut(v, 1)[0]) is None
    assert 'tells no sampling rate' in predictor.problem
    assert predictor.process(cut(v[1:], 100, start=1)[0]) is not None
    # behind others its rate is known
    assert predictor.process(cut(v[101:], 1, start=101)[0]).t.size == 1


@pytest.mark.parametrize('measured_first', [True, False])
def test_streams_match_whichever_comes_first(measured_first):
    matcher = Matcher()
    calls = [
        lambda: matcher.measured(block(0, 100, 3.0)),
        lambda: matcher.predicted(block(0, 100, 1.0)),
    ]
    one, two = calls if measured_first else calls[::-1]
    assert one() == []
    (pair,) = two()
    np.testing.assert_array_equal(pair.residual.values, np.full(100, 2.0))
    assert pair.residual.segment == 'sine:50Hz'


def test_streams_match_however_they_are_cut():
    matcher = Matcher()
    pairs = matcher.predicted(block(0, 100)) + matcher.predicted(block(100, 100))
    for first, n in ((0, 30), (30, 100), (130, 70)):
        pairs += matcher.measured(block(first, n))
    t = np.concatenate([p.t for p in pairs])
    np.testing.assert_array_equal(t, np.arange(200) / RATE)
    assert matcher.unmatched == 0


def test_what_finds_no_partner_is_forgotten_and_counted():
    matcher = Matcher()
    matcher.measured(block(0, 100))
    assert matcher.measured(block(30_000, 100)) == []
    assert matcher.unmatched == 100
    assert matcher.predicted(block(0, 100)) == []
    assert matcher.unmeasured == 0
    assert matcher.predicted(block(30_100, 100)) == []
    assert matcher.predicted(block(80_000, 100)) == []
    assert matcher.unmeasured == 200


def test_runs_of_the_clock_are_not_mixed_up():
    matcher = Matcher()
    for k in range(0, 3000, 100):
        matcher.predicted(block(k, 100, 1.0))  # never measured
    # the new run is measured first, and has the times of the old one
    assert matcher.measured(block(0, 100, 5.0)) != []
    for k in range(100, 3000, 100):
        matcher.measured(block(k, 100, 5.0))
    assert matcher.measured(block(0, 100, 9.0)) == []
    assert matcher.measured(block(100, 100, 9.0)) == []
    pairs = matcher.predicted(block(0, 100, 2.0)) + matcher.predicted(block(100, 100, 2.0))
    assert [p.residual.values[0] for p in pairs] == [7.0, 7.0]
    # the next is predicted first
    for k in range(200, 3000, 100):
        matcher.predicted(block(k, 100, 2.0))
    matcher.predicted(block(0, 100, 3.0))
    (pair,) = matcher.measured(block(0, 100, 4.0))
    assert pair.residual.values[0] == 1.0


def test_streams_find_together_after_one_was_silent_at_a_restart():
    matcher = Matcher()
    matcher.measured(block(100, 100))
    for first in (0, 0, 0):
        for k in range(first, 3000, 100):
            matcher.predicted(block(k, 100))
    pairs = []
    for k in range(3000, 18_000, 100):
        matcher.predicted(block(k, 100))
        pairs += matcher.measured(block(k, 100))
    assert pairs and pairs[-1].t[-1] == 17_999 / RATE


def test_short_loops_find_together_after_two_publishers_were_taken_for_restarts():
    matcher, met = Matcher(), []
    matcher.predicted(block(0, 3000))
    for first in (0, 600, 0, 600, 0, 600):
        matcher.measured(block(first, 600))
    # each loop is shorter than what both streams wait for
    for _ in range(4):
        met.append(0)
        for k in range(0, 5000, 100):
            matcher.predicted(block(k, 100))
            met[-1] += len(matcher.measured(block(k, 100)))
    assert met[0] == 0 and met[-1] == 50


def test_preview_bins_hold_mean_least_and_largest():
    preview = Preview(50.0)
    t = np.arange(600) / RATE
    done = []
    for i in range(0, 600, 70):
        done += preview.add('displacement', t[i : i + 70], np.arange(600.0)[i : i + 70])
    assert [b.t for b in done] == [0.0, 0.02]
    assert done[0].values == {'displacement': (99.5, 0.0, 199.0)}
    assert done[1].values == {'displacement': (299.5, 200.0, 399.0)}


@pytest.mark.parametrize(
    ('names', 't', 'begins'),
    [
        # it waits for a late quantity, but not for ever
        ('pdpd', (0.0, 0.03, 0.03, 2.0), [[], [], [0.0], [0.02]]),
        # and begins again behind a restart
        ('ppp', (1.0, 0.0, 0.02), [[], [1.0], [0.0]]),
    ],
)
def test_preview_closes_a_bin_when_all_of_it_is_there(names, t, begins):
    preview = Preview(50.0)
    added = zip(names, np.array(t)[:, None], strict=True)
    done = [preview.add(name, at, np.ones(1)) for name, at in added]
    assert [[b.t for b in bins] for bins in done] == begins


def test_preview_leaves_out_what_is_no_number():
    preview = Preview(50.0)
    preview.add('residual', np.array([0.0, 0.001]), np.array([np.nan, 2.0]))
    (done,) = preview.add('residual', np.array([0.02]), np.ones(1))
    assert done.values['residual'] == (2.0, 2.0, 2.0)


def test_live_error_is_the_rms_of_the_window():
    live = LiveError(1.0)
    assert np.isnan(live.rms)
    for second, value in ((0, 100.0), (1, 3.0), (2, 4.0)):
        for k in range(0, 10_000, 100):
            b = block(second * 10_000 + k, 100, value)
            live.add(b.t, b.values)
    assert live.rms == pytest.approx(4.0)
    assert live.seconds == pytest.approx(1.0, abs=0.02)
    live.add(np.array([0.0]), np.array([7.0]))
    assert live.rms == 7.0
    # a stretch longer than the window is the window
    short = LiveError(0.001)
    for k in (0, 100):
        short.add(block(k, 100).t, np.full(100, 2.0))
        assert short.rms == 2.0


def error_of(e, size=100):
    """Return the live error of residuals [m] that come in blocks."""
    live = LiveError(1.0)
    for k in range(0, e.size, size):
        live.add(block(k, size).t, e[k : k + size], 75e-6)
    return live


@pytest.mark.parametrize('size', [7, 100, 4000])
def test_live_error_leaves_out_what_is_wild(size):
    rng, n = np.random.default_rng(0), 8000
    e = rng.normal(1e-7, 1e-8, n)
    rms, mean = np.sqrt(np.mean(e**2)), e.mean()
    wild = np.array([99, 100, 700, 1399, 4000, 4001, 4002])
    e[wild] = 1.0
    live = error_of(e, size)
    assert live.outliers == wild.size
    assert (live.rms, live.mean) == pytest.approx((rms, mean), rel=1e-3)
    # what happens often is the way of the stage
    e[::5] = 1.0
    often = error_of(e, size)
    assert often.outliers == 0 and often.rms > 0.2


@pytest.mark.parametrize('noise', [0.1, 0.2, 0.3])
def test_codes_of_a_coarse_sensor_are_not_wild(noise):
    rng, q = np.random.default_rng(2), 75e-6 / 2**8
    y_hat = 4e-5 + 3e-5 * np.sin(2.0 * np.pi * 2.0 * block(0, 8000).t)
    y_hat[5000:] = y_hat[5000]
    y = q * np.round(y_hat / q + noise * rng.normal(size=y_hat.size))
    y[[900, 6000]] = 0.0
    live, tracking = LiveError(1.0), TrackingError(1.0)
    for k in range(0, 8000, 100):
        t, part = block(k, 100).t, slice(k, k + 100)
        live.add(t, y[part] - y_hat[part], 75e-6, y[part])
        tracking.wanted(Samples(t, y_hat[part]))
        tracking.measured(Samples(t, y[part]))
    assert live.outliers == tracking.live.outliers == 2
    e = np.delete(y - y_hat, [900, 6000])
    assert live.rms == pytest.approx(np.sqrt(np.mean(e**2)), rel=0.01)


def test_a_goal_out_of_reach_is_no_wild_reading():
    rng, n = np.random.default_rng(4), 4000
    wanted, tracking = np.full(n, 2e-5), TrackingError(1.0)
    # three times the goal is elsewhere for a moment, and the stage stays; once a reading is wild
    for k in (500, 1500, 2500):
        wanted[k : k + 2] = 3.1e-5
    y = 2e-5 + rng.normal(0.0, 1e-8, n)
    e = wanted - y
    y[3000] = 0.0
    for k in range(0, n, 100):
        part = slice(k, k + 100)
        tracking.wanted(Samples(block(k, 100).t, wanted[part]))
        tracking.measured(Samples(block(k, 100).t, y[part]))
    assert tracking.live.outliers == 1
    assert tracking.live.rms == pytest.approx(np.sqrt(np.mean(e**2)), rel=0.01)


def test_live_error_starts_afresh_behind_a_gap():
    live = LiveError(1.0)
    for first, level in ((0, 0.0), (200, 1e-6)):
        live.add(block(first, 100).t, np.full(100, level), 75e-6)
    assert live.outliers == 0 and live.seconds == pytest.approx(0.03, abs=1e-3)


@pytest.mark.parametrize('t', [np.array([0.0, 1.0, 2.0, 5.0, 6.0]) / RATE, 1e-9 * np.arange(100)])
def test_ragged_time_and_clocks_faster_than_any_card_are_left_out(t):
    predictor = Predictor()
    assert predictor.process(Samples(t, np.zeros(t.size))) is None
    assert 'not ticks of one rate' in predictor.problem


def test_blocks_that_are_kept_are_bounded(monkeypatch):
    monkeypatch.setattr('piezo_ident.live.history.MOST_BLOCKS', 50)
    predictor = Predictor()
    for b in [block(0, 2), *(block(k, 1) for k in range(2, 200))]:
        predictor.process(b)
    assert len(predictor._pasts[0]._recent) == 50


def test_behind_a_voltage_beyond_all_numbers_nothing_is_known_and_all_is_finite():
    m, n = model(), 2000
    predictor = running(m)
    blocks = cut(drive(n))
    blocks[10] = replace(blocks[10], values=np.full(blocks[10].values.size, 1e308))
    for block in blocks[:11]:
        predictor.process(block)
    assert 'not finite' in predictor.problem
    assert not predictor.memory_known
    y = predicted(predictor, blocks[11:])
    assert np.isfinite(y).all()
    # a model that comes later runs through the voltage that is kept
    predictor.set_model(m)
    assert np.isfinite(predictor.process(cut(drive(n + 100))[-1]).values).all()
