# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Identify records without labelled segments: fit delay, dynamics and hysteresis together.

About a fifth of each record is held out.  `free_run_starts` fits candidates to at most `MOST` of
the other samples, and `selection.comparison` chooses one.  This candidate is fitted to all samples
that are not held out, and the held-out samples judge this fit.  A last fit has all samples.
"""

from __future__ import annotations

from collections.abc import Sequence
import itertools

import numpy as np
from piezo_ident.common.arrays import Array, Mask
from piezo_ident.common.errors import ConfigError, IdentificationError
from piezo_ident.fitting.free_run import fit
from piezo_ident.fitting.stage import PARTS
from piezo_ident.fitting.stretch import block_count, remembered, Stretch
from piezo_ident.identification.free_run_result import FreeRunFits, outcome_of
from piezo_ident.identification.free_run_starts import Allowed, Search, UNKNOWN
from piezo_ident.identification.prepare import MOVES, Run
from piezo_ident.identification.results import FitOutcome
from piezo_ident.identification.settings import Progress, Settings
from piezo_ident.identification.spectra import HIGH_PASS, rms_above
from piezo_ident.identification.step3_hysteresis import even_thresholds
from piezo_ident.model.scaling import REST, Scaling
from piezo_ident.operators.hysteresis_law import HysteresisLaw
from piezo_ident.record.readings.suspicions import rises_first
from piezo_ident.selection.motion_kinds import interleaved, motion_kinds

#: The search simulates records of at most `MOST` samples as a whole.  From longer records it takes
#: windows of at most `WINDOWED` samples together, and then lasts half a minute.  The final fits
#: have about `MOST_ROWS` rows at most
MOST, WINDOWED, MOST_ROWS = 100_000, 60_000, 400_000
#: number of blocks of all stretches together (taste); the search holds out a fifth of them in turn
BLOCKS = 50
#: number of plays of H, including the play at r = 0, unless the user sets it
PLAYS = 40
#: voltages over which H must rise, normalised: similar motion may leave the range slightly (taste)
SPAN = (-0.05, 1.05)
#: the first 1/`RINGING` of a window is not fitted, as earlier motion may still ring there (taste)
RINGING = 20
#: number of elements of creep that are tried, spread over the times of a record (one a decade)
ELEMENTS = 5
#: shortest time constant of creep [s]: faster motion is dynamics
FASTEST = 0.05
#: iterations of the fit to all samples, which starts at the fit without the held-out samples
LAST = 5
#: smallest number of samples at the end of an unlabelled record that gives an error
MIN_HELD = 10
#: smallest number of samples for a fit
MIN_FIT = 100
#: most runs that are fitted, the widest range first
MOST_RUNS = 8
#: number of held-out stretches in a run (taste)
STRETCHES = 4
#: number of positions of the stretches that are tried, from the end backwards
PLACES = 20
#: edges of the bands [Hz] above `HIGH_PASS`, and the smallest rms of a band that counts,
#: normalised
EDGES, FAINT = (150.0, 750.0, 3000.0), 2e-4
#: share of the range, and of the energy of every band, that the fitted samples must keep (taste)
STAYS = 0.65


def fit_free_run(
    runs: Sequence[Run], rate: float, scaling: Scaling, settings: Settings, progress: Progress
) -> FitOutcome:
    """
    Fit delay, dynamics and hysteresis together.

    Raises IdentificationError if the fitted or the held-out samples are too few, or the voltage
    does not move in them, and ConfigError for the swarm, which fits H alone.
    """
    if settings.solver == 'swarm':
        raise ConfigError(
            f'{runs[0].record}: the swarm fits H alone, so it needs segments labelled '
            'noise and triangle; take the solver least_squares, or label the segments'
        )
    chosen, parts = _fitted_parts(runs, settings)
    _refuse_rest(chosen, parts)
    stretches, guesses = _stretches(chosen, parts)
    search = _search(stretches, guesses, settings, progress)
    progress('delay', 1.0)
    best, candidates = search.best()
    progress('dynamics', 0.7)
    candidates += tuple(search.wider(best, _taus(stretches)))
    best = search.at_rest(candidates)
    candidates += (best,)
    progress('dynamics', 1.0)
    kept = _thinned(stretches)
    start = best.fit.stage
    start = start if search.stretches is stretches else start.on_other(stretches)
    judged = fit(start, kept)
    progress('hysteresis', 0.6)
    everything = _thinned([s.with_use(run.use) for s, run in zip(stretches, chosen, strict=True)])
    last = fit(judged.stage, everything, iterations=LAST)
    progress('hysteresis', 1.0)
    fits = FreeRunFits(chosen, parts, judged, last, candidates, best)
    return outcome_of(fits, runs, rate, scaling, settings)


def _refuse_rest(runs: Sequence[Run], parts: Sequence[Mask]) -> None:
    used = [run.u[run.use & mask] for run, mask in zip(runs, parts, strict=True)]
    swing = max((float(np.ptp(u)) for u in used if u.size), default=0.0)
    if swing < MOVES:
        raise IdentificationError(
            f'{runs[0].record}: the voltage moves by {swing:.1%} of its range in the fitted part; '
            'let it move there, or hold out less (--hold-out)'
        )


def _stretches(runs: Sequence[Run], parts: Sequence[Mask]) -> tuple[list[Stretch], Array]:
    """Turn runs into stretches with blocks of one length, and guess the memory of each."""
    size = max(1, sum(run.u.size for run in runs) // BLOCKS)
    stretches, guesses, count = [], np.full((len(runs), PARTS), UNKNOWN), 0
    for i, (run, mask) in enumerate(zip(runs, parts, strict=True)):
        n = max(1, round(run.u.size / size))
        block = count + np.minimum(np.arange(run.u.size) * n // run.u.size, n - 1)
        count += n
        stretches.append(Stretch(run.u, run.x, run.use & mask, block, run.piece.sample_rate, i, i))
        if abs(float(run.u[0])) < REST and not rises_first(run.piece):
            guesses[i] = 0.0
    return stretches, guesses


def _search(
    stretches: Sequence[Stretch], guesses: Array, settings: Settings, progress: Progress
) -> Search:
    swing = max(float(np.ptp(s.u[s.use])) for s in stretches if s.use.any())
    if sum(s.u.size for s in stretches) > MOST:
        stretches = _windows(stretches)
    law = HysteresisLaw('plays', even_thresholds(swing, settings.thresholds or PLAYS), SPAN)
    count = block_count(stretches)
    steps = 0

    def tick() -> None:
        nonlocal steps
        steps += 1
        # a search takes about a hundred steps
        progress('dynamics', 0.7 * steps / (100.0 + steps))

    allowed = Allowed(settings.delay, settings.order, settings.max_order)
    kinds = motion_kinds(stretches, count)
    return Search(stretches, interleaved(count), kinds, law, guesses, allowed, tick)


def _windows(stretches: Sequence[Stretch]) -> list[Stretch]:
    """Choose three windows: of the widest motion, of the fastest, and of the largest jump."""
    size = WINDOWED // 3
    parts = [
        (s, slice(start, min(start + size, s.u.size)))
        for s in stretches
        for start in range(0, max(1, s.u.size - size // 2), size)
    ]
    used = [int(s.use[part].sum()) for s, part in parts]
    # a long part that is held out may leave few samples in any window
    enough = min(size // 4 + 1, max(used))
    windows = [window for window, n in zip(parts, used, strict=True) if n >= enough]
    spans = [float(np.ptp(s.u[part])) for s, part in windows]
    speeds = [float(np.mean(np.diff(s.u[part]) ** 2)) for s, part in windows]
    jumps = [float(np.max(np.abs(np.diff(s.u[part])))) for s, part in windows]
    order = [int(np.argmax(x)) for x in (spans, speeds, jumps)]
    order += sorted(range(len(windows)), key=lambda i: -spans[i] * speeds[i])
    chosen = list(dict.fromkeys(order))[:3]
    short = []
    for number, i in enumerate(sorted(chosen)):
        s, part = windows[i]
        # windows are short: finer blocks allow more of them to be held out
        length = s.u[part].size
        block = (number * length + np.arange(length)) * (BLOCKS // 3) // length
        use, before = s.use[part].copy(), np.empty(0)
        if part.start:
            before = remembered(s.u[: part.start + 1])
            # ringing from before the window is unknown
            use[: length // RINGING] = False
        short.append(Stretch(s.u[part], s.x[part], use, block, s.rate, number, s.record, before))
    return short


def _thinned(stretches: Sequence[Stretch]) -> list[Stretch]:
    """Thin stretches to about `MOST_ROWS` samples that count, in whole pieces of each block."""
    n = sum(int(s.use.sum()) for s in stretches)
    piece, every, golden = 200, max(1, -(-n // MOST_ROWS)), 0.5 + np.sqrt(1.25)
    # multiples of the golden ratio choose pieces at all phases of a periodic motion
    chosen = [np.arange(s.u.size) // piece * golden % 1.0 < 1.0 / every for s in stretches]
    return [s.with_use(s.use & kept) for s, kept in zip(stretches, chosen, strict=True)]


def _taus(stretches: Sequence[Stretch]) -> Array:
    longest = max(s.u.size / s.rate for s in stretches)
    shortest = max(FASTEST, 10.0 / stretches[0].rate)
    return np.geomspace(shortest, max(longest, 10.0 * shortest), ELEMENTS)


def _fitted_parts(runs: Sequence[Run], settings: Settings) -> tuple[list[Run], list[Mask]]:
    """
    Choose the widest runs, in the order of recording, and the fitted samples of each.

    With `hold_out` the end of each run is held out, else a few stretches spread over it.  Raises
    IdentificationError if every run has too few samples to fit or to judge by.
    """
    ranked = sorted(runs, key=lambda r: (round(float(np.ptp(r.u)), 2), r.piece.n), reverse=True)
    masks: dict[Run, Mask] = {}
    refusal: IdentificationError | None = None
    for run in ranked:
        piece, rate = run.piece, run.piece.sample_rate
        held_time = settings.hold_out or min(max(1.5, 0.2 * piece.duration), 0.25 * piece.duration)
        n_held = round(held_time * rate)
        n_fit = piece.n - n_held
        if n_held < MIN_HELD or n_fit < MIN_FIT:
            refusal = refusal or IdentificationError(
                f'{run.record}: holding out {held_time:.3g} s leaves {max(n_fit, 0)} samples to '
                f'fit and {min(n_held, piece.n)} to judge by, where {MIN_FIT} and {MIN_HELD} are '
                'needed; record longer, or hold out another time (--hold-out)'
            )
            continue
        fitted = np.arange(piece.n) < n_fit
        if not settings.hold_out:
            fitted = ~held_out_stretches(run.u, rate, n_held)
        enough = float(np.ptp(run.u[fitted])) >= MOVES and (run.use & fitted).sum() >= MIN_FIT
        if len(masks) < MOST_RUNS and (enough or not masks):
            masks[run] = fitted
    if refusal and not masks:
        raise refusal
    # the model takes the zero of displacement of the last run
    chosen = [run for run in runs if run in masks]
    return chosen, [masks[run] for run in chosen]


def held_out_stretches(u: Array, rate: float, n_held: int) -> Mask:
    """
    Mark the samples of a normalised voltage u that are held out, shape (n,).

    `n_held` samples are held out in a few stretches spread over the run.  The last stretch lies at
    the end if possible, because only the end shows drift.  The fitted samples must keep the share
    `STAYS` of the range and of the energy of each frequency band, because G needs the only chirp
    of a record.  If they lose more, all stretches move towards the beginning.
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
