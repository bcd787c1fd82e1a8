# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The graph as it runs is that of docs/graph.md and config/security/policy.xml."""

import json
import re

from course import block, HIGH, model_of, numbers, PROGRAM, QUICK
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from graph import Graph
from graph_page import DIAGNOSTICS, OPERATOR, rights, ROOT, SERVICES, STATES, TOPICS
from layouts import (
    found_by_foxglove,
    messages_of,
    series_of_plotjuggler,
    shown_by_foxglove,
    shown_by_plotjuggler,
)
import numpy as np
import piezo_ident as pi
from piezo_ident.nodes.parameters import NODES
from piezo_ident.nodes.wire import LATCHED
import pytest
from rcl_interfaces.msg import Log
from rclpy.parameter import parameter_dict_from_yaml_file, parameter_value_to_python
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
import yaml

#: longer than a busy machine keeps a stream from its next block [s]
SILENCE = 2.0
#: what `Graph` keeps beside the values of a diagnosis
OTHERS = {'message', 'level', 'hardware_id'}
#: who publishes a topic only while it drives or replays
NOW_AND_THEN = {('voltage', 'feedforward'), ('voltage', 'player'), ('displacement', 'player')}


@pytest.fixture(scope='module')
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp('whole')
    with Graph() as g:
        g.lines()
        models, reports = g.texts('model'), g.texts('report')
        g.start_all(
            ('excitation', {'subscribers': 3, 'block_size': 500, 'rate_factor': 2.0}),
            ('stage', {'seed': 3, 'silence': SILENCE}),
            ('identifier', {**QUICK, 'program': PROGRAM}),
            ('model', {'window': 0.5, 'observe_gain': True, 'adapt': 'hysteresis'}),
            ('recorder', {'output': str(folder / 'bag')}),
            ('player', {'bag': str(folder / 'bag'), 'rate': 0.1}),
            (
                'feedforward',
                {'silence': SILENCE, 'ramp_slew': 200.0, 'window': 0.2, 'follow': 'gain'},
            ),
        )
        g.output, g.asked = folder, []
        # recorded here, for every test of this file may be run alone
        end = g.finish('recorder/start', 'recording')
        assert end['state'] == 'recording', end
        # the recorder is the fourth
        assert g.set('excitation', 'subscribers', 4)[0]
        end = g.finish('identifier/run')
        assert (end['state'], end['level'], end['progress']) == ('done', '0', '100'), end
        g.wait(lambda: models and reports, 'model and report')
        g.wait(lambda: g.status('model')['text'] == 'with topic model', 'the model')
        told = lambda: 'residual_percent' in g.diagnostics('model')  # noqa: E731
        g.wait(told, 'the live error to be recorded')
        end = g.finish('recorder/stop')
        assert end['state'] == 'done', end
        assert g.set('excitation', 'subscribers', 3)[0]
        # some values are there only while a stream comes
        assert g.set('excitation', 'program', HIGH)[0]
        assert g.call('excitation/start')[0]
        g.wait(lambda: 'head_room' in g.diagnostics('model'), 'the head-room')
        assert g.finish('excitation/stop', 'stopped')['state'] == 'stopped'
        # until then it follows the excitation alone
        g.wait(lambda: g.status('stage')['state'] == 'idle', 'a stage at rest')
        track(g)
        yield g


def track(g, wanted='done'):
    """Let the feedforward node follow a reference to its end, or up to another state."""
    assert g.call('feedforward/start')[0]
    g.wait(lambda: g.status('feedforward')['state'] == 'ready', 'the right to drive')
    if wanted != 'ready':
        told, tick = len(g.diagnoses('feedforward')), iter(range(0, 10**9, 500))
        level = np.full(500, 20e-6)
        g.wait(
            lambda: any('tracking_rms' in d for d in g.diagnoses('feedforward')[told:]),
            'the tracking error',
            meanwhile=lambda: g.publish(
                'reference', block(next(tick), level, 'level', 'reference')
            ),
        )
        g.until('feedforward', wanted)


def publishers(g, topic):
    """Return who publishes a topic, as the middleware tells."""
    found = g.node.get_publishers_info_by_topic(topic)
    return {i.node_name: i for i in found if i.node_name != 'observer'}


def subscribers(g, topic):
    """Return who listens to a topic, but for those who listen to whatever there is."""
    found = g.node.get_subscriptions_info_by_topic(topic)
    return {i.node_name for i in found} - {'observer', 'recorder'}


def test_a_run_through_the_whole_graph(whole):
    report = json.loads(whole.texts('report')[-1])
    assert report['data_faults'] == [] and report['delay']['samples'] == 3
    assert model_of(whole.texts('model')[-1]).delay.total == pytest.approx(3, abs=0.1)
    record = pi.read(whole.output / 'bag')
    assert record.n == round(3.37 * 20_000) and record.faults == ()


@pytest.mark.parametrize(
    ('node', 'level', 'line'),
    [
        ('recorder', Log.INFO, r'piezo_ident \S+ is up; set: output = .*bag'),
        ('stage', Log.INFO, r'piezo_ident \S+ is up; set: seed = 3'),
        ('identifier', Log.INFO, '~/run: the program is requested'),
        ('excitation', Log.INFO, 'set: program = '),
        ('excitation', Log.INFO, 'running: '),
        ('stage', Log.INFO, 'running: '),
        ('identifier', Log.INFO, r'done: .*\d % of stroke'),
        ('model', Log.INFO, 'predicting: with topic model'),
        ('recorder', Log.INFO, r'done: \d+ messages in .*bag'),
        ('recorder', Log.WARN, '~/stop refused: not recording'),
        ('excitation', Log.WARN, 'parameter refused: .*no_such_program'),
        ('excitation', Log.WARN, 'parameter refused: Wrong parameter type'),
    ],
)
def test_the_log_tells_what_happened(whole, node, level, line):
    if 'recorder/stop' not in whole.asked:
        whole.asked = ['recorder/stop']
        assert not whole.call('recorder/stop')[0]
        assert not whole.set('excitation', 'program', 'no_such_program')[0]
        assert not whole.set('excitation', 'program', 1)[0]
    said = whole.lines()
    whole.wait(lambda: any(x[:2] == (node, level) and re.match(line, x[2]) for x in said), line)


def test_live_replayed_and_offline_models_are_equal(whole):
    models = [whole.texts('model')[-1]]
    bag = whole.output / 'bag'
    replayed = whole.texts('replay/model')
    players = whole.start_all(
        ('player', {'bag': str(bag), 'rate': 4.0}, 'replay'), ('identifier', QUICK, 'replay')
    )
    try:
        end = whole.finish('replay/player/start')
        assert end['state'] == 'done', end
        # the player is done when the last message has left, not when it has arrived
        seconds = f'{pi.read(bag).n / 20_000:.3f} s of'
        captured = f'{seconds} voltage, {seconds} displacement captured'
        whole.wait(
            lambda: whole.status('replay/identifier')['text'] == captured, 'the last message'
        )
        end = whole.finish('replay/identifier/identify')
        assert end['state'] == 'done', end
        whole.wait(lambda: replayed, 'the replayed model')
        models.append(replayed[-1])
    finally:
        ended = [handle.stop() for handle in players]
    assert ended == [0, 0]
    settings = pi.Settings(max_order=6, thresholds=10, solver='swarm')
    offline = numbers(pi.identify(pi.read(bag), settings).model)
    for text in models:
        np.testing.assert_allclose(numbers(model_of(text)), offline, rtol=1e-12, atol=0)


def test_layouts_show_what_was_recorded(whole):
    recorded = messages_of(whole.output / 'bag')
    missing = set(shown_by_plotjuggler()) - set(series_of_plotjuggler(recorded))
    assert not missing
    for path in shown_by_foxglove():
        assert found_by_foxglove(recorded, path), path


def test_topics_are_those_of_the_table(whole):
    of_one = [t for t in TOPICS if t.publishers != {'every node'}]
    assert whole.set('excitation', 'program', HIGH)[0]
    ok, reason = whole.call('excitation/start')
    assert ok, reason
    for t in of_one:
        always = {name for name in t.publishers if (t.name, name) not in NOW_AND_THEN}
        wanted = always, set(t.subscribers)
        whole.wait(
            lambda t=t, w=wanted: (
                (set(publishers(whole, f'/{t.name}')), subscribers(whole, f'/{t.name}')) == w
            ),
            f'{wanted} on {t.name}',
        )
    for t in TOPICS:
        for name in [f'/{n}/status' for n in NODES] if t.name == '~/status' else [f'/{t.name}']:
            name = name.replace('//', '/')
            found = publishers(whole, name)
            if t.name == '/diagnostics':
                assert set(found) == set(NODES)
            for node, info in found.items():
                assert t.name != '~/status' or name == f'/{node}/status'
                assert info.topic_type == t.type
                latched = info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
                assert latched == ('transient local' in t.qos), name
                assert info.qos_profile.reliability == ReliabilityPolicy.RELIABLE, name
            assert found or not t.publishers, name
    assert whole.finish('excitation/stop', 'stopped')['state'] == 'stopped'
    # who drives by a reference
    track(whole, 'ready')
    whole.wait(lambda: 'feedforward' in publishers(whole, '/voltage'), 'it on voltage')
    assert whole.finish('feedforward/stop', 'stopped')['state'] == 'stopped'
    # a replay on its way
    assert whole.call('player/start')[0]
    for t in of_one:
        wanted = 'player' in t.publishers, 'player' in t.subscribers
        whole.wait(
            lambda t=t, w=wanted: (
                ('player' in publishers(whole, f'/{t.name}')) == w[0]
                and ('player' in subscribers(whole, f'/{t.name}')) == w[1]
            ),
            f'the player on {t.name}',
        )
    assert whole.finish('player/stop', 'stopped')['state'] == 'stopped'


@pytest.mark.parametrize('node', NODES)
def test_services_are_those_of_the_table(whole, node):
    found = whole.node.get_service_names_and_types_by_node(node, '/')
    triggers = {name for name, types in found if types == ['std_srvs/srv/Trigger']}
    assert triggers == {f'/{n}/{name}' for n, name in SERVICES if n == node}


def test_what_is_latched_is_heard_by_who_comes_late(whole):
    heard = {}
    for node in NODES:
        whole.node.create_subscription(
            DiagnosticStatus, f'/{node}/status', lambda m, n=node: heard.update({n: m}), LATCHED
        )
    whole.wait(lambda: set(heard) == set(NODES), 'the last words')
    for node, message in heard.items():
        values = {pair.key: pair.value for pair in message.values}
        assert values['state'] in {state for n, state in STATES if n == node}
        assert 0.0 <= float(values['progress']) <= 100.0
        assert message.message
        assert (message.name, message.hardware_id) == (f'/{node}', '/')


def test_diagnostics_are_those_of_the_table(whole):
    arrays = []
    subscription = whole.node.create_subscription(
        DiagnosticArray, '/diagnostics', arrays.append, 100
    )
    for node in NODES:
        always = {name for n, name, when in DIAGNOSTICS if n == node and not when}
        every = {name for n, name, _ in DIAGNOSTICS if n == node}
        whole.wait(
            lambda n=node, e=every: e <= {k for d in whole.diagnoses(n) for k in d},
            f'all values of {node}',
        )
        for found in whole.diagnoses(node):
            assert always <= set(found) - OTHERS <= every, node
    # once a second, by their own stamps
    whole.wait(lambda: len(arrays) >= 4 * len(NODES), 'some more')
    stamps = {}
    for array in arrays:
        (status,) = array.status
        assert status.hardware_id == '/'
        stamp = array.header.stamp
        stamps.setdefault(status.name, []).append(stamp.sec + 1e-9 * stamp.nanosec)
    assert set(stamps) == {f'/{node}' for node in NODES}
    assert 0.8 < np.median(np.concatenate([np.diff(t) for t in stamps.values()])) < 1.5
    whole.forget(subscription)


@pytest.mark.parametrize('node', NODES)
def test_parameters_are_those_of_the_table(whole, node):
    found = whole.parameters(node)
    foreign = ('use_sim_time', 'start_type_description_service', 'qos_overrides.')
    assert {n for n in found if not n.startswith(foreign)} == {d.name for d in NODES[node]}
    for d in NODES[node]:
        described = found[d.name]
        assert d.description in described.description
        assert not d.unit or f'[{d.unit}]' in described.description
        assert all(choice in described.description for choice in d.choices)
        assert described.read_only == d.read_only
        ranges = [*described.floating_point_range, *described.integer_range]
        assert [(r.from_value, r.to_value) for r in ranges] == (
            [] if d.low is None else [(d.low, d.high)]
        )
        value = whole.get(node, d.name)
        assert isinstance(value, list if isinstance(d.default, tuple) else type(d.default))


@pytest.mark.parametrize('node', NODES)
def test_the_policy_allows_what_the_node_does_and_no_more(whole, node):
    if node == 'player':
        # it publishes what it finds in a bag
        assert whole.call('player/start')[0]
        whole.wait(lambda: whole.status('player')['state'] == 'playing', 'the player to play')
        assert whole.finish('player/stop', 'stopped')['state'] == 'stopped'
    if node == 'feedforward':
        track(whole, 'ready')
    may = {
        right: {re.sub(r'^(?!/)', '/', name.replace('~', f'/{node}')) for name in names}
        for right, names in rights(node).items()
    }
    see = {
        'publish': whole.node.get_publisher_names_and_types_by_node,
        'subscribe': whole.node.get_subscriber_names_and_types_by_node,
        'reply': whole.node.get_service_names_and_types_by_node,
        'request': whole.node.get_client_names_and_types_by_node,
    }
    for right, ask in see.items():

        def does(ask=ask):
            return {name for name, _ in ask(node, '/')}

        if right in ('publish', 'reply'):
            # an excitation plays voltage or a reference
            either = {f'/{node}/get_type_description', '/reference'}
            wanted = may[right] - either
            whole.wait(lambda d=does, w=wanted: w <= d(), f'{node}: {right}')
        assert does() <= may[right], f'{node} may not {right}'
    if node == 'feedforward':
        assert whole.finish('feedforward/stop', 'stopped')['state'] == 'stopped'


def test_only_the_drive_and_the_operator_have_their_rights():
    may = {node: rights(node) for node in (*NODES, OPERATOR)}
    assert [n for n in may if 'voltage' in may[n]['publish']] == [
        'excitation',
        'player',
        'feedforward',
    ]
    assert [n for n in may if 'model' in may[n]['publish']] == ['identifier']
    asks = [n for n in may if 'excitation/start' in may[n]['request']]
    assert asks == ['identifier', OPERATOR]
    assert [n for n in may if 'stage/set_parameters' in may[n]['request']] == [OPERATOR]
    called = {f'{node}/{name}' for node, name in SERVICES}
    assert called <= may[OPERATOR]['request']


@pytest.mark.parametrize('node', NODES)
def test_bad_parameters_are_refused_with_the_reason(whole, node):
    for d in NODES[node]:
        value = whole.get(node, d.name)
        bad = [[True] if isinstance(d.default, str) else 'text' if not d.choices else 1]
        if d.low is not None:
            kind = type(d.default)
            bad += [kind(d.low - 1 - abs(d.low) // 100), kind(d.high + 1 + d.high // 100)]
        if isinstance(d.default, float):
            bad += [float('nan'), 1]
        bad += ['nonsense'] * bool(d.choices)
        bad += [not value] * (d.read_only and isinstance(value, bool))
        for wrong in bad:
            taken, reason = whole.set(node, d.name, wrong)
            assert not taken, (d.name, wrong)
            assert d.name in reason or 'parameter type' in reason, (d.name, wrong, reason)
        after = whole.get(node, d.name)
        assert after == value, d.name
        # what cannot be changed may be set to what it is
        assert whole.set(node, d.name, value) == (True, ''), d.name


def test_what_is_no_parameter_is_refused(whole):
    for node in NODES:
        taken, reason = whole.set(node, 'nonsense', 1)
        assert not taken and reason == 'nonsense is no parameter of this node'
    reason = 'rate_facter is no parameter of this node; did you mean rate_factor?'
    assert whole.set('excitation', 'rate_facter', 1.0) == (False, reason)


def test_every_yaml_file_loads_into_its_running_node_and_a_bare_off_is_a_choice():
    # as ros2 param load has it: all keys, whether they can be changed or not
    with Graph() as g:
        files = {node: ROOT / f'config/{node}.yaml' for node in NODES}
        values = {
            node: next(iter(yaml.safe_load(files[node].read_text()).values()))['ros__parameters']
            for node in NODES
        }
        # YAML reads a bare off as false
        values['model']['adapt'] = False
        g.start_all(*((node, values[node]) for node in NODES))
        assert g.get('model', 'adapt') == 'off'
        for wanted, name in (('gain', 'gain'), (False, 'off')):
            assert g.set('model', 'adapt', wanted) == (True, '')
            assert g.get('model', 'adapt') == name
        taken, reason = g.set('model', 'adapt', True)
        assert not taken and 'hysteresis' in reason
        for node in NODES:
            found = parameter_dict_from_yaml_file(str(files[node]), True)
            for name, message in found.items():
                value = parameter_value_to_python(message.value)
                assert g.set(node, name, value) == (True, ''), (node, name, value)
        taken, reason = g.set('identifier', 'nice', 6)
        assert not taken and 'read-only' in reason
        # whatever the node holds: limits that share nothing with those of the file
        for node in ('excitation', 'feedforward'):
            for low, rest, high in ((20.0, 50.0, 150.0), (-30.0, -25.0, -20.0)):
                held = {'voltage_low': low, 'voltage_high': high, 'rest': rest}
                if node == 'excitation':
                    # the client of ROS cannot load a text that is YAML itself
                    held['program'] = str(g.folder / 'held.yaml')
                    (g.folder / 'held.yaml').write_text(
                        f'limits: [{low}, {high}]\nrest: {rest}\n'
                        f'segments:\n  - {{signal: hold, level: {rest}, duration: 1}}\n'
                    )
                for wanted in (held, values[node]):
                    assert g.load(node, wanted) == ({}, wanted)
            # what was in the way for a moment is no refusal
            assert 'refused' not in g.handle(node).log
