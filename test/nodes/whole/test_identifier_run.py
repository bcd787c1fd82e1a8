# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The identifier drives the excitation: what it needs, and how a run is cut short."""

import time

from course import block, PROGRAM, SETTINGS
from graph import Graph, in_time
import numpy as np
import pytest


@pytest.fixture(scope='module')
def course():
    """Return a graph to drive a stage in; stage and excitation come when they are needed."""
    with Graph() as g:
        g.start('identifier', {**SETTINGS, 'program': PROGRAM, 'excitation_limit': 1.0})
        yield g


@pytest.fixture(scope='module')
def driven(course):
    """Return the graph with an excitation, also where a later test runs alone."""
    course.start('excitation', {'rate_factor': 2.0, 'block_size': 1000, 'subscribers': 2})
    return course


@pytest.fixture(scope='module')
def measured(driven):
    """Return the graph with an excitation and a stage."""
    # longer than a busy machine keeps a program from its next block
    driven.start('stage', {'seed': 3, 'silence': 5.0})
    assert driven.set('identifier', 'excitation_limit', 20.0)[0]
    return driven


def test_run_without_an_excitation_fails_with_the_reason(course):
    end = course.finish('identifier/run')
    assert end['state'] == 'failed'
    assert "no excitation offers 'excitation/start' within 1 s" in end['text']


def test_run_without_a_stage_fails_with_the_reason(driven):
    course = driven
    # what was captured before is no news of the run
    for tick in (0, 400):
        course.publish('voltage', block(tick, np.zeros(200)))
    course.wait(lambda: course.diagnostics('identifier').get('lost') == '200', 'a gap')
    course.unpublish('voltage')
    since = len(course.statuses('identifier'))
    said = 'no publisher of displacement within 1 s'
    # it may take a moment to know of the excitation
    course.wait(lambda: said in course.finish('identifier/run')['text'], said)
    assert course.status('identifier')['level'] == '2'
    told = {s['text'] for s in course.statuses('identifier')[since:] if s['state'] == 'exciting'}
    assert any('waiting for a publisher of displacement' in text for text in told)
    assert not any('missing' in text for text in told)


def test_run_drives_the_excitation_and_identifies(measured):
    course = measured
    assert course.set('identifier', 'program', 'nonsense')[0]
    end = course.finish('identifier/run')
    assert end['state'] == 'failed' and 'the excitation refuses the program' in end['text']
    assert course.set('identifier', 'program', PROGRAM)[0]
    end = course.finish('identifier/run')
    assert (end['state'], end['level']) == ('done', '0'), end['text']
    states = [s['state'] for s in course.statuses('identifier')]
    assert states.index('exciting') < states.index('identifying') < states.index('done')
    course.wait(lambda: course.texts('model'), 'the model')
    assert course.diagnostics('identifier')['lost'] == '0'
    # the next start is not of what the identifier wanted
    assert course.get('excitation', 'program') == 'identification'


def settling(g):
    """Run a program that sweeps the bias for long enough to be met at it."""
    assert g.set('identifier', 'program', PROGRAM.replace('cycles: 8', 'cycles: 1600'))[0]
    seen = len(g.statuses('excitation'))
    assert g.call('identifier/run')[0]
    g.wait(
        lambda: any(s.get('segment') == 'settle' for s in g.statuses('excitation')[seen:]),
        'settle',
    )
    return seen


@pytest.mark.timed
def test_cancel_during_the_excitation_ramps_to_rest(measured):
    course = measured
    voltage = course.collect('voltage')

    course.call('identifier/cancel')
    seen, begun = settling(course), len(course.statuses('identifier'))
    for what in ('identify', 'run', 'clear', 'save'):
        ok, reason = course.call(f'identifier/{what}')
        assert not ok and 'busy: program' in reason
    begin = time.monotonic()
    assert course.call('identifier/cancel')[0]
    answered = time.monotonic() - begin
    course.until('identifier', 'cancelled', since=begun)
    ended = time.monotonic() - begin
    course.until('excitation', 'stopped', since=seen)
    course.wait(lambda: voltage and voltage[-1].values[-1] == 0.0, 'rest')
    in_time(answered, 0.5, 'answer to a cancel during the excitation')
    in_time(ended, 2.0, 'end after a cancel during the excitation')


def test_the_end_of_the_node_ends_the_excitation(measured):
    course = measured
    voltage, seen = course.collect('voltage'), settling(course)
    assert course.handle('identifier').stop() == 0
    course.until('excitation', 'stopped', since=seen)
    course.wait(lambda: voltage and voltage[-1].values[-1] == 0.0, 'rest')
    assert voltage[-1].segment == 'ramp:stop'
