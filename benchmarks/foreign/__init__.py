# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Stages of another family for judging a diagnosis: their hysteresis is no sum of plays.

Nothing here knows the package that is judged.  A case is drawn by its set and number, and holds
the stage, what is hidden in it and how it is measured:

    case = draw('tuning', 7)
    case.key, case.effects, case.labelled
"""

from .case import Case, CASES, draw
from .motion import Motion, record_motion
from .references import references
from .stage import make_stage, Stage

__all__ = [
    'CASES',
    'Case',
    'Motion',
    'Stage',
    'draw',
    'make_stage',
    'record_motion',
    'references',
]
