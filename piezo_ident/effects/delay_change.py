# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Delay change: the delay differs from the identified delay."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from piezo_ident.effects.effect import Effect, Parameter, Trial, View
from piezo_ident.operators.c_code import CCode
from piezo_ident.operators.chain import Block


class DelayChange(Effect):
    """
    Correction of the delay of the model, by whole samples or a fraction, in either direction.

    ``y(k) = x(k - d - delta)``, with linear interpolation between samples.  An operator of the
    chain receives its signal block by block and cannot look ahead, so it cannot shorten a delay.
    The model therefore lengthens or shortens its own delay line by delta
    (`StageModel.total_delay`), and refuses a negative delay.  The operator itself passes its
    signal unchanged.  Signals that join behind the delay line, such as hum, another axis or
    feed-through, keep their own time.

    Notes
    -----
    Possible cause: the buffer of a driver or the filter of a sensor was switched after the
    identification.  One sample at 20 kHz is 3.8 % of rms(y) at 120 Hz.  Linear interpolation is
    the first of the Lagrange fractional delays: T. I. Laakso, V. Valimaki, M. Karjalainen and
    U. K. Laine, "Splitting the unit delay", IEEE Signal Process. Mag. 13(1), 1996, pp. 30-60.
    """

    name = 'delay_change'
    slot = 'acquisition'
    change = 'passed'
    in_dynamics = True
    description = (
        'a delay other than the identified delay; a sample at 20 kHz is 1.3 % of stroke at 120 Hz'
    )
    needs = 'a multisine, noise or steps well beyond the first resonance'
    in_delay_line = True
    parameters = (Parameter('samples', 'samples', 'added delay delta', 0.0, -1e5, 1e5, step=0.1),)

    @classmethod
    def added_delay(cls, values: Mapping[str, Any]) -> float:
        """Give the change of the delay [samples]."""
        return float(values['samples'])

    @classmethod
    def trials(cls, view: View) -> tuple[Trial, ...]:
        """List a fraction of a sample, about 1e-3 of the span at the speeds of the data."""
        step = min(0.5, max(0.01, 1e-3 * view.sample_rate / view.speed))
        return (cls.trial({}, steps={'samples': step}),)

    def process(self, block: Block) -> Block:
        """Pass the block unchanged: the delay line of the model applies the effect."""
        return block

    def c_code(self) -> CCode:
        """Write no statements, as `process` does nothing."""
        return CCode()
