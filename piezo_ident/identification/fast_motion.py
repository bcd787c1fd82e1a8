# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
What is fast in a record: jumps, chirps, multisines, noise, turning points.

Both sides of G pass the same high-pass, so that slow errors of H and creep stay outside; G is
still what leads from one to the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import itertools

import numpy as np
from piezo_ident.common.arrays import Array, Mask
from piezo_ident.identification.prepare import Excerpt
from piezo_ident.identification.step1_delay import find_jumps
from scipy import ndimage, signal

#: below this the signals are taken away before G is fitted [Hz]
HIGH_PASS = 30.0
#: time after a jump in which the dynamics are looked for [s]
WINDOW = 0.1
#: rms above `HIGH_PASS` from which the voltage excites the dynamics, normalised
FAST = 2e-3
#: further edges of the bands whose motion is searched [Hz], and the rms they need
EDGES, FAINT = (150.0, 750.0, 3000.0), 2e-4
#: share of motion above the first of these edges from which it is more than a slow sweep
PURE = 0.3
#: samples of fast motion that the search uses
MOST = 100_000
#: after this time a voltage that moves by less than this share of its range rests [s]
SETTLED, STILL = 0.2, 1e-3
#: time ahead of the samples that count, in which the start of G dies away [s]
WARM_UP = 0.15
#: time of a block [s], and how many blocks share one that is held out: what a chirp passes, and
#: a ring that dies away, has to be seen on both sides
BLOCK, EVERY = 0.005, 4


def moving(u: Array, rate: float, swing: float) -> Mask:
    """
    Return the samples at which the voltage moves, or did a moment ago.

    Of a rest only its beginning counts: what a stage does there later is creep, and a long rest
    would outweigh the motion.  All samples count where hardly any would be left.
    """
    width = max(2, int(SETTLED * rate))
    behind = {'size': width, 'origin': (width - 1) // 2, 'mode': 'nearest'}
    span = ndimage.maximum_filter1d(u, **behind) - ndimage.minimum_filter1d(u, **behind)
    found = span > STILL * swing
    return np.asarray(found if found.sum() > u.size // 10 else np.ones(u.size, dtype=bool))


def rms_above(u: Array, rate: float, edge: float) -> Array:
    """Return the rms above a frequency around each sample."""
    if 4.0 * edge > rate:
        return np.zeros(u.size)
    width = max(1, int(WINDOW * rate))
    sos = signal.butter(2, edge, btype='highpass', fs=rate, output='sos')
    # both ways, with the ends turned over: a record that starts on the move does not jump there
    pad = min(u.size - 1, int(3.0 * rate / edge))
    power = ndimage.uniform_filter1d(signal.sosfiltfilt(sos, u, padlen=pad) ** 2, width)
    return np.asarray(np.sqrt(np.maximum(power, 0.0)))


def behind_jumps(u: Array, rate: float) -> Mask:
    """Return the samples behind each jump of the voltage."""
    use = np.zeros(u.size, dtype=bool)
    before = min(50, u.size // 10)
    for k in find_jumps(u, before, min(20, u.size // 10)):
        use[max(0, k - before) : k + int(WINDOW * rate)] = True
    return use


@dataclass(frozen=True, eq=False)
class FastAndCalm:
    """Of each run, the samples whose motion is fast, and those that are slow enough for H."""

    fast: list[Mask]
    calm: list[Mask]

    @classmethod
    def of(cls, excerpts: Sequence[Excerpt], rate: float, swing: float) -> FastAndCalm:
        """Return them for the fitted parts of runs; `swing` is the range of the voltage."""
        jumps = [behind_jumps(e.u, rate) & e.use for e in excerpts]
        rms = [rms_above(e.u, rate, HIGH_PASS) for e in excerpts]
        quiet = np.concatenate(
            [r[e.use & ~j] for e, r, j in zip(excerpts, rms, jumps, strict=True)]
        )
        fast = jumps
        broad = quiet.size > 0 and bool(
            np.sqrt(np.mean(quiet**2)) > FAST or quiet.max() > 2 * FAST
        )
        if broad:
            pure = [_purity(e.u, rate) > PURE for e in excerpts]
            if sum(int((p | j).sum()) for p, j in zip(pure, jumps, strict=True)) <= WINDOW * rate:
                pure = [e.use for e in excerpts]
            fast = _spread(excerpts, pure, jumps, rate)
            fast = [f & e.use for f, e in zip(fast, excerpts, strict=True)]
        calm = [e.use & (r < FAST) for e, r in zip(excerpts, rms, strict=True)]
        # where the stage lags behind a fast drive, H alone would take the lag for hysteresis
        slow = [float(np.ptp(e.u[c])) for e, c in zip(excerpts, calm, strict=True) if c.any()]
        enough = sum(int(c.sum()) for c in calm) > sum(e.u.size for e in excerpts) // 20
        if not broad or not enough or max(slow, default=0.0) < 0.8 * swing:
            calm = [e.use for e in excerpts]
        # every run keeps some, for its offset
        calm = [c if c.any() else e.use for e, c in zip(excerpts, calm, strict=True)]
        return cls(fast, calm)


def _purity(u: Array, rate: float) -> Array:
    """Return the share of fast motion in all motion around each sample: H errs with the rest."""
    width = max(1, int(WINDOW * rate))
    u = u - u.mean()
    power = ndimage.uniform_filter1d(u**2, width) - ndimage.uniform_filter1d(u, width) ** 2
    return np.asarray(rms_above(u, rate, EDGES[0]) / np.sqrt(np.maximum(power, 1e-12)))


def _spread(
    excerpts: Sequence[Excerpt], pure: Sequence[Mask], jumps: Sequence[Mask], rate: float
) -> list[Mask]:
    """Return the jumps, and blocks all over the motion of each band: a chirp passes them all."""
    size = max(1, int(0.2 * WINDOW * rate))
    above = [[rms_above(e.u, rate, edge) ** 2 for e in excerpts] for edge in (HIGH_PASS, *EDGES)]
    above.append([np.zeros(e.u.size) for e in excerpts])
    places = [np.arange(0, e.u.size, size) for e in excerpts]
    chosen = np.zeros(sum(p.size for p in places), dtype=bool)
    for band, higher in itertools.pairwise(above):
        power = np.concatenate(
            [
                np.maximum.reduceat((b - h) * p, at)
                for b, h, p, at in zip(band, higher, pure, places, strict=True)
            ]
        )
        if power.max() > FAINT**2:
            found = np.flatnonzero(power > 0.1 * power.max())
            quota = max(1, MOST // size // (len(EDGES) + 1))
            chosen[found[:: 1 + (found.size - 1) // quota]] = True
    parts = np.split(chosen, np.cumsum([p.size for p in places])[:-1])
    return [
        jump | np.repeat(part, size)[: jump.size] for jump, part in zip(jumps, parts, strict=True)
    ]


@dataclass(frozen=True, eq=False)
class FastMotion:
    """
    What G is found from: pieces of w = H[v] and of the displacement, sampled at a rate [Hz].

    They are there with all samples that count, with those fitted, and with those that judge.
    """

    whole: list[Excerpt]
    fitted: list[Excerpt]
    held: list[Excerpt]
    rate: float

    @classmethod
    def of(cls, signals: Sequence[Excerpt], rate: float) -> FastMotion:
        """Return the motion in the samples that count, high-passed, blocks of it held out."""
        whole, fitted, held = [], [], []
        warm_up = int(WARM_UP * rate)
        for e in signals:
            w, x = (high_passed(z, rate) for z in (e.u, e.x))
            out = _held_blocks(e, max(1, int(BLOCK * rate)))
            whole += _cut(w, x, e.use, warm_up)
            fitted += _cut(w, x, e.use & ~out, warm_up)
            held += _cut(w, x, e.use & out, warm_up)
        return cls(whole, fitted, held, rate)


def high_passed(x: Array, rate: float) -> Array:
    """Return a signal above `HIGH_PASS`; all but its start where the rate is too low for that."""
    if 4.0 * HIGH_PASS > rate:
        return np.asarray(x - x[0])
    sos = signal.butter(2, HIGH_PASS, btype='highpass', fs=rate, output='sos')
    return np.asarray(signal.sosfilt(sos, x - x[0]))


def _held_blocks(e: Excerpt, size: int) -> Mask:
    """Return blocks all over the samples that count; a short stretch is one block."""
    held = np.zeros(e.use.size, dtype=bool)
    i = 0
    for start, stop in e.joined:
        count = max(1, round((stop - start) / size))
        edges = np.linspace(start, stop, count + 1).astype(int)
        for a, b in itertools.pairwise(edges):
            i += 1
            held[a:b] = i % EVERY == 0
    return held


def _cut(w: Array, x: Array, use: Mask, warm_up: int) -> list[Excerpt]:
    """Return the samples that count with what comes before them, without the rest."""
    pieces: list[list[int]] = []
    for start, stop in Excerpt(w, x, use).joined:
        begin = max(0, start - warm_up)
        if pieces and begin <= pieces[-1][1]:
            pieces[-1][1] = stop
        else:
            pieces.append([begin, stop])
    return [Excerpt(w[a:b], x[a:b], use[a:b]) for a, b in pieces]
