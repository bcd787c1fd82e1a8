# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The models identified live, from the replay of the bag and from the bag offline are equal."""

from course import model_of, numbers, PROGRAM, QUICK
from graph import Graph
import numpy as np
import piezo_ident as pi


def end_of(g, service):
    """Call a service, and return the state in which its node ends."""
    node = service.rpartition('/')[0]
    seen = len(g.statuses(node))
    accepted, reason = g.call(service)
    assert accepted, reason

    def states():
        return [s['state'] for s in g.statuses(node)[seen:]]

    g.wait(lambda: {'done', 'failed'} & set(states()), f'the end of {service}')
    return states()[-1]


def test_live_replayed_and_offline_models_are_equal(tmp_path):
    bag = tmp_path / 'bag'
    with Graph() as g:
        live, replayed = g.texts('model'), g.texts('replay/model')
        g.start_all(
            ('stage', {'seed': 3}),
            ('identifier', {**QUICK, 'program': PROGRAM}),
            ('recorder', {'output': str(bag)}),
            ('excitation', {'subscribers': 3, 'block_size': 500}),
        )
        assert g.call('recorder/start')[0]
        g.wait(lambda: g.status('recorder')['state'] == 'recording', 'the recording')
        assert end_of(g, 'identifier/run') == 'done'
        g.wait(lambda: live, 'the live model')
        assert end_of(g, 'recorder/stop') == 'done'
        g.start_all(
            ('identifier', QUICK, 'replay'),
            ('player', {'bag': str(bag), 'rate': 1.0}, 'replay'),
        )
        assert end_of(g, 'replay/player/start') == 'done'
        assert end_of(g, 'replay/identifier/identify') == 'done'
        g.wait(lambda: replayed, 'the replayed model')
    settings = pi.Settings(max_order=6, thresholds=10, solver='swarm')
    offline = numbers(pi.identify(pi.read(bag), settings).model)
    for text in (live[-1], replayed[-1]):
        np.testing.assert_allclose(numbers(model_of(text)), offline, rtol=1e-12, atol=0)
