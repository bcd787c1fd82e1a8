# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Records from arrays, and what they say of themselves."""

import numpy as np
import piezo_ident as pi
from piezo_ident.common.errors import DataError
from piezo_ident.record.record import Piece, Record
import pytest

RATE = 1000.0
V = 5 + 5 * np.sin(0.02 * np.arange(2000))
Y = 7.5e-6 * V


def test_arrays_with_a_rate_are_those_with_times():
    one = Record.from_arrays(np.arange(V.size) / RATE, V, 1e6 * Y, displacement_unit='um')
    other = Record.from_arrays(V, Y, sample_rate=RATE)
    (a,), (b,) = one.pieces, other.pieces
    assert (a.sample_rate, a.start_time) == (b.sample_rate, b.start_time) == (RATE, 0.0)
    np.testing.assert_allclose(a.y, b.y, rtol=1e-15)


def test_arrays_are_checked_as_a_file_is():
    t, y = np.arange(V.size) / RATE, Y.copy()
    t[1000:] += 0.5
    y[100] = np.nan
    record = Record.from_arrays(t, V, y, segments=(['noise'], [0]), channels={'heat': V})
    assert [p.n for p in record] == [100, 899, 1000]
    assert {f.name for f in record.faults} == {'not_finite', 'gap'}
    assert record.labels == ('noise',)
    assert list(record.pieces[0].channels) == ['heat']
    with pytest.raises(DataError, match=r'75 m, .*--displacement-unit 1um or 1nm'):
        Record.from_arrays(V, 1e6 * Y, sample_rate=RATE)


@pytest.mark.parametrize(
    ('arrays', 'rate'), [((V, Y), None), ((V, Y, Y, V), RATE), ((V, Y), 0.0), ((V,), RATE)]
)
def test_arrays_without_their_time_are_refused(arrays, rate):
    with pytest.raises(DataError, match='sample_rate'):
        Record.from_arrays(*arrays, sample_rate=rate)


def test_a_time_that_is_none_is_refused():
    with pytest.raises(DataError, match=r'mine: columns differ in length \(t , v 2000'):
        Record.from_arrays(None, V, Y, name='mine')


@pytest.mark.parametrize(
    ('wrong', 'line'),
    [
        ({'sample_rate': '1000'}, 'mine: sample_rate: expected Real, got str'),
        ({'sample_rate': [RATE]}, 'mine: sample_rate: expected Real, got list'),
        ({'sample_rate': RATE, 'channels': [V]}, 'mine: channels: expected Mapping, got list'),
        ({'sample_rate': RATE, 'channels': {1: V}}, 'mine: channels: 1 is no name'),
        *(
            ({'sample_rate': RATE, 'segments': segments}, 'mine: segments need text labels')
            for segments in ((), 3.0, ('noise', 'sine', 'noise'), (None, [0]), ([1.0], [0]))
        ),
        *(
            ({'sample_rate': RATE, 'voltage_limits': limits}, 'voltage limits .* two numbers')
            for limits in ((), (0.0,), 10.0, ('low', 'high'), (None, None), V)
        ),
        ({'sample_rate': RATE, 'voltage_limits': (np.nan, 10.0)}, r'voltage limits nan\.\.10 V'),
    ],
)
def test_options_of_another_type_are_refused(wrong, line):
    with pytest.raises(DataError, match=line):
        Record.from_arrays(V, Y, name='mine', **wrong)
    assert Record.from_arrays(V, Y, sample_rate=np.array(RATE)).pieces[0].sample_rate == RATE


def test_stroke_does_not_count_single_wild_samples():
    y = Y.copy()
    y[[300, 301, 900]] = 5e-3
    assert Record((Piece(V, y, RATE),)).stroke == pytest.approx(np.ptp(Y), rel=1e-9)
    assert Record((Piece(V, Y, RATE),)).stroke == np.ptp(Y)


def test_a_record_shows_what_it_holds():
    record = Record((Piece(V, Y, RATE),), '<b>')
    page = record._repr_html_()
    assert '&lt;b&gt;' in page
    assert '75' in page
    assert '75' in repr(record)
    drawn = Record((Piece(V, Y, RATE), Piece(V, Y, RATE, 5.0))).plot()
    assert [len(axes.lines) for axes in drawn.axes] == [2, 2]
    # a voltage alone has no stroke
    shown = repr(Record((Piece(V, np.full(V.size, np.nan), RATE),)))
    assert '\u221e' not in shown
    assert 'none' in shown


def test_what_needs_a_displacement_refuses_a_voltage_alone():
    model = pi.SimulatedStage.load('paper').model
    v = 5 - 5 * np.cos(np.arange(4000) / 100)
    record = Record((Piece(v, np.full(v.size, np.nan), 20_000.0),), 'scan')
    for use in (
        lambda: pi.identify(record),
        lambda: pi.diagnose(model, record),
        lambda: pi.free_run(model, record),
    ):
        with pytest.raises(DataError, match=r'scan: .* displacement; .* prediction'):
            use()
    assert np.isfinite(model.simulate(v)).all()
