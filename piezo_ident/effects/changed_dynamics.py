# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Changed dynamics: a resonance was added, or has moved, since G was identified."""

from __future__ import annotations

import numpy as np
from piezo_ident.effects.effect import Effect, NAN, Parameter, Trial, View
from piezo_ident.effects.second_order import SecondOrderSection, sections_in_c
from piezo_ident.effects.trials import ladder
from piezo_ident.operators.c_code import CCode
from piezo_ident.operators.chain import Block


class ChangedDynamics(Effect):
    """
    Modes in parallel with the output of G; the static gain does not change.

    ``y = x + sum_m (g_m (M_m - 1) + k_m R_m) x`` with ``M = w^2 / D``, ``R = w s / D`` and
    ``D = s^2 + 2 zeta w s + w^2``, each by the bilinear transform, prewarped at its own frequency.

    A resonance that moved from (w, zeta) to (w', zeta') has exactly this form, with the new
    frequency and damping, ``g = 1 - (w'/w)^2`` and ``k = 2 zeta w'/w - 2 zeta' (w'/w)^2``.  The
    old mode times the effect is then the new mode.  An added mode with a share g has k = 0.  g
    therefore stays below 1, and above -3 if a mode moved by at most a factor of two.  A mode far
    above the band with a larger g would imitate any lag.

    Notes
    -----
    A load m_L on a stage of mass m multiplies its resonance by ``sqrt(m / (m + m_L))``.  Modes as
    second-order sections: S. Devasia, E. Eleftheriou and S. O. R. Moheimani, "A survey of
    control issues in nanopositioning", IEEE Trans. Control Syst. Technol. 15(5), 2007,
    pp. 802-823.  Bilinear transform with prewarping: A. V. Oppenheim and R. W. Schafer,
    "Discrete-Time Signal Processing".
    """

    name = 'changed_dynamics'
    slot = 'output'
    change = 'linear'
    in_dynamics = True
    description = (
        'a resonance added or moved since G was identified, as by a load; linear, the static gain '
        'stays'
    )
    needs = 'a multisine or noise, or steps, across the resonance, at two amplitudes'
    parameters = (
        Parameter('frequency', 'Hz', 'frequency of mode m', NAN, 1e-3, 1e6, True, scale='log'),
        Parameter('damping', '1', 'damping ratio zeta_m', NAN, 1e-4, 10.0, True, scale='log'),
        Parameter('gain', '1', 'share g_m', 0.0, -3.0, 1.0, True, step=1e-3),
        Parameter('rate_gain', '1', 'share k_m of the rate', 0.0, -2.0, 2.0, True, step=1e-3),
    )

    def prepare(self) -> None:
        """Build the modes."""
        columns = zip(*(self.array(p.name).tolist() for p in self.parameters), strict=True)
        self._sections = [
            SecondOrderSection(f, zeta, g, k, self.sample_rate) for f, zeta, g, k in columns
        ]
        self._silent = not np.any([self.array('gain'), self.array('rate_gain')])

    @classmethod
    def trials(cls, view: View) -> tuple[Trial, ...]:
        """List the lowest modes of G, moved slightly, and a few new modes near the band."""
        top, band = 0.45 * view.sample_rate, max(view.max_frequency, 5.0 / view.duration)
        lowest = sorted(m for m in view.modes if m[0] < top and m[1] < 0.9)[:2]
        tried = [(min(c * f, top), z) for f, z in lowest for c in (0.9, 1.0, 1.1)]
        new = ladder(min(band / 4, top / 2), min(20.0 * band, top), 5)
        tried += [(f, z) for f in new for z in (0.02, 0.1)]
        trials = []
        for f, z in tried:
            # far below a mode, M - 1 grows with the square of the frequency, and R linearly
            far = max(1.0, f / band)
            steps = {'gain': min(0.5, 1e-3 * far**2), 'rate_gain': min(1.0, 1e-3 * far)}
            trials.append(cls.trial({'frequency': [f], 'damping': [z]}, steps=steps))
        return tuple(trials)

    def reset(self, v0: float, x0: float) -> float:
        """Come to rest: no mode moves, and the static gain is one."""
        for section in self._sections:
            section.reset(x0)
        return x0

    def process(self, block: Block) -> Block:
        """Add the modes to the block."""
        if self._silent:
            return block
        y = block.x.copy()
        for section in self._sections:
            y += section.process(block.x)
        return block.with_signal(y)

    def c_code(self) -> CCode:
        """Write the effect in C."""
        if self._silent:
            return CCode()
        return sections_in_c(self._sections, 'x')
