# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Delay change: the delay is another than when it was identified."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from piezo_ident.effects.effect import Effect, Parameter, Trial, View
from piezo_ident.operators.c_code import CCode
from piezo_ident.operators.chain import Block


class DelayChange(Effect):
    """
    A correction of the model's own delay, by samples or a fraction of one, either way.

    ``y(k) = x(k - d - delta)``, between samples by linear interpolation.  A link of the chain that
    takes its signal block by block cannot look ahead, so a shorter delay is not made by one: the
    model lengthens or shortens its own delay line by delta (`StageModel.total_delay`), and refuses
    one that would come out negative.  Alone, the operator passes its signal on.  What joins the
    signal behind the delay line, such as hum, another axis or feed-through, keeps its own time.

    Notes
    -----
    A driver's buffer or a sensor's filter, switched since the delay was identified: one sample
    at 20 kHz is 3.8 % of rms(y) at 120 Hz.  Linear interpolation as the first of the Lagrange
    fractional delays: T. I. Laakso, V. Valimaki, M. Karjalainen and U. K. Laine, "Splitting the
    unit delay", IEEE Signal Process. Mag. 13(1), 1996, pp. 30-60.
    """

    name = 'delay_change'
    slot = 'acquisition'
    change = 'passed'
    in_dynamics = True
    description = (
        'a delay other than the one identified; a sample at 20 kHz is 1.3 % of stroke at 120 Hz'
    )
    needs = 'a multisine, noise or steps well beyond the first resonance'
    in_delay_line = True
    parameters = (Parameter('samples', 'samples', 'added delay delta', 0.0, -1e5, 1e5, step=0.1),)

    @classmethod
    def added_delay(cls, values: Mapping[str, Any]) -> float:
        """Return the change in samples."""
        return float(values['samples'])

    @classmethod
    def trials(cls, view: View) -> tuple[Trial, ...]:
        """Return a fraction of a sample, about 1e-3 of the span at the speeds seen."""
        step = min(0.5, max(0.01, 1e-3 * view.sample_rate / view.speed))
        return (cls.trial({}, steps={'samples': step}),)

    def process(self, block: Block) -> Block:
        """Return the block as it is: the model's delay line does the work."""
        return block

    def c_code(self) -> CCode:
        """Return nothing, as `process` does nothing."""
        return CCode()
