# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The report of an identification as one HTML page."""

from __future__ import annotations

from collections.abc import Sequence

from piezo_ident.identification.results import Identification
from piezo_ident.model.free_run import SineError
from piezo_ident.record.record import Record
from piezo_ident.report.html import cards, document, figures, listed, Shown, table
from piezo_ident.report.numbers import verdict
from piezo_ident.report.tables import (
    dynamics_tables,
    error_tables,
    facts,
    fault_table,
    hysteresis_tables,
    origin_tables,
)

__all__ = ['page']

FOOTER = (
    'Method: Gu, Li, Zhu and Su, IEEE/ASME Trans. Mechatronics 21(3), 2016, '
    'doi:10.1109/TMECH.2015.2465868. Every error is of a free run, never of one-step '
    'prediction. Beside this page: model.yaml, identification.json and the pictures.'
)


def page(
    identification: Identification,
    records: Sequence[Record],
    sines: Sequence[SineError],
    pictures: Sequence[Shown],
    left_out: Sequence[tuple[str, str]],
) -> str:
    """
    Return the HTML of a report.

    Parameters
    ----------
    identification : Identification
    records : sequence of Record
    sines : sequence of SineError
    pictures : sequence of (name, title, caption, png)
    left_out : sequence of (title, reason)
        Pictures that the data do not allow.
    """
    faults = fault_table(records)
    # a fault is told in its own table; a second time would hide the other warnings
    told = {f'{record.name}: {fault}' for record in records for fault in record.faults}
    warnings = [said for said in identification.warnings if said not in told]
    if faults is not None:
        warnings.append(f'the data had {len(faults.rows)} kinds of faults, see below')
    body = [
        listed('warnings', 'Warnings', warnings),
        listed(
            'missing',
            'Not identified',
            [f'{what}: {why}' for what, why in identification.not_identified],
        ),
        cards(facts(identification)),
        '<h2>How well the model predicts</h2>\n',
        *map(table, error_tables(identification, sines)),
        figures(pictures, 'sines', 'loops', 'segments', 'overview'),
        '<h2>Delay and dynamics</h2>\n',
        figures(pictures, 'delay', 'response', 'orders'),
        *map(table, dynamics_tables(identification)),
        '<h2>Hysteresis</h2>\n',
        figures(pictures, 'weights'),
        *map(table, hysteresis_tables(identification)),
        '<h2>Origin</h2>\n',
        table(faults) if faults is not None else '',
        *map(table, origin_tables(identification)),
        listed(
            'missing',
            'Pictures that these data do not allow',
            [f'{title}: {reason}' for title, reason in left_out],
        ),
    ]
    return document(
        'Identification of a piezo stage',
        ', '.join(f'{record.name} ({record.duration:.4g} s)' for record in records),
        verdict(identification),
        body,
        FOOTER,
    )
