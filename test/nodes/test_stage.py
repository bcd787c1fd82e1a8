# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The stage node as a process, under streams that are in order and others."""

from dataclasses import replace
import functools

from course import block, column, FS, level
from graph import Graph, ROOT
import numpy as np
from piezo_ident.live.guard import Guard, GuardSettings
from piezo_ident.model.simulated_stage import SimulatedStage
from piezo_ident.nodes.wire import STREAM, to_message
from piezo_ident.record.blocks import Samples
import pytest
from std_msgs.msg import Float64MultiArray
import yaml

SETTINGS = GuardSettings(0.0, 10.0, 40000.0, 20.0, 0.0, FS)


def idle(g):
    """Let the stage go to rest; the next stream may take its time."""
    assert g.set('stage', 'silence', 0.05)[0]
    g.wait(lambda: g.status('stage')['state'] == 'idle', 'the stage at rest')
    got, rest = g.collect('applied_voltage'), g.get('stage', 'rest')
    # the end of the ramp belongs to what was before
    g.wait(lambda: not got or abs(got[-1].values[-1] - rest) < 1e-9, 'what was applied last')
    assert g.set('stage', 'silence', 600.0)[0]
    return len(g.statuses('stage'))


def warned(g, text, since=0):
    """Wait for a warning in the status, which is shown for three seconds."""
    g.wait(
        lambda: any(text in s['text'] and s['level'] == '1' for s in g.statuses('stage')[since:]),
        text,
    )


@pytest.fixture(scope='module')
def lab():
    with Graph() as g:
        g.collect('displacement')
        g.collect('applied_voltage')
        g.start('stage', {'silence': 600.0, 'seed': 3})
        g.matched('displacement')
        g.matched('applied_voltage')
        yield g


def test_every_fault_in_one_stream_sample_by_sample():
    v = 5 - 5 * np.cos(2 * np.pi * 50 * np.arange(1200) / FS)
    sizes = {'a': 100, 'b': 7, 'c': 333, 'd': 1, 'e': 100, 'f': 100, 'g': 100, 'h': 100}
    blocks, tick = {}, 0
    for name, n in sizes.items():
        blocks[name] = block(tick, v[tick : tick + n])
        tick += n
    bad = blocks['g'].values.copy()
    bad[[3, 4, 70]] = np.nan, np.inf, 12.0
    blocks['g'] = block(round(blocks['g'].t[0] * FS), bad)

    # the same offline: what is expected sample by sample
    guard = Guard(SETTINGS)
    run = SimulatedStage.load('paper').run(np.random.default_rng(3))
    applied, back, fast = [], [], 0
    for name in 'abcdfgh':
        if name == 'f':
            hold = guard.hold(blocks['e'].t.size)
            applied.append(hold)
            run.process(hold)
        out = guard.process(blocks[name].values)
        applied.append(out.voltage)
        fast += out.altered.get('too_fast', 0)
        back.append(run.process(applied[-1]))

    # after the gap and after the samples that are no numbers it has to catch up
    assert fast > 0
    with Graph() as g:
        seen, got = g.collect('displacement'), g.collect('applied_voltage')
        g.start('stage', {'silence': 600.0, 'seed': 3})
        g.matched('displacement')
        g.matched('applied_voltage')

        def send(*names):
            for name in names:
                g.publish('voltage', blocks[name])

        send('a', 'b', 'c', 'c')
        warned(g, 'the block at t = 0.00535 s came twice')
        send('d', 'f')
        warned(g, '100 samples are missing at t = 0.02705 s')
        send('e')
        warned(g, 'the block at t = 0.02205 s came too late')
        send('g')
        warned(g, '1 samples are outside the voltage limits')
        message = to_message(blocks['h'])
        message.layout.dim[0].size = 99
        g.publish('voltage', message)
        warned(g, 'not N x 2')
        g.publish('voltage', Samples(np.arange(100) / 10000.0, np.zeros(100), 'x'))
        warned(g, 'sampled at 10000 Hz, expected are 20000 Hz')
        g.publish('voltage', Samples(blocks['h'].t, blocks['h'].values, 'x', 'displacement'))
        warned(g, "a block of 'displacement', expected is voltage")
        g.publish('voltage', Float64MultiArray())
        warned(g, 'is not')
        send('h')
        g.wait(lambda: len(seen) >= 7 and len(got) >= 8, 'the answers')
        assert (len(seen), len(got)) == (7, 8)
        assert [b.segment for b in got].count('hold:gap') == 1
        assert column(got)[1].tobytes() == np.concatenate(applied).tobytes()
        assert column(seen)[1].tobytes() == np.concatenate(back).tobytes()
        assert column(seen)[0].tobytes() == column([blocks[k] for k in 'abcdfgh'])[0].tobytes()
        # t goes on over the gap
        assert np.array_equal(np.rint(column(got)[0] * FS), np.arange(tick))
        g.wait(lambda: g.diagnostics('stage').get('blocks') == '7', 'the diagnostics')
        counts = g.diagnostics('stage')
        assert {k: counts[k] for k in counts if k.startswith(('refused', 'altered', 'lost'))} == {
            'lost': '100',
            'refused_malformed': '4',
            'refused_repeat': '1',
            'refused_late': '1',
            'refused_second': '0',
            'altered_not_finite': '2',
            'altered_outside_limits': '1',
            'altered_too_fast': str(fast),
            'altered_joining': '0',
        }
        idle(g)
        g.wait(lambda: g.diagnostics('stage')['silences'] == '1', 'one silence')
        assert got[-1].values[-1] == 0.0


@pytest.mark.parametrize(('rest', 'ramp_slew'), [(0.0, 20.0), (2.0, 40.0)])
def test_a_stream_joins_by_a_ramp_and_silence_ends_at_rest(lab, rest, ramp_slew):
    told = idle(lab)
    seen, got = lab.collect('displacement'), lab.collect('applied_voltage')
    before, applied = len(seen), len(got)
    assert lab.set('stage', 'ramp_slew', ramp_slew) == (True, '')
    # at 5 V for longer than it takes to join there
    stream = level(5.0, 120)
    for b in stream:
        lab.publish('voltage', b)
        if round(b.t[0] * 200) % 40 == 39:
            lab.wait(lambda b=b: seen and seen[-1].t[-1] == b.t[-1], 'the answers')
    lab.wait(lambda: len(seen) >= before + 120, 'the answers')
    expected = Guard(replace(SETTINGS, ramp_slew=ramp_slew)).process(column(stream)[1])
    assert expected.altered == {'joining': int(200_000 / ramp_slew)}
    lab.wait(lambda: len(got) >= applied + 120, 'what is applied')
    assert column(got[applied : applied + 120])[1].tobytes() == expected.voltage.tobytes()
    warned(lab, 'joined by a ramp', told)
    # no displacement is missing, altered or not
    assert column(seen[before:])[0].tobytes() == column(stream)[0].tobytes()

    since = len(lab.statuses('stage'))
    assert lab.set('stage', 'rest', rest) == (True, '')
    assert lab.set('stage', 'silence', 0.05)[0]
    try:
        lab.wait(lambda: got[-1].values[-1] == rest, 'rest')
        idle(lab)
        # with another rest the stage ramps once more
        ended = got[applied:]
    finally:
        assert lab.set('stage', 'rest', 0.0)[0]
        assert lab.set('stage', 'ramp_slew', 20.0)[0]
    said = lab.statuses('stage')[since:]
    assert next(s['state'] for s in said if s['state'] != 'running') == 'ramping'
    assert any('ramping to rest' in s['text'] and s['level'] == '1' for s in said)
    # t goes on, at 20 V/s at its steepest
    ramp = [b for b in ended if b.segment == 'ramp:silence']
    t, v = column(ended)
    assert np.array_equal(np.rint(t * FS), np.arange(t.size))
    assert np.abs(np.diff(v)).max() * FS == pytest.approx(ramp_slew, rel=1e-3)
    down = column(ramp)[1]
    assert np.all(np.diff(down) <= 0)
    assert np.count_nonzero(down != rest) == pytest.approx(2 * (5 - rest) / ramp_slew * FS, abs=2)
    assert len(seen) == before + 120


def test_the_next_stream_joins_while_the_ramp_is_under_way(lab):
    idle(lab)
    got = lab.collect('applied_voltage')
    applied = len(got)
    for b in [*level(0.0, 1), block(100, np.linspace(0, 9, 9000)), *level(9.0, 1, 9100)]:
        lab.publish('voltage', b)
    lab.wait(lambda: got[-1].values[-1] == 9.0, '9 V')
    # slow enough to be met on its way, whatever else the machine does
    assert lab.set('stage', 'ramp_slew', 1.0)[0]
    assert lab.set('stage', 'silence', 0.05)[0]
    lab.wait(lambda: got[-1].segment == 'ramp:silence' and got[-1].values[-1] < 8.9, 'the ramp')
    assert lab.set('stage', 'silence', 600.0)[0]
    assert lab.set('stage', 'ramp_slew', 20.0)[0]
    for b in level(1.0, 180, segment='hold:next'):
        lab.publish('voltage', b)
        if round(b.t[0] * 200) % 20 == 19:
            lab.wait(lambda b=b: got[-1].t[-1] == b.t[-1], 'the answers')
    assert got[-1].segment == 'hold:next' and got[-1].values[-1] == 1.0
    _, v = column(got[applied:])
    assert v[next(k for k in range(v.size) if v[k] == 9.0) :].max() == 9.0
    assert np.abs(np.diff(v)).max() * FS <= 20.01
    idle(lab)


def test_limits_and_slew_may_be_set_and_hold_at_once(lab):
    told = idle(lab)
    got = lab.collect('applied_voltage')
    assert lab.set('stage', 'voltage_high', 4.0) == (True, '')
    assert lab.set('stage', 'slew', 20000.0) == (True, '')
    try:
        taken, reason = lab.set('stage', 'rest', 5.0)
        assert not taken
        assert 'outside the voltage limits 0 .. 4 V' in reason
        assert not lab.set('stage', 'voltage_low', 4.0)[0]
        assert not lab.set('stage', 'seed', 4)[0]
        applied = len(got)
        lab.publish('voltage', block(0, [0.0, 0.0, 7.0, 7.0, 7.0, 7.0, 7.0, 0.0]))
        lab.wait(lambda: len(got) > applied, 'what is applied')
        assert got[applied].values.tolist() == [0.0, 0.0, 1.0, 2.0, 3.0, 4.0, 4.0, 3.0]
        warned(lab, 'are faster than slew', told)
    finally:
        assert lab.set('stage', 'voltage_high', 10.0)[0]
        assert lab.set('stage', 'slew', 40000.0)[0]


def test_a_file_is_loaded_whatever_the_node_holds(lab):
    told, load = len(lab.handle('stage').log), functools.partial(lab.load, 'stage')
    high = {'voltage_low': 20.0, 'voltage_high': 150.0, 'rest': 50.0}
    low = {'voltage_low': -30.0, 'voltage_high': 10.0, 'rest': 0.0}
    before = {name: lab.get('stage', name) for name in high}
    try:
        for wanted in (high, low, high):
            assert load(wanted) == ({}, wanted)
        shipped = yaml.safe_load((ROOT / 'config' / 'stage.yaml').read_text())
        (shipped,) = (x['ros__parameters'] for x in shipped.values())
        # its seed is another, and can be given at the start only; that is no reason for the rest
        refused, now = load({**shipped, 'silence': 600.0})
        assert set(refused) == {'seed'} and 'seed' in refused['seed'], refused
        assert now == {**shipped, 'silence': 600.0, 'seed': 3}
        # what was in the way for a moment is no refusal
        said = lab.handle('stage').log[told:].splitlines()
        assert all('seed' in line for line in said if 'refused' in line), said
        refused, now = load({**high, 'voltage_low': 200.0})
        assert refused and 'voltage_low' in refused
        assert now['voltage_low'] == 0.0
    finally:
        assert load(before) == ({}, before)


def test_a_restart_of_the_same_publisher_and_a_very_long_gap(lab):
    idle(lab)
    seen = lab.collect('displacement')
    before = len(seen)
    # two runs of the sample clock, and a jump of 50 s ahead, which is a new stream
    assert lab.set('stage', 'silence', 20.0)[0]
    stream = [*level(0.0, 12), *level(0.0, 3, segment='again'), *level(0.0, 2, 10**6, 'far')]
    for b in stream:
        lab.publish('voltage', b)
    # the first block that starts over cannot be told from a repetition where all are zero
    lab.wait(lambda: len(seen) >= before + len(stream), 'the answers')
    assert [b.segment for b in seen[before:]] == [b.segment for b in stream]
    idle(lab)


def test_a_second_publisher_is_refused_until_the_first_is_silent_and_at_rest(lab):
    idle(lab)
    seen, got = lab.collect('displacement'), lab.collect('applied_voltage')
    second = lab.node.create_publisher(Float64MultiArray, 'voltage', STREAM)
    lab.publish('voltage', level(0.0, 1)[0])
    lab.wait(second.get_subscription_count, 'the match')
    lab.wait(lambda: lab.diagnostics('stage').get('publishers') == '2', 'two publishers')
    told = idle(lab)
    try:
        before, applied = len(seen), len(got)
        mine = level(0.0, 40, segment='first')
        # slightly ahead, and far ahead
        others = [*level(3.0, 20, 30, 'second'), *level(3.0, 20, 100000, 'second')]
        for a, b in zip(mine, others, strict=True):
            lab.publish('voltage', a)
            second.publish(to_message(b))
        warned(lab, 'second publisher', told)
        lab.wait(lambda: len(seen) >= before + 40, 'the answers')
        lab.wait(lambda: len(got) >= applied + 40, 'what is applied')
        assert {b.segment for b in seen[before:]} == {'first'}
        assert column(got[applied:])[1].max() == 0.0
        idle(lab)
        # while the stage ramps behind a silence of the first
        (last,) = level(9.0, 1, 9100)
        for b in [*level(0.0, 1), block(100, np.linspace(0, 9, 9000)), last]:
            lab.publish('voltage', b)
        lab.wait(lambda: got[-1].values[-1] == 9.0, '9 V')
        lab.wait(lambda: seen[-1].t[0] >= last.t[0], 'the answer to it')
        before, told = len(seen), len(lab.statuses('stage'))
        assert lab.set('stage', 'ramp_slew', 2.0)[0]
        assert lab.set('stage', 'silence', 0.05)[0]
        lab.wait(lambda: got[-1].segment == 'ramp:silence', 'the ramp')
        second.publish(to_message(level(3.0, 1, 9200, 'second')[0]))
        warned(lab, 'second publisher', told)
        assert len(seen) == before
        assert lab.set('stage', 'ramp_slew', 20.0)[0]
        idle(lab)
        before, applied = len(seen) - 40, len(got)
        for b in level(3.0, 90, 200000, 'second'):
            second.publish(to_message(b))
        lab.wait(lambda: len(seen) >= before + 130, 'the second one alone')
        assert seen[-1].segment == 'second'
        lab.wait(lambda: got[-1].t[-1] == seen[-1].t[-1], 'what is applied')
        assert column(got[applied:])[1].max() == 3.0
    finally:
        lab.forget(second)
    idle(lab)
