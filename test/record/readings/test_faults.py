# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Data in which every number is in order, and something is wrong all the same."""

from dataclasses import replace

from measured_data import DATA
import numpy as np
import piezo_ident as pi
from piezo_ident.common.errors import IdentificationError
from piezo_ident.excitation.program import parse_program
from piezo_ident.identification.identify import identify
from piezo_ident.many.table import identified as cells
from piezo_ident.operators.play import play_columns
from piezo_ident.record.readings.faults import without_faults
from piezo_ident.record.readings.suspicions import line_error, misspelt, suspicions
from piezo_ident.record.record import Piece, Record
from programs import identification_program, SLOW, slow_model, SLOW_PROGRAM
import pytest
from scipy.signal import lfilter


def triangle(noise=3e-9):
    v = np.tile(np.concatenate([np.linspace(0, 10, 4000), np.linspace(10, 0, 4000)]), 4)
    rng = np.random.default_rng(1)
    return v, 1e-6 * v + noise * rng.standard_normal(v.size)


def test_a_good_record_makes_nobody_suspicious():
    v, y = triangle()
    assert suspicions(Record((Piece(v, y, 1000.0),))) == []
    # a coarse converter repeats its codes while the voltage hardly moves
    assert suspicions(Record((Piece(v, np.round(y / 5e-9) * 5e-9, 1000.0),))) == []
    # a stage at rest under a resting voltage
    rest = Piece(np.full(500, 2.0), np.full(500, 2e-6), 1000.0)
    assert suspicions(Record((Piece(v, y, 1000.0), rest))) == []


def test_a_sensor_at_its_stop_is_told_and_a_step_after_a_rest_is_none():
    v, y = triangle()
    (said,) = suspicions(Record((Piece(v, np.clip(y, 0.5e-6, None), 1000.0),), 'clipped'))
    assert 'stop' in said
    assert '5e-07' in said
    assert 'NaN' in said
    v = np.repeat(np.tile([4.0, 6.0], 10), 2000)
    y = np.roll(np.round(1e-6 * v / 24e-9) * 24e-9, 5)
    assert suspicions(Record((Piece(v, y, 10e3),))) == []


def test_a_sensor_that_is_slower_than_the_voltage():
    v, y = triangle()
    for m in (2, 25):
        record = Record((Piece(v, np.repeat(y[::m], m), 1000.0),))
        (said,) = suspicions(record)
        assert f'one row in {m},' in said
        # each of its readings lasts, and none hangs
        assert without_faults(record) is record
    assert suspicions(Record((Piece(np.repeat(v[::4], 4), np.repeat(y[::4], 4), 1000.0),))) == []


def test_swapped_columns():
    v, _y = triangle()
    hold = np.repeat([2.0, 4.0, 6.0, 3.0], 3000)
    drive = np.concatenate([np.zeros(200), v, hold])
    measured = 1e-6 * drive + 3e-9 * np.random.default_rng(2).standard_normal(drive.size)
    # the measured displacement in the column of the voltage, scaled to look like one
    (said,) = suspicions(Record((Piece(1e6 * measured + 0.1 * drive, 1e-6 * drive, 1000.0),)))
    assert 'swapped' in said


def test_line_error_is_that_of_polyfit():
    v, y = triangle(noise=1e-7)
    slope, offset = np.polyfit(v, y, 1)
    expected = 100 * np.sqrt(np.mean((y - slope * v - offset) ** 2)) / np.ptp(y)
    assert line_error([Piece(v, y, 1000.0)]) == pytest.approx(expected, rel=1e-9)


def test_labels_that_are_nearly_right_are_named():
    assert misspelt(['noise', 'triangl', 'Steps:2', 'segment_0', 'sine:50Hz']) == [
        'triangl (did you mean triangle?)',
        'Steps:2 (did you mean step?)',
    ]


def test_a_displacement_of_noise_is_refused():
    v, _ = triangle()
    y = 1e-6 * np.random.default_rng(3).standard_normal(v.size)
    with pytest.raises(IdentificationError):
        identify(Record((Piece(v, y, 1000.0),)))


# --- readings that are none --------------------------------------------------------------------

RATE = 20_000.0
T = np.arange(200_000) / RATE
V = 5 + 5 * np.sin(2 * np.pi * T)
Y = 7.5e-6 * V
AT = np.random.default_rng(0).choice(np.arange(1000, 199_000, 40), 150, replace=False)


def cleaned(y, v=V):
    record = Record((Piece(v, y, RATE),))
    clean = without_faults(record)
    return clean, {fault.name: fault.count for fault in clean.faults}


def test_wild_and_lost_readings_are_bridged_and_counted():
    truth = Y + 2e-9 * np.random.default_rng(1).normal(size=Y.size)
    for length in (1, 2):
        y, v = truth.copy(), V.copy()
        for k in range(length):
            y[AT + k] = v[AT + k] = 0.0
        y[123_456] = 5e-3
        record, counts = cleaned(y, v)
        assert counts['outliers'] == 1
        # near zero a lost reading looks as any other
        assert 0.9 * length * AT.size <= counts['lost'] <= length * AT.size
        assert abs(record.pieces[0].y - truth).max() < 0.03 * np.ptp(Y)
        assert np.sqrt(np.mean((record.pieces[0].y - truth) ** 2)) < 1e-3 * np.ptp(Y)


def test_a_sensor_that_hangs_or_drops_out_is_left_out():
    y = Y + 2e-9 * np.random.default_rng(1).normal(size=Y.size)
    y[50_000:52_000] = y[50_000]
    y[90_000:90_300] = 0.0
    record, counts = cleaned(y)
    assert counts == {'stuck': 1999, 'lost': 300}
    (piece,) = record.pieces
    assert not piece.mask[50_001:52_000].any() and not piece.mask[90_000:90_300].any()
    np.testing.assert_array_equal(piece.v, V)
    assert without_faults(record) is record
    # a tenth of the record, too; where most of it is so, it is the way of the sensor
    y[100_000:117_000] = y[100_000]
    assert cleaned(y)[1] == {'stuck': 1999 + 16_999, 'lost': 300}


def test_a_sensor_hangs_also_while_the_voltage_goes_round():
    y = Y + 2e-9 * np.random.default_rng(1).normal(size=Y.size)
    y[20_000:60_500] = y[20_000]
    assert cleaned(y)[1] == {'stuck': 40_499}
    # and comes back to the very place
    y[20_000:60_500] = Y[20_000:60_500]
    y[100_000:120_000] = y[100_000]
    assert cleaned(y)[1] == {'stuck': 19_999}
    # a rest before a step that the stage answers late is none
    v = np.repeat(np.tile([4.0, 6.0, 2.0, 8.0], 5), 10_000)
    late = np.round(np.roll(7.5e-6 * v, 400) / 1e-8) * 1e-8
    assert cleaned(late, v)[1] == {}


@pytest.mark.parametrize('bits', [8, 10, 12])
@pytest.mark.parametrize('noise', [0.1, 0.15, 0.2])
def test_two_codes_that_take_turns_tell_no_noise_that_a_backlash_lacks(bits, noise):
    v = 5.0 + sum(0.4 * np.sin(2.0 * np.pi * f * T + f) for f in (1, 3, 7, 13, 29, 61))
    y = 7.5e-6 * play_columns(v, np.array([2.0]), v[:1])[0]
    q = 75e-6 / 2**bits
    read = q * np.round(y / q + noise * np.random.default_rng(4).normal(size=y.size))
    assert cleaned(read, v)[1] == {}


@pytest.mark.parametrize('bits', [6, 8, 12, 16])
@pytest.mark.parametrize('noise', [0.0, 0.3, 2.0])
def test_coarse_saturated_and_resting_readings_are_sound(bits, noise):
    q = 75e-6 / 2**bits
    rng = np.random.default_rng(bits)
    square = np.where(T % 1.0 < 0.5, 2.0, 8.0)
    for v, y in (
        (V, Y),
        (V, np.clip(Y, 2e-5, 5.5e-5)),
        (square, 7.5e-6 * square),
        (np.full(V.size, 5.0), np.full(V.size, 3e-5)),
    ):
        read = np.round((y + noise * q * rng.normal(size=y.size)) / q) * q
        assert cleaned(read, v)[1] == {}
        # the converter at its end
        assert cleaned(np.clip(read, 20 * q, 40 * q), v)[1] == {}


@pytest.mark.parametrize(
    'name', ['diagnosis', 'holds', 'identification', 'minor_loops', 'validation']
)
def test_a_stage_gives_no_faulty_readings(name):
    record = pi.SimulatedStage.load('paper').play(pi.Program.load(name))
    assert without_faults(record) is record


@pytest.mark.skipif(not DATA.is_dir(), reason='the measured data are not there')
def test_measured_records_hold_no_faulty_readings():
    for path in sorted(DATA.glob('*.csv')):
        record = pi.read(path)
        assert without_faults(record) is record


def test_one_wild_sample_does_not_deflate_the_error():
    stage = pi.SimulatedStage.load('paper')
    record = stage.play(pi.Program.load('minor_loops'))
    s = stage.model.scaling
    wrong = replace(stage.model, scaling=replace(s, Y=1.4 * s.Y))
    expected = pi.free_run(wrong, record).errors.percent
    (piece,) = record.pieces
    y = piece.y.copy()
    y[y.size // 2] = 5e-3
    run = pi.free_run(wrong, replace(record, pieces=(replace(piece, y=y),)))
    assert run.errors.percent == pytest.approx(expected, rel=0.01)
    assert [(f.name, f.count) for f in run.record.faults] == [('outliers', 1)]


def test_the_first_part_of_a_record_says_so():
    record = Record((Piece(V, Y, RATE), Piece(V, Y, RATE, 20.0)))
    part = record.first(250_000)
    assert [p.n for p in part] == [200_000, 50_000]
    assert [(f.name, f.count) for f in part.faults] == [('part', 150_000)]
    assert record.first(400_000) is record


# --- one mask, for every fit and every error ---------------------------------------------------

PLAYED = parse_program(SLOW_PROGRAM).build(SLOW)
NOISE = 5e-9


def slow_record(offset=0.0, sound=True, **spoilt):
    """Return a record of the slow stage, and which of its readings are no displacement."""
    y = slow_model().simulate(PLAYED.v) + offset
    y += NOISE * np.random.default_rng(0).standard_normal(y.size)
    read, bad = (y, np.zeros(y.size, bool)) if sound else lossy(y, **spoilt)
    return Record((Piece(PLAYED.v, read, SLOW, segments=PLAYED.segments),), 'slow'), bad


def lossy(y, kind, share, length):
    """Return readings of which runs are lost, wild, at full scale, or repeated."""
    rng, bad = np.random.default_rng(5), np.zeros(y.size, bool)
    while bad.mean() < share:
        start = rng.integers(1, y.size - length)
        bad[start : start + length] = True
    values = {
        'zero': np.zeros(y.size),
        'full scale': np.full(y.size, y.max() + 2 * np.ptp(y)),
        'wild': y.mean() + 3 * np.ptp(y) * rng.standard_normal(y.size),
        'repeated': y[np.maximum.accumulate(np.where(bad, 0, np.arange(y.size)))],
    }
    return np.where(bad, values[kind], y), bad


@pytest.mark.parametrize('offset', [0.0, -37e-6])
@pytest.mark.parametrize('length', [1, 7, 30])
@pytest.mark.parametrize('kind', ['zero', 'full scale'])
def test_a_tenth_of_the_readings_may_be_lost(kind, length, offset):
    record, bad = slow_record(offset, sound=False, kind=kind, share=0.1, length=length)
    piece = without_faults(record).pieces[0]
    true = slow_record(offset)[0].pieces[0].y
    left = (record.pieces[0].y - true)[piece.mask]
    # a zero among zeros does no harm
    assert np.sqrt(np.mean(left**2)) < NOISE
    assert np.mean(~piece.mask & ~bad) < 0.005
    assert without_faults(record).stroke == pytest.approx(np.ptp(true), rel=0.01)


@pytest.mark.parametrize('length', [1, 3, 7])
def test_wild_readings_that_no_voltage_asks_for_are_found(length):
    record, bad = slow_record(sound=False, kind='wild', share=0.1, length=length)
    mask = without_faults(record).pieces[0].mask
    # what lies within the motion of the noise cannot be told from it
    assert np.mean(~mask[bad]) > 0.98 and np.mean(~mask & ~bad) < 0.001


@pytest.mark.parametrize(('share', 'least'), [(0.002, 0.5), (0.1, 0.6)])
def test_repeated_readings_in_motion_are_found(share, least):
    record, bad = slow_record(sound=False, kind='repeated', share=share, length=1)
    mask = without_faults(record).pieces[0].mask
    # in a rest nobody can tell
    assert np.mean(~mask[bad]) > least and np.mean(bad[~mask]) > 0.95


SETTINGS = pi.Settings(thresholds=8, order=(2, 2))


@pytest.fixture(scope='module')
def good():
    """Return what is identified from readings that are all sound."""
    return pi.identify(slow_record()[0], SETTINGS)


@pytest.mark.parametrize(
    ('kind', 'length', 'share', 'more'),
    [
        ('zero', 1, 0.1, 0.0),
        ('full scale', 7, 0.1, 0.0),
        # a few that lie within the motion stay, with up to so many % of stroke rms
        ('wild', 1, 0.05, 0.1),
        ('repeated', 1, 0.02, 0.0),
    ],
)
def test_the_model_of_lossy_readings_is_that_of_sound_ones(good, kind, length, share, more):
    truth, span = slow_record()[0], abs(good.model.scaling.Y)
    record, _ = slow_record(sound=False, kind=kind, share=share, length=length)
    found = pi.identify(record, SETTINGS)
    apart = found.model.simulate(PLAYED.v) - good.model.simulate(PLAYED.v)
    assert np.sqrt(np.mean(apart**2)) < NOISE
    assert found.model.delay.samples == good.model.delay.samples
    assert any(word in w for w in found.warnings for word in ('lost', 'outliers', 'missed'))
    assert found.stroke == pytest.approx(good.stroke, rel=1e-3)
    assert cells(found, record)['stroke'] == pytest.approx(good.stroke, rel=1e-3)
    assert found.headline.percent == pytest.approx(good.headline.percent, rel=0.1)
    assert found.noise_floor == pytest.approx(good.noise_floor, rel=0.15)
    # and the same errors, wherever they are printed
    sound, spoilt = (pi.free_run(found.model, r).errors for r in (truth, record))
    assert spoilt.percent == pytest.approx(sound.percent, abs=100 * NOISE / span + more)
    assert spoilt.n < sound.n
    checked = pi.identify(truth, SETTINGS, validation=[record])
    rows = [row for row in checked.errors if row.data == 'validation']
    assert max(row.percent for row in rows) < 1.2 * good.headline.percent + more


def unlabelled(n, seed, lost):
    """Return random sweeps at 50 Hz, and a share of whose readings is 0 where 41 um are least."""
    rng = np.random.default_rng(seed)
    turns = np.cumsum([0, *rng.integers(8, 50, n // 20)])
    v = np.interp(np.arange(n), turns, [0.0, *rng.uniform(0.0, 150.0, turns.size - 1)])
    w = play_columns(v, np.array([8.0, 20.0, 40.0, 70.0]), np.zeros(4)).sum(axis=0)
    y = 41e-6 + 25e-9 * v + 4e-9 * w + 12e-9 * rng.standard_normal(n)
    return pi.Record.from_arrays(v, np.where(rng.random(n) < lost, 0.0, y), sample_rate=50.0)


def test_a_model_and_a_diagnosis_of_unlabelled_readings_that_are_lost_now_and_then():
    few, creep = pi.Settings(thresholds=10, max_order=2), pi.DiagnosisSettings(effects=('creep',))
    sound, lossy = (pi.identify(unlabelled(2400, 1, lost), few).model for lost in (0.0, 0.016))
    (piece,) = unlabelled(2400, 1, 0.0)
    apart = lossy.simulate(piece.v) - sound.simulate(piece.v)
    assert np.sqrt(np.mean(apart**2)) < 12e-9
    assert pi.free_run(lossy, unlabelled(3500, 3, 0.016)).errors.percent < 0.4
    assert pi.diagnose(lossy, unlabelled(3500, 2, 0.016), creep).verdict in ('none', 'refitted')


def test_the_displacement_of_another_axis_is_judged_too():
    v_b, y_b = np.roll(V, 3000) + 1, np.roll(Y, 3000) + 30e-6
    channels = {'v_b': v_b.copy(), 'y_b': y_b.copy(), 'heat': np.where(T == T[AT[0]], 90.0, 20.0)}
    # a row of that axis that was lost as a whole, and readings alone
    channels['v_b'][AT[:50]] = channels['y_b'][AT] = 0.0
    record = Record((Piece(V, Y, RATE, channels=channels),))
    (piece,) = (clean := without_faults(record)).pieces
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(piece.channels['y_b'])), np.sort(AT))
    np.testing.assert_allclose(piece.channels['v_b'], v_b, atol=1e-3)
    np.testing.assert_array_equal(piece.channels['heat'], channels['heat'])
    assert piece.mask.all() and piece.y is record.pieces[0].y
    (fault,) = clean.faults
    assert (fault.name, fault.count) == ('lost', 150) and 'y_b' in fault.where
    assert without_faults(clean) is clean
    # where both lose readings, either is left out of its own axis alone
    y = Y + 30e-6
    y[AT + 7] = 0.0
    (piece,) = without_faults(Record((Piece(V, y, RATE, channels=channels),))).pieces
    np.testing.assert_array_equal(np.flatnonzero(~piece.mask), np.sort(AT + 7))
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(piece.channels['y_b'])), np.sort(AT))


def test_steps_rests_and_stops_are_no_lost_readings():
    rng = np.random.default_rng(3)
    # steps and pulses of the stage, late by ten samples and ringing
    v = np.repeat(rng.uniform(0, 10, 400), rng.integers(3, 500, 400))
    late = np.concatenate([np.full(10, v[0]), v[:-10]])
    pole = 0.97 * np.exp(0.4j)
    ringing = lfilter([abs(1 - pole) ** 2], np.poly([pole, pole.conjugate()]).real, late - v[0])
    for y in (late, ringing):
        assert cleaned(7.5e-6 * y + 2e-9 * rng.standard_normal(v.size), v)[1] == {}
    # a sensor that was set to another zero within the record
    assert cleaned(Y + np.where(T < 4.0, 0.0, 5e-6), V)[1] == {}
    # quantised rests at zero, and a stage that is at its end
    q = 75e-6 / 2**12
    rests = np.clip(np.round((Y - 20e-6) / q) * q, 0.0, 40e-6)
    assert cleaned(rests, V)[1] == {}


@pytest.mark.parametrize('seed', [45, 57, 64, 73])
def test_pauses_of_fast_motion_are_no_missed_samples(seed):
    text = identification_program(steps=8, cycles=8, frequency=20, noise=1, slope=40)
    stage = pi.SimulatedStage.load('paper')
    v = parse_program(text).build(20_000.0).v[:28_300]
    y = stage.run(np.random.default_rng(seed)).process(v)
    assert without_faults(Record((Piece(v, y, 20_000.0),), 'noise')).faults == ()
