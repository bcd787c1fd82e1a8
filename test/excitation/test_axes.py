# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Several axes play one program side by side."""

import itertools

import numpy as np
from piezo_ident.common.errors import ConfigError
from piezo_ident.excitation.axes import build_axes
from piezo_ident.excitation.program import parse_program, Program
import pytest

TWO = """
limits: [0, 10]
seed: 3
slew: 50
segments:
  - {signal: step, bias: 5, size: 1, hold: 0.02, count: 2}
  - {signal: noise, bias: 5, amplitude: 0.4, cutoff: 300, duration: 0.2}
  - {signal: multisine, bias: 4, amplitude: 3, lowest: 1, highest: 100, period: 0.5, periods: 2}
"""


def test_segments_meet_sample_by_sample_and_random_signals_differ():
    first, second = build_axes(parse_program(TWO), 2, 1000.0)
    assert first.segments == second.segments and first.n == second.n
    for segment in first.segments:
        cut = slice(segment.start, segment.stop)
        is_random = segment.kind in ('noise', 'multisine')
        same = np.array_equal(first.v[cut], second.v[cut])
        assert same != is_random or segment.kind == 'ramp'
    # where one axis waits for the other it holds its voltage
    assert max(np.abs(np.diff(s.v)).max() for s in (first, second)) < 1.1
    assert first.v[-1] == second.v[-1] == 0


def test_one_axis_plays_what_it_always_did():
    program = Program.load('validation')
    (only,) = build_axes(program, 1, 20e3)
    plain = program.build(20e3)
    np.testing.assert_array_equal(only.v, plain.v)
    assert only.segments == plain.segments


def test_all_lines_of_a_multisine():
    text = TWO.replace('period: 0.5,', 'lines: all, period: 0.5,')
    sequence = parse_program(text).build(1000.0)
    (part,) = (s for s in sequence.segments if s.kind == 'multisine')
    lines = np.abs(np.fft.rfft(sequence.v[part.start : part.start + 500]))
    assert (lines[1:51] > 0.5 * lines[1]).all() and lines[51:].max() < 1e-9 * lines[1]
    with pytest.raises(ConfigError, match='lines'):
        parse_program(TWO.replace('period: 0.5,', 'lines: even, period: 0.5,'))


def test_axes_that_play_in_turn_rest_while_another_one_moves():
    axes = build_axes(parse_program(TWO), 3, 1000.0, in_turn=True)
    n = parse_program(TWO).build(1000.0).n
    moves = np.array([axis.v != 0.0 for axis in axes])
    assert moves.any(axis=1).all() and not (moves.sum(axis=0) > 1).any()
    np.testing.assert_array_equal(axes[0].v[:n], parse_program(TWO).build(1000.0).v)
    assert all(axis.segments == axes[0].segments for axis in axes)
    assert [s.kind for s in axes[0].segments].count('noise') == 3
    ends = [(s.start, s.stop) for s in axes[0].segments]
    assert ends[0][0] == 0 and ends[-1][1] == axes[0].n
    assert all(one[1] == other[0] for one, other in itertools.pairwise(ends))
    labels = [s.label for s in axes[0].segments]
    assert all(one != other for one, other in itertools.pairwise(labels))
