# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The result of a diagnosis for a terminal."""

from __future__ import annotations

from collections.abc import Sequence
import textwrap

from piezo_ident.diagnosis.results import Diagnosis
from piezo_ident.report.diagnosis_tables import (
    error_rows,
    parameter_rows,
    percent_of_explainable,
    STATES,
    UNKNOWN,
    Unseen,
    unseen_table,
)
from piezo_ident.report.numbers import number
from piezo_ident.report.reversals import reversal_sentence
from piezo_ident.report.text import columns, printable, WIDTH

__all__ = ['diagnosis_summary']

#: candidates that are told of
CANDIDATES = 6


def diagnosis_summary(diagnosis: Diagnosis, unseen: Sequence[Unseen] = ()) -> str:
    """
    Return the verdict, the errors before and after, what was added and what was not.

    Parameters
    ----------
    diagnosis : Diagnosis
    unseen : sequence of Unseen, optional
        Errors on records that took no part in it.
    """
    lines = [*textwrap.wrap(printable(diagnosis.sentence), WIDTH), '']
    lines += columns(
        [
            ('error / % of stroke', *STATES, 'times smaller'),
            *((printable(row[0]), *row[1:]) for rows in error_rows(diagnosis) for row in rows),
        ]
    )
    table = unseen_table(unseen)
    if table is not None:
        head = ('records that took no part', *table.head[1:])
        rows = [(printable(row[0]), *row[1:]) for row in table.rows]
        lines += ['', *columns([head, *rows])]
    near = reversal_sentence(diagnosis)
    if near:
        lines += ['', *textwrap.wrap(printable(near), WIDTH)]
    lines += ['', *_facts(diagnosis)]
    lines += _effects(diagnosis)
    if diagnosis.group is not None:
        names = ', '.join(map(printable, diagnosis.group.names))
        lines += _item(
            f'these data cannot tell apart: {names}; what would: '
            f'{printable(diagnosis.group.separating_experiment)}'
        )
    lines += _listed(
        'not added',
        [
            f'{c.name} ({percent_of_explainable(c.share)}): {c.why_not}'
            for c in diagnosis.candidates[:CANDIDATES]
        ],
        len(diagnosis.candidates) - CANDIDATES,
    )
    lines += _listed(
        'not testable with these data',
        [f'{x.name}: needs {x.needs}' for x in diagnosis.untestable],
    )
    lines += _listed('met in the data', [str(fault) for fault in diagnosis.faults])
    for said in diagnosis.warnings:
        lines += _item(f'warning: {printable(said)}')
    return '\n'.join(lines)


def _facts(diagnosis: Diagnosis) -> list[str]:
    left, floor = diagnosis.unexplained, diagnosis.noise_floor
    source = printable(diagnosis.noise_source.removeprefix(UNKNOWN))
    facts = [
        ('verdict', diagnosis.verdict.replace('_', ' ')),
        (
            'unexplained',
            f'{percent_of_explainable(left.share)} of the explainable part, '
            f'{number(left.rms_percent)} % of stroke{_after(left.description)}',
        ),
        (
            'noise floor',
            f'unknown ({source})' if floor is None else f'{number(floor)} % of stroke ({source})',
        ),
    ]
    if diagnosis.smallest_detectable is not None:
        said = f'{number(diagnosis.smallest_detectable)} % of stroke'
        facts.append(('detectable', f'effects from {said}'))
    lines = []
    for what, said in facts:
        lines += textwrap.wrap(f'{what:<14}{said}', WIDTH, subsequent_indent=' ' * 14)
    return lines


def _after(description: str) -> str:
    return f': {printable(description)}' if description else ''


def _effects(diagnosis: Diagnosis) -> list[str]:
    lines = []
    rows = parameter_rows(diagnosis)
    for effect in diagnosis.effects:
        lines += [
            '',
            f'added: {effect.name} (slot: {effect.slot}), '
            f'{percent_of_explainable(effect.share)} of the explainable part, '
            f'{number(effect.rms_percent)} % of stroke',
        ]
        for name, parameter, value, unit, _ in rows:
            if name == effect.name:
                lines += textwrap.wrap(
                    printable(f'  {parameter:<16}{value}{f" [{unit}]" if unit else ""}'),
                    WIDTH,
                    subsequent_indent=' ' * 18,
                )
    return lines


def _item(text: str) -> list[str]:
    return ['', *textwrap.wrap(text, WIDTH, subsequent_indent='  ')]


def _listed(title: str, items: Sequence[str], more: int = 0) -> list[str]:
    if not items:
        return []
    lines = ['', f'{title}:']
    for item in items:
        lines += textwrap.wrap(
            printable(item), WIDTH, initial_indent='  ', subsequent_indent='    '
        )
    if more > 0:
        lines.append(f'  and {more} more')
    return lines
