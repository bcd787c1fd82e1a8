# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The driver of the documentation in the place of the stage, and what it guarantees."""

import itertools
from pathlib import Path
import signal
import sys

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='rclpy cannot be imported: no ROS here')

from graph import Graph, Handle
from piezo_ident.excitation.program import parse_program
from piezo_ident.record.blocks import Samples

ROOT = Path(__file__).resolve().parents[3]
EXAMPLE = ROOT / 'examples/daq_driver.py'
FS = 20_000.0
#: longer than a busy machine keeps a test from its next block
SILENCE = 5.0
RAMP = 20.0
PROGRAM = """
limits: [0, 10]
segments:
  - {signal: idle, duration: 0.1}
  - {signal: sine, bias: 5, amplitude: 4, frequency: 5, duration: 0.4}
"""


@pytest.fixture(scope='module')
def lab():
    with Graph() as g:
        for topic in ('voltage', 'displacement', 'applied_voltage'):
            g.collect(topic)
        command = [sys.executable, str(EXAMPLE), '--ros-args', '-p', f'silence:={SILENCE}']
        g.follow('stage', 'stage')
        g.handles.append(Handle(g, 'stage', command, g.folder / 'driver.log'))
        g.wait(lambda: g.statuses('stage'), 'the driver')
        # few blocks: a busy machine keeps up with them
        options = {'program': PROGRAM, 'subscribers': 3, 'block_size': 1000}
        g.start_all(('identifier',), ('excitation', options))
        for topic in ('displacement', 'applied_voltage'):
            g.matched(topic)
        yield g


@pytest.fixture
def begin(lab):
    """Start the driver afresh, and return how many blocks came before."""
    lab.handle('stage').stop()
    lab.restart(lab.handle('stage'))
    topics = ('displacement', 'applied_voltage')
    for topic in topics:
        lab.matched(topic)
    return {topic: len(lab.collect(topic)) for topic in topics}


def column(blocks: list[Samples], name: str = 'values') -> np.ndarray:
    return np.concatenate([getattr(b, name) for b in blocks] or [np.empty(0)])


def block(tick: int, v: np.ndarray | float, n: int = 100, segment: str = 'hold') -> Samples:
    return Samples(np.arange(tick, tick + n) / FS, np.full(n, 0.0) + v, segment)


def send(g: Graph, volts: list[float]) -> None:
    """Publish blocks of a hundred samples from t = 0 on, no faster than they are answered."""
    y = g.collect('displacement')
    want = len(y)
    for k, v in enumerate(volts):
        g.publish('voltage', block(100 * k, v))
        want += 1
        if k % 20 == 19:
            g.wait(lambda n=want: len(y) >= n, 'answers')


def at_rest(g: Graph) -> bool:
    applied = g.collect('applied_voltage')
    return bool(applied) and applied[-1].values[-1] == 0.0


def test_what_a_killed_driver_left_on_the_card_is_ramped_to_rest(tmp_path):
    text = EXAMPLE.read_text(encoding='utf-8')
    driver = tmp_path / 'driver.py'
    driver.write_text(text.replace('return rest  #', 'return 1.5  #'), encoding='utf-8')
    with Graph() as g:
        applied = g.collect('applied_voltage')
        # until the test listens
        command = [sys.executable, str(driver), '--ros-args', '-p', 'silence:=600.0']
        g.follow('stage', 'stage')
        g.handles.append(Handle(g, 'stage', command, g.folder / 'driver.log'))
        g.matched('applied_voltage')
        assert g.set('stage', 'silence', 0.05)[0]
        g.wait(lambda: at_rest(g), 'rest')
        v = column(applied)
        assert v.max() <= 1.5
        assert np.abs(np.diff(v)).max() <= 1.001 * RAMP / FS
        assert applied[0].segment == 'ramp:silence'


def test_a_program_is_followed_bit_by_bit(lab):
    voltage = lab.collect('voltage')
    n = parse_program(PROGRAM).build(FS).n
    assert lab.call('excitation/start')[0]
    lab.wait(lambda: lab.status('excitation')['state'] == 'done', 'the program')
    applied, y = lab.collect('applied_voltage'), lab.collect('displacement')
    for stream in (voltage, applied, y):
        lab.wait(lambda s=stream: column(s).size >= n, 'the whole program')
    assert [b.segment for b in y] == [b.segment for b in voltage]
    assert column(applied).tobytes() == column(voltage).tobytes()
    for back in (applied, y):
        assert column(back, 't').tobytes() == column(voltage, 't').tobytes()
    np.testing.assert_array_equal(column(y), 7.5e-6 * column(voltage))
    seconds = f'{n / FS:.3f} s'
    lab.wait(lambda: lab.status('identifier')['text'].count(seconds) >= 2, 'both streams captured')


def test_a_second_publisher_is_refused(lab, begin):
    y, before = lab.collect('displacement'), begin['displacement']
    assert lab.set('excitation', 'program', PROGRAM.replace('0.4', '120'))[0]
    assert lab.call('excitation/start')[0]
    # for its first second a driver gives way to another
    lab.wait(lambda: len(y) > before + 30, 'a stream')
    ticks = itertools.count(10_000_000, 100)
    # the first ones may be sent before the stage knows of this publisher
    lab.wait(
        lambda: any('second publisher' in s['text'] for s in lab.statuses('stage')),
        'refusal',
        meanwhile=lambda: lab.publish('voltage', block(next(ticks), 0.5, segment='foreign')),
    )
    seen = len(y)
    lab.wait(lambda: len(y) > seen + 20, 'the stream going on')
    assert 'foreign' not in {b.segment for b in y}
    assert np.all(np.diff(column(y[before:], 't')) > 0)
    # from here on the tests drive alone
    assert lab.handle('excitation').stop() == 0


def test_a_block_of_another_quantity_is_no_voltage(lab, begin):
    lab.publish('voltage', Samples(np.arange(100) / FS, np.full(100, 9.0), 'hold', 'displacement'))
    lab.wait(
        lambda: any(
            "of 'displacement', expected is voltage" in s['text'] for s in lab.statuses('stage')
        ),
        'refusal',
    )
    assert len(lab.collect('displacement')) == begin['displacement']


def test_silence_and_what_comes_after_it(lab, begin):
    applied, y = lab.collect('applied_voltage'), lab.collect('displacement')
    # up by a ramp, too high, and then nothing more
    send(lab, [9.0] * 60 + [11.0] * 20)
    seen = len(lab.statuses('stage'))
    assert lab.set('stage', 'silence', 0.05)[0]
    lab.until('stage', 'ramping', since=seen)
    lab.wait(lambda: at_rest(lab), 'rest')
    new = applied[begin['applied_voltage'] :]
    v = column(new)
    assert v.max() <= 10.0
    # no sample is faster than the ramps allow but where the stream itself steps from 9 V to 10 V
    steps = np.abs(np.diff(v)) * FS
    assert np.count_nonzero(steps > 1.01 * RAMP) == 1
    assert {b.segment for b in new} == {'hold', 'ramp:silence'}
    assert len(y) == begin['displacement'] + 80
    # t goes on without a gap, so that the two topics join
    np.testing.assert_allclose(np.diff(column(new, 't')), 1 / FS, rtol=1e-6)


def test_a_stream_joins_by_a_ramp_within_limits_that_were_just_set(lab, begin):
    assert not lab.set('stage', 'voltage_low', 20.0)[0]
    assert lab.set('stage', 'voltage_high', 5.0)[0]
    try:
        send(lab, [9.0] * 160)
    finally:
        assert lab.set('stage', 'voltage_high', 10.0)[0]
    joined = column(lab.collect('applied_voltage')[begin['applied_voltage'] :])
    assert np.abs(np.diff(joined)).max() * FS <= 1.01 * RAMP
    assert joined.max() == joined[:16_000][-1] == 5.0


def test_it_ends_at_rest(lab, begin):
    send(lab, [9.0] * 100)
    driver = lab.handle('stage')
    assert driver.stop(signal.SIGTERM) == 0 and not driver.complaints
    lab.wait(lambda: at_rest(lab), 'rest')
