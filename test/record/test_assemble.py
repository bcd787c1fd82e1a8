# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Every fault of measured data, on data whose truth is known."""

from collections.abc import Iterator

from hypothesis import example, given, settings
from hypothesis import strategies as st
import numpy as np
from piezo_ident.common.errors import DataError
from piezo_ident.record.assemble import assemble, label_runs
from piezo_ident.record.clock import fit_clock, Resolution, split_uniform
from piezo_ident.record.record import Record, Segment
import pytest

RATE = 1000.0


def columns(n: int = 200, rate: float = RATE, start: int = 0) -> list[np.ndarray]:
    k = np.arange(start, start + n)
    v = 5 + 5 * np.sin(0.1 * k)
    return [k / rate, v, 7.5e-6 * v]


def rows(*parts: list[np.ndarray]) -> list[np.ndarray]:
    return [np.concatenate(c) for c in zip(*parts, strict=True)]


def read(c: list[np.ndarray], **options: object) -> Record:
    return Record.from_arrays(*c, name='data', **options)  # type: ignore[arg-type]


def faults(record: Record) -> dict[str, int]:
    return {f.name: f.count for f in record.faults}


def sizes(record: Record) -> list[int]:
    return [p.n for p in record]


def test_clean_columns_come_back_as_they_are():
    t, v, y = c = columns()
    record = read(c)
    assert sizes(record) == [200]
    assert record.faults == ()
    piece = record.pieces[0]
    assert piece.sample_rate == RATE
    np.testing.assert_array_equal(piece.t, t)
    np.testing.assert_array_equal(piece.v, v)
    np.testing.assert_array_equal(piece.y, y)


@pytest.mark.parametrize('column', [1, 2])
def test_an_offset_of_some_strokes_does_no_harm(column):
    c = columns()
    assert sizes(read(changed(slice(None), column, 100 * np.ptp(c[column]), c))) == [200]


def test_inputs_stay_as_they_are():
    c = rows(columns(50), columns(50, start=60))
    c[1][7] = np.nan
    c = rows(c, *[[x[-1:] for x in c]] * 2)
    before = [x.copy() for x in c]
    read(rows(c, columns(300, start=200)), displacement_unit='m')
    for x, y in zip(c, before, strict=True):
        np.testing.assert_array_equal(x, y)


def changed(rows, column: int, by: float, c: list[np.ndarray]) -> list[np.ndarray]:
    c[column][rows] += by
    return c


def inserted(at: int, column: int, by: float) -> list[np.ndarray]:
    return changed(at, column, by, [np.insert(x, at, x[at - 1]) for x in columns()])


def block_again(by: float = 0.0) -> list[np.ndarray]:
    block = [x[40:60] for x in columns()]
    block[2] = block[2] + by
    return rows(columns(60), block, columns(100, start=60))


@pytest.mark.parametrize(
    ('c', 'pieces', 'met'),
    [
        (columns(), [(200, 0.0)], {}),
        (rows(columns(100), columns(100, start=150)), [(100, 0.0), (100, 0.15)], {'gap': 1}),
        (rows(columns(100), columns(100, start=101)), [(100, 0.0), (100, 0.101)], {'gap': 1}),
        # the same run again, bit for bit or not
        (rows(columns(500), columns(600)), [(500, 0.0), (600, 0.0)], {'restart': 1}),
        (
            rows(columns(100), changed(7, 2, 1e-7, columns(120))),
            [(100, 0.0), (120, 0.0)],
            {'restart': 1},
        ),
        (block_again(), [(160, 0.0)], {'repeated_rows': 20}),
        ([np.repeat(x, 2) for x in columns()], [(200, 0.0)], {'repeated_rows': 200}),
        (
            changed(200, 2, np.nan, changed(202, 2, np.nan, columns(500))),
            [(200, 0.0), (297, 0.203)],
            {'not_finite': 2, 'lone_sample': 1},
        ),
        *(
            (changed(200, k, bad, columns(500)), [(200, 0.0), (299, 0.201)], {'not_finite': 1})
            for k in range(3)
            for bad in (np.nan, np.inf, -np.inf)
        ),
    ],
)
def test_what_is_met_and_where_the_record_is_split(c, pieces, met):
    record = read(c)
    assert [(p.n, p.start_time) for p in record] == pieces
    assert faults(record) == met


@pytest.mark.parametrize('other', [1100.0, 500.0, 8000.0])
def test_rate_change_splits(other):
    late = columns(300, rate=other)
    late[0] = late[0] + 0.2
    record = read(rows(columns(200), late))
    assert sizes(record) == [200, 300]
    assert [p.sample_rate for p in record] == [RATE, other]
    assert 'rate_change' in faults(record)


def test_rate_that_changes_a_little_and_back():
    t = np.cumsum(np.repeat([1 / 1000, 1 / 1050, 1 / 1000], [500, 600, 700]))
    v = np.arange(t.size) / 200
    record = read([t, v, 1e-6 * v])
    assert [round(p.sample_rate, 3) for p in record] == [1000, 1050, 1000]
    np.testing.assert_allclose(sizes(record), [500, 600, 700], atol=1)


@pytest.mark.parametrize(
    ('rate', 'begin', 'rounded'),
    [
        *((rate, 0, 4) for rate in (256.0, 1024.0, 2048.0, 1000 / 3)),
        *((rate, 0, 5) for rate in (256.0, 1024.0, 2048.0, 1000 / 3)),
        *((rate, 0, 6) for rate in (256.0, 1024.0, 2048.0, 1000 / 3)),
        (2048.0, 10, np.vectorize(lambda x: float(f'{x:.7g}'))),
        (2048.0, 10, np.vectorize(lambda x: float(f'{x:.9g}'))),
        (20000.0, 3, np.float32),
    ],
)
def test_rounded_stamps_are_no_jitter(rate, begin, rounded):
    t, v, y = columns(5000, rate=rate)
    t += begin
    record = read([rounded(t) if begin else np.round(t, rounded), v, y])
    assert sizes(record) == [5000]
    (piece,) = record.pieces
    assert piece.sample_rate == pytest.approx(rate, rel=0.0 if begin else 1e-12)
    np.testing.assert_allclose(piece.t, t, rtol=0.0, atol=0.0 if begin == 10 else 1e-12)
    assert begin or record.faults == ()


@pytest.mark.parametrize(
    ('n', 'rate', 'lost', 'left'),
    [
        (3000, 2048.0, [500, 700, 701, 900], [500, 199, 198, 2099]),
        # a step as fine as the last decimal
        (1000, 10000.0, [500], [500, 499]),
    ],
)
def test_lost_samples_show_in_rounded_stamps(n, rate, lost, left):
    c = [np.delete(x, lost) for x in columns(n, rate=rate)]
    c[0] = np.round(c[0], 4)
    record = read(c)
    assert sizes(record) == left
    assert {p.sample_rate for p in record} == {rate}


def test_short_piece_takes_the_rate_of_a_long_one():
    t, v, y = rows(columns(2000, rate=2048.0), columns(3, rate=2048.0, start=2100))
    record = read([np.round(t, 4), v, y])
    assert sizes(record) == [2000, 3]
    assert [p.sample_rate for p in record] == [2048, 2048]


def test_jitter_is_reported():
    t, v, y = columns(2000)
    t = t + np.random.default_rng(1).normal(scale=0.03 / RATE, size=t.size)
    record = read([t, v, y])
    assert sizes(record) == [2000]
    assert faults(record) == {'timing_jitter': 1}
    assert record.pieces[0].sample_rate == pytest.approx(RATE, rel=1e-4)


def scattered(n: int, by: float) -> list[np.ndarray]:
    t, v, y = columns(n)
    return [t + np.random.default_rng(2).uniform(-by, by, n) / RATE, v, y]


@pytest.mark.parametrize('by', [0.1, 0.15, 0.2, 0.3, 0.4])
@pytest.mark.parametrize('n', [200, 5000])
def test_stamps_that_scatter_about_one_clock_are_uniform(n, by):
    record = read(scattered(n, by))
    assert sizes(record) == [n]
    assert record.pieces[0].sample_rate == RATE
    (fault,) = record.faults
    assert fault.name == 'timing_jitter'
    assert float(fault.where.split()[2]) == pytest.approx(by, rel=0.1)


def test_some_late_stamps_are_no_breaks():
    t, v, y = columns(2000)
    t[[50, 51, 700, 1500]] += 0.4 / RATE
    record = read([t, v, y])
    assert (sizes(record), faults(record)) == ([2000], {'timing_jitter': 1})


@pytest.mark.parametrize('by', [0.15, 0.3])
def test_lost_samples_and_gaps_show_among_stamps_that_scatter(by):
    lost = [500, 900, *range(2000, 2030)]
    record = read([np.delete(x, lost) for x in scattered(5000, by)])
    assert sizes(record) == [500, 399, 1099, 2970]
    assert {p.sample_rate for p in record} == {RATE}
    assert faults(record) == {'timing_jitter': 4, 'gap': 3}


def test_regular_losses_are_no_scatter_and_no_rates_are_made_of_jitter():
    with pytest.raises(DataError, match=r'\(250 .* 750 .*--rate 2251\.5'):
        read([np.delete(x, np.s_[::4]) for x in columns(1000, rate=3000.0)])
    # two rates, both with jitter
    first, late = scattered(5000, 0.2), scattered(5000, 0.2)
    late[0] = first[0][-1] + 4 * (late[0] - late[0][0] + 1 / RATE)
    with pytest.raises(DataError, match=r'not uniformly sampled.* --rate 399\.'):
        read(rows(first, late))


def test_not_finite_channel_splits():
    x = np.ones(500)
    x[0], x[499] = np.nan, np.nan
    record = read(columns(500), channels={'temperature': x})
    assert sizes(record) == [498]
    assert np.isfinite(record.pieces[0].channels['temperature']).all()


def swapped() -> Iterator[list[np.ndarray]]:
    order = np.arange(200)
    yield order[::-1].copy()
    yield np.random.default_rng(0).permutation(200)
    order[[50, 51]] = order[[51, 50]]
    yield order.copy()
    # two blocks in the wrong order
    yield np.concatenate([np.r_[0:50], np.r_[100:150], np.r_[50:100], np.r_[150:200]])


def scaled(*by: float) -> list[np.ndarray]:
    return [x * f for x, f in zip(columns(), by, strict=True)]


@pytest.mark.parametrize(
    ('c', 'reason'),
    [
        *(
            ([x[order] for x in columns()], 'time is unsorted, .* sort the rows by t')
            for order in swapped()
        ),
        *((inserted(50, k, 1e-6), r'two different samples at t = 0\.049 s') for k in (1, 2)),
        (block_again(1e-9), 'two different samples'),
        (
            changed(slice(100, 106), 1, np.nan, columns(500)),
            '6 of 500 samples are NaN or infinite, more than 1 %',
        ),
        # what some loggers write where there is no reading
        (
            changed(slice(108, 117), 2, 9.9e37, columns(500)),
            r'y is 9\.9e\+37 in 9 samples, .* leave these cells empty',
        ),
        # a sensor that is read with every tenth voltage
        (
            changed(np.arange(500) % 10 > 0, 2, np.nan, columns(500)),
            '450 of 500 displacements .* in 50 places; .* all rows without a displacement',
        ),
        (scaled(1, 1, 1e6), '--displacement-unit'),
        # no unit makes it a stroke
        (scaled(1, 1, 1e-6), 'is it the column of y'),
        (
            [columns()[k] for k in (0, 2, 1)],
            'v spans .* V; if v and y are swapped, .* --columns v=y,y=v, else name the unit',
        ),
        *((scaled(f, 1, 1), 'write t in seconds') for f in (1e15, 1e-9)),
        *((scaled(1, f, 1), 'no voltage') for f in (1e-320, 1e13)),
        *((scaled(1, 1, f), 'no piezo stage') for f in (1e-314, 1e305)),
        *(
            (changed(slice(None), k, 1e11 * size, columns()), f'{"tvy"[k]} lies at')
            for k, size in ((1, 10.0), (2, 75e-6))
        ),
        (
            [np.sort(np.random.default_rng(1).uniform(size=200)), *columns()[1:]],
            'not uniformly sampled',
        ),
        ([x[:0] for x in columns()], 'no samples'),
        ([x[:1] for x in columns()], 'one sample only'),
        ([x[: 200 - k // 2] for k, x in enumerate(columns())], 't 200, v 200, y 199'),
    ],
)
def test_what_would_need_a_guess_is_refused(c, reason):
    with pytest.raises(DataError, match=f'data: .*{reason}'):
        read(c)


@pytest.mark.parametrize(
    ('unit', 'factor'), [('mm', 1e3), ('um', 1e6), ('µm', 1e6), ('nm', 1e9), ('10 um', 1e5)]
)
def test_displacement_units(unit, factor):
    t, v, y = columns()
    record = read([t, v, y * factor], displacement_unit=unit)
    np.testing.assert_allclose(record.pieces[0].y, y, rtol=1e-15)


def test_unknown_unit_is_refused():
    for unit in ('inch', '0um', '-3um', '10', '1e999um'):
        with pytest.raises(DataError, match=f"'{unit}'.* 10um"):
            read(columns(), displacement_unit=unit)


def test_voltage_limits():
    read(columns(), voltage_limits=(0.0, 10.0))
    with pytest.raises(DataError, match=r'voltage limits 0\.\.9 V, worst (9\.9|10)'):
        read(columns(), voltage_limits=(0.0, 9.0))
    with pytest.raises(DataError, match=r'150\.\.0 V'):
        read(columns(), voltage_limits=(150.0, 0.0))


def test_an_idle_record_is_a_record():
    t, v, y = columns()
    record = read([t, np.zeros_like(v), np.full_like(y, 3e-6)])
    assert record.stroke == 0


def test_named_rate_is_checked_against_the_stamps():
    assert faults(read(columns(), sample_rate=RATE)) == {}
    record = read(columns(), sample_rate=2 * RATE)
    assert record.pieces[0].sample_rate == RATE
    assert faults(record) == {'sample_rate': 1}


def test_segments_of_labels_follow_the_pieces():
    labels = ['', *['noise'] * 99, *['sine:50Hz'] * 100]
    c = columns(200)
    c[2][150] = np.nan
    record = assemble(*rows(c, columns(300, start=200)), label_runs(labels), name='data')
    assert record.pieces[0].segments == (Segment('noise', 1, 100), Segment('sine:50Hz', 100, 150))
    assert record.pieces[1].segments == (Segment('sine:50Hz', 0, 349),)


@pytest.mark.parametrize(
    'segments', [(['a'], [0, 5]), (['a', 'b'], [5, 0]), (['a'], [201]), (['a'], [0.5])]
)
def test_bad_segments_are_refused(segments):
    with pytest.raises(DataError, match=r'data: .* 0 to 200'):
        assemble(*columns(), segments, name='data')


@pytest.mark.parametrize(
    'clock', [np.arange(5000) * 5e-5, np.linspace(0, 1, 5001), 1.7e9 + np.arange(5000) / 20e3]
)
def test_other_ways_to_count_time(clock):
    v = np.arange(clock.size) / 1e3
    record = read([clock, v, 1e-6 * v])
    assert sizes(record) == [clock.size]
    assert record.pieces[0].sample_rate in (20000, 5000)
    np.testing.assert_allclose(record.pieces[0].t, clock, rtol=1e-15)


@settings(max_examples=60, deadline=None)
@given(
    st.one_of(st.integers(1, 10**6).map(float), st.floats(0.1, 1e6)),
    st.integers(2, 3000),
    st.integers(0, 10**6),
)
@example(23.166468355528195, 17, 373)
def test_stamps_of_a_sampling_clock_are_a_fixpoint(rate, n, first):
    t = (first + np.arange(n)) / rate
    assert split_uniform(t, Resolution.of(t)) == [(0, n)]
    v = np.linspace(0, 10, n)
    once = read([t, v, 1e-6 * v]).pieces[0]
    twice = read([once.t, v, 1e-6 * v]).pieces[0]
    np.testing.assert_array_equal(once.t, twice.t)
    np.testing.assert_allclose(once.t, t, rtol=1e-11)
    # at least what the stamps themselves can tell
    assert once.sample_rate == pytest.approx(rate, rel=1e-11 + 4e-16 * (first + n) / (n - 1))


def test_nicest_rate_wins():
    t = np.round(np.arange(2000) / 5000, 4)
    assert fit_clock(t, Resolution.of(t)).sample_rate == 5000
    t = np.arange(2000) * 3e-4
    assert fit_clock(t, Resolution.of(t)).sample_rate == 1 / 3e-4


def test_a_masked_reading_is_no_reading():
    bad = (np.arange(500) // 50) % 5 == 2
    t, v, y = columns(500)
    masked = read([t, v, np.ma.array(np.where(bad, 1.02 * y, y), mask=bad)])
    unknown = read([t, v, np.where(bad, np.nan, y)])
    assert masked.faults == unknown.faults != ()
    assert sizes(masked) == sizes(unknown)


@pytest.mark.parametrize(
    ('place', 'kind', 'line'),
    [
        (0, 'm8[ns]', r'data: t: expected real numbers, got timedelta64\[ns\]; give seconds'),
        (0, 'M8[us]', r'data: t: expected real numbers, got datetime64\[us\]; give seconds'),
        (1, 'c16', 'data: v: expected real numbers, got complex128; give its real part'),
        (2, 'c8', 'data: y: expected real numbers, got complex64; give its real part'),
    ],
)
def test_types_that_hold_no_real_numbers_are_refused(place, kind, line):
    c = columns()
    c[place] = (1e9 * c[place]).astype(kind)
    with pytest.raises(DataError, match=line):
        read(c)
