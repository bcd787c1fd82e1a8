# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Stages for judging a diagnosis: every effect in another form than the one that is fitted.

Nothing here knows the package that is judged.  A stage answers a voltage from rest:

    stage = make_stage('creep', 0.3, seed=1)
    t, v, labels = program('diagnosis', seed=1)
    y = stage.respond(t, v)
"""

from .programs import other_axis, program, table_one_sines
from .stage import make_stage, SPAN, Stage
from .table import describe, EFFECTS, LATER, OUTSIDE

__all__ = [
    'EFFECTS',
    'LATER',
    'OUTSIDE',
    'SPAN',
    'Stage',
    'describe',
    'make_stage',
    'other_axis',
    'program',
    'table_one_sines',
]
