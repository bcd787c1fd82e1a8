# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Noncongruent minor loops: loops of the same width differ with their bias."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import ModelError
from piezo_ident.common.kernel import kernel
from piezo_ident.effects.effect import Effect, NAN, Parameter, Trial, Value, View
from piezo_ident.operators.c_code import CCode, Numbers, read_c
from piezo_ident.operators.chain import Block
from piezo_ident.operators.hysteresis import HysteresisOperator
from piezo_ident.operators.kernels import held
from piezo_ident.operators.play import initial_memory


@kernel
def _tilted(v: Array, r: Array, slope: Array, bend: Array, bias: float, memory: Array) -> Array:
    out = np.empty(v.size)
    for k in range(v.size):
        x = v[k]
        w = 0.0
        bent = 0.0
        for i in range(r.size):
            f = held(memory[i], x - r[i], x)
            memory[i] = f
            w += slope[i] * f
            bent += bend[i] * f * f
        out[k] = (x - bias) * w + bent
    return out


class NoncongruentMinorLoops(Effect):
    """
    Plays whose weight depends on the voltage.

    ``w = H[v] + sum_j (kappa_j (v - c) F_rho_j[v] + lambda_j F_rho_j[v]^2)``.  The weight grows
    with the voltage (kappa) or with the output of the play (lambda).  In a Prandtl-Ishlinskii
    operator all minor loops between the same two voltages are congruent.  Without its cubic, all
    loops of the same width at different biases are congruent, too.  With a weight that grows with
    the voltage they are not.  The plays have thresholds and a memory of their own.

    After `reset` each play has the output of a play of H with the same threshold.  By default
    this is the state of a stage that last came down to zero (`Hysteresis.initial_memory`).  If H
    was given another memory, the output is interpolated between the plays of H.  Their outputs
    are a continuous function of the threshold, which starts at F_0 = v and is flat beyond the
    largest threshold.

    Notes
    -----
    Congruency, and models without it: I. D. Mayergoyz, "Mathematical Models of Hysteresis",
    Springer, 1991, doi:10.1007/978-1-4612-3028-1.
    """

    name = 'noncongruent_minor_loops'
    slot = 'hysteresis'
    of_hysteresis = 'not'
    rate_independent = True
    description = 'minor loops of one width that differ with the bias; 0.3 .. 2 % of stroke'
    needs = 'equal minor loops at three biases, in two widths'
    parameters = (
        Parameter(
            'threshold', '1', 'threshold rho_j', NAN, 1e-6, 10.0, vector=True, scale='fixed'
        ),
        Parameter('slope', '1', 'growth kappa_j', 0.0, -10.0, 10.0, True, step=2e-3),
        Parameter('bend', '1', 'growth lambda_j', 0.0, -10.0, 10.0, True, step=2e-3),
        Parameter(
            'bias', '1', 'voltage c without a change', NAN, -10.0, 10.0, default=0.5, scale='fixed'
        ),
    )

    def prepare(self) -> None:
        """Read the lists."""
        self._r = self.array('threshold')
        self._slope, self._bend = self.array('slope'), self.array('bend')

    @classmethod
    def agree(cls, values: Mapping[str, Value]) -> None:
        """Refuse an empty list; see `Effect.agree`."""
        super().agree(values)
        if not np.size(values['threshold']):
            raise ModelError('effect noncongruent_minor_loops: give at least one threshold')

    @classmethod
    def trials(cls, view: View) -> tuple[Trial, ...]:
        """List plays of three widths with either kind of weight, and a single play."""
        bias = (view.low + view.high) / 2
        widths = np.array([0.05, 0.15, 0.4]) * view.span
        shape = {'threshold': widths, 'bias': bias}
        return (
            cls.trial({'threshold': widths[1:2], 'bias': bias}, ['slope']),
            cls.trial(shape, ['slope']),
            cls.trial(shape, ['bend']),
            cls.trial(shape, ['slope', 'bend']),
        )

    def reset(self, v0: float, x0: float) -> float:
        """Come to rest, with the outputs of plays of H."""
        w = self.inner.reset(v0, x0)
        memory, core = initial_memory(x0, self._r), self.core
        if isinstance(core, HysteresisOperator):
            h = core.hysteresis
            plays = core.memory[: h.thresholds.size]
            if not np.array_equal(plays, h.initial_memory(x0)):
                r, f = np.append(0.0, h.thresholds), np.append(x0, plays)
                memory = np.clip(np.interp(self._r, r, f), x0 - self._r, x0)
        self._memory = memory
        return w + float(self._more(np.array([x0]))[0])

    def process(self, block: Block) -> Block:
        """Apply H to the block and add the plays."""
        more = self._more(np.ascontiguousarray(block.x))
        inner = self.inner.process(block)
        return inner.with_signal(inner.x + more)

    def c_code(self) -> CCode:
        """Write the effect in C."""
        numbers: Numbers = {'n': self._r.size, 'r': self._r, 'slope': self._slope}
        numbers |= {'bend': self._bend, 'bias': self.number('bias')}
        return read_c(__package__, self.name, numbers)

    def _more(self, x: Array) -> Array:
        out: Array = _tilted(
            x, self._r, self._slope, self._bend, self.number('bias'), self._memory
        )
        return out
