# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Long bags: window by window they give what reading them whole gives."""

from collections.abc import Iterator
from pathlib import Path
import tempfile

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from piezo_ident.common.errors import DataError
from piezo_ident.record import long_bag, windows
from piezo_ident.record.bags.read import MESSAGE_TYPE, read_bag, typestore
from piezo_ident.record.blocks import encode, Samples
from piezo_ident.record.io import read_long, read_record, write_record
from piezo_ident.record.long_bag import read_long_bag
from piezo_ident.record.long_record import LongRecord
from piezo_ident.record.record import Record
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer

RATE, WINDOW, BLOCK = 1000.0, 400, 50


class Tape:
    """Messages as a recorder gets them."""

    def __init__(self, n: int = 3000, seed: int = 0, start: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.t = (start + np.arange(n)) / RATE
        self.v, self.y = 5 + rng.normal(size=n), 1e-6 * rng.normal(size=n)
        self.columns = {'voltage': self.v, 'displacement': self.y}
        self.labels = [''] * n
        self.messages: list[tuple[str, Samples]] = []

    def cut(self, topics: tuple[str, ...] = ()) -> 'Tape':
        """Turn the columns into messages."""
        names = topics or tuple(self.columns)
        self.messages = [
            (
                f'/{q}',
                Samples(
                    self.t[i : i + BLOCK],
                    self.columns[q][i : i + BLOCK],
                    self.labels[i],
                    'voltage' if q == 'applied_voltage' else q,
                ),
            )
            for i in range(0, self.t.size, BLOCK)
            for q in names
        ]
        return self

    def save(self, path: Path, rate: float | None = RATE, storage: str = 'MCAP') -> Path:
        store = typestore()
        types, senders = store.types, {}
        with Writer(path, version=9, storage_plugin=StoragePlugin[storage]) as writer:
            if rate is not None:
                writer.set_custom_data('sample_rate', repr(rate))
            for k, (topic, samples) in enumerate(self.messages):
                if topic not in senders:
                    senders[topic] = writer.add_connection(topic, MESSAGE_TYPE, typestore=store)
                data, dims = encode(samples)
                dim = [types['std_msgs/msg/MultiArrayDimension'](*d) for d in dims]
                layout = types['std_msgs/msg/MultiArrayLayout'](dim, 0)
                raw = store.serialize_cdr(types[MESSAGE_TYPE](layout, data), MESSAGE_TYPE)
                writer.write(senders[topic], 10**9 + k * 10**6, raw)
        return path


def pieces_of(record: Record | LongRecord) -> list[tuple]:
    """Return all that there is in a record, whatever it is kept in."""

    def parts() -> Iterator[tuple]:
        if isinstance(record, Record):
            yield from ((p, iter((p,))) for p in record)
        else:
            yield from record.parts(lambda step, share: None)

    found = []
    for piece, taken in parts():
        held = list(taken)
        columns = [
            np.concatenate([p.t for p in held]).tobytes(),
            np.concatenate([p.v for p in held]).tobytes(),
            np.concatenate([p.y for p in held]).tobytes(),
        ]
        names = sorted(piece.channels)
        columns += [np.concatenate([p.channels[c] for p in held]).tobytes() for c in names]
        found.append((piece.n, piece.sample_rate, piece.start_time, piece.segments, columns))
    return found


def outcome(read, path: Path, **options) -> tuple:
    try:
        record = read(path, **options)
    except DataError as error:
        return str(error), None
    counts: dict[str, int] = {}
    for f in record.faults:
        counts[f.name] = counts.get(f.name, 0) + f.count
    return (pieces_of(record), counts, record.name), record


def same(path: Path, *, long: bool | None = None, window: int = WINDOW, **options) -> tuple:
    whole, _ = outcome(read_bag, path, **options)
    got, record = outcome(read_long_bag, path, window=window, **options)
    assert got == whole
    if long is not None:
        assert isinstance(record, LongRecord) == long
    return got, record


def test_sound_bag_is_never_in_memory_as_a_whole(tmp_path):
    tape = Tape()
    tape.columns['x_heat'] = tape.v**2
    tape.labels = ['', *['noise'] * 1199, *['sine:5Hz'] * 800, *[''] * 1000]
    _, record = same(tape.cut().save(tmp_path / 'b'), long=True)
    assert [len(list(parts)) for _, parts in record.parts(lambda *_: None)] == [7]
    assert record.faults == ()
    assert (record.n, record.duration) == (3000, 3.0)
    assert record.labels == ('noise', 'sine:5Hz')
    whole = read_bag(tmp_path / 'b')
    assert (record.stroke, record.voltage_range) == (whole.stroke, whole.voltage_range)


def test_short_bag_is_read_at_once(tmp_path):
    same(Tape(2 * WINDOW).cut().save(tmp_path / 'b'), long=False)
    assert long_bag.WINDOW > 100 * windows.CLEAN


@pytest.mark.parametrize('rate', [None, RATE])
@pytest.mark.parametrize('storage', ['MCAP', 'SQLITE3'])
def test_gaps_nan_and_repeats_are_met_as_in_the_whole(tmp_path, rate, storage):
    tape = Tape()
    for i in (399, 400, 401, 1200, 2900):
        tape.y[i] = np.nan
    tape.cut()
    # lost: a block of both, and one of the displacement alone; twice: one of the voltage
    tape.messages[100:102] = []
    del tape.messages[61]
    tape.messages.insert(42, tape.messages[40])
    (_, faults, _), _ = same(tape.save(tmp_path / 'b', rate, storage), long=True)
    assert faults == {'gap': 2, 'not_finite': 5, 'repeated_rows': 50, 'unmatched': 50}


@pytest.mark.parametrize('error', [0.0, 1e-4, 0.5])
def test_guard_is_judged_by_the_range_of_the_whole(tmp_path, error):
    tape = Tape()
    applied = tape.v.copy()
    applied[700:730] += error
    # a window in which hardly anything moves: there the same error would be too much
    tape.v[1600:2400] = applied[1600:2400] = 5.0
    applied[2000] += error / 100.0
    tape.columns['applied_voltage'] = applied
    (_, faults, _), _ = same(tape.cut().save(tmp_path / 'b'), long=True)
    assert faults.get('guarded_voltage', 0) == (30 if error == 0.5 else 0)


def test_applied_voltage_may_end_early(tmp_path):
    tape = Tape()
    tape.columns['applied_voltage'] = tape.v.copy()
    tape.cut()
    tape.messages = [(q, s) for q, s in tape.messages if q != '/applied_voltage' or s.t[0] < 1.45]
    (_, faults, _), _ = same(tape.save(tmp_path / 'b'), long=True)
    assert faults == {'applied_unknown': 1550}


def test_clock_that_starts_over_begins_a_piece(tmp_path):
    runs = [Tape(1300, seed).cut().messages for seed in range(3)]
    tape = Tape()
    tape.messages = [m for run in runs for m in run]
    (pieces, faults, _), _ = same(tape.save(tmp_path / 'b'), long=True)
    assert [p[0] for p in pieces] == [1300] * 3
    assert faults == {'restart': 2}


def test_runs_that_are_shorter_than_a_window(tmp_path):
    tape = Tape()
    tape.messages = [m for seed in range(9) for m in Tape(350, seed).cut().messages]
    (_, faults, _), _ = same(tape.save(tmp_path / 'b'), long=True)
    assert faults == {'restart': 8}


@pytest.mark.parametrize(
    'odd',
    [
        pytest.param(lambda t: t + 1e-4 * np.sin(t), id='jitter'),
        pytest.param(lambda t: np.where(t < 1.5, t, 1.5 + 2 * (t - 1.5)), id='another rate'),
        pytest.param(lambda t: 1.001 * t, id='another rate than named'),
        pytest.param(lambda t: t + 3.3e-4, id='off the ticks'),
    ],
)
def test_other_clocks_are_read_whole(tmp_path, odd):
    tape = Tape()
    tape.t = odd(tape.t)
    same(tape.cut().save(tmp_path / 'b'), long=False)


def test_stamps_that_are_off_by_their_last_bits(tmp_path):
    tape = Tape()
    tape.t = np.arange(tape.t.size) * 1e-3
    assert not np.array_equal(tape.t, np.arange(tape.t.size) / RATE)
    same(tape.cut().save(tmp_path / 'named'), long=True)
    same(tape.save(tmp_path / 'unnamed', None), long=False)


def test_block_that_comes_later_than_a_window_is_read_whole(tmp_path):
    tape = Tape().cut()
    tape.messages.insert(80, tape.messages[4])
    same(tape.save(tmp_path / 'b'), long=False)


def test_first_blocks_again_are_no_restart(tmp_path):
    tape = Tape().cut()
    tape.messages[60:60] = tape.messages[:4]
    (_, faults, _), _ = same(tape.save(tmp_path / 'b'), long=False)
    assert faults == {'repeated_rows': 100}


def test_stream_that_is_absent_for_long_is_read_whole(tmp_path):
    tape = Tape(6000).cut()
    tape.messages = [
        (q, s) for q, s in tape.messages if q != '/displacement' or not 1.0 < s.t[0] < 4.0
    ]
    (_, faults, _), _ = same(tape.save(tmp_path / 'b'), long=False)
    assert faults['gap'] == 1


@pytest.mark.parametrize(('end', 'kept'), [(1.15, True), (4.0, False)])
def test_channel_that_is_absent_for_a_while_is_judged_by_the_whole(tmp_path, end, kept):
    tape = Tape(6000)
    tape.columns['x_temp'] = tape.v + 1
    tape.cut()
    tape.messages = [(q, s) for q, s in tape.messages if q != '/x_temp' or not 1.0 < s.t[0] < end]
    (_, faults, _), record = same(tape.save(tmp_path / 'b'), long=False)
    assert ('sparse_channel' in faults) != kept
    assert all(list(p.channels) == ['temp'] * kept for p in record.pieces)


def test_whole_record_is_judged(tmp_path):
    tape = Tape()
    # one window at rest, one with more than one per cent of NaN: neither is refused for it
    tape.v[800:1600], tape.y[800:1600] = 5.0, 0.0
    tape.y[2000:2010] = np.nan
    path = tape.cut().save(tmp_path / 'b')
    same(path, long=True)
    got, _ = same(path, voltage_limits=(4.9, 5.1))
    assert 'samples leave the voltage limits 4.9..5.1 V, worst' in got
    got, _ = same(path, displacement_unit='nm')
    assert 'is no piezo stage' in got
    tape.y[2000:2040] = np.nan
    got, _ = same(tape.cut().save(tmp_path / 'nan'))
    assert '40 of 3000 samples are NaN or infinite, more than 1 %' in got


def test_refusals_are_those_of_the_whole(tmp_path):
    tape = Tape().cut()
    q, s = tape.messages[60]
    tape.messages.insert(62, (q, Samples(s.t, s.values + 1.0, s.segment, s.quantity)))
    got, _ = same(tape.save(tmp_path / 'b'))
    assert 'two different samples of voltage' in got
    tape = Tape().cut(('voltage',))
    got, _ = same(tape.save(tmp_path / 'c'))
    assert "no topic carries 't,displacement'" in got


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([None, RATE]))
def test_random_bags_give_what_the_whole_gives(seed, rate):
    rng = np.random.default_rng(seed)
    tape = Tape()
    tape.messages = []
    runs = int(rng.integers(1, 4))
    for run in range(runs):
        part = Tape(int(rng.integers(700, 2500)), int(rng.integers(100)), int(rng.integers(3)))
        n = part.t.size
        for k in range(rng.integers(0, 5)):
            a = int(rng.integers(n))
            part.labels[a:] = [f'l{run}{k}'] * (n - a)
        if rng.random() < 0.5:
            applied = part.columns['applied_voltage'] = part.v.copy()
            for _ in range(rng.integers(0, 3)):
                a = int(rng.integers(n))
                applied[a : a + 30] += rng.choice([1e-5, 0.3])
        for _ in range(rng.integers(0, 4)):
            rng.choice([part.v, part.y])[rng.integers(n)] = np.nan
        part.cut()
        for _ in range(rng.integers(0, 3)):
            at = int(rng.integers(len(part.messages)))
            if rng.random() < 0.5:
                lost = part.messages[at : at + int(rng.integers(1, 4))]
                # what is lost of both streams in different runs would find each other in the whole
                one = [m for m in lost if runs == 1 or m[0] == '/displacement']
                part.messages = [m for m in part.messages if not any(m is x for x in one)]
            else:
                part.messages.insert(at + int(rng.integers(6)), part.messages[at])
        tape.messages += part.messages
    with tempfile.TemporaryDirectory() as folder:
        same(tape.save(Path(folder, 'b'), rate), window=int(rng.choice([150, 300, 500])))


@pytest.mark.parametrize('name', ['o', 'o.mcap', 'o.db3', 'o.csv', 'o.npz'])
def test_long_record_is_written_as_the_whole_is(tmp_path, monkeypatch, name):
    tape = Tape()
    tape.y[1000] = np.nan
    tape.columns['x_heat'] = tape.v**2
    tape.labels = ['', *['noise'] * 1199, *['a,"b"'] * 800, *[''] * 1000]
    tape.cut().save(tmp_path / 'b')
    monkeypatch.setattr(long_bag, 'WINDOW', WINDOW)
    record = read_long(tmp_path / 'b', to_write=True)
    assert isinstance(record, LongRecord)
    files = []
    for folder, it in (('long', record), ('whole', read_record(tmp_path / 'b'))):
        (tmp_path / folder).mkdir()
        assert write_record(it, tmp_path / folder / name) == ()
        path = tmp_path / folder / name
        files.append(
            [p.read_bytes() for p in sorted(path.iterdir())]
            if name == 'o'
            else [path.read_bytes()]
        )
    assert files[0] == files[1]


def test_file_that_changes_meanwhile_is_said(tmp_path, monkeypatch):
    Tape(seed=1).cut().save(tmp_path / 'b')
    record = read_long_bag(tmp_path / 'b', window=WINDOW)
    Tape(2500).cut().save(tmp_path / 'other')
    (tmp_path / 'b' / 'b.mcap').write_bytes((tmp_path / 'other' / 'other.mcap').read_bytes())
    with pytest.raises(DataError, match='changed while it was read'):
        write_record(record, tmp_path / 'o.csv')
    assert sorted(p.name for p in tmp_path.iterdir()) == ['b', 'other']
