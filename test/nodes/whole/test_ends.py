# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
SIGINT and SIGTERM end every node in two seconds whatever it does, with the drive at rest.

On a machine that other programs make three times slower.
"""

from collections.abc import Callable
import itertools
import signal
import time

from course import block, column, FS, HIGH, level, pairs_of, paper, SETTINGS, simulated
from graph import alive, crowd, Graph, in_time, listens
import numpy as np
from piezo_ident.nodes.parameters import NODES
from piezo_ident.record.bags.read import read_bag
from piezo_ident.record.bags.recover import is_unfinished
from piezo_ident.record.bags.write import write_bag
import pytest

#: how soon a node has to be gone [s]
PROMISED = 2.0
#: how long a machine that does other things may hold a ramp to rest up [s]
HELD_UP = 1.0


def end(g: Graph, meanwhile: Callable[[], None] = lambda: None, stopped: str = '') -> None:
    """
    Send the two signals to nodes in turn, and see that each ends in time with exit code 0.

    The time for which `meanwhile` keeps a node `stopped` does not count.
    """
    begin, took = time.monotonic(), {}
    for handle, number in zip(g.handles, itertools.cycle([signal.SIGINT, signal.SIGTERM])):
        handle.send(number)
    meanwhile()

    def look() -> bool:
        for handle in g.handles:
            if handle.name not in took and handle.process.poll() is not None:
                took[handle.name] = time.monotonic() - begin
        return len(took) == len(g.handles)

    g.wait(look, 'the end of all nodes')
    for handle in g.handles:
        if 'ended before' in handle.complaints:
            pytest.fail(f'{handle.name} {handle.complaints}')
        assert handle.process.returncode == 0, (handle.name, handle.log)
        assert not handle.complaints, handle.name
        limit = PROMISED + (HELD_UP if handle.name == stopped else 0.0)
        in_time(took[handle.name], limit, f'the end of {handle.name}')


@pytest.mark.timed
def test_in_the_middle_of_everything(tmp_path):
    in_the_middle(simulated(), tmp_path)


def in_the_middle(record, tmp_path):
    write_bag(record, tmp_path / 'old')
    (tmp_path / 'model.yaml').write_text(paper())
    with Graph() as g:
        applied, fed = g.collect('applied_voltage'), g.collect('fed/applied_voltage')
        voltage, slow = g.collect('voltage'), g.collect('slow/voltage')
        prediction, replayed = g.collect('prediction'), g.collect('replay/voltage')
        g.start_all(
            ('excitation', {'program': HIGH, 'subscribers': 4, 'block_size': 500}),
            ('stage', {'seed': 3}),
            ('model', {'model': str(tmp_path / 'model.yaml')}),
            ('recorder', {'output': str(tmp_path / 'new'), 'autostart': True}),
            # ramps of their own that are too slow for a node that has to end
            ('excitation', {'program': HIGH, 'ramp_slew': 0.5, 'block_size': 500}, 'slow'),
            ('stage', {'ramp_slew': 1.0, 'silence': 600.0}, 'fed'),
            ('identifier', {**SETTINGS, 'thresholds': 100, 'swarm_iterations': 10**7}, 'busy'),
            (
                'player',
                {
                    'bag': str(tmp_path / 'old'),
                    'rate': 0.1,
                    'topics': ['voltage'],
                    'autostart': True,
                },
                'replay',
            ),
        )
        for pair in pairs_of(record):
            for b in pair:
                g.publish(f'busy/{b.quantity}', b)
            time.sleep(0.005)
        g.wait(lambda: g.status('busy/identifier')['text'].count('3.370 s of') == 2, 'data')
        assert g.call('busy/identifier/identify')[0]
        for where in ('', 'slow/'):
            assert g.call(f'{where}excitation/start')[0]
        for b in [block(0, np.linspace(0, 10, 10_000)), *level(10.0, 3, 10_000)]:
            g.publish('fed/voltage', b)
        g.wait(lambda: slow and slow[-1].values[-1] == 9.0, 'the slow one at 9 V')
        g.wait(lambda: fed and fed[-1].values[-1] == 10.0, 'the other stage at 10 V')
        g.wait(lambda: applied and applied[-1].values[-1] == 9.0, '9 V')
        g.wait(lambda: prediction and replayed, 'model and player at work')
        g.wait(lambda: g.status('busy/identifier')['text'] == 'hysteresis', 'the swarm')
        g.wait(lambda: int(g.status('recorder')['messages']) > 20, 'the recorder at work')
        helpers = g.handle('busy/identifier').children()
        assert helpers
        # last, for the signals to come while it ramps
        assert g.call('slow/excitation/stop')[0]
        g.wait(lambda: slow[-1].segment == 'ramp:stop', 'the slow ramp')

        def held_up() -> None:
            process = g.handle('excitation').process
            g.wait(lambda: voltage[-1].segment == 'ramp:stop', 'the ramp')
            process.send_signal(signal.SIGSTOP)
            time.sleep(HELD_UP)
            process.send_signal(signal.SIGCONT)

        with crowd():
            end(g, held_up, 'excitation')
        try:
            for stream in (voltage, slow, applied, fed):
                g.wait(lambda s=stream: s[-1].values[-1] == 0.0, 'rest', 10.0)
        except AssertionError as error:
            # the last blocks of a node that ends may not come through to a crowded observer
            pytest.fail(f'rest was not seen: {error}')
        for stream in (voltage, slow, fed):
            t, v = column(stream)
            assert stream[-1].segment == 'ramp:stop'
            assert t.tobytes() == (np.arange(t.size) / FS).tobytes()
            assert np.abs(np.diff(v)).max() * FS < 201.0
        assert np.abs(np.diff(column(applied)[1])).max() * FS < 201.0
        for node, state in (('busy/identifier', 'cancelled'), ('replay/player', 'stopped')):
            g.wait(lambda n=node, s=state: g.status(n)['state'] == s, f'{node} to be {state}')
        g.wait(lambda: not any(alive(pid) for pid in helpers), 'the end of the helper')
    assert not is_unfinished(tmp_path / 'new')
    kept = read_bag(tmp_path / 'new')
    assert kept.n > 0 and not [f for f in kept.faults if f.name == 'truncated_bag']


@pytest.mark.timed
def test_idle_and_before_it_is_up(tmp_path):
    idle_and_starting(tmp_path)


def idle_and_starting(tmp_path):
    with Graph() as g:
        g.start_all(*((node,) for node in NODES))
        with crowd():
            cold = {'NUMBA_CACHE_DIR': str(tmp_path)}
            for node in ('stage', 'model'):
                g.start(node, {}, 'cold', wait=False, env=cold)
            # what it compiles first comes there when it is compiled
            g.wait(lambda: list(tmp_path.rglob('*.nbc')), 'the first kernel')
            g.start('model', {}, 'early', wait=False)
            g.start('recorder', {}, 'early', wait=False)
            pids = [handle.process.pid for handle in g.handles]
            g.wait(lambda: all(listens(pid) for pid in pids), 'all to take signals')
            # it waits for a model once all is compiled
            assert g.status('cold/model')['state'] in ('', 'idle')
            end(g)
