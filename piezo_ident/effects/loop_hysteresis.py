# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Hysteresis inside the loop: the spring of a mode is hysteretic."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import itertools
import math
from typing import Any

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import ModelError
from piezo_ident.common.kernel import alive, ordered_kernel, part_of_kernels
from piezo_ident.effects.effect import Effect, NAN, Parameter, Trial, Value, View
from piezo_ident.effects.second_order import slope_of_mode
from piezo_ident.operators.c_code import CCode, Numbers, read_c
from piezo_ident.operators.chain import Block
from piezo_ident.operators.hysteresis import LANES
from piezo_ident.operators.kernels import held
from scipy.linalg import expm

#: repetitions of a sub-step; each multiplies the error by a sixth of the squared phase
REPEATED = 3
#: phase of a mode in a sub-step [rad] (physics: a twentieth of a radian integrates a loop to 1e-3)
PHASE = 0.05
#: steps of Newton's method to the deflection at rest (each doubles the digits)
BENDS = 8
#: a mode with less damping resonates (physics: above 1/sqrt(2) its response has no peak)
RESONATES = math.sqrt(0.5)
#: largest slip [1/span^n]: an element that slips within a ten thousandth of the span is Coulomb
#: friction
STEEPEST = 1e4
#: laws that are tried: slip over the swing, and its skew, by which a loop softens (above -1) or
#: hardens.  They were chosen on one record of Bouc and Wen's law; a fit moves both
SLIPS, SKEWS = (3.0, 6.0), (0.0, -1.5)


@part_of_kernels
def _slipped(s: float, way: float, gamma: float, skew: float, power: float) -> float:
    # the law of Bouc and Wen along a short way, by its midpoint
    if gamma == 0.0:
        return s + way
    side = 1.0 if way > 0.0 else -1.0
    half = s
    for share in (0.5, 1.0):
        size = abs(half)
        if power != 1.0:
            size = size**power
        half = s + share * way * (1.0 - gamma * (skew + (side if half > 0.0 else -side)) * size)
    return half


@part_of_kernels
def _stepped(step: Array, q: float, p: float, begin: float, end: float) -> tuple[float, float]:
    # the linear mode after a sub-step, whose input moves along a line
    return (
        step[0, 0] * q + step[0, 1] * p + step[0, 2] * begin + step[0, 3] * end,
        step[1, 0] * q + step[1, 1] * p + step[1, 2] * begin + step[1, 3] * end,
    )


@ordered_kernel
def run_loop(
    x: Array, step: Array, spring: Array, elements: Array, state: Array, memory: Array, out: Array
) -> None:
    """
    Compute the force of the spring at each sample, and carry state and memory on.

    The rows of `step` give q and p from q, p and the inputs at both ends of a sub-step.  `spring`
    holds elastic, viscous, power, number of sub-steps, square and cubic.  A row of `elements` has
    stiffness, threshold, gamma and skew.  `state` holds the last two inputs, q and p of the linear
    mode, their change by the spring, and the force, all from rest; then input, q and force at
    rest.  A row of `memory` holds the play and the slip of an element.
    """
    count = int(spring[3])
    a, c, power, square, cubic = spring[0], spring[1], spring[2], spring[4], spring[5]
    w1, w2, l0, l1, d0, d1 = state[0], state[1], state[2], state[3], state[4], state[5]
    h, rest_x, rest_q, rest_h = state[6], state[7], state[8], state[9]
    new = np.empty_like(memory)
    for k in range(x.size):
        w0 = x[k] - rest_x
        # the command between samples: a parabola through the last three
        slope, bend = 0.5 * (3.0 * w0 - 4.0 * w1 + w2), 0.5 * (w0 - 2.0 * w1 + w2)
        begin = w1
        for j in range(count):
            tau = (j + 1.0) / count - 1.0
            end = w0 + tau * (slope + tau * bend)
            m0, m1 = _stepped(step, l0, l1, begin, end)
            e0 = step[0, 0] * d0 + step[0, 1] * d1 - step[0, 2] * h
            e1 = step[1, 0] * d0 + step[1, 1] * d1 - step[1, 2] * h
            force = h
            for _ in range(REPEATED):
                q = rest_q + (m0 + e0 - step[0, 3] * force)
                p = m1 + e1 - step[1, 3] * force
                force = q * (a + q * (square + q * cubic)) + c * p
                for i in range(elements.shape[0]):
                    r = elements[i, 1]
                    play = held(memory[i, 0], q - r, q + r)
                    slip = _slipped(
                        memory[i, 1],
                        play - memory[i, 0],
                        elements[i, 2],
                        elements[i, 3],
                        power,
                    )
                    new[i, 0], new[i, 1] = play, slip
                    force += elements[i, 0] * slip
                force -= rest_h
            l0, l1 = alive(m0), alive(m1)
            d0 = alive(e0 - step[0, 3] * force)
            d1 = alive(e1 - step[1, 3] * force)
            h, begin = force, end
            for i in range(elements.shape[0]):
                memory[i, 0], memory[i, 1] = new[i, 0], new[i, 1]
        out[k] = rest_h + h
        w2, w1 = w1, w0
    state[0], state[1], state[2], state[3], state[4], state[5] = w1, w2, l0, l1, d0, d1
    state[6] = h


@ordered_kernel
def run_loops(
    x: Array, step: Array, count: int, fixed: Array, linear: Array, state: Array, lanes: int
) -> Array:
    """
    Compute `run_loop` for eight springs of one mode side by side; forces of shape (n, 8).

    Each spring has one element and the power 1.  `fixed`, shape (10 * 8,), holds elastic, viscous,
    square, cubic, stiffness, threshold, gamma and skew, and q and force at rest.  `linear` holds
    the last two inputs, q and p of the linear mode, and the input at rest.  `state`, shape
    (5 * 8,), holds the change of q and p by the spring, force, play and slip.  `lanes` is 8.
    """
    w1, w2, l0, l1, rest_x = linear[0], linear[1], linear[2], linear[3], linear[4]
    out = np.empty((x.size, LANES))
    for k in range(x.size):
        w0 = x[k] - rest_x
        slope, bend = 0.5 * (3.0 * w0 - 4.0 * w1 + w2), 0.5 * (w0 - 2.0 * w1 + w2)
        begin = w1
        for j in range(count):
            tau = (j + 1.0) / count - 1.0
            end = w0 + tau * (slope + tau * bend)
            m0, m1 = _stepped(step, l0, l1, begin, end)
            # a number of lanes that the compiler knew would be unrolled instead of vectorised, and
            # so would rows of an unknown length
            for i in range(lanes):
                d0, d1, h = state[i], state[LANES + i], state[2 * LANES + i]
                before, slipped = state[3 * LANES + i], state[4 * LANES + i]
                e0 = step[0, 0] * d0 + step[0, 1] * d1 - step[0, 2] * h
                e1 = step[1, 0] * d0 + step[1, 1] * d1 - step[1, 2] * h
                r, gamma, skew = fixed[5 * LANES + i], fixed[6 * LANES + i], fixed[7 * LANES + i]
                force, play, slip = h, before, slipped
                for _ in range(REPEATED):
                    q = fixed[8 * LANES + i] + (m0 + e0 - step[0, 3] * force)
                    p = m1 + e1 - step[1, 3] * force
                    curve = fixed[2 * LANES + i] + q * fixed[3 * LANES + i]
                    force = q * (fixed[i] + q * curve) + fixed[LANES + i] * p
                    play = held(before, q - r, q + r)
                    slip = _slipped(slipped, play - before, gamma, skew, 1.0)
                    force = force + fixed[4 * LANES + i] * slip - fixed[9 * LANES + i]
                state[i] = alive(e0 - step[0, 3] * force)
                state[LANES + i] = alive(e1 - step[1, 3] * force)
                state[2 * LANES + i] = force
                state[3 * LANES + i], state[4 * LANES + i] = play, slip
            l0, l1 = alive(m0), alive(m1)
            begin = end
        for i in range(lanes):
            out[k, i] = fixed[9 * LANES + i] + state[2 * LANES + i]
        w2, w1 = w1, w0
    return out


def mode_step(
    frequency: float, damping: float, sample_rate: float, stiffest: float
) -> tuple[Array, int]:
    """
    Compute the exact sub-step of a mode, and the number of sub-steps in a sample.

    The sub-step is the argument `step` of `run_loop`.  Raises ModelError if the frequency is not
    below half the sampling rate.
    """
    slope_of_mode(frequency, sample_rate)  # refuses the frequency
    phase = 2.0 * math.pi * frequency / sample_rate
    # a power of two, so that a small change of the stiffness does not change the grid
    count = 2 ** max(0, math.ceil(math.log2(phase * math.sqrt(stiffest) / PHASE)))
    h = phase / count
    # q' = p, p' = x - q - 2 zeta p in units of phase, and x moves along a line
    motion = np.zeros((4, 4))
    motion[0, 1], motion[1, :3], motion[2, 3] = h, (-h, -2.0 * damping * h, h), 1.0
    E = expm(motion)
    return np.ascontiguousarray(np.column_stack([E[:2, :2], E[:2, 2] - E[:2, 3], E[:2, 3]])), count


class LoopHysteresis(Effect):
    """
    A mode whose spring is hysteretic.

    The force of the spring acts back on the motion that causes it, so the effect lies inside the
    loop of the mechanics and changes stiffness and damping with the amplitude.  H, in front of the
    mechanics, cannot do this.  With q the deflection of the mode of G at w = 2 pi frequency:

        q'' + 2 zeta w q' + w^2 q = w^2 (x - h),
        h = elastic q + square q^2 + cubic q^3 + viscous q' / w + sum_i k_i s_i,
        s_i' = e_i' - gamma_i (|e_i'| |s_i|^(n-1) s_i + skew_i e_i' |s_i|^n),

    and e_i is the output of a play of half width r_i that q drives.  The signal behind the effect
    is x - h, and G remains the linear part.  An element with r = 0 is the law of Bouc and Wen, and
    a lag along the path (Dahl) if skew = 0, too.  With gamma = 0 the element is a play.
    `elastic` and `viscous` correct the mean stiffness and damping that G had absorbed.

    Notes
    -----
    The linear part of a sub-step is exact; the force is found by repetition.  The command between
    samples is a parabola through the last three.  Y. K. Wen, "Method for random vibration of
    hysteretic systems", J. Eng. Mech. Div. 102(2), 1976, pp. 249-263.  J. P. Noel, M. Schoukens,
    "Hysteretic benchmark with a dynamic nonlinearity", 2016, doi:10.4121/12967592.
    """

    name = 'loop_hysteresis'
    slot = 'hidden'
    # elastic and viscous alone are a linear change of the mode; far below the mode, square and
    # cubic bend the displacement
    contains = (
        'amplifier_lag',
        'changed_dynamics',
        'delay_change',
        'even_nonlinearity',
        'input_feedthrough',
        'sensor_nonlinearity',
    )
    description = (
        'hysteresis in the spring of a mode; its frequency and damping change with the amplitude, '
        'by 1 .. 50 %'
    )
    needs = 'a multisine or a sweep across the resonance, at two amplitudes'
    parameters = (
        Parameter('frequency', 'Hz', 'frequency of the mode in G', NAN, 1e-3, 1e6, scale='fixed'),
        Parameter('damping', '1', 'damping ratio of the mode in G', NAN, 1e-5, 1.0, scale='fixed'),
        Parameter('elastic', '1', 'change of the stiffness', 0.0, -0.99, 3.0, step=1e-3),
        Parameter('viscous', '1', 'change of the damping 2 zeta', 0.0, -2.0, 2.0, step=1e-3),
        Parameter('square', 'span^-1', 'curvature of the force', 0.0, -20.0, 20.0, step=1e-3),
        Parameter('cubic', 'span^-2', 'hardening of the force', 0.0, -20.0, 20.0, step=1e-3),
        Parameter('stiffness', '1', 'stiffness k_i', 0.0, -3.0, 3.0, vector=True, step=1e-3),
        Parameter('threshold', 'span', 'half width r_i', NAN, 0.0, 10.0, True, 0.0, scale='fixed'),
        Parameter('gamma', 'span^-n', 'slip gamma_i', NAN, 0.0, STEEPEST, True, 0.0, scale='log'),
        Parameter('skew', '1', 'skew_i, delta over gamma', NAN, -10.0, 10.0, True, 0.0),
        Parameter('power', '1', 'power n', NAN, 0.5, 4.0, default=1.0, scale='fixed'),
    )

    def prepare(self) -> None:
        """Compute the sub-step."""
        self._silent = self.is_neutral(self.values)
        rows = [self.array(name) for name in ('stiffness', 'threshold', 'gamma', 'skew')]
        self._elements = np.ascontiguousarray(np.array(rows).T)
        stiffest = 1.0 + abs(self.number('elastic')) + float(np.abs(rows[0]).sum())
        frequency, damping = self.number('frequency'), self.number('damping')
        self._step, count = mode_step(frequency, damping, self.sample_rate, stiffest)
        spring = [self.number(name) for name in ('elastic', 'viscous', 'power')]
        curve = self.number('square'), self.number('cubic')
        self._spring = np.array([*spring, count, *curve])

    @classmethod
    def agree(cls, values: Mapping[str, Value]) -> None:
        """Refuse lists of different lengths, and a spring without stiffness."""
        super().agree(values)
        left = 1.0 + float(values['elastic']) + float(np.sum(values['stiffness']))
        if left <= 0.0:
            raise ModelError(
                f'effect {cls.name}: elastic and stiffness add up to {left - 1.0:g}, which leaves '
                'the mode no stiffness; their sum must stay above -1'
            )

    @classmethod
    def mode(cls, values: Mapping[str, Any]) -> tuple[float, float]:
        """Give frequency [Hz] and damping ratio of the mode in G that has this spring."""
        return float(values['frequency']), float(values['damping'])

    @classmethod
    def trials(cls, view: View) -> tuple[Trial, ...]:
        """
        List laws in the lowest mode that the data excite.

        A spring shows where its mode resonates: the deflection is then larger than the command.
        """
        modes = [m for m in view.modes if m[0] < 0.5 * view.sample_rate and m[1] < RESONATES]
        excited = [m for m in modes if m[0] <= view.max_frequency]
        if not excited or not view.span:
            return ()
        frequency, damping = min(excited)
        mode = {'frequency': frequency, 'damping': damping}
        # a sine at the resonance swings 1 / (2 damping) times as far as its command, other motion
        # as far as its command; a fit starts at the geometric mean
        swing = view.span / math.sqrt(2.0 * damping)
        return tuple(
            cls.trial(
                {
                    **mode,
                    'gamma': [min(slip / swing, STEEPEST)],
                    'skew': [skew],
                    'stiffness': [0.0],
                }
            )
            for slip, skew in itertools.product(SLIPS, SKEWS)
        )

    def reset(self, v0: float, x0: float) -> float:
        """Come to rest: no element has slipped."""
        self._state, self._memory = np.zeros(10), np.zeros((self._elements.shape[0], 2))
        if self._silent:
            return x0
        elastic, square, cubic = map(self.number, ('elastic', 'square', 'cubic'))
        q = x0 / (1.0 + elastic)
        for _ in range(BENDS):
            left = x0 - q * (1.0 + elastic + q * (square + q * cubic))
            q += left / (1.0 + elastic + q * (2.0 * square + q * (3.0 * cubic)))
        force = q * (elastic + q * (square + q * cubic))
        self._state[7:] = x0, q, force
        self._memory[:, 0] = q
        return x0 - force

    def process(self, block: Block) -> Block:
        """Subtract the force of the spring."""
        if self._silent:
            return block
        force, x = np.empty(block.x.size), np.ascontiguousarray(block.x)
        run_loop(x, self._step, self._spring, self._elements, self._state, self._memory, force)
        return block.with_signal(x - force)

    @classmethod
    def abreast(cls, effects: Sequence[Effect], block: Block) -> list[Array]:
        """Compute the outputs of several effects; eight springs of one mode run side by side."""
        found: list[Array] = []
        loops = [effect for effect in effects if isinstance(effect, cls)]
        for mode, some in itertools.groupby(loops, cls._lane):
            springs = list(some)
            if mode is None:
                found += [one.process(block).x for one in springs]
                continue
            for k in range(0, len(springs), LANES):
                found += cls._side_by_side(springs[k : k + LANES], block)
        return found

    def _lane(self) -> tuple[int, bytes] | None:
        """Return grid and mode of a spring that can run beside others, else None."""
        is_usual = self._elements.shape[0] == 1 and self.number('power') == 1.0
        if self._silent or not is_usual:
            return None
        return int(self._spring[3]), self._step.tobytes()

    @classmethod
    def _side_by_side(cls, springs: Sequence[LoopHysteresis], block: Block) -> list[Array]:
        x, one = np.ascontiguousarray(block.x), springs[0]
        # idle lanes repeat the last spring
        lanes = [*springs, *[springs[-1]] * (LANES - len(springs))]
        fixed = [[*z._spring[[0, 1, 4, 5]], *z._elements[0], *z._state[8:]] for z in lanes]
        state = [[*z._state[4:7], *z._memory[0]] for z in lanes]
        forces = run_loops(
            x,
            one._step,
            int(one._spring[3]),
            np.array(fixed).T.ravel(),
            one._state[[0, 1, 2, 3, 7]],
            np.array(state).T.ravel(),
            LANES,
        )
        return [x - force for force in forces.T[: len(springs)]]

    def c_code(self) -> CCode:
        """Write the effect in C."""
        if self._silent:
            return CCode()
        elastic, viscous, power, count, square, cubic = self._spring.tolist()
        names = ('stiffness', 'threshold', 'gamma', 'skew')
        n = self._elements.shape[0]
        numbers: Numbers = {'n': n, 'count': int(count), 'to_q': self._step[0]}
        numbers |= {'to_p': self._step[1], 'elastic': elastic, 'viscous': viscous, 'power': power}
        numbers |= {'square': square, 'cubic': cubic}
        numbers |= dict(zip(names, self._elements.T, strict=True))
        return read_c(__package__, self.name, numbers, bends=BENDS, repeated=REPEATED)
