# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Bags as a recorder writes them: on disk at every flush, and in parts."""

from bag_data import metadata, raw, recording
import numpy as np
from piezo_ident.common.errors import DataError
from piezo_ident.record.bags.read import opened_bag, read_bag, typestore
from piezo_ident.record.bags.recover import is_unfinished
from piezo_ident.record.bags.write import BagWriter, SAMPLE_QOS
from piezo_ident.record.blocks import Samples
import pytest
from rosbags.interfaces import QosDurability
from rosbags.rosbag2 import storage_mcap

pytest.importorskip('mcap_ros2', reason="mcap is not installed: see the extra 'test'")


RATE, SIZE = 20_000.0, 100
STORAGES = ('mcap', 'sqlite3')
TYPES = typestore().types


@pytest.mark.parametrize('storage', STORAGES)
def test_what_a_flush_uses_is_there(tmp_path, storage):
    # internals of rosbags: should a new version lose them, this says so, and nothing is written
    writer = recording(tmp_path / 'bag', storage)
    size = writer.size
    writer.write('/voltage', 2 * 10**18, b'\0' * 5000)
    writer.flush()
    assert writer.size > size
    writer.abort()


def test_a_rosbags_that_cannot_flush_is_refused(tmp_path, monkeypatch):
    monkeypatch.delattr(storage_mcap.McapWriter, 'close_chunk')
    with pytest.raises(DataError, match=r'bag: .* rosbags .* setup.py'):
        BagWriter(tmp_path / 'bag')


@pytest.mark.parametrize('storage', STORAGES)
def test_closed_bag(tmp_path, storage):
    writer = recording(tmp_path / 'bag', storage, custom_data={'sample_rate': '20000.0'})
    writer.close()
    assert not is_unfinished(tmp_path / 'bag')
    record = read_bag(tmp_path / 'bag')
    assert (record.n, record.pieces[0].sample_rate, record.faults) == (4000, RATE, ())
    t = np.arange(4000) / RATE
    np.testing.assert_array_equal(record.pieces[0].v, 5 + np.sin(t))
    assert writer.messages == 80
    assert writer.parts == [tmp_path / 'bag']
    assert 'part' not in metadata(tmp_path / 'bag')['custom_data']


@pytest.mark.parametrize('storage', STORAGES)
def test_metadata_as_rosbag2_of_jazzy_reads_it(tmp_path, storage):
    # The keys that rosbag2_storage of Jazzy (metadata_io, version 9) takes with as<...>(), which
    # throws when one is missing.
    latched = SAMPLE_QOS._replace(depth=1, durability=QosDurability.TRANSIENT_LOCAL)
    writer = BagWriter(tmp_path / 'bag', storage, {'sample_rate': '20000.0', 'namespace': '/a'})
    writer.add_topic('/a/model', 'std_msgs/msg/String', [latched])
    text = TYPES['std_msgs/msg/String']('model')
    writer.write('/a/model', 5, bytes(typestore().serialize_cdr(text, 'std_msgs/msg/String')))
    writer.close()
    info = metadata(tmp_path / 'bag')
    keys = 'version storage_identifier duration starting_time message_count files custom_data'
    keys += ' topics_with_message_count compression_format compression_mode relative_file_paths'
    assert set(info) == {*keys.split(), 'ros_distro'}
    assert (info['version'], info['storage_identifier'], info['message_count']) == (9, storage, 1)
    assert info['starting_time'] == {'nanoseconds_since_epoch': 5}
    assert info['duration'] == {'nanoseconds': 0}
    assert info['custom_data'] == {'sample_rate': '20000.0', 'namespace': '/a'}
    suffix = {'mcap': '.mcap', 'sqlite3': '.db3'}[storage]
    assert info['relative_file_paths'] == [f'bag{suffix}']
    assert set(info['files'][0]) == {'path', 'starting_time', 'duration', 'message_count'}
    (topic,) = info['topics_with_message_count']
    assert topic['message_count'] == 1
    meta = topic['topic_metadata']
    assert (meta['name'], meta['type']) == ('/a/model', 'std_msgs/msg/String')
    assert meta['serialization_format'] == 'cdr'
    # what rclpy 7.1 of Jazzy names std_msgs/msg/String
    hash_ = 'RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18'
    assert meta['type_description_hash'] == hash_
    forever = {'sec': 9223372036, 'nsec': 854775807}
    assert meta['offered_qos_profiles'] == [
        {
            'history': 'keep_last',
            'depth': 1,
            'reliability': 'reliable',
            'durability': 'transient_local',
            'deadline': forever,
            'lifespan': forever,
            'liveliness': 'automatic',
            'liveliness_lease_duration': forever,
            'avoid_ros_namespace_conventions': False,
        }
    ]


def test_names_are_numbered(tmp_path):
    for want in ('bag', 'bag_1', 'bag_2'):
        writer = BagWriter(tmp_path / 'bag')
        assert writer.path == tmp_path / want
        assert writer.file.name == f'{want}.mcap'
        writer.close()
    (tmp_path / 'file').write_text('')
    with pytest.raises(DataError, match='file/bag'):
        BagWriter(tmp_path / 'file' / 'bag')


def test_unknown_type_is_refused(tmp_path):
    writer = BagWriter(tmp_path / 'bag')
    with pytest.raises(DataError, match='type lab_msgs/msg/Odd '):
        writer.add_topic('/odd', 'lab_msgs/msg/Odd')
    writer.abort()


def recorded(path, storage, parts_of, blocks=60):
    """Write pairs of blocks, flushed after every fifth."""
    writer = BagWriter(path, storage, {'sample_rate': repr(RATE)}, parts_of)
    for topic in ('/voltage', '/displacement'):
        writer.add_topic(topic, 'std_msgs/msg/Float64MultiArray')
    for k in range(blocks):
        t = np.arange(SIZE * k, SIZE * (k + 1)) / RATE
        for topic, x in (('/voltage', 5 + np.sin(7 * t)), ('/displacement', 1e-6 * np.sin(7 * t))):
            writer.write(topic, 10**9 + 5_000_000 * k, raw(Samples(t, x, 'noise', topic[1:])))
        if k % 5 == 4:
            writer.flush()
    return writer


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_parts_are_whole_bags_that_follow_each_other(tmp_path, storage):
    writer = recorded(tmp_path / 'bag', storage, 60_000)
    writer.close()
    names = ['bag', *(f'bag_{k}' for k in range(1, len(writer.parts)))]
    assert [p.name for p in writer.parts] == names and len(names) >= 3
    assert writer.messages == 120
    assert writer.size == sum(next(p.glob('bag*.*')).stat().st_size for p in writer.parts)
    t, count = [], 0
    for k, part in enumerate(writer.parts):
        record = read_bag(part)
        assert record.faults == ()
        t.append(record.pieces[0].t)
        with opened_bag(part) as bag:
            count += sum(1 for _ in bag.messages(bag.connections))
        custom = metadata(part)['custom_data']
        assert custom['part'] == str(k) and custom['sample_rate'] == repr(RATE)
        assert custom['recording'] == ('' if k == 0 else 'bag')
    assert count == 120
    assert np.array_equal(np.rint(np.concatenate(t) * RATE), np.arange(6000))


def test_more_parts_than_names_are_tried(tmp_path, monkeypatch):
    monkeypatch.setattr('piezo_ident.record.bags.write.NAMES', 2)
    (tmp_path / 'bag_1').mkdir()
    writer = recorded(tmp_path / 'bag', 'mcap', 30_000)
    writer.close()
    assert len(writer.parts) > 3
    assert [p.name for p in writer.parts[:3]] == ['bag', 'bag_2', 'bag_3']


def test_a_file_that_cannot_be_looked_at_has_no_size(tmp_path):
    writer = recorded(tmp_path / 'bag', 'mcap', 0, blocks=5)
    # a failing disk gives other errors than that of a file that is not there
    writer.file = tmp_path / ('x' * 300)
    assert writer.size == 0
    writer.abort()


def test_a_part_that_cannot_be_made_leaves_those_before_it(tmp_path):
    writer = recorded(tmp_path / 'bag', 'mcap', 10**9, blocks=20)
    (tmp_path / 'file').write_text('')
    writer.max_size = 1
    writer._path = tmp_path / 'file' / 'bag'
    writer.flush()
    with pytest.raises(DataError, match='file/bag_1'):
        writer.write('/voltage', 10**12, b'')
    writer.abort()
    assert read_bag(tmp_path / 'bag').n == 2000


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_no_part_is_empty(tmp_path, storage):
    writer = recorded(tmp_path / 'bag', storage, 10**9, blocks=20)
    # full with the last message that comes
    writer.max_size = 1
    writer.flush()
    writer.close()
    assert [p.name for p in writer.parts] == ['bag']
    assert read_bag(tmp_path / 'bag').n == 2000
