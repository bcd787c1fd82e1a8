# Copyright 2026 The piezo_ident authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.


"""
Effects that were found in the beginnings of long records, fitted to whole records.

What creeps for an hour does not show in its first minutes.  The search is over; a few dozen runs
over everything are left, window by window, and nothing is kept from one to the next.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from piezo_ident.diagnosis.beginnings import rest_of
from piezo_ident.diagnosis.fit import base_at, fit_jointly, Fitted
from piezo_ident.diagnosis.rows import make_rows, Rows
from piezo_ident.diagnosis.search import afresh
from piezo_ident.diagnosis.simulator import Simulator, State, WINDOW
from piezo_ident.effects import Effect
from piezo_ident.model import StageModel
from piezo_ident.record import Record
from piezo_ident.results import Progress

__all__ = ['fitted_to_all']

#: iterations of each fit: a run over an hour takes seconds
ITERATIONS = 2
#: runs over everything after which half of the work passes for done
HALF = 100


class _Frugal(Simulator):
    """A simulator that keeps nothing from run to run, and says how far it is."""

    def __init__(self, model: StageModel, rows: Rows, tick: Callable[[], None]) -> None:
        super().__init__(model, rows)
        self._tick = tick

    def windows(self, state: State, run_index: int) -> Iterator[NDArray[np.float64]]:
        for x in super().windows(state, run_index):
            self._tick()
            yield x

    def remember(self, state: State) -> NDArray[np.float64]:
        self._state = state
        return self.run(state)

    def varied(self, state: State, effect: type[Effect] | None) -> NDArray[np.float64]:
        return self.run(state)


def fitted_to_all(
    simulator: Simulator,
    fitted: Fitted,
    records: Sequence[Record],
    used: Sequence[Record],
    lines: Sequence[float],
    progress: Progress,
) -> Fitted:
    """
    Return the fit to whole records, as it does on their beginnings.

    Parameters
    ----------
    simulator : Simulator
        Of the beginnings; it forgets what it has kept.
    fitted : Fitted
        To the beginnings; it comes back where it predicts the whole records no worse.
    records, used : sequence of Record
        Whole records, and their beginnings.
    lines : sequence of float
        Lines in the residual [Hz].
    progress : callable
    """
    simulator.forget()
    rows = make_rows(simulator.model, records)
    if rows.names != simulator.rows.names:
        return fitted
    done = 0.0
    step = 1.0 / HALF / max(1.0, sum(run.u.size for run in rows.runs) / WINDOW)

    def tick() -> None:
        nonlocal done
        done += step
        progress('whole records', 1.0 - 0.5**done)

    whole = _Frugal(simulator.model, rows, tick)
    found = fit_jointly(whole, fitted.state, base_at(whole, fitted.state), iterations=ITERATIONS)
    for i in range(len(found.state.effects)):
        for fresh in afresh(whole, found, i, lines, lambda: None, ITERATIONS):
            if fresh.mean_square < found.mean_square:
                found = fresh
    # rows of an hour are long: what is fast must not have been bent by them
    models = [simulator.model_of(state) for state in (fitted.state, found.state)]
    before, after = (rest_of(model, records, used).all for model in models)
    if after >= before:
        return fitted
    at = base_at(simulator, found.state)
    return fit_jointly(simulator, found.state, at, iterations=0)
