# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Multisines of the simulated stage whose axes share modes."""

from dataclasses import replace
import functools

import piezo_ident as pi
from piezo_ident.model.axis_records import axis_record
from piezo_ident.verbs.learn import identify_axis

#: saves the choice of numbers
FEW = pi.Settings(thresholds=8, order=(2, 2))
STAGE = pi.TwoAxisStage.load('two_axes')
PROGRAM = pi.Program.load('two_axes')


def program(*names, **options):
    """Return parts of the program, with other options."""
    entries = (e for e in PROGRAM.entries if e.name in names)
    return replace(
        PROGRAM, entries=tuple(replace(e, options={**e.options, **options}) for e in entries)
    )


@functools.cache
def measured():
    """Return a record of two amplitudes."""
    return STAGE.play(program('small', 'large', realisations=3, periods=3))


@functools.cache
def other():
    """Return a record of other multisines."""
    return replace(STAGE, seed=5).play(replace(program('large', realisations=2), seed=77))


@functools.cache
def chains():
    """Identify every axis by itself."""
    found = {a: identify_axis(axis_record(measured(), a), FEW) for a in ('y', 'y_b')}
    return pi.EachAxis(found)
