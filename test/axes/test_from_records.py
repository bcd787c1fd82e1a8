# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Periods are found in records, a stage of two axes is identified from them, and its text kept."""

from dataclasses import fields, replace

import numpy as np
import piezo_ident as pi
from piezo_ident.axes.from_records import identify_axes, periods_of
from piezo_ident.axes.loop_model import LoopModel
from piezo_ident.axes.model_text import AxesModel
from piezo_ident.common.errors import DataError, ModelError
import pytest

STAGE = pi.TwoAxisStage.load('two_axes')
PROGRAM = pi.Program.load('two_axes')


def program(*names, **options):
    entries = (e for e in PROGRAM.entries if e.name in names)
    return replace(
        PROGRAM, entries=tuple(replace(e, options={**e.options, **options}) for e in entries)
    )


@pytest.fixture(scope='module')
def record():
    return STAGE.play(program('small', 'large', realisations=3, periods=3))


def test_periods_are_found_and_the_first_is_left_to_settle(record):
    found = periods_of([record])
    assert [r.u.shape for r in found.records] == [(2, 2048, 2)] * 6
    assert [r.group for r in found.records] == ['multisine:small'] * 3 + ['multisine:large'] * 3
    assert (found.inputs, found.outputs) == (('v', 'v_b'), ('y', 'y_b'))
    np.testing.assert_allclose(found.v0, 5.0, atol=1e-9)
    # measured voltages never repeat to the last digit
    rng = np.random.default_rng(3)
    (piece,) = record
    noisy = pi.Record(
        (replace(piece, v=piece.v + 1e-4 * np.ptp(piece.v) * rng.uniform(-1, 1, piece.n)),),
        'noisy',
    )
    assert [r.u.shape for r in periods_of([noisy]).records] == [(2, 2048, 2)] * 6
    two = STAGE.play(program('small', realisations=1, periods=2))
    assert periods_of([two]).records[0].u.shape == (2, 2048, 2)


def test_hysteresis_inside_the_loop_is_named_and_halves_the_error(record):
    steps = []
    found = identify_axes([record], progress=lambda step, _: steps.append(step))
    assert found.explanation.name in ('loop_hysteresis', 'hysteretic_stiffness')
    assert found.error < 0.35 * found.linear_error
    # better than a linear model made for each amplitude alone
    assert found.error < 0.7 * found.explanation['changed_dynamics'].error
    assert found.model.model.radius < 1 and not found.warnings
    assert set(steps) == {'dynamics', 'candidates'}
    first, _, _, *rows, _, modes, _, y, y_b, path, _ = repr(found).splitlines()
    assert first == f'A stage of 2 axes: {found.model.effect}.'
    assert [row.split()[0] for row in rows] == [c.name for c in found.explanation.candidates]
    assert modes.startswith('The modes move as the amplitude grows')
    assert y.startswith('y: ') and y_b.startswith('y_b: ')
    # the axes of this stage pull at one another
    assert path.startswith('v moves y_b by') and not found.paths[0].wrong


def test_a_linear_stage_is_found_to_the_noise_and_nothing_is_blamed():
    linear = replace(STAGE, hysteresis=(0.0, 0.4, 1.0), creep_gain=np.zeros(2))
    record = linear.play(program('small', 'large', realisations=3, periods=3))
    found = identify_axes([record], iterations=4)
    assert found.explanation.name == 'linear'
    # the noise is 2 nm
    noise = 100 * 2e-9 / np.mean([r.y.std() for r in periods_of([record]).records])
    assert found.error < 3 * noise


def lossy(record, share, length, names=('y', 'y_b')):
    """Return a record that loses runs of its readings, and which."""
    (piece,), rng, lost = record, np.random.default_rng(4), {}
    columns = {'y': piece.y, **piece.channels}
    for name in names:
        lost[name] = np.zeros(piece.n, bool)
        while lost[name].mean() < share:
            start = rng.integers(1, piece.n - length)
            lost[name][start : start + length] = True
        columns[name] = np.where(lost[name], 0.0, columns[name])
    spoilt = replace(piece, y=columns.pop('y'), channels=columns)
    return pi.Record((spoilt,), 'lossy'), lost


@pytest.mark.parametrize(('share', 'length'), [(0.016, 1), (0.05, 4)])
def test_lost_readings_of_either_axis_are_left_out(share, length):
    linear = replace(STAGE, hysteresis=(0.0, 0.4, 1.0), creep_gain=np.zeros(2))
    record = linear.play(program('small', realisations=3, periods=3))
    spoilt, lost = lossy(record, share, length)
    sound, held = periods_of([record]), periods_of([spoilt])
    gone = np.concatenate([~r.sound for r in held.records], axis=1)
    assert 0.9 * share < gone.mean() < 1.2 * share
    for a, b in zip(sound.records, held.records, strict=True):
        # those of the other period stand in for them
        assert abs(a.y - b.y)[:, b.sound.any(axis=0)].max() < 20e-9
        assert np.std(b.noise) == pytest.approx(np.std(a.noise), rel=0.1)
    if length == 1:
        return
    found = identify_axes([spoilt], iterations=1)
    noise = 100 * 2e-9 / np.mean([r.y.std() for r in sound.records])
    assert found.explanation.name == 'linear' and found.error < 1.5 * noise
    assert all(x.of_motion < 1.5 * noise for x in found.axis_errors)
    said = ' '.join(found.warnings)
    assert f'lost ({lost["y"].sum()})' in said and f'lost ({lost["y_b"].sum()}) in y_b' in said


def test_what_cannot_be_used_says_why(record):
    with pytest.raises(DataError, match='no segment of the records repeats'):
        periods_of([record.first(500)])
    with pytest.raises(DataError, match='one realisation only'):
        identify_axes([STAGE.play(program('small', realisations=1, periods=2))])
    shorter = STAGE.play(program('small', realisations=1, periods=2, period=0.512))
    with pytest.raises(DataError, match=r'periods of .1024, 2048. samples'):
        periods_of([record, shorter])


def test_axes_that_cannot_be_told_apart_are_refused(record):
    (piece,) = record

    def of(v, v_b):
        channels = {**piece.channels, 'v_b': v_b}
        return pi.Record((replace(piece, v=v, channels=channels),), 'record')

    # another size and bias make no other signal
    with pytest.raises(DataError, match='small: v and v_b play one signal'):
        identify_axes(of(piece.v, 1 + 0.8 * piece.v))
    with pytest.raises(DataError, match='v_b rest in segments that repeat; drive all axes'):
        identify_axes(of(piece.v, np.full(piece.n, 5.0)))
    t = np.arange(piece.n) * 50 / 2048
    sine, triangle = np.sin(2 * np.pi * t), np.abs(t % 1 - 0.5)
    with pytest.raises(DataError, match=r'the inputs share \d lines of a period, 9 are needed'):
        identify_axes(of(5 + sine, 5 + triangle))


def test_the_text_of_a_model_reads_back_bit_by_bit(record, tmp_path):
    linear = periods_of([record])
    found = identify_axes([record], iterations=1)
    path = tmp_path / 'axes_model.yaml'
    for model in (found.model.model, LoopModel.of(found.model.model.linear)):
        held = AxesModel(model, 2000.0, linear.inputs, linear.outputs, linear.v0, 'x', 1.5)
        held.save(path)
        again = AxesModel.load(path)
        for f in fields(LoopModel):
            if f.name != 'linear':
                np.testing.assert_array_equal(getattr(again.model, f.name), getattr(model, f.name))
        u = np.random.default_rng(0).normal(size=(300, 2))
        np.testing.assert_array_equal(again.model.run(u).y, model.run(u).y)
        assert (again.inputs, again.sample_rate, again.effect) == (('v', 'v_b'), 2000.0, 'x')
    path.write_text(path.read_text().replace('linear:', 'lin:'))
    with pytest.raises(ModelError, match='no model of several axes'):
        AxesModel.load(path)
