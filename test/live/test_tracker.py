# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""From a reference to a voltage: joined softly, safe, and glitch-free from model to model."""

from dataclasses import replace
import functools

from effect_table import VISIBLE
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from paper_stage import FS, PAPER
from piezo_ident.common.errors import DataError, ModelError
from piezo_ident.live.guard import GuardSettings
from piezo_ident.live.tracker import Tracker
from piezo_ident.model.stage_model import EffectSetting
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.record.blocks import Samples
import pytest

SETTINGS = GuardSettings(0.0, 10.0, 40e3, 20.0, 0.0, FS)
CREEP = replace(PAPER, effects=(EffectSetting('creep', VISIBLE['creep']),))


def sine(seconds=1.0, frequency=20.0):
    return 35e-6 + 20e-6 * np.sin(2 * np.pi * frequency * np.arange(round(seconds * FS)) / FS)


def tracked(tracker, reference, size=100):
    """Return time, voltage and wanted motion for a reference, in blocks."""
    drives = [tracker.process(reference[k : k + size]) for k in range(0, reference.size, size)]
    return [np.concatenate([getattr(d, name) for d in drives]) for name in ('t', 'v', 'wanted')]


def test_a_reference_is_joined_from_rest_and_followed_a_preview_later():
    tracker, reference = Tracker(PAPER, SETTINGS, 300), sine()
    t, v, wanted = tracked(tracker, reference)
    assert t.tobytes() == (np.arange(t.size) / FS).tobytes()
    # from 35 um in twice the time that 20 V/s take to there
    assert v[0] == 0.0
    assert np.abs(np.diff(v[:4000])).max() < 2e-2
    joined = np.flatnonzero(np.abs(wanted[300:] - reference[:-300]) > 1e-12)[-1]
    assert 0.4 * FS < joined < 0.8 * FS
    assert np.abs(PAPER.simulate(v) - wanted).max() < 1e-8
    # its end is played, then it ramps to rest
    end = tracker.finish()
    assert np.abs(end.wanted - reference[-300:]).max() < 1e-12
    assert end.t[0] == v.size / FS
    while not tracker.is_at_rest:
        tracker.idle(100)


@pytest.mark.parametrize('first', [1, 100, 250])
def test_a_reference_that_begins_with_nan_is_joined_at_its_first_number(first):
    reference = sine()
    reference[:first] = np.nan
    _, v, wanted = tracked(Tracker(PAPER, SETTINGS), reference)
    assert np.isfinite(wanted).all()
    # 0.02 V a sample is the steepest of the same reference without a gap
    assert np.abs(np.diff(v[:4000])).max() < 2e-2


@pytest.mark.parametrize('follow', ['off', 'gain'])
@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_limits_and_slew_hold_whatever_comes(follow, seed):
    rng = np.random.default_rng(seed)
    guard = GuardSettings(1.0, 9.0, 10.0 ** rng.uniform(2.0, 5.0), 20.0, 2.0, FS)
    tracker, parts, models = Tracker(PAPER, guard, follow=follow), [], [CREEP, PAPER]
    for k in range(12):
        block = 1e-4 * rng.standard_normal(int(rng.integers(1, 600)))
        block[rng.random(block.size) < 0.05] = rng.choice([np.nan, np.inf, 1.0])
        drive = tracker.process(block, restarted=bool(rng.random() < 0.2))
        parts.append(drive.v)
        # a sensor of any size, that loses readings
        read = 10.0 ** rng.uniform(-7.0, -3.0) * rng.standard_normal(block.size)
        read[rng.random(block.size) < 0.1] = rng.choice([np.nan, np.inf, 1.0])
        tracker.measured(Samples(drive.t, read))
        if k % 5 == 4:
            tracker.take_over(tracker.successor(models[k % 2]))
    parts += [tracker.finish().v, tracker.idle(3000)[1]]
    v = np.concatenate(parts)
    assert v.min() >= 1.0 and v.max() <= 9.0
    step = guard.step * (1 + 1e-9)
    assert np.abs(np.diff(v, prepend=2.0)).max() <= step + 1e-12


@pytest.mark.parametrize('seconds', [0.5, 7.0])
def test_another_model_takes_over_without_a_glitch(seconds):
    # one with other plays, creep and gain; beyond the seconds that are kept in full too
    h = PAPER.hysteresis
    plays = Hysteresis(h.thresholds, 0.9 * h.weights, h.p1, h.p2 + 0.05)
    other = replace(CREEP, hysteresis=plays)
    reference = sine(seconds + 1.5, 5.0)
    k = round(seconds * FS)
    plain = tracked(Tracker(PAPER, SETTINGS), reference)[1]
    tracker = Tracker(PAPER, SETTINGS)
    before = tracked(tracker, reference[:k])
    successor = tracker.successor(other)
    # the stream goes on while it is made
    between = tracked(tracker, reference[k : k + 1000])
    tracker.take_over(successor)
    after = tracked(tracker, reference[k + 1000 :])
    v, wanted = (np.concatenate(z) for z in list(zip(before, between, after, strict=True))[1:])
    # neither a step nor a kink: the motion itself bends by 0.9 mV from sample to sample
    assert np.abs(np.diff(v)).max() < np.abs(np.diff(plain)).max() + 1e-5
    assert np.abs(np.diff(v, 2))[k + 900 : k + 1100].max() < 3e-4
    assert np.abs(v[k + 1000 :] - plain[k + 1000 :]).max() > 0.05
    # in the end the new model is where it is wanted, with the memory of the whole voltage
    miss = np.abs(other.simulate(v) - wanted)
    assert miss[-4000:].max() < 1e-8 < miss[k : k + 1000].max()
    np.testing.assert_allclose(wanted[-4000:], reference[-4400:-400], atol=1e-12)


def test_a_successor_that_comes_too_late_is_told():
    tracker = Tracker(PAPER, SETTINGS)
    successor = tracker.successor(PAPER)
    tracker.idle(40_000, 0.0)
    assert tracker.remembers(successor)
    tracker.idle(160_000, 0.0)
    assert not tracker.remembers(successor)


def test_before_the_first_block_a_model_is_merely_replaced():
    tracker = Tracker(PAPER, SETTINGS)
    tracker.take_over(tracker.successor(CREEP))
    _, v, wanted = tracked(tracker, sine(0.5))
    assert np.abs(CREEP.simulate(v) - wanted).max() < 1e-8


def test_what_does_not_fit_is_refused():
    tracker = Tracker(PAPER, SETTINGS)
    with pytest.raises(ModelError, match=r'reference .* 20000 Hz, .* 10000 Hz'):
        tracker.successor(replace(PAPER, sample_rate=10_000.0))
    with pytest.raises(DataError, match=r'reference .*\(0,\)'):
        tracker.process([])


SLOW = EffectSetting('creep', {'gain': [0.02, 0.01], 'time_constant': [0.1, 5.0]})
CREEPS = replace(PAPER, effects=(SLOW,), identification={'errors': {'held_out': 0.02}})


@functools.cache
def run_of(follow, gain=1.0, zero=0.0, earlier=False, seconds=1.5, readings=lambda y: y, size=100):
    """Return tracker, voltage and error in % of the scan's span, of a stage that answers."""
    tracker, stage = Tracker(CREEPS, SETTINGS, 400, follow=follow), CREEPS.stream()
    if earlier:
        way = np.linspace(0.0, 10.0, 10_000)
        stage.process(np.concatenate([way, np.full(40_000, 10.0), way[::-4], np.zeros(2000)]))
    x, rng = sine(seconds, 10.0), np.random.default_rng(1)
    v, error = [], []
    for k in range(0, x.size, size):
        drive = tracker.process(x[k : k + size])
        y = stage.process(drive.v)
        s = CREEPS.scaling
        y = s.y0 + (y - s.y0) * gain + zero
        v.append(drive.v)
        error.append(y - drive.wanted)
        measured = readings(y + 1.5e-9 * rng.standard_normal(y.size))
        tracker.measured(Samples(drive.t, measured))
    return tracker, np.concatenate(v), 100.0 * np.concatenate(error) / np.ptp(x)


@pytest.mark.parametrize(
    ('case', 'alone'),
    [
        ({'earlier': True}, 0.4),
        ({'gain': 1.03}, 2.0),
        ({'gain': 1.03, 'earlier': True}, 2.0),
        ({'zero': 0.4e-6}, 0.5),
    ],
)
def test_the_voltage_makes_up_for_creep_gain_and_zero(case, alone):
    def rms(error):
        return np.sqrt(np.mean(error[int(FS) // 2 :] ** 2))

    tracker, v, error = run_of('gain', **case)
    assert rms(error) < 0.03
    assert rms(run_of('off', **case)[2]) > alone
    assert np.abs(np.diff(v)).max() <= SETTINGS.step * (1 + 1e-9)
    assert v.min() >= 0.0 and v.max() <= 10.0
    (follower,) = tracker.followers
    assert follower.corrector.told['gain/value'] == pytest.approx(
        case.get('gain', 1.0) - 1.0, abs=1e-3
    )
    assert not follower.is_limited


@pytest.mark.parametrize('size', [37, 640])
def test_how_the_streams_are_cut_does_not_matter_to_what_follows(size):
    case = {'gain': 1.03, 'earlier': True, 'seconds': 0.6}
    one, other = run_of('gain', **case), run_of('gain', **case, size=size)
    # volts; the correction is about 0.2 V
    np.testing.assert_allclose(one[1], other[1], rtol=0, atol=1e-9)
    assert np.abs(one[1] - run_of('off', **case)[1]).max() > 0.1


def test_what_follows_costs_nothing_where_nothing_changed_or_is_read():
    assert np.abs(run_of('gain')[2] - run_of('off')[2]).max() < 0.02
    alone, lost = run_of('off')[1], run_of('gain', readings=lambda y: np.full(y.size, np.nan))[1]
    assert np.array_equal(alone, lost)


def test_a_sensor_at_fault_moves_the_stage_by_a_tenth_of_its_stroke_at_most():
    # it reads the negative of the motion from the start, so that nothing else is known of it
    tracker, v, error = run_of('gain', seconds=5.6, readings=lambda y: 60e-6 - 2.0 * y)
    span = 40e-6
    assert np.abs(error).max() < 100.0 * 0.105 * abs(CREEPS.scaling.Y) / span
    assert tracker.followers[0].is_limited
    assert np.abs(np.diff(v)).max() <= SETTINGS.step * (1 + 1e-9)


def test_another_model_takes_over_and_is_followed_anew():
    tracker, stage, x = Tracker(PAPER, SETTINGS, follow='gain'), CREEPS.stream(), sine(2.0, 10.0)
    v, error = [], []
    for k in range(0, x.size, 100):
        if k == int(FS) // 2:
            tracker.take_over(tracker.successor(CREEPS))
        drive = tracker.process(x[k : k + 100])
        y = stage.process(drive.v)
        tracker.measured(Samples(drive.t, y))
        v.append(drive.v)
        error.append(y - drive.wanted)
    # the motion itself moves by 0.21 V from sample to sample
    assert np.abs(np.diff(np.concatenate(v)[int(FS) // 4 :])).max() < 0.03
    assert np.sqrt(np.mean(np.concatenate(error)[-int(FS) // 2 :] ** 2)) < 1e-3 * 40e-6


def test_a_model_prepared_in_one_drive_does_not_take_over_in_the_next():
    tracker = Tracker(PAPER, SETTINGS)
    tracked(tracker, sine(0.5))
    successor = tracker.successor(PAPER)
    assert tracker.remembers(successor)
    tracker.reset()
    tracked(tracker, np.full(800, tracker.rest[0]))
    # the voltage would step towards where the drive before it ended
    assert not tracker.remembers(successor)


def test_a_single_sample_behind_a_change_of_the_model_waits_for_the_next():
    tracker = Tracker(PAPER, SETTINGS)
    tracked(tracker, sine(0.1))
    tracker.take_over(tracker.successor(PAPER))
    assert [tracker.process(np.full(n, 35e-6)).t.size for n in (1, 99)] == [0, 100]
