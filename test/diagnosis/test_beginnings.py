# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Long records: what is used of them, and what the rest says."""

import numpy as np
from piezo_ident.diagnosis import beginnings as module
from piezo_ident.diagnosis.beginnings import beginnings, rest_of, said_of
from piezo_ident.model.free_run import free_run
from piezo_ident.model.simulated_stage import SimulatedStage
from piezo_ident.record.record import Piece, Record, Segment
import pytest

RATE = 20_000.0
PAPER = SimulatedStage.load('paper').model


def record_of(*lengths, name='long', wrong=0.0, since=0):
    """Return pieces that the model answers, but for a gain that is wrong from a sample on."""
    rng = np.random.default_rng(1)
    pieces, start = [], 0
    for n in lengths:
        t = np.arange(n) / RATE
        v = 5.0 - 5.0 * np.cos(2 * np.pi * 20.0 * t)
        y = PAPER.predict_piece(Piece(v, np.zeros(n), RATE)) + 1e-9 * rng.standard_normal(n)
        late = np.arange(start, start + n) >= since
        y = y * np.where(late, 1.0 + wrong, 1.0)
        label = (Segment('sine:20Hz', 0, n),)
        pieces.append(Piece(v, y, RATE, start_time=(start + 1000) / RATE, segments=label))
        start += 2 * n
    return Record(tuple(pieces), name)


def test_short_records_come_back_as_they_are():
    records = [record_of(3000), record_of(2000)]
    assert beginnings(PAPER, records, 5000) == records


@pytest.mark.parametrize('most', [1, 999, 1000, 1001, 3000, 4321, 6999])
def test_beginnings_are_beginnings_in_proportion(most):
    records = [record_of(1000, 2000, 1000), record_of(3000)]
    found = beginnings(PAPER, records, most)
    assert sum(r.n for r in found) <= max(most, len(records))
    for whole, part in zip(records, found, strict=True):
        assert part.name == whole.name
        assert part.n == pytest.approx(whole.n * most / 7000, abs=1)
        v, y = (np.concatenate([getattr(p, c) for p in whole]) for c in 'vy')
        assert np.concatenate([p.v for p in part]).tobytes() == v[: part.n].tobytes()
        assert np.concatenate([p.y for p in part]).tobytes() == y[: part.n].tobytes()
        for ours, theirs in zip(part, whole, strict=False):
            assert ours.start_time == theirs.start_time
            assert ours.segments == (Segment('sine:20Hz', 0, ours.n),)


@pytest.mark.parametrize('window', [777, 1_000_000])
def test_errors_on_both_sides_are_those_of_the_prediction(monkeypatch, window):
    monkeypatch.setattr(module, 'WINDOW', window)
    record = record_of(4000, 6000, wrong=0.01, since=5000)
    # where the record is whole, what is used has all of it
    whole = rest_of(PAPER, [record], [record])
    errors = free_run(PAPER, record).whole
    assert whole.used == pytest.approx(errors.percent_without_offset, rel=1e-6)
    assert whole.unused == 0.0
    (part,) = beginnings(PAPER, [record], 2500)
    y_hat = np.concatenate(free_run(PAPER, record).prediction.pieces)
    e = np.concatenate([p.y for p in record]) - y_hat
    e -= e[: part.n].mean()
    found = rest_of(PAPER, [record], [part])
    for side, percent in ((e[: part.n], found.used), (e[part.n :], found.unused)):
        assert percent == pytest.approx(100 * np.sqrt(np.mean(side**2)) / record.stroke, rel=1e-6)


def test_a_change_behind_what_was_used_is_said():
    same, changed = record_of(20_000), record_of(20_000, wrong=0.02, since=12_000)
    text = said_of(PAPER, PAPER, [same], beginnings(PAPER, [same], 5000), 'fitted')
    assert text.startswith('5,000 of 20,000 samples were searched, the first 0.25 s of 1 s')
    assert 'changes later' not in text
    text = said_of(PAPER, PAPER, [changed], beginnings(PAPER, [changed], 5000), 'fitted')
    assert text.endswith('something changes later: give that part as a record of its own')


def test_pieces_of_another_rate_take_no_share():
    fast = record_of(30_000).pieces[0]
    fast = Piece(fast.v, fast.y, 100_000.0)
    good = record_of(3000).pieces[0]
    (found,) = beginnings(PAPER, [Record((fast, good), 'both')], 1000)
    assert [(p.n, p.sample_rate) for p in found] == [(1000, RATE)]
    records = [Record((fast,), 'fast'), Record((good,), 'good')]
    (found,) = beginnings(PAPER, records, 1000)
    assert found.name == 'good'
    assert rest_of(PAPER, records, [found]).all < 0.01


def test_two_records_with_offsets_of_their_own():
    a, b = record_of(4000, name='a'), record_of(4000, name='b')
    moved = Piece(b.pieces[0].v, b.pieces[0].y + 1e-6, RATE)
    both = [a, Record((moved,), 'b')]
    found = rest_of(PAPER, both, beginnings(PAPER, both, 4000))
    assert found.used < 0.01 and found.unused < 0.01
