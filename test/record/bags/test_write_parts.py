# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0


"""A recording in parts: each a whole bag, and nothing lost or doubled between them."""

from bag_data import raw
import numpy as np
from piezo_ident.common.errors import DataError
from piezo_ident.record.bags.read import opened_bag, read_bag
from piezo_ident.record.bags.write import BagWriter
from piezo_ident.record.blocks import Samples
from piezo_ident.record.io import read_record
import pytest
import yaml

RATE, SIZE = 20_000.0, 100


def recorded(path, storage, parts_of, blocks=60):
    """Write pairs of blocks, flushed after every fifth but the last."""
    writer = BagWriter(path, storage, {'sample_rate': repr(RATE)}, parts_of)
    for topic in ('/voltage', '/displacement'):
        writer.add_topic(topic, 'std_msgs/msg/Float64MultiArray')
    for k in range(blocks):
        t = np.arange(SIZE * k, SIZE * (k + 1)) / RATE
        for topic, x in (('/voltage', 5 + np.sin(7 * t)), ('/displacement', 1e-6 * np.sin(7 * t))):
            writer.write(topic, 10**9 + 5_000_000 * k, raw(Samples(t, x, 'noise', topic[1:])))
        # not after the last block, which would begin an empty part
        if k % 5 == 4 and k < blocks - 1:
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
        info = yaml.safe_load((part / 'metadata.yaml').read_text())
        custom = info['rosbag2_bagfile_information']['custom_data']
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


def test_without_a_size_there_is_one_bag_without_part(tmp_path):
    writer = recorded(tmp_path / 'bag', 'mcap', 0)
    writer.close()
    assert writer.parts == [tmp_path / 'bag']
    assert read_record(tmp_path / 'bag').n == 6000
    info = yaml.safe_load((tmp_path / 'bag' / 'metadata.yaml').read_text())
    assert 'part' not in info['rosbag2_bagfile_information']['custom_data']


def test_a_name_that_is_taken_is_passed_over(tmp_path):
    (tmp_path / 'bag_1').mkdir()
    writer = recorded(tmp_path / 'bag', 'mcap', 60_000)
    writer.close()
    assert [p.name for p in writer.parts][:3] == ['bag', 'bag_2', 'bag_3']


def test_a_part_that_cannot_be_made_leaves_those_before_it(tmp_path):
    writer = recorded(tmp_path / 'bag', 'mcap', 10**9, blocks=20)
    (tmp_path / 'file').write_text('')
    writer.max_size = 1
    writer._path = tmp_path / 'file' / 'bag'
    with pytest.raises(DataError, match='cannot be written'):
        writer.flush()
    writer.abort()
    assert read_bag(tmp_path / 'bag').n == 2000
