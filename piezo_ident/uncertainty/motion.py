# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Describe each sample of a motion by swing, speed and nesting, with which errors of free runs grow.

- Swing: the larger of two distances: between the last two turning points of the voltage, and from
  the last turning point to the voltage.  The misfit of H grows with the size of the loop.
- Speed: the largest recent change of the predicted displacement, which fades with the slowest mode
  of G.  The misfit of G and of the delay grows with speed.
- Nesting: the squared mean of ``1 - swing`` over a recent path of one range (taste).  Small loops
  inside a wide loop drift on many stages, and a sum of plays closes them.

All three follow from the past alone, so a stream gives the same values as a whole record.
"""

from __future__ import annotations

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.kernel import alive, ordered_kernel
from piezo_ident.model.stage_model import StageModel

#: way back that makes an extreme of the voltage a turning point, as a share of the range (taste).
#: The noise of a measured voltage is smaller, and a loop whose error matters is larger
TURN = 2e-3
#: shortest and longest time in which the speed of the past fades [samples, s]; taste
FEWEST, LONGEST = 10.0, 0.1


class Motion:
    """
    Swing, speed and nesting of a stream of samples.

    Parameters
    ----------
    model : StageModel
        Gives the sampling rate, and the ringing time of G.

    Examples
    --------
    >>> import piezo_ident as pi
    >>> motion = Motion(pi.SimulatedStage.load('paper').model)
    >>> motion.follow(np.array([0.0, 0.5, 1.0, 0.7]), np.zeros(4))[0].tolist()
    [0.0, 0.5, 1.0, 1.0]
    """

    def __init__(self, model: StageModel) -> None:
        rate, radius = model.sample_rate, model.dynamics.radius
        ringing = FEWEST if radius <= 0.0 else -1.0 / np.log(radius)
        self._fades = float(np.exp(-1.0 / np.clip(ringing, FEWEST, max(FEWEST, LONGEST * rate))))
        self._rate = rate
        self._state: Array | None = None

    def follow(self, u: Array, x: Array) -> Array:
        """
        Describe the next samples.

        Parameters
        ----------
        u, x : ndarray, shape (n,)
            Voltage and predicted displacement, normalised.

        Returns
        -------
        ndarray, shape (3, n)
            Swing, normalised, speed [spans/s], and nesting.
        """
        out = np.empty((3, u.size))
        if not u.size:
            return out
        if self._state is None:
            self._state = np.array([1.0, u[0], u[0], u[0], 0.0, x[0], 0.0])
        _described(u, x, TURN, self._fades, self._rate, self._state, out)
        return out


@ordered_kernel
def _described(
    u: Array, x: Array, turn: float, fades: float, rate: float, state: Array, out: Array
) -> None:
    """Write swing, speed and nesting; state: direction, extreme, two turns, speed, x, small."""
    rising, extreme, last, before, speed, past, small = state
    for k in range(u.size):
        way = abs(u[k] - extreme)
        if (u[k] - extreme) * rising >= 0.0:
            extreme = u[k]
        elif (extreme - u[k]) * rising > turn:
            before, last, extreme, rising = last, extreme, u[k], -rising
        else:
            way = 0.0
        swing = max(abs(last - before), abs(u[k] - last))
        speed = max(alive(speed * fades), abs(x[k] - past) * rate)
        small += (max(1.0 - swing, 0.0) - small) * (1.0 - np.exp(-way))
        past = x[k]
        out[0, k], out[1, k], out[2, k] = swing, speed, small**2
    state[:] = np.array([rising, extreme, last, before, speed, past, small])
