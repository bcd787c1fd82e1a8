# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The band of a prediction: its level over kinds of motion, its width, and where it ends."""

from dataclasses import replace
import json

from command_line import refuse, succeed
import numpy as np
from paper_stage import FS, PAPER
from piezo_ident.common.errors import ConfigError, ModelError
from piezo_ident.model.files import load, model_from_dict, model_to_dict
from piezo_ident.model.stage_model import EffectSetting
from piezo_ident.record.io import write
from piezo_ident.record.record import Piece, Record, Segment
from piezo_ident.selection.judged import JudgedRun
from piezo_ident.uncertainty.band import BandStream, FAR, FAST, KEY, PredictionBand
from piezo_ident.uncertainty.calibration import blocks_of, calibrated
from piezo_ident.uncertainty.motion import Motion
from piezo_ident.verbs.predict import free_run
import pytest

BAND = PredictionBand(np.array([1e-3, 2e-3, 0.0, 0.0]), np.ones(5), 100.0)


def banded(band=BAND, **changes):
    model = replace(PAPER, **changes)
    return replace(model, identification={**model.identification, KEY: band.to_dict()})


def sine(f=20.0, n=4000, low=0.0, high=10.0):
    middle, size = 0.5 * (low + high), 0.5 * (high - low)
    return middle - size * np.cos(2 * np.pi * f * np.arange(n) / FS)


@pytest.mark.parametrize('spread', [0.0, 0.3, 0.6])
@pytest.mark.parametrize(('kinds', 'level'), [(3, 0.9), (6, 0.9), (6, 0.5), (20, 0.95)])
def test_a_band_holds_its_share_of_further_kinds(kinds, level, spread):
    rng = np.random.default_rng(kinds)
    r, further = np.exp(spread * rng.standard_normal((2, 400, kinds)))
    held = [
        np.mean(np.abs(x * rng.standard_normal((100, kinds))) <= factor)
        for x, own in zip(further, r, strict=True)
        for factor in [PredictionBand(np.ones(3), own, 1.0).factor(level)]
    ]
    assert level - 0.02 < np.mean(held) < level + 0.1


@pytest.mark.parametrize('level', [0.0, 1.0, -0.5, np.nan])
def test_a_level_lies_between_0_and_1(level):
    with pytest.raises(ConfigError, match='interval'):
        BAND.factor(level)


def judged(error, labels=('sine:1', 'sine:2', 'noise', 'steps')):
    v = np.concatenate([sine(5.0), sine(20.0), sine(80.0, low=4.0, high=6.0), sine(1.0)])
    edges = np.linspace(0, v.size, len(labels) + 1).astype(int)
    cut = zip(labels, edges[:-1], edges[1:], strict=True)
    segments = tuple(Segment(label, int(a), int(b)) for label, a, b in cut)
    y = PAPER.simulate(v)
    e = abs(PAPER.scaling.Y) * error(Motion(PAPER).follow(PAPER.scaling.u(v), PAPER.scaling.x(y)))
    piece = Piece(v, y + e, FS, segments=segments)
    use = np.ones(v.size, dtype=bool)
    return JudgedRun('record', piece, y, use, ~use)


@pytest.mark.parametrize('place', [0, 1, 2, 3])
def test_calibration_finds_what_the_error_follows(place):
    rng = np.random.default_rng(1)
    true = np.array([1e-4, 1e-5, 1e-8, 1e-5])
    true[place] = [1e-3, 5e-3, 2e-4, 5e-3][place]

    def error(motion):
        scale = np.sqrt(true[0] ** 2 + np.sum((true[1:, None] * motion) ** 2, axis=0))
        return scale * rng.standard_normal(scale.size)

    band = calibrated(blocks_of(PAPER, [judged(error)]))
    assert band.ratios.size == 4
    assert band.coefficients[place] == pytest.approx(true[place], rel=0.15)
    assert np.sqrt(np.mean(band.ratios**2)) == pytest.approx(1.0, rel=0.5)


def test_small_loops_inside_a_wide_one_are_nested_along_their_path():
    wide, small = sine(5.0, 8000), 5.0 + 0.2 * np.sin(2.0 * np.pi * 50.0 * np.arange(8000) / FS)
    u = PAPER.scaling.u(np.concatenate([wide, small]))
    nesting = Motion(PAPER).follow(u, u)[2]
    assert nesting[4000:8000].max() < 0.05
    # twenty cycles are 1.6 ranges of path, and the mean has come to 1 - exp(-1.6) of 0.96
    assert nesting[8400] < 0.1 and nesting[-1] == pytest.approx(0.59, abs=0.03)
    # noise of a resting voltage is no path
    still = 5e-4 * np.random.default_rng(0).uniform(-1.0, 1.0, 4000)
    assert Motion(PAPER).follow(still, still)[2].max() < 0.01


def test_a_band_of_an_older_file_is_read():
    old = {'coefficients': [1e-3, 2e-3, 0.0], 'kinds': 5, 'ratio': 1.0, 'speed': 100.0}
    motion, band = np.random.default_rng(0).random((3, 50)), PredictionBand.from_dict(old)
    np.testing.assert_allclose(band.scale(motion), BAND.scale(motion))
    assert band.factor(0.9) == BAND.factor(0.9)


def test_kinds_without_fits_raise_the_error_of_fitted_kinds_and_not_the_other_way():
    run = judged(lambda motion: 1e-3 * motion[0], ('triangle', 'noise', 'sine:slow', 'sine:fast'))
    third = run.piece.find('sine')[0].start
    size = np.where(np.arange(run.use.size) < third, 1.0, 10.0)
    worse = replace(run, predicted=run.piece.y - size * run.error)
    outside = np.arange(run.use.size) >= third
    swing = [
        calibrated(blocks_of(PAPER, [replace(worse, held=held)])).scale(np.eye(3)[:, :1])
        for held in (outside, np.zeros_like(outside), ~outside)
    ]
    assert swing[0] == pytest.approx(1e-2, rel=0.15)
    assert swing[1] < 0.8 * swing[0] and swing[2] < 0.8 * swing[0]


def test_samples_held_out_count_more_than_samples_fitted():
    run = judged(lambda motion: np.full(motion.shape[1], 1e-3))
    held = np.arange(run.use.size) % 2 == 1
    error = np.where(held, 3.0, 1.0) * run.error
    worse = replace(run, predicted=run.piece.y - error, held=held)
    plain, found = (blocks_of(PAPER, [x]).square.mean() for x in (run, worse))
    assert found == pytest.approx(9.0 * plain, rel=0.05)


def test_a_model_that_diverges_and_a_record_without_blocks_have_no_band():
    run = judged(lambda motion: np.full(motion.shape[1], 1e-3))
    far = run.predicted.copy()
    far[100:] = np.inf
    assert blocks_of(PAPER, [replace(run, predicted=far)]) is None
    assert blocks_of(PAPER, [replace(run, use=np.zeros(run.use.size, dtype=bool))]) is None


def test_the_width_follows_the_motion_and_not_the_blocks():
    model, v = banded(), np.concatenate([np.zeros(100), sine(), np.full(100, 5.0)])
    y = model.simulate(v)
    whole = BandStream(model, 0.9).follow(v, y)
    stream = BandStream(model, 0.9)
    parts = np.concatenate(
        [stream.follow(v[a : a + 333], y[a : a + 333]) for a in range(0, v.size, 333)]
    )
    np.testing.assert_array_equal(whole, parts)
    assert whole[2000] > 2.0 * whole[50]


def test_far_outside_the_range_and_at_much_faster_motion_nothing_is_known():
    model = banded()
    near, far = 10.0 * (1.0 + 0.5 * FAR), 10.0 * (1.0 + 1.1 * FAR)
    at = [BandStream(model, 0.9).follow(np.full(9, v), np.zeros(9))[-1] for v in (9.0, near, far)]
    assert at[1] > 10.0 * at[0] and np.isfinite(at[1])
    assert np.isinf(at[2])
    slow = replace(BAND, speed=1.01 * np.pi * 2.0)
    for f, is_known in ((2.0, True), (1.5 * 2.0 * FAST, False)):
        v = sine(f, 20_000)
        half = BandStream(banded(slow), 0.9).follow(v, PAPER.simulate(v))
        assert np.isfinite(half).all() == is_known


def test_the_unknown_start_is_in_the_band_until_it_is_forgotten():
    model, v = banded(), 5.0 + 4.9 * np.sin(np.arange(4000) / 200)
    y = model.simulate(v)
    known, unknown = (BandStream(model, 0.9, plays=x).follow(v, y) for x in (True, False))
    assert unknown[0] > 3.0 * known[0]
    np.testing.assert_allclose(unknown[-10:], known[-10:])
    creep = EffectSetting('creep', {'gain': [0.02], 'time_constant': [0.05]})
    slow = banded(effects=(creep,))
    y = slow.simulate(v)
    known, unknown = (BandStream(slow, 0.9, creep=x).follow(v, y) for x in (True, False))
    extra = unknown - known
    assert extra[0] > 10.0 * extra[-1] > 0.0


def test_a_model_file_keeps_its_band_and_an_old_one_says_what_to_do(tmp_path):
    model = model_from_dict(json.loads(json.dumps(model_to_dict(banded()))))
    v = sine()
    y = PAPER.simulate(v)
    np.testing.assert_array_equal(
        BandStream(model, 0.9).follow(v, y), BandStream(banded(), 0.9).follow(v, y)
    )
    with pytest.raises(ModelError, match='identify'):
        BandStream(PAPER, 0.9)
    for damaged in (
        {},
        {**BAND.to_dict(), 'ratios': [1.0, 0.0]},
        {**BAND.to_dict(), 'speed': np.inf},
    ):
        broken = replace(PAPER, identification={KEY: damaged})
        with pytest.raises(ModelError):
            BandStream(broken, 0.9)


def test_a_free_run_counts_what_lies_inside():
    model, v = banded(), sine(n=8000)
    y = PAPER.simulate(v)
    half = BandStream(model, 0.9).follow(v, y)
    inside = np.arange(v.size) % 4 > 0
    record = Record.from_arrays(v, y + np.where(inside, 0.5, 1.5) * half, sample_rate=FS)
    run = free_run(model, record, 0.9)
    assert run.inside == pytest.approx(0.75, abs=0.01)
    assert free_run(model, record).half_widths == ()
    assert run.plot() and run.to_json()['share_inside_band'] == run.inside


def test_predict_writes_the_band_or_asks_to_identify_again(capsys, tmp_path):
    banded().save(tmp_path / 'model.yaml')
    PAPER.save(tmp_path / 'old.yaml')
    v = sine()
    write(Record.from_arrays(v, PAPER.simulate(v), sample_rate=FS), tmp_path / 'measured.npz')
    rows = np.c_[np.arange(v.size) / FS, v]
    np.savetxt(tmp_path / 'scan.csv', rows, '%.9g', ',', header='t,v', comments='')
    for name in ('measured.npz', 'scan.csv'):
        out = tmp_path / f'{name}.out.npz'
        argv = ['predict', tmp_path / 'model.yaml', tmp_path / name, '--interval', '0.9']
        data = json.loads(succeed(capsys, *argv, '--out', out, '--json'))
        half = np.load(out)['half_width']
        mean = data['interval']['axes']['y']['mean_half_width_percent_of_span']
        assert half.shape == v.shape
        assert 100.0 * half.mean() / abs(PAPER.scaling.Y) == pytest.approx(mean)
        argv[1] = tmp_path / 'old.yaml'
        refuse(capsys, tmp_path, argv, 'old.yaml', 'identify')
    assert load(tmp_path / 'old.yaml').identification.get(KEY) is None
