# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Short gaps are bridged: the model found is that of the whole record."""

import numpy as np
from numpy.testing import assert_array_equal
from paper_stage import CONFIG, FS, STAGE
from piezo_ident.excitation.program import Program
from piezo_ident.identification.identify import identify
from piezo_ident.identification.results import Settings
from piezo_ident.model.free_run import free_run
from piezo_ident.model.sines import sine_errors
from piezo_ident.record.assemble import assemble, label_runs
from piezo_ident.record.io import read, write
from piezo_ident.record.readings.gaps import bridged, follows
from piezo_ident.record.record import Piece, Record, Segment
import pytest


def played(program):
    return Program.load(CONFIG / f'program_{program}.yaml').build(FS)


@pytest.fixture(scope='module')
def whole():
    return STAGE.play(played('identification'), np.random.default_rng(3)).pieces[0]


@pytest.fixture(scope='module')
def truth():
    return STAGE.ideal.play(played('validation'))


def with_losses(piece, lost):
    labels = np.full(piece.n, '', dtype=object)
    for s in piece.segments:
        labels[s.start : s.stop] = s.label
    keep = ~lost
    segments = label_runs(list(labels[keep]))
    return assemble(piece.t[keep], piece.v[keep], piece.y[keep], segments, name='lossy')


def test_pieces_join_on_the_clock_and_segments_go_on():
    v = np.arange(100.0)
    piece = Piece(v, 1e-6 * v, 100.0, 0.0, (Segment('noise', 10, 60), Segment('sine', 60, 100)))
    lost = np.zeros(100, dtype=bool)
    lost[[30, 31, 80]] = True
    record = with_losses(piece, lost)
    assert len(record.pieces) == 3
    (joined,) = bridged(record)
    assert (joined.gaps, joined.filled) == (2, 3)
    assert joined.piece.segments == piece.segments
    np.testing.assert_allclose(joined.piece.v, piece.v, rtol=1e-12)
    assert_array_equal(joined.piece.t, piece.t)
    assert not joined.sound[[30, 31, 32, 80, 81]].any()
    assert joined.sound.sum() == 100 - 5


def test_a_gap_with_a_voltage_may_be_long():
    v = np.arange(1000.0) % 70
    piece = Piece(v, 1e-6 * v, 100.0, 0.0, (), {'v_b': 2.0 * v})
    parts = piece.without([(1, 2), (100, 500), (501, 600)])
    assert [(p.start_time, p.n) for p in parts] == [(0.02, 98), (6.0, 400)]
    (joined,) = bridged(Record(tuple(parts)))
    assert_array_equal(joined.piece.v, v[2:])
    assert_array_equal(joined.piece.channels['v_b'], 2.0 * v[2:])


def test_gaps_are_straight_lines():
    rng = np.random.default_rng(5)
    piece = Piece(rng.standard_normal(4000), 1e-6 * rng.standard_normal(4000), 100.0)
    lost = rng.random(4000) < 0.005
    lost[[0, -1]] = False
    lost[100:140] = True
    (joined,) = bridged(with_losses(piece, lost))
    k = np.arange(4000)
    for name in ('v', 'y'):
        expected = np.interp(k, k[~lost], getattr(piece, name)[~lost])
        np.testing.assert_allclose(getattr(joined.piece, name), expected, rtol=0, atol=1e-15)
    assert joined.filled == lost.sum()


def test_what_does_not_connect_stays_apart():
    one = Piece(np.arange(50.0), np.arange(50.0), 100.0, 0.0)
    far = Piece(np.arange(50.0), np.arange(50.0), 100.0, 5.0)
    other_rate = Piece(np.arange(50.0), np.arange(50.0), 50.0, 0.6)
    between_ticks = Piece(np.arange(50.0), np.arange(50.0), 100.0, 0.605)
    earlier = Piece(np.arange(50.0), np.arange(50.0), 100.0, 0.2)
    for piece in (far, other_rate, between_ticks, earlier):
        assert follows(one, piece) is None
        assert len(bridged(Record((one, piece)))) == 2
    assert follows(one, Piece(np.arange(5.0), np.arange(5.0), 100.0, 0.53)) == 3


@pytest.mark.parametrize(
    'lose',
    [
        lambda n: np.random.default_rng(0).random(n) < 0.002,
        # 0.8 s in the triangle
        lambda n: (np.arange(n) >= 240_000) & (np.arange(n) < 256_000),
    ],
    ids=['0.2 % of samples', 'hole in the triangle'],
)
def test_lost_samples_cost_next_to_nothing(whole, truth, lose):
    settings = Settings(order=(10, 10), thresholds=10)
    found = identify(with_losses(whole, lose(whole.n)), settings)
    assert any('bridged' in w for w in found.warnings)
    # the whole record gives 0.001 %; before gaps were bridged these gave 0.5 to 12 %
    assert max(e.percent for e in sine_errors(found.model, truth)) < 0.01
    assert found.error('selection') < 0.01


@pytest.mark.parametrize(
    'unmeasure',
    [
        pytest.param(lambda y: y[0], id='the sensor hangs'),
        pytest.param(lambda y: np.nan, id='no number'),
    ],
)
def test_the_voltage_goes_on_where_the_displacement_alone_is_bad(unmeasure, tmp_path):
    t = np.arange(40_000) / 20e3
    v = 3.0 * (1.0 - np.cos(5.0 * t)) + 2.0 * (1.0 - np.cos(37.0 * t))
    y = STAGE.model.simulate(v) + np.random.default_rng(0).normal(0.0, 2e-9, v.size)
    hole = slice(10_000, 21_000)
    y[hole] = unmeasure(y[hole])
    record = Record.from_arrays(v, y, sample_rate=20e3)
    run = free_run(STAGE.model, record)
    # by a straight line of voltage, this hole costs 0.3 %
    assert run.errors.percent < 0.005
    (joined,) = bridged(run.record)
    assert_array_equal(joined.piece.v, v)
    assert not joined.sound[hole][1:].any() and run.errors.n < 29_100
    assert joined.gaps == 0
    # a file of any format keeps it
    for name in ('kept.csv', 'kept.npz', 'kept.mat', 'kept.mcap', 'kept.db3', 'kept'):
        assert write(record, tmp_path / name) == ()
        assert free_run(STAGE.model, read(tmp_path / name)).errors == run.errors
