# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Nodes that fail in a run: each is said, the stage is safe, and no bad model is made of it."""

import re
import signal

from course import column, FS, HIGH, model_of, PROGRAM, QUICK, simulated
from graph import ENDS, Graph
import numpy as np
from piezo_ident.nodes.exclusive_publisher import LISTEN
from piezo_ident.record.bags.write import write_bag
from processes import WORK
import pytest

RESTING = ('idle', 'done', 'failed', 'cancelled', 'stopped', '')


@pytest.fixture(scope='module')
def graph():
    with Graph() as g:
        g.collect('applied_voltage')
        g.texts('model')
        g.start_all(
            ('excitation', {'block_size': 500, 'subscribers': 2}),
            # longer than a busy machine keeps a program from its next block
            ('stage', {'seed': 3, 'silence': 2.0}),
            ('identifier', QUICK),
        )
        g.matched('applied_voltage')
        yield g


@pytest.fixture
def lab(graph):
    """Return the graph at rest."""
    assert graph.set('stage', 'ramp_slew', 20.0)[0]
    graph.call('identifier/cancel')
    graph.call('excitation/stop')
    for node in ('identifier', 'excitation', 'stage'):
        graph.wait(lambda n=node: graph.status(n)['state'] in RESTING, f'{node} at rest')
    return graph


def run(g: Graph, program: str) -> int:
    """Call ``~/run``, and return how many statuses came before."""
    seen = len(g.statuses('identifier'))
    assert g.set('identifier', 'program', program)[0]
    ok, reason = g.call('identifier/run')
    assert ok, reason
    return seen


def ended(g: Graph, seen: int, state: str) -> str:
    """Wait for the end of a run, and return its message."""
    end = g.until('identifier', *ENDS, since=seen, timeout=WORK)
    assert end['state'] == state, end
    return end['text']


def at_nine_volts(g: Graph) -> None:
    applied = g.collect('applied_voltage')
    g.wait(lambda: applied and applied[-1].values[-1] == 9.0, '9 V')


def test_two_excitations_on_one_topic(lab):
    # on a busy machine the stage may ramp to rest for lack of voltage, so the sent one is judged
    sent = lab.collect('voltage')
    assert lab.set('excitation', 'program', HIGH)[0]
    assert lab.call('excitation/start')[0]
    lab.wait(lambda: sent and sent[-1].values[-1] == 9.0, '9 V')
    since = len(sent)
    # one of the same name is told by its blocks
    own = {'~/start': '/twin/start', '~/status': '/other/twin/status'}
    lab.follow('other/twin', 'excitation')
    twin = lab.start('excitation', {'program': HIGH}, remaps=own, wait=False)
    lab.wait(
        lambda: any(
            d['message'].startswith('nothing played yet; another node is called /excitation')
            and d['publishers'] == '2'
            for d in lab.diagnoses('excitation')
        ),
        'the twin to know that it is not alone',
    )
    assert lab.call('twin/start')[0]
    said = lab.until('other/twin', 'failed')['text']
    assert 'another /excitation drives /voltage now' in said
    assert twin.stop() == 0
    other = lab.start('excitation', {'program': HIGH}, remaps={'__node': 'other'})
    first = 'second publisher /excitation on voltage'
    lab.wait(lambda: lab.diagnostics('other').get('message') == first, first)
    ok, reason = lab.call('other/start')
    assert not ok and '/excitation publishes on /voltage too; end it first' in reason
    warning = 'second publisher /other on voltage'
    lab.wait(lambda: warning in lab.status('excitation')['text'], warning)
    assert lab.status('excitation')['level'] == '1'
    assert other.stop() == 0
    lab.wait(lambda: lab.status('excitation')['level'] == '0', 'the warning to be taken back')
    # who pauses for as long as the twin listens is not heard by it before its own first block
    pause = np.diff(lab.arrivals('voltage')[since:]).max()
    assert set(column(sent[since:])[1]) == {9.0} or pause > LISTEN


def test_an_excitation_that_is_killed_at_nine_volts_and_comes_back(lab):
    applied, models = lab.collect('applied_voltage'), len(lab.texts('model'))
    seen = run(lab, HIGH)
    at_nine_volts(lab)
    killed, end, told = lab.handle('excitation'), len(applied), len(lab.statuses('stage'))
    killed.kill()
    ramping = lab.until('stage', 'ramping', since=told)
    assert ramping['level'] == '1' and 'no voltage for' in ramping['text']
    lab.restart(killed)
    # on a busy machine the start takes longer than the identifier waits for a stage in trouble
    reason = ended(lab, seen, 'failed')
    early, late = 'the excitation ended early (idle)', 'no displacement from the stage for 3 s'
    assert early in reason or (late in reason and 'no voltage' in reason), reason
    lab.wait(lambda: lab.status('stage')['state'] == 'idle', 'rest')
    lab.wait(lambda: applied[-1].values[-1] == 0.0, '0 V')
    since = len(applied)
    seen = run(lab, PROGRAM)
    assert 'the model' in ended(lab, seen, 'done')
    v = column(b for b in applied[end:since] if b.segment == 'ramp:silence')[1]
    assert np.abs(np.diff(v)).max() * FS <= 20.1
    assert applied[since].values[0] == 0.0
    lab.wait(lambda: len(lab.texts('model')) == models + 1, 'the model')


def test_a_stage_that_stops_answering_in_a_run(lab):
    models, stage = len(lab.texts('model')), lab.handle('stage')
    # the excitation, too, has so long to answer
    assert lab.set('identifier', 'excitation_limit', 5.0)[0]
    seen = run(lab, HIGH)
    at_nine_volts(lab)
    stage.send(signal.SIGSTOP)
    try:
        reason = ended(lab, seen, 'failed')
        # the shorter time where the stage has warned of something last
        assert re.search('no displacement from the stage for [35] s', reason), reason
        lab.wait(lambda: lab.status('excitation')['state'] == 'stopped', 'the excitation to stop')
    finally:
        stage.send(signal.SIGCONT)
    assert lab.set('identifier', 'excitation_limit', 20.0)[0]
    lab.wait(lambda: lab.status('stage')['state'] == 'idle', 'the stage at rest')
    applied = lab.collect('applied_voltage')
    lab.wait(lambda: applied[-1].values[-1] == 0.0, '0 V')
    assert len(lab.texts('model')) == models


def test_an_excitation_that_is_killed_before_its_first_block(lab):
    excitation = lab.handle('excitation')
    assert lab.set('identifier', 'excitation_limit', 2.0)[0]
    # so that it waits for somebody who never comes
    assert lab.set('excitation', 'subscribers', 9)[0]
    before = len(lab.statuses('excitation'))
    try:
        seen = run(lab, HIGH)
        # on a busy machine the run may end before the excitation has answered
        lab.wait(
            lambda: (
                any(s['state'] == 'waiting' for s in lab.statuses('excitation')[before:])
                or any(s['state'] == 'failed' for s in lab.statuses('identifier')[seen:])
            ),
            'the excitation to wait',
        )
        excitation.kill()
        # with its answer, or before it
        reason = ended(lab, seen, 'failed')
        assert re.search('no status of the excitation for 2 s|not respond within 2 s', reason), (
            reason
        )
    finally:
        if not excitation.is_ended:
            excitation.kill()
        lab.restart(excitation)
        assert lab.set('identifier', 'excitation_limit', 20.0)[0]


def test_a_stage_that_refuses_the_rate_ends_the_run(graph):
    half = {'sample_rate': 10_000.0, 'block_size': 500, 'subscribers': 2}
    graph.start_all(
        ('excitation', half, 'odd'),
        ('stage', {}, 'odd'),
        ('identifier', QUICK, 'odd'),
    )
    assert graph.set('odd/identifier', 'program', HIGH)[0]
    ok, reason = graph.call('odd/identifier/run')
    assert ok, reason
    reason = graph.until('odd/identifier', 'failed')['text']
    # of a stage that warns
    assert 'no displacement from the stage for 3 s, none at all' in reason
    assert 'it says: a block is refused: it is sampled at 10000 Hz' in reason
    assert float(graph.until('odd/excitation', 'stopped')['progress']) < 60.0
    assert '1' in {s['level'] for s in graph.statuses('odd/stage')}


def test_an_identifier_that_is_killed_in_a_run(lab):
    models, applied = len(lab.texts('model')), lab.collect('applied_voltage')
    run(lab, HIGH)
    at_nine_volts(lab)
    lab.handle('identifier').die()
    new = lab.restart(lab.handle('identifier'))
    # what the killed one said last is still there
    told = len(lab.diagnoses('identifier'))

    def captures():
        words = lab.diagnoses('identifier')[told:]
        return words and float(words[-1].get('captured', 0)) > 0.5

    lab.wait(captures, 'a capture of the new one')
    kept = float(lab.diagnostics('identifier')['captured'])
    # nobody stops the program, and it is not started again over itself
    seen = run(lab, PROGRAM)
    reason = ended(lab, seen, 'failed')
    assert 'a program is being played already; call ~/stop first' in reason
    # and a run that did not begin has cost nothing
    told = len(lab.diagnoses('identifier'))
    lab.wait(lambda: len(lab.diagnoses('identifier')) > told + 1, 'the capture of then')
    assert float(lab.diagnostics('identifier')['captured']) > kept
    assert new.status()['level'] == '2' and applied[-1].values[-1] == 9.0
    assert lab.call('excitation/stop')[0]
    lab.wait(lambda: lab.status('excitation')['state'] == 'stopped', 'the excitation to stop')
    assert len(lab.texts('model')) == models


def test_a_bag_that_ends_early(graph, tmp_path):
    graph.texts('replay/model')
    # no swarm fits the part of a program that is left, and a search of large orders takes long
    quick = {**QUICK, 'solver': 'least_squares', 'max_order': 2}
    graph.start_all(('player', {}, 'replay'), ('identifier', quick, 'replay'))
    write_bag(simulated(), tmp_path / 'bag')
    (file,) = (tmp_path / 'bag').glob('*.mcap')
    file.write_bytes(file.read_bytes()[: int(0.6 * file.stat().st_size)])
    (tmp_path / 'bag' / 'metadata.yaml').unlink()
    assert graph.set('replay/player', 'bag', str(tmp_path / 'bag'))[0]
    assert graph.set('replay/player', 'rate', 4.0)[0]
    end = graph.finish('replay/player/start')
    assert (end['state'], end['level']) == ('done', '1')
    assert 'the bag ends early: truncated_bag' in end['text']

    def is_captured():
        # on a busy machine blocks are on their way when the player has ended
        last = [float(d.get('captured', 0)) for d in graph.diagnoses('replay/identifier')[-2:]]
        return len(last) == 2 and last[0] == last[1] > 0.0

    graph.wait(is_captured, 'all that was played')
    end = graph.finish('replay/identifier/identify')
    assert (end['state'], end['level']) == ('done', '1'), end
    graph.wait(lambda: graph.texts('replay/model'), 'the model')
    said = ' '.join(model_of(graph.texts('replay/model')[-1]).identification['warnings'])
    assert 'no segments labelled noise and triangle' in said
