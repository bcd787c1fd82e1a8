# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0


"""The exit code of the demonstration says whether the graph did what it should."""

from piezo_ident import cli
from piezo_ident.cli import demo as demonstration
from piezo_ident.cli import graph_demo
from piezo_ident.cli.graph_demo import GraphRun, largest_difference
from piezo_ident.common.errors import PiezoIdentError
from piezo_ident.model.simulated_stage import SimulatedStage
import pytest


@pytest.fixture
def short(monkeypatch, tmp_path):
    """Leave out what has nothing to do with the graph."""
    done = []
    monkeypatch.setattr(demonstration, '_dense_stage', lambda *_: None)
    monkeypatch.setattr(demonstration, '_measured', lambda *_: None)
    monkeypatch.setattr(demonstration, '_lacking', lambda *_: '')
    monkeypatch.setattr(demonstration, '_offline', lambda *_: done.append('offline') or (None, ()))
    monkeypatch.setattr(demonstration, '_keep', lambda *_: None)
    monkeypatch.setattr(demonstration, 'text_summary', lambda found: 'summary')
    monkeypatch.setattr(demonstration, 'rclpy_is_there', lambda: True)
    monkeypatch.setenv('PIEZO_IDENT_DATA', str(tmp_path))
    return done


def run(differences=None, lost=None, unclean=()):
    same = {'replayed': 0.0, 'offline': 1e-13}
    return GraphRun(None, None, (), {**same, **(differences or {})}, lost or {}, unclean)


@pytest.mark.parametrize(
    ('found', 'code', 'said'),
    [
        (run(), 0, ''),
        (run(lost={'of the live prediction': 100}), 0, ''),
        (
            run({'replayed': 0.3}, {'in the replay': 200}),
            1,
            'the replayed model differs from the live one; samples were lost: 200 in the replay',
        ),
        (run({'offline': float('nan')}), 1, 'the offline model differs from the live one'),
        (run(unclean=('stage: exit code 1',)), 1, 'stage: exit code 1'),
    ],
)
def test_what_the_graph_found(short, monkeypatch, tmp_path, capsys, found, code, said):
    monkeypatch.setattr(graph_demo, 'graph_demo', lambda *_: found)
    assert cli.main(['demo', '--out', str(tmp_path / 'out')]) == code
    out, err = capsys.readouterr()
    assert 'summary' in out and short == []
    assert said in err and (code or not err)
    for where, n in found.lost.items():
        assert f'{n} samples were lost {where}' in out


def test_a_graph_that_fails_is_said_and_the_rest_is_shown(short, monkeypatch, tmp_path, capsys):
    def fail(*_):
        raise PiezoIdentError('node stage ended with code 1')

    monkeypatch.setattr(graph_demo, 'graph_demo', fail)
    assert cli.main(['demo', '--out', str(tmp_path / 'out')]) == 1
    out, err = capsys.readouterr()
    assert short == ['offline'] and 'summary' in out
    assert err == ('piezo_ident: the graph did not get through: node stage ended with code 1\n')


def test_without_ros_there_is_nothing_to_fail(short, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(demonstration, 'rclpy_is_there', lambda: False)
    assert cli.main(['demo', '--out', str(tmp_path / 'out')]) == 0
    out, err = capsys.readouterr()
    assert short == ['offline'] and not err
    assert 'without ROS: rclpy is not here' in out


def test_difference_of_two_models():
    model = SimulatedStage.load('paper').model
    assert largest_difference(model, model) == 0.0
    assert largest_difference(model, model.without_dynamics()) > 0.1
