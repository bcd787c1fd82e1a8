# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Compare the refined model of a diagnosis with the given model: errors on new records, and H."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

from piezo_ident.diagnosis.messages import sentence
from piezo_ident.diagnosis.results import Diagnosis, Unseen
from piezo_ident.identification.warnings import LAW_WORDS
from piezo_ident.model.free_run import FreeRun, same_part_errors
from piezo_ident.model.multi_axis import each_of, EachAxis, MultiAxisModel
from piezo_ident.model.sines import sine_errors
from piezo_ident.record.record import Record
from piezo_ident.report.table import number
from piezo_ident.verbs.predict import free_run


def validated(
    result: Diagnosis | EachAxis[Diagnosis], records: Sequence[Record]
) -> Diagnosis | EachAxis[Diagnosis]:
    """
    Add to a diagnosis the errors of both models on records that took no part in it.

    Raises
    ------
    ModelError
        When a piece has another sampling rate than the models.
    """
    if isinstance(result, EachAxis):
        model, chains = result.model, MultiAxisModel(result.model.axes)
        seen = [chains.seen(record) for record in records]
        runs = [each_of(free_run(model, record)) if model.modes else {} for record in records]
        parts = [*zip(seen, runs, strict=True)]
        return result.mapped(lambda a, x: _judged(x, [(of[a], run.get(a)) for of, run in parts]))
    return _judged(result, [(record, None) for record in records])


def _judged(result: Diagnosis, parts: Iterable[tuple[Record, FreeRun | None]]) -> Diagnosis:
    """Add the errors on records; a run of shared modes replaces the run of the refined model."""
    unseen = tuple(_unseen(result, *x) for x in parts)
    judged = replace(result, unseen=(*result.unseen, *unseen))
    return replace(judged, sentence=sentence(judged)) if unseen else result


def _unseen(result: Diagnosis, record: Record, refined: FreeRun | None) -> Unseen:
    last = refined or free_run(result.model, record)
    # without effects the shared modes were given
    first = last if refined and not result.effects else free_run(result.given, record)
    before, after = same_part_errors(first, last)
    sines = zip(*(sine_errors(x, record) for x in (result.given, result.model)), strict=True)
    return Unseen(
        record=record.name,
        before=before.percent,
        after=after.percent,
        before_centred=before.percent_without_offset,
        after_centred=after.percent_without_offset,
        n=after.n,
        sines=() if refined else tuple((a.frequency, a.percent, b.percent) for a, b in sines),
    )


def law_told(result: Diagnosis) -> list[str]:
    """Describe the law of H, and the error of each law on held-out kinds of motion."""
    errors = result.errors_of_laws
    if not errors:
        return []
    compared = ', '.join(
        f'{name} {number(x)} %' for name, x in sorted(errors.items(), key=lambda item: -item[1])
    )
    if not result.law:
        about = 'as it was given'
    elif result.law not in LAW_WORDS:
        about = 'a sum of plays'
    else:
        # if effects were added, the refined model may keep another law for H
        kind = 'fitted with' if result.effects else 'not a sum of plays: H has'
        about = f'{kind} {LAW_WORDS[result.law]} ({result.law})'
    return [
        f'{about}; refitted with nothing added, laws of H predict what was held out to {compared}'
    ]
