# Copyright 2026 The piezo_ident authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""A long record is thinned to sections that stand for it."""

import numpy as np
from piezo_ident.record import Piece, Record, Segment
from piezo_ident.thinning import thinned

RATE = 1000.0


def triangles(count, n=1000, labels=None):
    """Return a piece of triangles from rest to rest, a segment each."""
    one = np.concatenate([np.linspace(0, 10, n // 2), np.linspace(10, 0, n - n // 2)])
    v = np.tile(one, count)
    labels = labels or [f'triangle:{k}' for k in range(count)]
    segments = tuple(Segment(x, k * n, (k + 1) * n) for k, x in enumerate(labels))
    return Piece(v, 1e-6 * v, RATE, 5.0, segments)


def test_a_short_record_stays_as_it_is():
    record = Record((triangles(10),))
    found, said = thinned([record], 10_000)
    assert found == [record] and said == ''


def test_sections_from_rest_to_rest_are_spread_over_the_time():
    record = Record((triangles(600, labels=['triangle'] * 600),))
    [found], said = thinned([record], 60_000)
    assert 50_000 <= found.n <= 60_000
    assert f'{found.n} of 600000 samples' in said
    starts = np.array([p.start_time for p in found])
    ends = np.array([p.start_time + p.duration for p in found])
    # first and last of all, and no hole of more than a twentieth
    assert starts[0] == 5.0 and ends[-1] == 605.0
    assert np.max(starts[1:] - ends[:-1]) < 0.05 * 600
    for piece in found:
        assert piece.v[0] <= 0.1 and piece.v.max() == 10.0
        # what is kept is what was measured, at its own time
        at = round((piece.start_time - 5.0) * RATE)
        np.testing.assert_array_equal(piece.v, record.pieces[0].v[at : at + piece.n])


def test_every_kind_of_segment_is_kept():
    labels = ['triangle'] * 600
    labels[333], labels[412] = 'sine:50Hz', 'hold:4V'
    [found], _ = thinned([Record((triangles(600, labels=labels),))], 30_000)
    assert {'triangle', 'sine:50Hz', 'hold:4V'} <= set(found.labels)


def test_what_never_rests_is_cut_anywhere():
    k = np.arange(100_000)
    v = 5.0 + np.sin(k / 40.0)
    v[0] = 0.0
    pieces = (Piece(v, 1e-6 * v, RATE), Piece(v + 3.0, 1e-6 * v, RATE, 1e3))
    [found], said = thinned([Record(pieces)], 20_000)
    assert found.n <= 20_000 and said
    assert found.pieces[-1].start_time > 1e3


def test_several_records_keep_their_names():
    records = [Record((triangles(100),), name) for name in ('one', 'other')]
    found, _ = thinned(records, 40_000)
    assert [r.name for r in found] == ['one', 'other']
    assert sum(r.n for r in found) <= 40_000
