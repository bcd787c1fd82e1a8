# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

from dataclasses import replace

import axes_stage as stage
import numpy as np
from piezo_ident.common.errors import DataError, IdentificationError, ModelError
from piezo_ident.fitting.modes.frequency_response import excited_lines, frequency_response
from piezo_ident.fitting.modes.linear_fit import choose_order, refined
from piezo_ident.fitting.modes.loop_fit import loop_fit
from piezo_ident.fitting.modes.periods import differences, PeriodicRecord, weighted
from piezo_ident.fitting.modes.subspace import subspace
from piezo_ident.model.modes.modal import Modal, narrowest, to_modal
from piezo_ident.model.modes.shared_modes import SharedModes
import pytest


@pytest.fixture(scope='module')
def noisy():
    return stage.records(
        stage.linear_stage(), np.random.default_rng(1), (1.0,), count=6, noise=0.01
    )


def test_a_record_that_changed_between_periods_counts_less(noisy):
    changed = noisy[2]
    y = changed.y.copy()
    other = stage.multisine(np.random.default_rng(2), 1.0)
    y[1] += 0.1 * y.std() * other
    records = [*noisy[:2], PeriodicRecord('changed', '1', stage.RATE, changed.u, y), *noisy[3:]]
    weights = np.array([r.weight for r in weighted(records)])
    found = differences(records)
    assert weights[[0, 1, 3, 4, 5]] == pytest.approx(1)
    assert weights[2] == pytest.approx(0.14, rel=0.15)
    assert found[2] == pytest.approx(0.1, rel=0.1)
    assert found[0] == pytest.approx(0.01 * np.sqrt(2), rel=0.1)


def test_response_agrees_with_the_truth_within_the_noise(noisy):
    truth = stage.linear_stage()
    found = frequency_response(noisy)
    last = found.lines[-1] * noisy[0].rate / found.samples
    assert found.lines[0] == 1 and last == pytest.approx(800, rel=0.01)
    error = found.g - truth.response(found.z)
    assert np.linalg.norm(error) < 0.01 * np.linalg.norm(found.g)
    with pytest.raises(DataError, match=r'1 records of \d+ lines .* 2 inputs'):
        frequency_response(noisy[:1], half_width=1, degree=2)


def test_subspace_is_exact_without_noise():
    truth = stage.linear_stage()
    records = stage.records(truth, np.random.default_rng(3), (1.0,), count=3)
    response = frequency_response(records, half_width=1, degree=0)
    exact = replace(response, g=truth.response(response.z))
    found = subspace(exact, 4)
    assert np.abs(found.response(exact.z) - exact.g).max() < 1e-6
    frequency, damping = stage.modes(found.a)
    assert frequency == pytest.approx([190, 310], rel=1e-6)
    assert damping == pytest.approx([0.03, 0.02], rel=1e-4)
    with pytest.raises(IdentificationError, match='odd'):
        subspace(exact, 3)


def test_refinement_recovers_the_stage_to_the_noise(noisy):
    start = subspace(frequency_response(noisy[:4]), 4)
    found = refined(start, frequency_response(noisy[:4]))
    for record in noisy[4:]:
        assert stage.percent(SharedModes.of(found), [record]) == pytest.approx(1.0, rel=0.15)
    assert found.radius < 1
    assert stage.modes(found.a)[0] == pytest.approx([190, 310], rel=1e-3)


def test_an_axis_of_a_short_stroke_is_fitted_as_well():
    truth = stage.uncoupled_stage()
    small = replace(truth, c=truth.c * np.array([[1.0], [1e-3]]))
    records = stage.records(small, np.random.default_rng(1), (1.0,), count=6)
    noise = np.random.default_rng(2).standard_normal((6, *records[0].y.shape))
    records = [
        replace(r, y=r.y + 0.01 * r.y.std(axis=(0, 1)) * e)
        for r, e in zip(records, noise, strict=True)
    ]
    start, errors = choose_order(records[:4], records[4:], orders=(2, 4, 8))
    assert start.order == 4 and errors[4] == pytest.approx(1.0, rel=0.15)
    for model in (
        SharedModes.of(start),
        loop_fit(SharedModes.of(start), records[:4], iterations=3),
    ):
        error = stage.error(model, records[5]).std(axis=0) / records[5].y[-1].std(axis=0)
        assert error == pytest.approx(0.01, rel=0.2)


def test_order_is_chosen_by_held_out_error_and_one_too_high_stays_stable(noisy):
    model, errors = choose_order(noisy[:4], noisy[4:], orders=(2, 4, 8))
    assert model.order == 4
    assert errors[2] > 10 and errors[4] == pytest.approx(1.0, rel=0.15)
    response = frequency_response(noisy)
    assert refined(subspace(response, 12), response, iterations=3).radius < 1


def test_a_mode_narrower_than_a_line_is_widened_and_holds_up_nothing(noisy):
    truth = stage.linear_stage()
    slow = 0.99989 * np.array([[np.cos(0.003), np.sin(0.003)], [-np.sin(0.003), np.cos(0.003)]])
    start = Modal(
        np.concatenate([0.995 * truth.blocks, slow[None]]),
        np.vstack([truth.b, 0.1 * np.ones((2, 2))]),
        np.hstack([truth.c, 0.1 * np.ones((2, 2))]),
        truth.d,
    )
    limit = narrowest(stage.SAMPLES)
    found = refined(start, frequency_response(noisy[:4]))
    assert found.radius <= limit + 1e-12
    model = loop_fit(SharedModes.of(start), noisy[:4], iterations=10)
    assert model.linear.radius <= limit + 1e-12
    for linear in (found, model.linear):
        assert stage.percent(SharedModes.of(linear), [noisy[4]]) == pytest.approx(1.0, rel=0.15)


def test_poles_beyond_the_circle_are_mirrored_and_odd_orders_refused():
    a = np.diag([1.1, 0.5])
    assert to_modal(a, np.ones((2, 1)), np.ones((1, 2)), np.zeros((1, 1))).radius < 1
    with pytest.raises(ModelError, match='odd'):
        to_modal(np.eye(1) / 2, np.ones((1, 1)), np.ones((1, 1)), np.zeros((1, 1)))


def test_lines_that_one_record_alone_excites_are_left_out(noisy):
    rng = np.random.default_rng(4)
    odd = noisy[0].u + 1e-3 * rng.standard_normal(noisy[0].u.shape)
    dirty = PeriodicRecord('dirty', '1', stage.RATE, odd, noisy[0].y)
    assert (excited_lines([dirty, *noisy[1:]]) == excited_lines(noisy)).all()
