# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Stages for judging: every effect in another form than the one that is fitted.

Nothing here knows the package that is judged.  A sum of plays answers a voltage from rest:

    stage = make_stage('creep', 0.3, seed=1)
    t, v, labels = program('diagnosis', seed=1)
    y = stage.respond(t, v)

A stage of another family (`make_family_stage`) has a past, and is measured as `record_motion`
says.  `sum_cases` and `draw` are the cases of the study.
"""

from .cases import Case, CASES, draw, sum_cases, SumCase
from .family_stage import FamilyStage, make_family_stage
from .motion import Motion, record_motion
from .references import references
from .stage import make_stage, SPAN, Stage
from .table import describe, EFFECTS, LATER, OUTSIDE
from .tape import other_axis, program, table_one_sines

__all__ = [
    'CASES',
    'EFFECTS',
    'LATER',
    'OUTSIDE',
    'SPAN',
    'Case',
    'FamilyStage',
    'Motion',
    'Stage',
    'SumCase',
    'describe',
    'draw',
    'make_family_stage',
    'make_stage',
    'other_axis',
    'program',
    'record_motion',
    'references',
    'sum_cases',
    'table_one_sines',
]
