# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Choose the held-out samples of unlabelled runs.

The rest of a run keeps most of the voltage range and most of the energy of every frequency band.
Without this rule a record that ends in its only chirp, or holds a single step, could lose the
motion that identifies G.
"""

from __future__ import annotations

from collections.abc import Sequence
import itertools

import numpy as np
from piezo_ident.common.arrays import Array, Mask
from piezo_ident.common.errors import IdentificationError
from piezo_ident.identification.prepare import Run
from piezo_ident.identification.settings import Settings
from piezo_ident.identification.spectra import HIGH_PASS, rms_above

#: smallest number of samples at the end of an unlabelled record that gives an error
MIN_HELD = 10
#: smallest number of samples for a fit
MIN_FIT = 100
#: share of its range by which the voltage of a run must move
MOVES = 0.02
#: most runs that are fitted, the widest range first
MOST_RUNS = 8
#: number of held-out stretches in a run (taste)
STRETCHES = 4
#: number of positions of the stretches that are tried, from the end backwards
PLACES = 20
#: edges of the bands [Hz] above `HIGH_PASS`, and the smallest rms of a band that counts,
#: normalised
EDGES, FAINT = (150.0, 750.0, 3000.0), 2e-4
#: share of the range, and of the energy of every band, that must stay in the rest (taste)
STAYS = 0.65


def fitted_parts(runs: Sequence[Run], settings: Settings) -> tuple[list[Run], list[Mask]]:
    """
    Choose the runs that are fitted, the widest first, and the fitted samples of each.

    With `hold_out` the end of each run is held out, else a few stretches spread over it.  Raises
    IdentificationError if the widest run has too few samples to fit or to judge by.
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
        if n_held < MIN_HELD or n_fit < MIN_FIT:
            if chosen:
                continue
            raise IdentificationError(
                f'{run.record}: holding out {held_time:.3g} s leaves {max(n_fit, 0)} samples to '
                f'fit and {min(n_held, piece.n)} to judge by, where {MIN_FIT} and {MIN_HELD} are '
                'needed; record longer, or hold out another time (--hold-out)'
            )
        if settings.hold_out:
            fitted = np.arange(piece.n) < n_fit
        else:
            fitted = ~held_out_stretches(run.u, rate, n_held)
        enough = float(np.ptp(run.u[fitted])) >= MOVES and (run.use & fitted).sum() >= MIN_FIT
        if enough or not chosen:
            chosen.append(run)
            masks.append(fitted)
    return chosen, masks


def held_out_stretches(u: Array, rate: float, n_held: int) -> Mask:
    """
    Mark the samples of a normalised voltage u that are held out, shape (n,).

    `n_held` samples are held out in a few stretches spread over the run.  The last stretch lies at
    the end if possible, because only the end shows drift.  All stretches move towards the
    beginning if the rest would otherwise lack motion that the stretches alone hold.
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
