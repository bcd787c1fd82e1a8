# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What one axis moves of another is seen beside its own motion, and where a model misses it."""

from dataclasses import replace

import axes_stage as stage
import numpy as np
from piezo_ident.axes.loop_model import LoopModel
from piezo_ident.axes.modal import Modal
from piezo_ident.axes.paths import axis_errors, paths_of
from piezo_ident.axes.periodic import PeriodicRecord
from piezo_ident.common.errors import DataError
import pytest

INPUTS, OUTPUTS = ('v', 'v_b'), ('y', 'y_b')


def coupled(share):
    """Return a stage of a mode an axis, whose first axis moves the second by a share of itself."""
    plain = stage.uncoupled_stage()
    c = plain.c.copy()
    c[1] += share * c[0]
    return LoopModel.of(replace(plain, c=c))


def held_out(truth, noise=0.02):
    return stage.records(truth, np.random.default_rng(7), count=1, noise=noise)


def test_a_coupling_that_the_model_lacks_is_told():
    records = held_out(coupled(0.02))
    size = 100 * np.sqrt(
        np.mean([np.var(0.02 * r.y[-1][:, 0]) / np.var(r.y[-1][:, 1]) for r in records])
    )
    path, back = paths_of(coupled(0.0), records, INPUTS, OUTPUTS)
    assert (path.input, path.output) == ('v', 'y_b')
    assert path.seen and path.wrong and path.doubt < 0.5 * size
    assert path.size == pytest.approx(size, rel=0.2)
    assert path.error == pytest.approx(path.size, rel=0.1)
    assert str(path).startswith('v moves y_b by') and 'errs by 1' in str(path)
    assert not back.seen and not back.wrong
    assert str(back).startswith('v_b is not seen to move y, by less than')


def test_a_coupling_that_the_model_has_is_told_and_one_that_is_not_there():
    path, _ = paths_of(coupled(0.02), held_out(coupled(0.02)), INPUTS, OUTPUTS)
    assert path.seen and not path.wrong and 'errs by at most' in str(path)
    path, _ = paths_of(coupled(0.02), held_out(coupled(0.0)), INPUTS, OUTPUTS)
    assert not path.seen and path.wrong


def test_each_axis_has_an_error_of_its_own():
    truth = coupled(0.0)
    first, second = axis_errors(truth, held_out(truth), OUTPUTS)
    # the noise is 2 % of the rms of both axes together, and equal
    (record, *_) = held_out(truth, noise=0.0)
    powers = record.y[-1].var(axis=0)
    for found, power in ((first, powers[0]), (second, powers[1])):
        expected = 2 * np.sqrt(powers.mean() / power)
        assert found.of_motion == pytest.approx(expected, rel=0.15)
        assert 4 * found.of_stroke < found.of_motion < 9 * found.of_stroke
    assert str(first).startswith('y: ') and '% of stroke' in str(first)


def test_too_few_lines_are_refused():
    sine = np.sin(np.arange(stage.SAMPLES) * 2 * np.pi / stage.SAMPLES)[:, None]
    few = [replace(r, u=np.array([sine * [1, 2]] * 2)) for r in held_out(coupled(0.0))]
    with pytest.raises(DataError, match='1 lines do not tell'):
        paths_of(coupled(0.0), few, INPUTS, OUTPUTS)


def test_paths_that_are_not_there_are_not_seen_by_one_record_of_many_axes():
    # lines share the more neighbours, the more inputs a record has to tell apart
    rng, axes, samples, last = np.random.default_rng(0), 4, 512, 60
    plain = Modal(0.1 * np.eye(2)[None], np.zeros((2, axes)), np.zeros((axes, 2)), np.eye(axes))
    names = ['', '_b', '_c', '_d']
    seen = 0
    for _ in range(60):
        lines = np.zeros((samples // 2 + 1, axes), complex)
        lines[1:last] = np.exp(2j * np.pi * rng.random((last - 1, axes)))
        u = np.fft.irfft(lines, samples, axis=0)
        y = u + 0.05 * u.std() * rng.standard_normal(u.shape)
        record = PeriodicRecord('r', 'g', 2000.0, u[None], y[None])
        paths = paths_of(
            LoopModel.of(plain), [record], [f'v{n}' for n in names], [f'y{n}' for n in names]
        )
        seen += sum(path.seen for path in paths)
    # of 720, one by chance
    assert seen <= 1
