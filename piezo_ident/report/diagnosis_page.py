# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The report of a diagnosis as one HTML page."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from piezo_ident.diagnosis.results import Diagnosis
from piezo_ident.report.diagnosis_tables import (
    candidate_table,
    changes,
    diagnosis_facts,
    error_tables,
    fault_table,
    parameter_table,
    percent_of_explainable,
    setting_tables,
    UNKNOWN,
    Unseen,
    unseen_table,
    untestable_table,
)
from piezo_ident.report.html import cards, document, figures, listed, Shown, table
from piezo_ident.report.numbers import number
from piezo_ident.report.reversals import reversal_sentence, reversal_table
from piezo_ident.report.tables import Table

__all__ = ['diagnosis_page']

FOOTER = (
    'Every error is of a free run, never of one-step prediction. Base model: Gu, Li, Zhu and Su, '
    'IEEE/ASME Trans. Mechatronics 21(3), 2016, doi:10.1109/TMECH.2015.2465868. Beside this page: '
    'model.yaml (the refined model), diagnosis.json and the pictures.'
)


def diagnosis_page(
    diagnosis: Diagnosis,
    pictures: Sequence[Shown],
    left_out: Sequence[tuple[str, str]],
    unseen: Sequence[Unseen] = (),
) -> str:
    """
    Return the HTML of a report.

    Parameters
    ----------
    diagnosis : Diagnosis
    pictures : sequence of (name, title, caption, png)
    left_out : sequence of (title, reason)
        Pictures that the data do not allow.
    unseen : sequence of Unseen, optional
        Errors on records that took no part in the diagnosis.
    """
    faults, untestable = fault_table(diagnosis), untestable_table(diagnosis)
    warnings = list(diagnosis.warnings)
    if faults is not None:
        warnings.append('the data had faults, see the table near the end')
    body = [
        listed('warnings', 'Warnings', warnings),
        _group(diagnosis),
        cards(diagnosis_facts(diagnosis)),
        '<h2>Error before and after</h2>\n',
        figures(pictures, 'error'),
        *map(table, error_tables(diagnosis)),
        _optional(unseen_table(unseen)),
        '<h2>The residual before and after</h2>\n',
        _paragraph(reversal_sentence(diagnosis)),
        figures(pictures, 'residual', 'signature', 'spectrum', 'coherence'),
        _optional(reversal_table(diagnosis)),
        '<h2>What was added</h2>\n',
        *_added(diagnosis),
        '<h2>What was not, and why</h2>\n',
        figures(pictures, 'ranking'),
        _optional(candidate_table(diagnosis)),
        '<h2>What remains</h2>\n',
        *_remains(diagnosis),
        _optional(untestable),
        '<h2>Origin</h2>\n',
        _optional(faults),
        *map(table, setting_tables(diagnosis)),
        listed(
            'missing',
            'Pictures that these data do not allow',
            [f'{title}: {reason}' for title, reason in left_out],
        ),
    ]
    return document(
        'Diagnosis of a piezo stage',
        ', '.join(diagnosis.records),
        diagnosis.sentence,
        body,
        FOOTER,
    )


def _optional(content: Table | None) -> str:
    return '' if content is None else table(content)


def _paragraph(text: str) -> str:
    return f'<p>{escape(text)}</p>\n' if text else ''


def _group(diagnosis: Diagnosis) -> str:
    group = diagnosis.group
    if group is None:
        return ''
    return listed(
        'missing',
        'These data cannot tell apart',
        [*group.names, f'what would: {group.separating_experiment}'],
    )


def _added(diagnosis: Diagnosis) -> list[str]:
    changed = changes(diagnosis.given, diagnosis.model)
    said = ', '.join(changed) if changed else 'the same as the one that was given'
    parts = [
        _paragraph(
            f'{effect.name} (slot: {effect.slot}): '
            f'{percent_of_explainable(effect.share)} of the explainable part, '
            f'{number(effect.rms_percent)} % of stroke.'
        )
        for effect in diagnosis.effects
    ]
    return [*parts, _optional(parameter_table(diagnosis)), _paragraph(f'Refined model: {said}.')]


def _remains(diagnosis: Diagnosis) -> list[str]:
    left, smallest = diagnosis.unexplained, diagnosis.smallest_detectable
    rest = left.description.rstrip('.')
    said = [
        f'Unexplained: {percent_of_explainable(left.share)} of the explainable part, '
        f'{number(left.rms_percent)} % of stroke{f"; {rest}" if rest else ""}.'
    ]
    if diagnosis.noise_floor is None:
        said.append(
            f'Noise floor: unknown ({diagnosis.noise_source.removeprefix(UNKNOWN)}), so it is not '
            'known which part of the residual a model could explain.'
        )
    else:
        said.append(
            f'Noise floor: {number(diagnosis.noise_floor)} % of stroke, rms of single samples '
            f'({diagnosis.noise_source}).'
        )
    if smallest is not None:
        said.append(
            f'An effect of {number(smallest)} % of stroke rms or larger that these data can show '
            'would have been taken; smaller ones may be there.'
        )
    return [_paragraph(text) for text in said]
