# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Build one program for several axes: the same segments, with random signals for each axis."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from piezo_ident.common.errors import ConfigError
from piezo_ident.excitation.program import Program, Sequence
from piezo_ident.record.record import Segment


def build_axes(
    program: Program,
    count: int,
    sample_rate: float | None = None,
    limits: tuple[float, float] | None = None,
    *,
    in_turn: bool = False,
) -> tuple[Sequence, ...]:
    """
    Build one sequence for each of several axes, with the same segments at the same samples.

    Each axis has noise and multisines of its own, so a record shows which voltage moved which
    axis.  All other signals are the same on every axis.  With `in_turn` the axes play the program
    one after the other, while the other axes rest.  For a single axis the result equals
    `Program.build`.  Limits and errors are those of `Program.build`.

    >>> import piezo_ident as pi
    >>> first, second = build_axes(pi.Program.load('two_axes'), 2)
    >>> first.segments == second.segments, bool((first.v == second.v).all())
    (True, False)
    >>> one_by_one = build_axes(pi.Program.load('two_axes'), 2, in_turn=True)
    >>> bool((one_by_one[0].v * one_by_one[1].v == 0.0).all())
    True
    """
    seeds: list[int | list[int]] = [program.seed, *([program.seed, i] for i in range(1, count))]
    built = [program.build(sample_rate, np.random.default_rng(seed), limits) for seed in seeds]
    if in_turn:
        return _in_turn(built, program.rest)
    if len({tuple(s.label for s in sequence.segments) for sequence in built}) > 1:
        raise ConfigError(
            f'{program.name}: one axis needs a ramp where another needs none; move the bias'
        )
    # the ramp to the first value of a random signal has another length on each axis
    lengths = [max(s.n for s in same) for same in zip(*(q.segments for q in built), strict=True)]
    return tuple(_stretched(sequence, lengths) for sequence in built)


def _in_turn(built: list[Sequence], rest: float) -> tuple[Sequence, ...]:
    """Put sequences one after the other; each axis rests while another one plays."""
    segments: list[Segment] = []
    n = 0
    for sequence in built:
        for s in sequence.segments:
            if segments and segments[-1].label == s.label:
                # no two neighbours share a label
                segments[-1] = replace(segments[-1], stop=n + s.stop)
            else:
                segments.append(Segment(s.label, n + s.start, n + s.stop))
        n += sequence.n

    def alone(one: Sequence) -> Sequence:
        parts = [q.v if q is one else np.full(q.n, rest) for q in built]
        return replace(one, v=np.concatenate(parts), segments=tuple(segments))

    return tuple(map(alone, built))


def _stretched(sequence: Sequence, lengths: Iterable[int]) -> Sequence:
    """Lengthen the segments of a sequence by their last voltage."""
    parts, segments, n = [], [], 0
    for s, length in zip(sequence.segments, lengths, strict=True):
        parts.append(np.pad(sequence.v[s.start : s.stop], (0, length - s.n), mode='edge'))
        segments.append(Segment(s.label, n, n + length))
        n += length
    return replace(sequence, v=np.concatenate(parts), segments=tuple(segments))
