# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
What is held out of unlabelled runs: stretches that leave most of every band and of the range.

A record that ends in its only chirp would lose G to its own test, and one with a single step too.
"""

from __future__ import annotations

from collections.abc import Sequence
import itertools

import numpy as np
from piezo_ident.common.arrays import Array, Mask
from piezo_ident.common.errors import IdentificationError
from piezo_ident.identification.prepare import Run
from piezo_ident.identification.results import Settings
from piezo_ident.identification.spectra import HIGH_PASS, rms_above

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
#: places of the stretches that are tried, from the end backwards
PLACES = 20
#: edges of the bands [Hz] above `HIGH_PASS`, and the rms of a band that counts, normalised
EDGES, FAINT = (150.0, 750.0, 3000.0), 2e-4
#: share of the range, and of the energy of every band, that has to stay in the rest (taste)
STAYS = 0.65


def fitted_parts(runs: Sequence[Run], settings: Settings) -> tuple[list[Run], list[Mask]]:
    """
    Return the runs that are fitted, the widest first, and which samples of each.

    With `hold_out` set the end is held out, else a few stretches all over each run.
    IdentificationError when what is left of the widest to fit or to judge by is too short.
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
            if settings.hold_out:
                fitted = np.arange(piece.n) < n_fit
            else:
                fitted = ~held_out_stretches(run.u, rate, n_held)
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


def held_out_stretches(u: Array, rate: float, n_held: int) -> Mask:
    """
    Return which samples of a normalised voltage u are held out, shape (n,).

    They are `n_held` samples in a few stretches all over the run.  The end is among them where it
    can be: stretches in between would not show what drifts.  Where the rest would lack what only
    they excite, all stretches move towards the beginning.
    """
    n, size = u.size, n_held // STRETCHES
    ends = np.linspace(0, n, STRETCHES + 1).astype(int)[1:]
    above = [rms_above(u, rate, edge) ** 2 for edge in (HIGH_PASS, *EDGES)]
    bands = [np.maximum(b - h, 0.0) for b, h in itertools.pairwise([*above, np.zeros(n)])]
    bands = [b for b in bands if b.max() > FAINT**2]
    swing = max(float(np.ptp(u)), np.finfo(float).tiny)
    best, best_share = np.zeros(n, dtype=bool), -1.0
    for shift in np.linspace(0, n // STRETCHES - size, PLACES).astype(int):
        held = np.zeros(n, dtype=bool)
        for end in ends - shift:
            held[end - size : end] = True
        share = min([float(np.ptp(u[~held])) / swing, *(b[~held].sum() / b.sum() for b in bands)])
        if share >= STAYS:
            return held
        if share > best_share:
            best, best_share = held, share
    return best
