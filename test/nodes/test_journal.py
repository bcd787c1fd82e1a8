# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The log of a node has what is new, and stays short whatever happens."""

import pytest

pytest.importorskip('rclpy', reason='rclpy cannot be imported: no ROS here')

from diagnostic_msgs.msg import DiagnosticStatus
from piezo_ident.nodes.journal import Journal, LONGEST, MOST, shortened


class Lines(list):
    def info(self, line):
        self.append(('info', line))

    def warning(self, line):
        self.append(('warning', line))

    def error(self, line):
        self.append(('error', line))


def test_levels_and_long_texts():
    lines = Lines()
    journal = Journal(lines)
    journal.tell('running:\n  sine')
    journal.tell('lost', DiagnosticStatus.WARN)
    journal.warn('failed', DiagnosticStatus.ERROR)
    assert lines == [('info', 'running: sine'), ('warning', 'lost'), ('error', 'failed')]
    journal.tell('x' * 1000)
    assert len(lines[-1][1]) == LONGEST


def test_control_characters_of_a_label_do_not_reach_a_terminal():
    lines = Lines()
    Journal(lines).tell('segment a\x1b[2Jb\x07')
    assert lines == [('info', 'segment a?[2Jb?')]


def test_a_long_path_leaves_room_for_what_is_wrong_with_it():
    path = f'/home/{"a_long_name/" * 20}monday'
    text = shortened(f'{path}: cannot be written; choose another', 100)
    assert text.startswith('...') and '/monday: cannot be written; choose another' in text
    assert shortened('1.5 % of stroke, with /tmp/model.yaml', 100).endswith('with /tmp/model.yaml')


def test_what_goes_on_is_told_once():
    lines = Lines()
    journal = Journal(lines)
    journal.tell('ramping: no voltage for 0.51 s', DiagnosticStatus.WARN)
    for k in range(100):
        journal.warn(f'no voltage for {k / 7:.2f} s')
        journal.warn(f'{k} blocks lost')
        journal.warn(f'{k} blocks lost; {k + 1} blocks lost; too late')
        journal.tell('started')
    said = ['ramping: no voltage for 0.51 s', '0 blocks lost', 'too late', 'started']
    assert [text for _, text in lines] == said


def test_a_flood_is_cut():
    lines = Lines()
    journal = Journal(lines)
    for k in range(10 * MOST):
        journal.tell(f'cleared {k}')
        journal.warn(f'refused {chr(300 + k)}')
    assert len(lines) <= 2 * MOST
