# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What stands near the reversals of the voltage, as a table and in a sentence."""

from __future__ import annotations

import numpy as np
from piezo_ident.diagnosis.results import Diagnosis
from piezo_ident.report.diagnosis_tables import STATES
from piezo_ident.report.numbers import number
from piezo_ident.report.tables import Table
from piezo_ident.residual.reversals import Way, ways

__all__ = ['reversal_sentence', 'reversal_table', 'ways_of']

#: what is near a reversal, share of the voltage range behind it
NEAR = 0.05
#: a residual stands near the reversals when it is this much larger there than elsewhere
STANDS = 1.25


def ways_of(diagnosis: Diagnosis) -> tuple[Way, ...]:
    """Return the three residuals by the way since a turn [% of stroke]."""
    stroke = max(float(np.ptp(r.piece.y)) for r in diagnosis.residuals)
    return ways(
        [(r.piece.v, r.sound, r.piece.sample_rate) for r in diagnosis.residuals],
        [[100.0 * e / stroke for e in (r.given, r.before, r.after)] for r in diagnosis.residuals],
    )


def reversal_table(diagnosis: Diagnosis) -> Table | None:
    """Return the table; None where the voltage does not turn."""
    found = ways_of(diagnosis)
    if not found:
        return None
    rows = tuple(
        (f'{100.0 * w.start:g} .. {100.0 * w.stop:g} %', *map(number, w.rms), str(w.n))
        for w in found
    )
    return Table(
        'By the way since the voltage last turned',
        ('share of the range', *STATES, 'means'),
        rows,
        'In % of stroke: rms of the residual, free run, means over 2 ms; fitted to all of these '
        'data.',
    )


def reversal_sentence(diagnosis: Diagnosis) -> str:
    """Return what the residual near the reversals is; empty where it is no larger there."""
    found = ways_of(diagnosis)
    near = [w for w in found if w.stop <= NEAR]
    far = [w for w in found if w.stop > NEAR]
    if not near or not far:
        return ''
    given, refitted, refined = _rms(near)
    elsewhere = _rms(far)
    if given < STANDS * elsewhere[0]:
        return ''
    said = (
        f'Near the reversals (the first {100.0 * NEAR:g} % of the range behind a turn) the model '
        f'as given misses {number(given)} % of stroke, elsewhere {number(elsewhere[0])} %.'
    )
    by_refit = 1.0 - (refitted / given) ** 2
    said += (
        f' {100.0 * max(by_refit, 0.0):.0f} % of its square go when H is refitted on finer '
        f'thresholds: so far it was the shape of the loop behind a turn'
    )
    if diagnosis.effects and refined < refitted:
        names = ' and '.join(e.name.replace('_', ' ') for e in diagnosis.effects)
        said += f'; {100.0 * (refitted**2 - refined**2) / given**2:.0f} % with {names}'
    last = refined if diagnosis.effects else refitted
    there = elsewhere[2] if diagnosis.effects else elsewhere[1]
    said += f'. {number(last)} % stay, elsewhere {number(there)} %.'
    return said


def _rms(some: list[Way]) -> tuple[float, ...]:
    n = np.array([w.n for w in some])
    squares = np.array([w.rms for w in some]) ** 2
    return tuple(float(x) for x in np.sqrt(n @ squares / n.sum()))
