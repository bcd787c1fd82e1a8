# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Bags as other tools read them, and bags as live recordings leave them."""

from collections.abc import Iterable
from dataclasses import replace
import re
import shlex
import sys

from bag_data import blocks, metadata, write
import numpy as np
import piezo_ident as pi
from piezo_ident.cli import main
from piezo_ident.common.errors import DataError
from piezo_ident.live.capture import Capture
from piezo_ident.record.bags.read import MESSAGE_TYPE, read_bag
from piezo_ident.record.bags.write import SAMPLE_QOS, write_bag
from piezo_ident.record.blocks import Dimension, Samples
from piezo_ident.record.join import APPLIED
from piezo_ident.record.record import Piece, Record, Segment
import pytest
from rosbags.rosbag2 import CompressionMode, storage_mcap, StoragePlugin
from zstandard import ZstdCompressor

pytest.importorskip('mcap_ros2', reason="mcap is not installed: see the extra 'test'")

from mcap.reader import make_reader
from mcap.writer import IndexType
from mcap.writer import Writer as McapWriter
from mcap_ros2.decoder import DecoderFactory

RATE = 1000.0


def record(n: int = 1050, start: float = 0.0) -> Record:
    rng = np.random.default_rng(0)
    segments = (Segment('noise', 130, 400), Segment('sine:50Hz', 400, n))
    channels = {'temperature': rng.normal(size=n)}
    piece = Piece(rng.normal(size=n), 1e-6 * rng.normal(size=n), RATE, start, segments, channels)
    return Record((piece,), 'r')


def interleave(pairs: Iterable[tuple[Samples, Samples]]) -> list[tuple[str, Samples]]:
    return [(f'/{s.quantity}', s) for pair in pairs for s in pair]


def faults(got: Record) -> dict[str, int]:
    return {f.name: f.count for f in got.faults}


@pytest.mark.parametrize('start', [0.0, -2.5, 100.0])
def test_other_readers_see_the_same(tmp_path, start):
    want = record(start=start)
    write_bag(want, tmp_path / 'bag', custom_data={'seed': '7'})
    got: dict[str, list] = {}
    with (tmp_path / 'bag' / 'bag.mcap').open('rb') as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for schema, channel, message, ros in reader.iter_decoded_messages():
            assert schema.name == MESSAGE_TYPE
            assert 'history' in channel.metadata['offered_qos_profiles']
            got.setdefault(channel.topic, []).append((message.log_time, ros))
    assert set(got) == {'/voltage', '/displacement', '/x_temperature'}
    p = want.pieces[0]
    columns = {'voltage': p.v, 'displacement': p.y, 'x_temperature': p.channels['temperature']}
    base = 3 if start < 0 else 0
    for quantity, x in columns.items():
        messages = got[f'/{quantity}']
        rows = np.concatenate([np.array(m.data).reshape(-1, 2) for _, m in messages])
        np.testing.assert_array_equal(rows, np.column_stack([p.t, x]))
        for log_time, m in messages:
            samples, names = m.layout.dim
            assert (names.label, names.size, names.stride) == (f't,{quantity}', 2, 2)
            assert samples.label in ('sample:', 'sample:noise', 'sample:sine:50Hz')
            assert 0 < samples.size <= 100
            assert samples.stride == len(m.data) == 2 * samples.size
            assert m.layout.data_offset == 0
            assert log_time == round((m.data[0] + base) * 1e9)
        assert [m.layout.dim[0].label for _, m in messages[:3]] == ['sample:'] * 2 + [
            'sample:noise'
        ]
    info = metadata(tmp_path / 'bag')
    assert info['version'] == 9
    assert info['storage_identifier'] == 'mcap'
    assert info['relative_file_paths'] == ['bag.mcap']
    assert info['custom_data'] == {'sample_rate': '1000.0', 'seed': '7'}
    for topic in info['topics_with_message_count']:
        (qos,) = topic['topic_metadata']['offered_qos_profiles']
        assert (qos['history'], qos['depth']) == ('keep_last', 1000)
        assert (qos['reliability'], qos['durability']) == ('reliable', 'volatile')
    assert SAMPLE_QOS.depth == 1000


def test_a_displacement_of_another_clock_is_told_from_gaps(tmp_path):
    moved = [
        Samples(s.t * 1.01, s.values, s.segment, s.quantity) if s.quantity != 'voltage' else s
        for pair in blocks()
        for s in pair
    ]
    messages = [(f'/{s.quantity}', s) for s in moved]
    with pytest.raises(DataError, match=r'bag: voltage and displacement .*10 of 990'):
        read_bag(write(tmp_path / 'bag', messages))


def test_late_and_early_streams_meet(tmp_path):
    pairs = blocks()
    messages = [('/voltage', v) for v, _ in pairs[:3]] + interleave(pairs[3:])[:-1]
    got = read_bag(write(tmp_path / 'bag', messages))
    assert [(p.n, p.start_time) for p in got] == [(600, 0.3)]
    assert faults(got) == {'unmatched': 400}


@pytest.mark.parametrize('which', [[0], [1], [0, 1]])
@pytest.mark.parametrize('later', [1, 5])
def test_a_block_twice_is_dropped(tmp_path, which, later):
    messages = interleave(blocks())
    for i in which:
        messages.insert(8 + 2 * later, messages[8 + i])
    got = read_bag(write(tmp_path / 'bag', messages))
    assert [p.n for p in got] == [1000]
    assert faults(got) == {'repeated_rows': 100}


def test_a_block_twice_with_other_values_is_refused(tmp_path):
    pairs = blocks()
    v, _ = pairs[4]
    messages = interleave(pairs)
    messages.insert(10, ('/voltage', Samples(v.t, v.values + 1, v.segment, v.quantity)))
    with pytest.raises(DataError, match=r'samples of voltage at t = 0\.4 s'):
        read_bag(write(tmp_path / 'bag', messages))


def test_restart_with_the_same_voltage_and_a_lost_block(tmp_path):
    first, second = blocks(seed=1), blocks(seed=2)
    again = [(v, y) for (v, _), (_, y) in zip(first, second, strict=True)]
    messages = interleave([*first, *again])
    del messages[0]  # its twin in the second run must not stand in for it
    got = read_bag(write(tmp_path / 'bag', messages))
    assert [(p.n, p.start_time) for p in got] == [(900, 0.1), (1000, 0.0)]
    np.testing.assert_array_equal(got.pieces[0].y[:100], first[1][1].values)
    np.testing.assert_array_equal(got.pieces[1].y[:100], second[0][1].values)


def test_streams_that_never_meet_are_refused(tmp_path):
    pairs = [(v, Samples(y.t + 1e-4, y.values, '', y.quantity)) for v, y in blocks()]
    with pytest.raises(DataError, match=r'bag: voltage and displacement .* 0 of \d+'):
        read_bag(write(tmp_path / 'bag', interleave(pairs)))


@pytest.mark.parametrize('storage', StoragePlugin)
@pytest.mark.parametrize('step', [0.3, 1.0, 3.0])
def test_a_log_clock_that_is_set_back(tmp_path, storage, step):
    # as by NTP; two blocks come every 10 ms
    def stamp(i):
        return 10**10 + i * 5_000_000 - (round(step * 1e9) if i >= 200 else 0)

    pairs = blocks(20_000)
    (piece,) = (
        got := read_bag(write(tmp_path / 'bag', interleave(pairs), stamp=stamp, storage=storage))
    ).pieces
    assert piece.n == 20_000
    for x, i in ((piece.v, 0), (piece.y, 1)):
        np.testing.assert_array_equal(x, np.concatenate([pair[i].values for pair in pairs]))
    assert faults(got) == {'log_time_step': 1}


def test_a_log_clock_that_is_set_back_and_a_restart(tmp_path):
    # the stage starts over, and later the clock of the log does
    def stamp(i):
        return 10**10 + i * 50_000_000 - (10**9 if i >= 60 else 0)

    messages = interleave([*blocks(2000, seed=1), *blocks(2000, seed=2)])
    got = read_bag(write(tmp_path / 'bag', messages, stamp=stamp))
    assert [(p.n, p.start_time) for p in got] == [(2000, 0.0), (2000, 0.0)]
    np.testing.assert_array_equal(got.pieces[1].y[1900:], messages[-1][1].values)
    assert faults(got) == {'log_time_step': 1, 'restart': 1}


@pytest.mark.parametrize('mode', [None, CompressionMode.MESSAGE])
def test_messages_that_were_written_out_of_turn_are_in_the_order_of_their_log_times(
    tmp_path, mode
):
    # as threads do of which each writes the message that it has compressed
    messages, order = interleave(blocks()), [*range(20)]
    order[6:10] = [8, 9, 6, 7]
    path = write(
        tmp_path / 'bag',
        [messages[k] for k in order],
        stamp=lambda i: 10**9 + order[i] * 10**6,
        compression=mode,
    )
    got = read_bag(path)
    assert [p.n for p in got] == [1000] and not got.faults
    if mode is not None:
        (path / 'metadata.yaml').unlink()
        assert [p.n for p in read_bag(path, recover=True)] == [1000]


@pytest.mark.parametrize('statistics', [True, False])
@pytest.mark.parametrize('folder', [True, False])
def test_chunks_without_an_index_of_their_messages(tmp_path, statistics, folder):
    want = record()
    write_bag(want, tmp_path / 'bag')
    file = tmp_path / 'bag' / 'bag.mcap'
    with file.open('rb') as source, (tmp_path / 'bare.mcap').open('wb') as target:
        writer = McapWriter(target, index_types=IndexType.CHUNK, use_statistics=statistics)
        writer.start('ros2', 'test')
        ids = {}
        for schema, channel, m in make_reader(source).iter_messages():
            if channel.topic not in ids:
                about = writer.register_schema(schema.name, schema.encoding, schema.data)
                ids[channel.topic] = writer.register_channel(
                    channel.topic, channel.message_encoding, about, dict(channel.metadata)
                )
            writer.add_message(ids[channel.topic], m.log_time, m.data, m.publish_time)
        writer.finish()
    path = tmp_path / 'bare.mcap'
    if folder:
        path = path.rename(file).parent
    got = read_bag(path)
    (piece,) = got
    assert not got.faults and piece.segments == want.pieces[0].segments
    np.testing.assert_array_equal(piece.y, want.pieces[0].y)


@pytest.mark.parametrize('storage', StoragePlugin)
@pytest.mark.parametrize('mode', [CompressionMode.FILE, CompressionMode.MESSAGE])
def test_compressed_bags_and_what_is_left_of_them(tmp_path, storage, mode, capsys):
    path = write(tmp_path / 'bag', interleave(blocks()), storage=storage, compression=mode)
    (file,) = (f for f in path.iterdir() if f.name != 'metadata.yaml')
    assert file.suffix == '.zstd' or mode is CompressionMode.MESSAGE
    want = np.concatenate([y.values for _, y in blocks()])
    for whole in (path, file):
        got = read_bag(whole)
        np.testing.assert_array_equal(got.pieces[0].y, want)
        assert not got.faults
    # by a verb, which knows it for a bag
    assert main(['convert', str(file), str(tmp_path / 'a.npz'), '--namespace', '/']) == 0
    (path / 'metadata.yaml').unlink()
    with pytest.raises(DataError) as caught:
        read_bag(path)
    # the command that is named is typed
    shown = re.search(r"'piezo_ident (.*) OUT'", str(caught.value))[1]
    assert main([*shlex.split(shown), str(tmp_path / 'b.npz')]) == 0
    np.testing.assert_array_equal(pi.read(tmp_path / 'b.npz').pieces[0].y, want)
    assert 'metadata.yaml is missing' in capsys.readouterr().out


@pytest.mark.parametrize('name', ['bag.mcap', 'bag.db3'])
def test_a_file_that_somebody_compressed(tmp_path, name, monkeypatch):
    want = record(5000)
    write_bag(want, tmp_path / name)
    packed = tmp_path / f'{name}.zst'
    packed.write_bytes(ZstdCompressor().compress((tmp_path / name).read_bytes()))
    (tmp_path / name).unlink()
    monkeypatch.setenv('TMPDIR', str(tmp_path))
    monkeypatch.setattr('tempfile.tempdir', None)
    (piece,) = (got := read_bag(packed)).pieces
    np.testing.assert_array_equal(piece.v, want.pieces[0].v)
    assert not got.faults
    # nothing stays behind
    assert [f.name for f in tmp_path.iterdir()] == [packed.name]
    for data in (packed.read_bytes()[: packed.stat().st_size // 2], b'', b'no zstd'):
        packed.write_bytes(data)
        with pytest.raises(DataError, match=packed.name):
            read_bag(packed)
    packed.write_bytes(b'')
    monkeypatch.setitem(sys.modules, 'zstandard', None)
    with pytest.raises(DataError, match=f'{packed.name}.*pip install zstandard'):
        read_bag(packed)


def test_two_stages_need_a_namespace(tmp_path):
    a, b = blocks(seed=1), blocks(seed=2)
    messages = [
        (f'/{name}{topic}', s)
        for pair in zip(interleave(a), interleave(b), strict=True)
        for name, (topic, s) in zip('ab', pair, strict=True)
    ]
    path = write(tmp_path / 'bag', messages)
    with pytest.raises(DataError, match=r'/a/voltage, /b/voltage;'):
        read_bag(path)
    for options in (
        {'namespace': '/b'},
        {'namespace': 'b/'},
        {'voltage_topic': 'b/voltage', 'displacement_topic': '/b/displacement'},
    ):
        got = read_bag(path, **options)
        np.testing.assert_array_equal(got.pieces[0].v[:100], b[0][0].values)
    with pytest.raises(DataError, match=r"'t,voltage' .* /c/"):
        read_bag(path, namespace='c')
    with pytest.raises(DataError, match=r'samples .* /c'):
        read_bag(path, voltage_topic='c')


def test_remapped_and_further_topics(tmp_path):
    messages = []
    for v, y in blocks():
        messages += [
            ('/stage/drive', v),
            ('/stage/gauge', y),
            ('/stage/residual', Samples(y.t, y.values, '', 'residual')),
            ('/stage/x_temp', Samples(y.t, y.t, '', 'x_temp')),
        ]
    got = read_bag(write(tmp_path / 'bag', messages))
    assert got.n == 1000
    assert list(got.pieces[0].channels) == ['temp']
    names = ('/applied_voltage', '/voltage', '/displacement', '/prediction')
    messages = [m for v, y in blocks() for m in zip(names, (v, v, y, y), strict=True)]
    assert read_bag(write(tmp_path / 'bag2', messages)).n == 1000


@pytest.mark.parametrize(('step', 'stop', 'n'), [(10, 1000, 100), (1, 600, 600)])
def test_a_sparse_channel_costs_no_other_sample(tmp_path, step, stop, n):
    messages = []
    for v, y in blocks():
        x = v.t[v.t < stop / RATE][::step]
        messages += [('/voltage', v), ('/displacement', y)]
        messages += [('/x_temp', Samples(x, x, '', 'x_temp'))] if x.size else []
    got = read_bag(write(tmp_path / 'bag', messages))
    (piece,) = got.pieces
    assert (piece.n, list(piece.channels)) == (1000, [])
    (fault,) = got.faults
    assert (fault.name, fault.count) == ('sparse_channel', 1000 - n)
    assert str(fault.where) == f'x_temp, {n} samples beside 1000'


@pytest.mark.parametrize('name', ['prediction', 'residual', 'estimate'])
def test_what_a_model_says_is_not_taken_for_measured(tmp_path, name):
    messages = [m for v, y in blocks() for m in (('/s/voltage', v), (f'/s/{name}', y))]
    path = write(tmp_path / 'bag', messages)
    with pytest.raises(DataError, match=rf'/s/{name}: .* measured \w+;'):
        read_bag(path)
    # whoever asks for it gets it
    assert read_bag(path, displacement_topic=f's/{name}').n == 1000
    # beside what was measured under another name it is no second displacement
    messages += [('/s/gauge', Samples(y.t, -y.values, '', y.quantity)) for _, y in blocks()]
    got = read_bag(write(tmp_path / 'both', messages))
    np.testing.assert_array_equal(got.pieces[0].y[:100], -blocks()[0][1].values)


def test_what_a_model_says_of_a_further_axis_is_no_channel(tmp_path):
    messages = []
    for v, y in blocks():
        v_b, y_b = replace(v, quantity='voltage_b'), replace(y, quantity='displacement_b')
        messages += [('/s/voltage', v), ('/s/displacement', y), ('/s/voltage_b', v_b)]
        messages += [(f'/s/{x}_b', y_b) for x in ('prediction', 'prediction_band', 'estimate')]
        messages += [('/s/residual_b', y), ('/s/gauge_b', replace(y_b, values=-y.values))]
    (piece,) = read_bag(write(tmp_path / 'bag', messages)).pieces
    assert sorted(piece.channels) == ['v_b', 'y_b']
    np.testing.assert_array_equal(piece.channels['y_b'], -piece.y)


@pytest.mark.parametrize('voltage', ['voltage', 'drive'])
def test_applied_voltage_is_met_as_in_a_live_capture(tmp_path, voltage):
    messages, capture = [], Capture()
    for k, (v, y) in enumerate(blocks()):
        # the guard was at work in block 3, its word on block 6 was lost, the stage missed block 8
        a = Samples(v.t, v.values - (k == 3) * np.linspace(0, 1, 100), v.segment, 'voltage')
        for topic, key, samples in (
            (voltage, 'voltage', v),
            (APPLIED, APPLIED, a),
            ('displacement', 'displacement', y),
        ):
            if (k, key) in ((6, APPLIED), (8, 'displacement')):
                continue
            capture.add(key, samples, 10**9 + len(messages) * 10**6)
            messages.append((f'/left/{topic}', samples))
    live = capture.record()
    bag = read_bag(write(tmp_path / 'bag', messages))
    assert [p.n for p in bag] == [301, 400, 100]
    assert faults(bag) == {**faults(live), 'guarded_voltage': 99, 'applied_unknown': 100}
    for one, other in zip(bag, live, strict=True):
        assert one.segments == other.segments and one.sample_rate == other.sample_rate
        for column in ('t', 'v', 'y'):
            np.testing.assert_array_equal(getattr(one, column), getattr(other, column))
    # whoever asks for it gets it as the voltage
    asked = read_bag(tmp_path / 'bag', voltage_topic=f'left/{APPLIED}')
    assert asked.n == 800 and asked.pieces[0].v[399] == messages[10][1].values[99]


def test_corrupt_layout_names_topic_and_message(tmp_path):
    def edit(i, data, dims):
        return (data[:-1] if i == 7 else data), dims

    with pytest.raises(DataError, match='topic /displacement, message 3: layout announces 100'):
        read_bag(write(tmp_path / 'bag', interleave(blocks()), edit))
    with pytest.raises(DataError, match='topic /voltage, message 0: layout'):
        read_bag(
            write(tmp_path / 'bag2', interleave(blocks()), lambda i, data, dims: (data, dims[:1]))
        )


def test_a_healthy_bag_is_unpacked_once(tmp_path, monkeypatch):
    pi.write(record(100_000), tmp_path / 'bag')
    with (tmp_path / 'bag' / 'bag.mcap').open('rb') as file:
        chunks = make_reader(file).get_summary().statistics.chunk_count
    unpacked = []
    decompress = storage_mcap.decompress

    def counted(*arguments):
        unpacked.append(1)
        return decompress(*arguments)

    monkeypatch.setattr(storage_mcap, 'decompress', counted)
    assert pi.read(tmp_path / 'bag').n == 100_000
    # the first chunk once more for each topic, to learn what it carries
    assert chunks > 3 and len(unpacked) <= chunks + 3


def test_bag_without_samples(tmp_path):
    foreign = Samples(np.zeros(2), np.zeros(2), '', '')
    path = write(
        tmp_path / 'bag', [('/scan', foreign)], lambda i, data, dims: (data, [Dimension('', 4, 4)])
    )
    with pytest.raises(DataError, match=r'blocks .*topics: /scan'):
        read_bag(path)


@pytest.mark.parametrize('text', [None, '', '{', 'a: 1', 'rosbag2_bagfile_information: 3'])
def test_damaged_metadata_and_a_folder_without_a_bag(tmp_path, text):
    write_bag(record(), tmp_path / 'bag')
    if text is None:
        for name in ('metadata.yaml', 'bag.mcap'):
            (tmp_path / 'bag' / name).unlink()
    else:
        (tmp_path / 'bag' / 'metadata.yaml').write_text(text)
    says = 'ros2 bag reindex' if text is None else 'damaged or unfinished bag'
    with pytest.raises(DataError, match=says):
        read_bag(tmp_path / 'bag')


def test_storage_must_be_known_and_agree(tmp_path):
    for name, storage in (('bag', 'rosbag1'), ('bag.mcap', 'sqlite3')):
        with pytest.raises(DataError, match=r'mcap .*sqlite3'):
            write_bag(record(), tmp_path / name, storage=storage)
    assert not list(tmp_path.iterdir())
