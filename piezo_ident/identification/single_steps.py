# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0


"""One step of the three at a time, for who wants to look before going on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from piezo_ident.common.errors import IdentificationError
from piezo_ident.identification.identify import identify
from piezo_ident.identification.prepare import prepare
from piezo_ident.identification.results import Identification, Progress, Settings, silent, Steps
from piezo_ident.identification.solvers.least_squares import singular_is_ours
from piezo_ident.identification.three_steps import first_step, second_step
from piezo_ident.operators.dynamics import Delay
from piezo_ident.record.record import Record

__all__ = ['find_delay', 'find_dynamics', 'find_hysteresis']


def find_delay(
    records: Sequence[Record], settings: Settings | None = None, *, progress: Progress = silent
) -> Steps:
    """
    Take the first step alone.

    Parameters
    ----------
    records : sequence of Record
        With segments ``step`` or ``noise``.
    settings : Settings, optional
    progress : callable, optional
        As for `piezo_ident.identification.identify.identify`.

    Raises
    ------
    IdentificationError
        When the data do not tell the delay.
    """
    data = prepare(records)
    if not {s.kind for p in data.pieces for s in p.segments} & {'step', 'noise'}:
        raise IdentificationError(
            'delay: no segment is labelled step or noise; drive the stage with the programme '
            'identification, or identify unlabelled data in one go'
        )
    with singular_is_ours():
        return Steps(delay=first_step(data.runs, settings or Settings(), progress))


def find_dynamics(
    records: Sequence[Record],
    settings: Settings | None = None,
    *,
    steps: Steps | None = None,
    progress: Progress = silent,
) -> Steps:
    """
    Take the second step, and the first where `steps` does not hold it.

    Parameters
    ----------
    records : sequence of Record
        With segments ``noise`` and ``triangle``: the hysteresis has to be undone.
    settings : Settings, optional
    steps : Steps, optional
        What was found already.
    progress : callable, optional
        As for `piezo_ident.identification.identify.identify`.

    Raises
    ------
    IdentificationError
        When the data do not carry the dynamics.
    """
    data, settings, steps = prepare(records), settings or Settings(), steps or Steps()
    if not data.labelled:
        raise IdentificationError(
            'dynamics: segments labelled noise and triangle are needed, since the hysteresis is '
            'undone; drive the stage with the programme identification'
        )
    with singular_is_ours():
        delay = steps.delay or first_step(data.runs, settings, progress)
        found = second_step(data.runs, Delay(delay.samples), settings, progress)
    return replace(steps, delay=delay, dynamics=found)


def find_hysteresis(
    records: Sequence[Record],
    settings: Settings | None = None,
    *,
    steps: Steps | None = None,
    progress: Progress = silent,
) -> Identification:
    """
    Take the third step, and those before it that `steps` does not hold.

    Parameters
    ----------
    records : sequence of Record
        With segments ``noise`` and ``triangle``.
    settings : Settings, optional
    steps : Steps, optional
        What was found already.
    progress : callable, optional
        As for `piezo_ident.identification.identify.identify`.

    Raises
    ------
    IdentificationError
        When the data do not carry a model.
    """
    if not prepare(records).labelled:
        raise IdentificationError(
            'hysteresis: segments labelled noise and triangle are needed; drive the stage with '
            'the programme identification, or identify unlabelled data in one go'
        )
    return identify(records, settings, steps=steps, progress=progress)
