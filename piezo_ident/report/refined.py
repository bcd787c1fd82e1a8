# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The refined model of a diagnosis against the given one: errors elsewhere, and its H."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from piezo_ident.diagnosis.results import Diagnosis, Unseen
from piezo_ident.identification.warnings import LAW_WORDS
from piezo_ident.model.free_run import free_run, same_part_errors
from piezo_ident.model.multi_axis import EachAxis
from piezo_ident.model.sines import sine_errors
from piezo_ident.record.record import Record
from piezo_ident.report.table import number


def validated(
    result: Diagnosis | EachAxis[Diagnosis], records: Sequence[Record]
) -> Diagnosis | EachAxis[Diagnosis]:
    """
    Return a diagnosis with the errors of both models on records that took no part in it.

    Raises
    ------
    ModelError
        When a piece has another sampling rate than the models.
    """
    if isinstance(result, EachAxis):
        seen = [result.model.seen(record) for record in records]
        return EachAxis(
            {
                axis: replace(x, unseen=(*x.unseen, *(_unseen(x, of[axis]) for of in seen)))
                for axis, x in result.items()
            }
        )
    unseen = [_unseen(result, record) for record in records]
    return replace(result, unseen=(*result.unseen, *unseen))


def _unseen(result: Diagnosis, record: Record) -> Unseen:
    models = (result.given, result.model)
    before, after = same_part_errors(*(free_run(model, record) for model in models))
    sines = zip(*(sine_errors(model, record) for model in models), strict=True)
    return Unseen(
        record=record.name,
        before=before.percent,
        after=after.percent,
        before_centred=before.percent_without_offset,
        after_centred=after.percent_without_offset,
        n=after.n,
        sines=tuple((a.frequency, a.percent, b.percent) for a, b in sines),
    )


def law_told(result: Diagnosis) -> list[str]:
    """Return whether H is a sum of plays, and what each law leaves on kinds held out."""
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
        # with an effect beside it, the wider law need not be that of H
        kind = 'fitted with' if result.effects else 'not a sum of plays: H has'
        about = f'{kind} {LAW_WORDS[result.law]} ({result.law})'
    return [
        f'{about}; refitted with nothing added, laws of H predict what was held out to {compared}'
    ]
