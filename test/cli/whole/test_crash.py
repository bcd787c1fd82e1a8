# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0
"""
Killed while writing, no room, no right to write: nothing is lost, nothing is half there.

`make crash` kills every command, a hundred times in all.
"""

import os

import piezo_ident as pi
from piezo_ident.common import files as output
from piezo_ident.common.errors import DataError
from piezo_ident.common.files import temporary_output
import pytest
from reliability import crash

KINDS = ('save', 'report', 'convert to r.db3', 'convert to bag', 'predict')


@pytest.fixture(scope='module')
def works(tmp_path_factory):
    inputs = tmp_path_factory.mktemp('inputs')
    return {job.name: job for job in crash.jobs(inputs, slow=False)}


@pytest.mark.parametrize('name', KINDS)
def test_sigkill(tmp_path, works, name):
    job = works[name]
    states = [state for _, state in crash.kills({job.kind: 2}, tmp_path, [job])]
    assert len(states) == 2
    assert crash.GOOD.issuperset(states)


@pytest.mark.parametrize('options', ['full', 'ro'])
def test_no_room_and_no_right(tmp_path, works, options):
    some = [job for name, job in works.items() if name != 'convert to r.csv']
    outcomes = list(crash.without_room(tmp_path, some, options))
    if not outcomes:
        pytest.skip('mounting a small disk is not allowed here')
    assert {job.name: wrong for job, wrong in outcomes if wrong} == {}
    assert len(outcomes) == len(some)


@pytest.mark.parametrize('swaps', [True, False])
def test_a_bag_is_replaced_at_once(tmp_path, monkeypatch, swaps):
    bag = tmp_path / 'bag'
    pi.write(crash.record(50), bag)
    there = []

    def watched(new, old):
        there.append(old.is_dir())
        done = exchanged(new, old) if swaps else False
        there.append(old.is_dir())
        return done

    exchanged = output._exchanged
    monkeypatch.setattr(output, '_exchanged', watched)
    pi.write(crash.record(60), bag, overwrite=True)
    assert there == [True, True]
    assert pi.read(bag).n == 60
    assert os.listdir(tmp_path) == ['bag']


def test_names_that_a_kill_leaves_behind_can_be_told(tmp_path):
    with temporary_output(tmp_path / 'r.csv') as target:
        (name,) = os.listdir(tmp_path)
        assert crash.LEFTOVER.fullmatch(name)
        target.write_text('')


def test_a_full_disk_is_said_for_databases_too(tmp_path, monkeypatch):
    import sqlite3

    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Writer

    def full(*arguments):
        raise sqlite3.OperationalError('database or disk is full')

    monkeypatch.setattr(Sqlite3Writer, 'close', full)
    with pytest.raises(DataError, match=r'r\.db3: .*disk is full'):
        pi.write(crash.record(40), tmp_path / 'r.db3')
    assert os.listdir(tmp_path) == []
