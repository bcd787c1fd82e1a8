# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A graph in a namespace and one under other names hear only themselves."""

from course import column, FS, HIGH, model_of, numbers, PROGRAM, QUICK, voltage_of
from graph import ENDS, Graph
import numpy as np
from piezo_ident.record.bags.read import opened_bag
from processes import WORK

#: of every topic of the graph
NAMES = {
    'voltage': 'command',
    'displacement': 'position',
    'applied_voltage': 'amplifier',
    'prediction': 'expected',
    'residual': 'misfit',
    'preview': 'shown',
    'model': 'learnt',
    'report': 'findings',
}
#: where the excitation has another name too
DRIVE = {
    f'excitation/{name}': f'drive/{name}' for name in ('start', 'stop', 'set_parameters', 'status')
}
WHERE = ('a/', '')


def test_two_graphs_side_by_side(tmp_path):
    excitation = {'subscribers': 4, 'block_size': 500, 'rate_factor': 2.0}
    identifier = {**QUICK, 'program': PROGRAM}
    # longer than a busy machine keeps a program from its next block
    stage = {'seed': 1, 'silence': 5.0}
    with Graph() as g:
        applied = {
            w: g.collect(f'{w}{"amplifier" if not w else "applied_voltage"}') for w in WHERE
        }
        voltage = {w: g.collect(f'{w}{"command" if not w else "voltage"}') for w in WHERE}
        expected = {w: g.collect(f'{w}{"expected" if not w else "prediction"}') for w in WHERE}
        models = {w: g.texts(f'{w}{"learnt" if not w else "model"}') for w in WHERE}
        reports = {w: g.texts(f'{w}{"findings" if not w else "report"}') for w in WHERE}
        g.start_all(
            ('stage', stage, 'a'),
            ('excitation', excitation, 'a'),
            ('identifier', identifier, 'a'),
            ('model', {}, 'a'),
            ('stage', stage, '', {**NAMES, '__node': 'table'}),
            ('excitation', {**excitation, 'subscribers': 5}, '', {**NAMES, '__node': 'drive'}),
            ('identifier', identifier, '', {**NAMES, **DRIVE}),
            ('model', {}, '', NAMES),
            ('recorder', {'output': str(tmp_path / 'bag'), 'autostart': True}, '', NAMES),
            ('player', {'topics': ['report']}, '', NAMES),
        )
        g.wait(lambda: g.status('recorder')['state'] == 'recording', 'the recording')
        for where in WHERE:
            ok, reason = g.call(f'{where}identifier/run')
            assert ok, reason
        for where in WHERE:
            assert g.until(f'{where}identifier', *ENDS, timeout=WORK)['state'] == 'done'

        # each has the whole program and nothing but it
        sent = column(voltage_of(PROGRAM))
        for where in WHERE:
            for stream in (voltage[where], applied[where]):
                g.wait(lambda s=stream: column(s)[0].size >= sent[0].size, 'the last block')
                t, v = column(stream)
                assert t.tobytes() == sent[0].tobytes() and v.tobytes() == sent[1].tobytes()
            kept = g.diagnoses(f'{where}identifier')
            g.wait(lambda k=kept: k and k[-1]['state'] == 'done', 'diagnostics')
            assert float(kept[-1]['captured']) == round(sent[0].size / FS, 3)
            assert kept[-1]['lost'] == '0'
            assert kept[-1]['hardware_id'] == f'/{where}'.rstrip('/') or '/'
        for name in NAMES:
            assert g.node.count_publishers(f'/{name}') == 0, name

        # the same stage has the same model whatever it is called
        g.wait(lambda: all(models.values()) and all(reports.values()), 'models and reports')
        found = {where: numbers(model_of(models[where][-1])) for where in WHERE}
        np.testing.assert_allclose(found['a/'], found[''], rtol=1e-12)
        for where in WHERE:
            g.wait(
                lambda w=where: g.status(f'{w}model')['text'] == 'with topic model',
                'the model to be taken over',
            )

        # one of them goes on, and the other is silent
        heard = {where: len(voltage[where]) for where in WHERE}
        assert g.set('a/excitation', 'program', HIGH)[0]
        assert g.call('a/excitation/start')[0]
        g.wait(lambda: expected['a/'], 'a prediction')
        assert g.call('a/excitation/stop')[0]
        g.wait(lambda: g.status('a/excitation')['state'] == 'stopped', 'the stop')
        assert len(voltage['a/']) > heard['a/'] and len(voltage['']) == heard['']
        assert not expected['']

        # the bag has the names of this graph, and is played under them
        assert g.call('recorder/stop')[0]
        g.wait(lambda: g.status('recorder')['state'] == 'done', 'the bag')
        with opened_bag(tmp_path / 'bag') as bag:
            topics = {c.topic for c in bag.connections if c.msgcount}
        # status goes by the name of its node, which may be remapped
        assert {t for t in topics if not t.endswith('/status')} == {
            *('/command', '/position', '/amplifier', '/learnt', '/findings', '/shown'),
            '/diagnostics',
        }
        assert g.set('player', 'bag', str(tmp_path / 'bag'))[0]
        assert g.call('player/start')[0]
        g.wait(lambda: len(reports['']) == 2, 'the recorded report')
        assert reports[''][0] == reports[''][1]
