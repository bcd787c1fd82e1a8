# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Effects that were found in the beginnings of long records, fitted to whole records.

What creeps for an hour does not show in its first minutes.  The search is over; some hundred runs
over everything are left, window by window, and no signal is kept from one to the next.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.errors import IdentificationError
from piezo_ident.diagnosis.beginnings import rest_of
from piezo_ident.diagnosis.fit import base_at, fit_jointly, Fitted
from piezo_ident.diagnosis.rows import make_rows, Rows
from piezo_ident.diagnosis.search import afresh
from piezo_ident.diagnosis.simulator import Simulator, State
from piezo_ident.effects import Effect
from piezo_ident.identification.results import Progress
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.record import Record

__all__ = ['Whole', 'fitted_to_all']

#: iterations of each fit: a run over an hour takes seconds
ITERATIONS = 2
#: a row is left out where it leaves both neighbours by so many times what others mostly do
OUT = 10.0
#: runs over everything after which half of the work passes for done
HALF = 100


class _Frugal(Simulator):
    """A simulator that keeps nothing from run to run, and says how far it is."""

    def __init__(self, model: StageModel, rows: Rows, tick: Callable[[int], None]) -> None:
        super().__init__(model, rows)
        self._tick = tick

    def windows(self, state: State, run_index: int) -> Iterator[NDArray[np.float64]]:
        for x in super().windows(state, run_index):
            self._tick(x.size)
            yield x

    def remember(self, state: State) -> NDArray[np.float64]:
        self._state = state
        return self.run(state)

    def varied(self, state: State, effect: type[Effect] | None) -> NDArray[np.float64]:
        return self.run(state)


@dataclass(frozen=True, eq=False)
class Whole:
    """
    Fits to whole records.

    Attributes
    ----------
    simulator : Simulator
        Of the whole records.
    e : ndarray, shape (n,)
        Residual of the rows under the model as given, normalised.
    base, fitted : Fitted
        Without the effects, and with them.
    """

    simulator: Simulator
    e: NDArray[np.float64]
    base: Fitted
    fitted: Fitted


def fitted_to_all(
    simulator: Simulator,
    given: State,
    base: Fitted,
    fitted: Fitted,
    records: Sequence[Record],
    used: Sequence[Record],
    lines: Sequence[float],
    progress: Progress,
) -> Whole | None:
    """
    Return fits to whole records, None where they predict these records no better.

    Parameters
    ----------
    simulator : Simulator
        Of the beginnings; it forgets what it has kept.
    given : State
        The model as it was given.
    base, fitted : Fitted
        To the beginnings, without effects and with them.
    records, used : sequence of Record
        Whole records, and their beginnings.
    lines : sequence of float
        Lines in the residual [Hz].
    progress : callable

    Raises
    ------
    IdentificationError, ModelError
        When the whole records cannot be fitted though their beginnings can.
    """
    simulator.forget()
    model, done = simulator.model, 0.0
    total = sum(record.n for record in records)

    def tick(n: int) -> None:
        nonlocal done
        done += n / total / HALF
        progress('whole records', 1.0 - 0.5**done)

    rows = make_rows(model, records)
    if rows.names != simulator.rows.names:
        raise IdentificationError('some records only begin behind their beginnings')
    bad = _standing_out(rows, _Frugal(model, rows, tick).run(fitted.state))
    if any(out.any() for out in bad):
        rows = make_rows(model, records, bad)
    whole = _Frugal(model, rows, tick)
    e = rows.x - whole.run(given)
    without = _fit(whole, base.state)
    found = _fit(whole, fitted.state)
    for i in range(len(found.state.effects)):
        for fresh in afresh(whole, found, i, lines, lambda: None, ITERATIONS):
            if fresh.mean_square < found.mean_square:
                found = fresh
    # rows of an hour are long: what is fast must not have been bent by them
    before, after = (
        rest_of(simulator.model_of(state), records, used, lambda: tick(0)).all
        for state in (fitted.state, found.state)
    )
    return Whole(whole, e, without, found) if after < before else None


def _fit(simulator: Simulator, state: State) -> Fitted:
    return fit_jointly(simulator, state, base_at(simulator, state), iterations=ITERATIONS)


def _standing_out(rows: Rows, prediction: NDArray[np.float64]) -> list[NDArray[np.bool_]]:
    """Return for each run the samples of rows that stand out from both of their neighbours."""
    e = rows.x - prediction
    padded = np.concatenate([e[:1], e, e[-1:]])
    jump = np.abs(e - np.median([padded[:-2], e, padded[2:]], axis=0))
    jumps = jump[jump > 0.0]
    wrong = jump > OUT * max(np.quantile(jumps, 0.95), 1e-300) if jumps.size else jump > np.inf
    bad, first = [], 0
    for run, keep in zip(rows.runs, rows.keep, strict=True):
        of_rows = np.zeros(keep.size, dtype=bool)
        count = int(keep.sum())
        of_rows[keep] = wrong[first : first + count]
        first += count
        samples = np.zeros(run.u.size, dtype=bool)
        samples[: keep.size * rows.m] = np.repeat(of_rows, rows.m)
        bad.append(samples)
    return bad
