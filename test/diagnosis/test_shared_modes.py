# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Hysteresis inside the loop of modes that axes share is found, or is not there."""

from dataclasses import replace
import functools

import axes_stage as stage
import numpy as np
import piezo_ident as pi
from piezo_ident.common.errors import DataError, ModelError
from piezo_ident.diagnosis.shared_modes import IN_FRONT, LawSearch
from piezo_ident.fitting.modes.periods import PeriodicRecord, periods_of
from piezo_ident.fitting.modes.signals import with_loop_plays, with_softening
from piezo_ident.identification.settings import silent
from piezo_ident.model.modes.shared_modes import SharedModes
import pytest
from two_axes_record import chains, FEW, measured, other, program, STAGE


def searched(truth, seed=1):
    records = stage.records(truth, np.random.default_rng(seed), count=4, noise=0.002)
    return LawSearch(records, silent)


@functools.cache
def diagnosed():
    only = pi.DiagnosisSettings(effects=('loop_hysteresis',))
    return pi.diagnose(chains().model, measured(), only)


def test_hysteresis_inside_the_loop_fits_best_and_moves_the_modes():
    search = searched(replace(stage.loop_stage(), memory=300.0))
    assert search.modes_move()
    fitted = search.laws().items()
    errors = {law: search.error(dict.fromkeys(search.groups, x)) for law, x in fitted}
    assert min(errors, key=errors.get) == 'softening and plays'
    # noise is 0.2 %
    assert errors['softening and plays'] < 0.5 < 2 < errors['plays in front']


def test_hysteresis_of_the_voltages_leaves_the_modes_where_they_are():
    truth = stage.loop_stage(softening=0.0, plays=0.1)
    truth = replace(truth, f=0 * truth.f, g=np.vstack([np.eye(2)] * 2))  # of voltages
    search = searched(truth)
    assert not search.modes_move()


def yielded(u, size=2.5, part=0.5):
    """Return voltages less what they yield, by the law of Bouc and Wen."""
    z, last, out = np.zeros(2), u[0], np.empty_like(u)
    for k, now in enumerate(np.vstack([u, u])):
        side, step = np.sign(now - last), np.abs(now - last)
        # back to zero without yielding, and what is left of the way beyond
        back = np.minimum(step, np.maximum(0, -side * z))
        z, step, last = z + side * back, step - back, now
        z = side * size - (side * size - z) * np.exp(-step / size)
        out[k % len(u)] = now - part * z
    return out


def test_a_law_in_front_that_is_no_play_leaves_the_modes_where_they_are():
    rng = np.random.default_rng(8)
    truth = stage.linear_stage()

    def record(amplitude):
        u = stage.multisine(rng, amplitude)
        y = np.array([stage.answer(truth, yielded(u))] * 2)
        y += 0.002 * y.std() * rng.standard_normal(y.shape)
        return PeriodicRecord('record', f'{amplitude:g}', stage.RATE, np.array([u] * 2), y)

    records = [record(a) for a in (0.5, 1.0, 1.5) for _ in range(4)]
    assert not LawSearch(records, silent).modes_move()


def test_a_shared_loop_is_named_on_every_axis_and_predicts_another_record():
    result = diagnosed()
    assert {x.verdict for x in result.values()} == {'named'}
    assert {e.name for x in result.values() for e in x.effects} == {'loop_hysteresis'}
    assert all(x.after.overall < 0.4 * x.before.overall for x in result.values())
    assert not any(f'({law})' in result['y'].sentence for law in IN_FRONT)
    of_chains, modes = (
        pi.free_run(x, other()) for x in (pi.MultiAxisModel(result.model.axes), result.model)
    )
    for axis, run in modes.items():
        assert run.errors.percent < 0.5 * of_chains[axis].errors.percent
    assert 'shared' in repr(result.model)


def test_the_file_of_shared_modes_reads_back_bit_by_bit(tmp_path):
    model = diagnosed().model
    model.save(tmp_path / 'model.yaml')
    again = pi.load(tmp_path / 'model.yaml')
    rng = np.random.default_rng(0)
    v = {'v': 5 + rng.normal(size=300), 'v_b': 5 + rng.normal(size=300)}
    for axis, y in model.simulate(v).items():
        np.testing.assert_array_equal(again.simulate(v)[axis], y)
    text = (tmp_path / 'model.yaml').read_text(encoding='utf-8')
    (tmp_path / 'model.yaml').write_text(text.replace('blocks:', 'block:'), encoding='utf-8')
    with pytest.raises(ModelError, match=r"model\.yaml: modes: .*'blocks'"):
        pi.load(tmp_path / 'model.yaml')


def test_band_and_promise_of_shared_modes_hold_on_another_record():
    result = diagnosed()
    for axis, run in pi.free_run(result.model, other(), 0.9).items():
        assert 0.75 < run.inside <= 1.0
        assert np.median(run.half_widths[0]) < 5 * np.std(run.measured - run.predicted)
        assert 0.5 < run.errors.percent / result[axis].promise.same < 2.0


def test_the_error_of_an_inverse_is_expected_from_the_modes():
    model, t = diagnosed().model, np.arange(4000) / STAGE.sample_rate
    soft = np.minimum(1.0, np.minimum(t, t[::-1]) / 0.2) ** 2
    rest = {a: float(y[0]) for a, y in model.simulate({'v': [5.0], 'v_b': [5.0]}).items()}
    wanted = {
        a: rest[a] + 0.2 * model.axes[a].scaling.Y * soft * np.sin(2 * np.pi * f * t)
        for a, f in (('y', 30.0), ('y_b', 7.0))
    }
    drive = pi.invert(model, wanted)
    for axis, one in drive.items():
        assert drive.errors[axis] < 0.1 < one.expected


def test_a_linear_stage_shares_no_loop():
    linear = replace(STAGE, hysteresis=(0.0, 0.4, 1.0), creep_gain=np.zeros(2))
    record = linear.play(program('small', 'large', realisations=2, periods=2))
    assert pi.identify(record, FEW).modes is None


def test_periods_are_found_and_the_first_is_left_to_settle():
    periods, v0 = periods_of([measured()])
    assert [r.u.shape for r in periods] == [(2, 2048, 2)] * 6
    assert [r.group for r in periods] == [periods[0].group] * 3 + [periods[-1].group] * 3
    np.testing.assert_allclose(v0, 5.0, atol=1e-9)
    # measured voltages never repeat to the last digit
    rng = np.random.default_rng(3)
    (piece,) = measured()
    noisy = replace(piece, v=piece.v + 1e-4 * np.ptp(piece.v) * rng.uniform(-1, 1, piece.n))
    assert [r.u.shape for r in periods_of([pi.Record((noisy,), 'noisy')])[0]] == [(2, 2048, 2)] * 6
    # a piece without segments is one segment
    cut = piece.find('multisine:small-1')[0]
    bare = replace(piece.cut(cut.start, cut.stop), segments=())
    assert [r.u.shape for r in periods_of([pi.Record((bare,), 'bare')])[0]] == [(2, 2048, 2)]
    assert periods_of([measured().first(500)])[0] == ()


@pytest.mark.parametrize(('share', 'length'), [(0.016, 1), (0.05, 4)])
def test_lost_readings_of_either_axis_are_left_out(share, length):
    linear = replace(STAGE, hysteresis=(0.0, 0.4, 1.0), creep_gain=np.zeros(2))
    record = linear.play(program('small', realisations=3, periods=3))
    (piece,), rng, columns = record, np.random.default_rng(4), {}
    for name, y in {'y': piece.y, 'y_b': piece.channels['y_b']}.items():
        lost = np.zeros(piece.n, bool)
        while lost.mean() < share:
            start = rng.integers(1, piece.n - length)
            lost[start : start + length] = True
        columns[name] = np.where(lost, 0.0, y)
    channels = {**piece.channels, 'y_b': columns['y_b']}
    spoilt = pi.Record((replace(piece, y=columns['y'], channels=channels),), 'lossy')
    sound, held = periods_of([record])[0], periods_of([spoilt])[0]
    gone = np.concatenate([~r.sound for r in held], axis=1)
    assert 0.9 * share < gone.mean() < 1.2 * share
    for a, b in zip(sound, held, strict=True):
        # those of the other period stand in for them
        assert abs(a.y - b.y)[:, b.sound.any(axis=0)].max() < 20e-9


def test_softening_comes_first():
    rng = np.random.default_rng(5)
    records = [stage.record(stage.linear_stage(), rng, 1.0)]
    plain = SharedModes.of(stage.linear_stage())
    played = with_loop_plays(with_softening(plain, records), records)
    assert played.levels == 2 and played.signals == 4
    z = played.run(np.vstack([records[0].mean_u] * 2)).z[stage.SAMPLES :]
    assert z.std(axis=0) == pytest.approx(1, rel=0.05)
    with pytest.raises(ModelError, match=r'4 signals .*with_softening'):
        with_softening(played, records)


def test_voltages_of_another_number_of_axes_are_refused():
    with pytest.raises(DataError, match='do not fit 2 inputs'):
        SharedModes.of(stage.linear_stage()).run(np.zeros((10, 1)))
