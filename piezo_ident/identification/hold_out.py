# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
What is held out of unlabelled runs: the end, unless the rest would lack what only it excites.

A record that ends in its only chirp would lose G to its own test.  Then another stretch of the
same length is held out, one that leaves most of every band and of the range in the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
import itertools

import numpy as np
from piezo_ident.common.arrays import Array, Mask
from piezo_ident.common.errors import IdentificationError
from piezo_ident.identification.fast_motion import EDGES, FAINT, HIGH_PASS, rms_above
from piezo_ident.identification.prepare import Run
from piezo_ident.identification.results import Settings

#: samples at the end of an unlabelled record that an error needs at least
MIN_HELD = 10
#: samples that a fit needs at least
MIN_FIT = 100
#: share of its range by which the voltage of a run has to move
MOVES = 0.02
#: runs that are fitted, those of the widest range first
MOST_RUNS = 8
#: stretches that are held out of a run together (taste)
STRETCHES = 4
#: places that are tried, from the end backwards
PLACES = 20
#: share of the range, and of the energy of every band, that has to stay in the rest
STAYS = 0.65
#: share of the mean travel that the held-out stretch needs to be a test
TRAVELS = 0.3


def fitted_parts(
    runs: Sequence[Run], settings: Settings, spread: bool = False
) -> tuple[list[Run], list[Mask]]:
    """
    Return the runs that are fitted, the widest first, and which samples of each.

    With `hold_out` set it is always the end that is held out.  `spread`: else a few stretches all
    over each run.  IdentificationError when what is
    left of the widest to fit or to judge by is too short.
    """
    ranked = sorted(runs, key=lambda r: (round(float(np.ptp(r.u)), 2), r.piece.n), reverse=True)
    chosen: list[Run] = []
    masks: list[Mask] = []
    for run in ranked[:MOST_RUNS]:
        piece, rate = run.piece, run.piece.sample_rate
        share = max(1.5, 0.2 * piece.duration)
        held_time = settings.hold_out or min(share, 0.25 * piece.duration)
        n_held = round(held_time * rate)
        n_fit = piece.n - n_held
        if n_held >= MIN_HELD and n_fit >= MIN_FIT:
            fitted = np.ones(piece.n, dtype=bool)
            if spread and not settings.hold_out:
                # the end is among them: stretches in between would not show what drifts
                for stop in np.linspace(0, piece.n, STRETCHES + 1).astype(int)[1:]:
                    fitted[stop - n_held // STRETCHES : stop] = False
            else:
                start = n_fit if settings.hold_out else held_out_place(run.u, rate, n_held)
                fitted[start : start + n_held] = False
            enough = float(np.ptp(run.u[fitted])) >= MOVES and (run.use & fitted).sum() >= MIN_FIT
            if enough or not chosen:
                chosen.append(run)
                masks.append(fitted)
        elif run is not ranked[0]:
            continue
        elif n_held < MIN_HELD:
            raise IdentificationError(
                f'{run.record}: holding out {held_time:.3g} s leaves {n_held} samples to judge '
                f'by; hold out at least {MIN_HELD / rate:.3g} s (--hold-out)'
            )
        else:
            raise IdentificationError(
                f'{run.record}: {piece.n} samples, of which {max(n_fit, 0)} are left to fit after '
                f'holding out {held_time:.3g} s; record longer or hold out less (--hold-out)'
            )
    return chosen, masks


def held_out_place(u: Array, rate: float, n_held: int) -> int:
    """Return where a stretch of `n_held` samples of a normalised voltage u is best held out."""
    n = u.size
    above = [rms_above(u, rate, edge) ** 2 for edge in (HIGH_PASS, *EDGES)]
    bands = [np.maximum(b - h, 0.0) for b, h in itertools.pairwise([*above, np.zeros(n)])]
    energy = [np.cumsum(np.concatenate([[0.0], b])) for b in bands if b.max() > FAINT**2]
    travel = np.cumsum(np.concatenate([[0.0], np.abs(np.diff(u, prepend=u[0]))]))
    best, best_share = n - n_held, -1.0
    for start in np.linspace(n - n_held, 0, PLACES).astype(int):
        stop = start + n_held
        rest = np.concatenate([u[:start], u[stop:]])
        moved = (travel[stop] - travel[start]) / n_held
        if moved < TRAVELS * travel[-1] / n:
            continue
        share = min(
            [float(np.ptp(rest) / max(float(np.ptp(u)), np.finfo(float).tiny)) ** 4]
            + [float(1.0 - (e[stop] - e[start]) / e[-1]) for e in energy]
        )
        if share >= STAYS:
            return int(start)
        if share > best_share:
            best, best_share = int(start), share
    return best
