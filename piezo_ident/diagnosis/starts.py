# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Fits from several starts, which know nothing of each other and so run side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from threading import Event

from piezo_ident.common.errors import Cancelled, IdentificationError, ModelError
from piezo_ident.diagnosis.joint_fit import Fitted
from piezo_ident.diagnosis.simulator import Simulator
from piezo_ident.diagnosis.state import State

#: what fails one start, and leaves the others going
Failure = ModelError | IdentificationError

#: how often a caller is asked whether to go on [s]
ASKED = 0.1


def fit_starts(
    simulator: Simulator,
    states: Sequence[State],
    fit: Callable[[Simulator, State, Callable[[], None]], Fitted],
    tick: Callable[[], None],
) -> list[Fitted | Failure]:
    """
    Return what a fit makes of each state, or why it failed.

    The fit is given a simulator that no other fit uses, a state, and what it has to call between
    its steps.  `tick` is called meanwhile, by this thread alone, and may raise `Cancelled`.
    """
    copies = simulator.copies(len(states))
    stopped = Event()

    def alive() -> None:
        if stopped.is_set():
            raise Cancelled('another fit was stopped')

    def share(k: int) -> list[Fitted | Failure]:
        found = list[Fitted | Failure]()
        for state in states[k :: len(copies)]:
            try:
                found.append(fit(copies[k], state, alive))
            except (ModelError, IdentificationError) as error:
                found.append(error)
            except BaseException:
                stopped.set()
                raise
        return found

    with ThreadPoolExecutor(len(copies)) as pool:
        futures = [pool.submit(share, k) for k in range(len(copies))]
        try:
            tick()
            while wait(futures, ASKED).not_done:
                tick()
        except BaseException:
            stopped.set()
            raise
        finally:
            wait(futures)
            for copy in copies[1:]:
                copy.forget()
    # the one that stopped the others says why
    errors = [future.exception() for future in futures]
    for error in sorted(filter(None, errors), key=lambda error: isinstance(error, Cancelled)):
        raise error
    shares = [future.result() for future in futures]
    return [shares[i % len(copies)][i // len(copies)] for i in range(len(states))]
