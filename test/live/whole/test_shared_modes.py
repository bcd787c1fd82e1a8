# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Modes that axes share, live: predicted block by block as offline, to the last bit."""

from dataclasses import replace

import numpy as np
import piezo_ident as pi
from piezo_ident.live.corrector import Corrector
from piezo_ident.live.guard import GuardSettings
from piezo_ident.live.predictor import Predictor
from piezo_ident.live.tracker import prepared
from piezo_ident.model.modes.stream import ModesStream
from piezo_ident.model.multi_axis import alone, SHARED_MODES
from piezo_ident.record.blocks import Samples
from piezo_ident.record.record import Piece
from piezo_ident.uncertainty.band import KEY, PredictionBand
from piezo_ident.verbs.invert import learn_axes
from piezo_ident.verbs.predict import bands
import pytest
from random_models import random_modes_model, random_voltages

RATE = 20e3
AXES = ('y', 'y_b', 'y_c')


def case(seed, axes=2, n=3000, **options):
    """Return a model and voltages, a row for each axis."""
    rng = np.random.default_rng(seed)
    model = random_modes_model(rng, axes, **options)
    return model, np.ascontiguousarray(random_voltages(rng, model.modes, n).T)


def offline(model, v, axes):
    """Return the prediction of `simulate`, a row for each axis."""
    columns = {f'v{axis[1:]}': row for axis, row in zip(axes, v, strict=True)}
    y = model.simulate(columns)
    return np.stack([y[axis] for axis in axes])


def predicted(predictor, v, start=0, size=70):
    t = (start + np.arange(v.shape[1])) / RATE
    blocks = [
        predictor.process(Samples(t[k : k + size], v[:, k : k + size]))
        for k in range(0, t.size, size)
    ]
    return np.hstack([block.values for block in blocks])


@pytest.mark.parametrize('seed', range(5))
def test_the_live_prediction_is_the_offline_one_to_the_last_bit(seed):
    axes = 1 + seed % 3
    model, v = case(seed, axes, softens=bool(seed % 2))
    order = AXES[:axes][::-1]
    expected = offline(model, v, order)
    assert np.ptp(expected, axis=1).min() > 1e-8
    for size in (1 + seed * 17, 500):
        predictor = Predictor(order)
        predictor.set_model(model)
        np.testing.assert_array_equal(predicted(predictor, v, size=max(size, 2)), expected)
    stream, cut = ModesStream(model.modes), np.random.default_rng(seed).integers(1, 2999, 40)
    columns = v[::-1].T
    parts = [stream.process(x) for x in np.split(columns, np.sort(cut))]
    np.testing.assert_array_equal(np.vstack(parts).T[::-1], expected)


def test_a_model_that_comes_late_has_the_state_of_one_that_came_first():
    model, v = case(7)
    predictor = Predictor(AXES[:2])
    t = np.arange(2000) / RATE
    assert predictor.process(Samples(t, v[:, :2000])) is None
    predictor.set_model(model)
    late = predicted(predictor, v[:, 2000:], start=2000)
    np.testing.assert_array_equal(late, offline(model, v, AXES[:2])[:, 2000:])


def test_a_late_model_knows_its_memory_after_a_sweep(monkeypatch):
    # the voltages in full are too short for the plays
    monkeypatch.setattr('piezo_ident.live.history.RECENT', 0.01)
    model, v = case(8, n=6000)
    v[:, :3000] = v[:, [0]]
    predictor = Predictor(AXES[:2])
    for k in range(0, 3000, 100):
        predictor.process(Samples((k + np.arange(100)) / RATE, v[:, k : k + 100]))
    predictor.set_model(model)
    assert not predictor.memory_known
    late = predicted(predictor, v[:, 3000:], start=3000)
    assert predictor.memory_known
    # once the plays are swept, the earlier motion is forgotten
    error = late - offline(model, v, AXES[:2])[:, 3000:]
    assert np.abs(error[:, -500:]).max() < 1e-9 * np.ptp(late)


def test_a_gap_is_bridged_and_the_memory_is_unknown_until_the_next_sweep():
    model, v = case(9, n=4000)
    v[:, 2001:2050] = v[:, [2000]] + np.arange(1, 50) / 50 * (v[:, [2050]] - v[:, [2000]])
    predictor = Predictor(AXES[:2])
    predictor.set_model(model)
    made = [predicted(predictor, v[:, :2001])]
    assert predictor.memory_known
    made.append(predicted(predictor, v[:, 2050:2060], start=2050))
    assert not predictor.memory_known
    made.append(predicted(predictor, v[:, 2060:], start=2060))
    assert predictor.lost == 49 and predictor.memory_known
    whole = np.delete(offline(model, v, AXES[:2]), np.s_[2001:2050], axis=1)
    np.testing.assert_allclose(np.hstack(made), whole, rtol=0.0, atol=1e-12 * np.ptp(whole))


def test_the_live_band_is_the_offline_one():
    model, v = case(12)
    band = PredictionBand(np.array([1e-3, 1e-2, 1e-6, 1e-2]), np.array([0.8, 1.2, 1.5]), 1e6)
    own = {SHARED_MODES: {KEY: band.to_dict()}, KEY: 'of the chain'}
    axes = {a: replace(x, identification=own) for a, x in model.axes.items()}
    # the order of the node is not that of the file
    model, order = pi.MultiAxisModel(axes, model.modes), AXES[1::-1]
    predictor, halves = Predictor(order, 0.8), []
    predictor.set_model(model)
    for k in range(0, 3000, 100):
        predictor.process(Samples((k + np.arange(100)) / RATE, v[:, k : k + 100]))
        halves.append(predictor.half_width.values)
    columns = {f'v{a[1:]}': row for a, row in zip(order, v, strict=True)}
    piece = Piece(columns.pop('v'), np.full(3000, np.nan), RATE, channels=columns)
    record = pi.Record((piece,), 'voltages')
    offline_bands = bands(model, record, model.predicted(record), 0.8)
    for row, axis in zip(np.hstack(halves), order, strict=True):
        np.testing.assert_array_equal(row, offline_bands[axis][0])
    with pytest.raises(pi.ModelError, match='no prediction band'):
        bands(case(12)[0], record, model.predicted(record), 0.8)


def test_modes_that_run_away_are_a_problem_of_the_stream():
    model, v = case(10)
    wild = replace(model.modes, e=-300.0 * model.modes.e, levels=0)
    predictor = Predictor(AXES[:2])
    predictor.set_model(pi.MultiAxisModel(model.axes, wild))
    answers = [predictor.process(Samples((k + np.arange(100)) / RATE, v[:, k : k + 100]))
               for k in range(0, 3000, 100)]  # fmt: skip
    assert None in answers and 'run away' in predictor.problem


def test_shared_modes_of_other_axes_are_refused():
    with pytest.raises(pi.ModelError, match="'axes'"):
        Predictor(('y', 'y_c')).set_model(case(11)[0])


def test_the_observer_corrects_the_prediction_of_each_axis():
    model, v = case(13, n=20_000)
    # as a diagnosis writes them, in % of span
    known = {SHARED_MODES: {'diagnosis': {'errors': {'after': 0.01, 'worst': 0.01}}}}
    axes = {a: replace(x, identification=known) for a, x in model.axes.items()}
    model = pi.MultiAxisModel(axes, model.modes)
    predictor = Predictor(AXES[:2])
    predictor.set_model(model)
    y, moved = offline(model, v, AXES[:2]), np.array([[4e-7], [-3e-7]])
    correctors, got = [Corrector(), Corrector()], [[], []]
    for k, axis in enumerate(AXES[:2]):
        correctors[k].set_model(alone(model)[axis])
    for cut in (slice(i, i + 100) for i in range(0, v.shape[1], 100)):
        t = np.arange(v.shape[1])[cut] / RATE
        predicted_rows = predictor.process(Samples(t, v[:, cut])).values
        for k, one in enumerate(correctors):
            prediction, voltage = Samples(t, predicted_rows[k]), Samples(t, v[k, cut])
            got[k] += one.predicted(prediction, voltage, True, predictor.felt[k])
            got[k] += one.measured(t, (y + moved)[k, cut])
    for k in range(2):
        estimate = np.concatenate([one.samples.values for one in got[k]])
        left = (estimate - (y + moved)[k, : estimate.size])[estimate.size // 2 :]
        assert np.abs(left).max() < 0.1 * abs(moved[k, 0])


def test_what_runs_chains_alone_refuses_shared_modes():
    model, _ = case(14)
    settings = GuardSettings(0.0, 10.0, 1e4, 100.0, 0.0, RATE)
    for verb, act in {
        'feedforward': lambda: prepared(model, AXES[:2], settings, 0, 'off', None),
        'learn': lambda: learn_axes(model, {a: np.zeros(9) for a in AXES[:2]}),
    }.items():
        with pytest.raises(pi.ModelError, match=f'^{verb}: cannot run the modes') as caught:
            act()
        assert 'MultiAxisModel(model.axes)' in str(caught.value)
