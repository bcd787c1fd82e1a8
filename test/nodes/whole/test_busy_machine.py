# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
What is captured on a busy machine is that of an idle one bit for bit, or what differs is told.

Programs that do nothing else take most of the machine, and one node gets no time at all: it is
stopped until more was sent than half a second holds.
"""

import json
import re
import signal

from course import column, FS, voltage_of
from graph import crowd, Graph
import numpy as np
from piezo_ident.model.simulated_stage import SimulatedStage
import pytest
from rcl_interfaces.msg import Log

pytestmark = pytest.mark.loads

PROGRAM = """
limits: [0, 10]
segments:
  - {signal: idle, duration: 0.1}
  - {signal: sine, bias: 5, amplitude: 5, frequency: 1, periods: 2}
  - {signal: step, bias: 5, size: 1, hold: 0.03, count: 8}
  - {signal: idle, duration: 0.1}
"""
TOPICS = ('voltage', 'displacement', 'applied_voltage')
#: blocks from the beginning, and until which a node is held up for 0.9 s
BEGIN, END = 60, 240


@pytest.fixture(scope='module')
def lab():
    with Graph() as g:
        g.start_all(
            ('stage', {'seed': 3}),
            ('excitation', {'program': PROGRAM, 'subscribers': 2}),
            ('identifier',),
        )
        for topic in TOPICS:
            g.matched(topic)
        yield g


def play(g, node, held_up):
    """Play the program while a node is stopped from `BEGIN` on, until `held_up` holds."""
    heard = {topic: len(g.collect(topic)) for topic in TOPICS}
    voltage, since = g.collect('voltage'), len(g.statuses('excitation'))
    assert g.call('identifier/clear')[0] and g.call('excitation/start')[0]
    g.wait(lambda: len(voltage) > heard['voltage'] + BEGIN, 'the first blocks')
    process = g.handle(node)
    process.send(signal.SIGSTOP)
    try:
        g.wait(lambda: held_up(len(voltage) - heard['voltage']), f'{node} to be late')
    finally:
        process.send(signal.SIGCONT)
    g.until('excitation', 'done', since=since)
    last = voltage_of(PROGRAM)[-1].t[-1]
    g.wait(lambda: all(g.collect(topic)[-1].t[-1] == last for topic in TOPICS), 'the last block')
    return {topic: column(g.collect(topic)[heard[topic] :]) for topic in TOPICS}


def test_a_node_that_gets_no_time_misses_nothing(lab):
    t, v = column(voltage_of(PROGRAM))
    # the stage goes on from where the first program left it
    truth = SimulatedStage.load('paper').run(np.random.default_rng(3))
    for node in ('stage', 'identifier'):
        with crowd():
            got = play(lab, node, lambda blocks: blocks > END)
        expected = {'voltage': v, 'applied_voltage': v, 'displacement': truth.process(v)}
        for topic, values in expected.items():
            np.testing.assert_array_equal(got[topic][0], t, f'{topic}, {node} held up')
            np.testing.assert_array_equal(got[topic][1], values, f'{topic}, {node} held up')
        n = f'{t.size / FS:.3f} s of'
        whole = ', '.join(f'{n} {topic}' for topic in TOPICS) + ' captured'
        lab.wait(lambda w=whole: lab.status('identifier')['text'] == w, whole)
        assert lab.status('identifier')['level'] == '0'


def test_a_voltage_that_does_not_come_is_told(lab):
    applied, since = lab.collect('applied_voltage'), len(lab.statuses('stage'))
    lines = lab.lines()
    got = play(lab, 'excitation', lambda _: applied and applied[-1].segment == 'ramp:silence')
    assert got['displacement'][0].size == got['voltage'][0].size < got['applied_voltage'][0].size
    assert any('no voltage' in s['text'] for s in lab.statuses('stage')[since:])
    # a segment alone is nothing to be warned of
    assert not [
        text for _, level, text in lines if level > Log.INFO and text.startswith('segment')
    ]
    told = 'samples of applied_voltage are a ramp to rest in silence'
    lab.wait(lambda: told in lab.status('identifier')['text'], told)
    assert lab.status('identifier')['level'] == '1'
    # of the report, the shortest work is enough
    count, reports = (
        re.search(rf'(\d+) {told}', lab.status('identifier')['text'])[1],
        lab.texts('report'),
    )
    end = lab.finish('identifier/identify_delay')
    assert (end['state'], end['level']) == ('done', '1'), end
    lab.wait(lambda: reports, 'the report')
    faults = {fault['name']: fault for fault in json.loads(reports[-1])['data_faults']}
    assert faults['ramp:silence']['count'] == int(count)
    assert 'the driver ramped to rest' in faults['ramp:silence']['action']
