# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Delay and G from any fast motion, by held-out free run.

Every order and delay comes from one factorisation of the ARX data matrix; the one that errs least
on blocks that were not fitted is refined by output error, and loses its poles one after the other
as long as it errs no more.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
import functools

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.arrays import Array
from piezo_ident.identification.fast_motion import FastMotion
from piezo_ident.identification.prepare import Excerpt
from piezo_ident.identification.slow_part import without_pairs, without_slow_part
from piezo_ident.identification.solvers.output_error import (
    output_error,
    OutputErrorFit,
    simulation_error,
)
from piezo_ident.identification.step1_delay import delay_from_loss, MAX_DELAY, SCAN_ORDER
from piezo_ident.identification.step2_dynamics import (
    ArxFactor,
    delayed,
    factor_of,
    instruments_of,
    stabilised,
)
from piezo_ident.operators.dynamics import Delay, Dynamics
from piezo_ident.residual.coherence import cross_spectra
from scipy import optimize, signal

#: na of further starts by instrumental variables
INSTRUMENTS = (4, 8)
#: of the output error, which starts far from its optimum while H is rough
ITERATIONS = 40
#: held-out errors within this share count as equal; the smaller order goes first
SLACK = 0.03
#: poles that together add less than this share of the error go at once
NEGLIGIBLE = 0.3
#: share by which G must lower the held-out error of a pure delay, and that the one of nothing
GAIN = 0.1
#: coherence that a mode needs at its frequency, once it stands out by this share of the gain
COHERENT, TALL = 0.5, 0.05
#: the coherence is seen in windows of so many time constants of the mode, so many at least
RING_TIMES, FEWEST = 8.0, 8


@dataclass(frozen=True, eq=False)
class LinearPart:
    """
    Delay and G that a fast motion shows.

    Attributes
    ----------
    delay : Delay
    fit : OutputErrorFit or None
        G, not normalised; None where a pure delay does as well.
    scan : int or None
        Delay that the scan of the ARX loss points to [samples].
    loss : ndarray or None
        That loss.
    errors : dict of str to float
        Held-out errors of nothing, of a pure delay, and of G, normalised.
    judged : int
        Samples held out.
    largest : int
        Largest order that was tried; 0 where the fast motion is too short for any.
    """

    delay: Delay
    fit: OutputErrorFit | None
    scan: int | None
    loss: Array | None
    errors: dict[str, float]
    judged: int = 0
    largest: int = 0

    @property
    def gain(self) -> float:
        """Sum of squares by which it errs less than nothing on the held-out blocks."""
        return self.judged * (self.errors['nothing'] ** 2 - min(self.errors.values()) ** 2)

    @property
    def methods(self) -> dict[str, float]:
        """Held-out errors as a share of that of nothing [%]."""
        whole = self.errors['nothing']
        return {k: 100.0 * e / whole for k, e in self.errors.items()} if whole > 0.0 else {}


def _moved(excerpts: Sequence[Excerpt], delay: int) -> list[Excerpt]:
    return [Excerpt(delayed(e.u, delay), e.x, e.use) for e in excerpts] if delay else [*excerpts]


def _factor(motion: FastMotion, na: int, lags: int) -> ArxFactor | None:
    """Return the factor of all stretches that are long enough."""
    width = na + lags + 1
    parts = [
        (e.u[start:stop], e.x[start:stop])
        for e in motion.whole
        for start, stop in e.joined
        if stop - start >= 3 * width
    ]
    factor = factor_of(parts, na, lags) if parts else None
    return factor if factor is not None and factor.n >= 10 * width else None


def _pure_delay(motion: FastMotion) -> tuple[Delay, float]:
    """Return the delay that alone leaves least of the held-out blocks, and what it leaves."""

    def error(total: float) -> float:
        whole = int(total)
        b = np.zeros(whole + 2)
        b[whole:] = 1.0 - (total - whole), total - whole
        return simulation_error(motion.held, Dynamics(np.empty(0), b))

    coarse = int(np.argmin([error(d) for d in range(MAX_DELAY)]))
    found = optimize.minimize_scalar(
        error, bounds=(max(0.0, coarse - 1.0), coarse + 1.0), method='bounded'
    )
    total = float(found.x) if found.fun < error(0.0) else 0.0
    return Delay(int(total), total - int(total)), error(total)


def _modal(G: Dynamics) -> tuple[NDArray[np.complex128], NDArray[np.complex128], Array]:
    """Return residues and poles of G, and the terms without a pole."""
    residues, poles, direct = signal.residuez(G.b, np.concatenate([[1.0], G.a]))
    return residues, poles, np.real(np.atleast_1d(direct))


def _supported(G: Dynamics, motion: FastMotion) -> bool:
    """Return whether the motion shows each mode that rings: nothing else may."""
    residues, poles, _ = _modal(G)
    height = np.abs(residues) / np.maximum(1.0 - np.abs(poles), 1e-12)
    f = np.abs(np.angle(poles)) * motion.rate / (2.0 * np.pi)
    ringing = (poles.imag > 0.0) & (np.abs(poles) ** 20 > 0.1) & (height > TALL * abs(G.gain))
    least = 512 * max(1, round(motion.rate / 20_000.0))
    longest = max(e.u.size for e in motion.whole)

    @functools.cache
    def coherence(size: int) -> Array | None:
        sums = [cross_spectra(e.u, e.x, size) for e in motion.whole if e.u.size >= size]
        if not sums:
            return None
        s_uu, s_yy, s_uy = (sum(parts) for parts in zip(*sums, strict=True))
        return np.asarray(np.abs(s_uy) ** 2 / np.maximum(s_uu * s_yy, np.finfo(float).tiny))

    for pole, frequency in zip(poles[ringing], f[ringing], strict=True):
        # a window that is shorter than the ring sees the answer to what came before it
        size = max(least, min(int(RING_TIMES / (1.0 - np.abs(pole))), longest // FEWEST))
        found, k = coherence(size), int(frequency * size / motion.rate)
        if found is not None and not (found[max(0, k - 1) : k + 3] > COHERENT).any():
            return False
    return True


def _smaller(G: Dynamics, motion: FastMotion, error: float) -> Dynamics | None:
    """Return G without the poles that add least to the motion; None with no pole left."""
    residues, poles, direct = _modal(G)
    if poles.size < 2:
        return None
    largest = max(motion.whole, key=lambda e: e.u.size)
    f, power = signal.welch(largest.u, motion.rate, nperseg=min(1024, largest.u.size))
    z = np.exp(-2j * np.pi * f / motion.rate)
    pairs = [i for i in range(poles.size) if poles[i].imag >= 0.0]

    def term(i: int) -> NDArray[np.complex128]:
        one = residues[i] / (1.0 - poles[i] * z)
        if poles[i].imag > 0.0:
            one = one + np.conj(residues[i]) / (1.0 - np.conj(poles[i]) * z)
        return np.asarray(one)

    size = {i: float(power @ np.abs(term(i)) ** 2) * (f[1] - f[0]) for i in pairs}
    keep, dropped = np.ones(poles.size, dtype=bool), 0.0
    for i in sorted(pairs, key=lambda i: size[i]):
        dropped += size[i]
        # at least one goes, and with it whatever adds less than the error does
        if not keep.all() and dropped > (NEGLIGIBLE * error) ** 2:
            break
        keep[i] = False
        if poles[i].imag > 0.0:
            keep[np.argmin(np.abs(poles - np.conj(poles[i])))] = False
    if not keep.any():
        return None
    b, a = signal.invresz(residues[keep], poles[keep], direct)
    b, a = np.real(b), np.real(a)
    return Dynamics(a[1:] / a[0], b / a[0])


def _refined(
    motion: FastMotion, G: Dynamics, delay: int, tick: Callable[[], None] = lambda: None
) -> tuple[OutputErrorFit, float] | None:
    """Return G by output error without slow poles and pairs, and its held-out error."""
    stretches = _moved(motion.fitted, delay)
    for _ in range(3):
        fit = output_error(stretches, G, maxiter=ITERATIONS, tick=tick)
        faster = without_slow_part(without_pairs(fit.dynamics, motion.rate), motion.rate)
        if faster is None:
            return None
        if faster.a.size == fit.dynamics.a.size:
            return fit, simulation_error(_moved(motion.held, delay), fit.dynamics)
        G = Dynamics(faster.a, faster.b * fit.dynamics.gain)
    return None


def _reduced(
    motion: FastMotion, start: Dynamics, delay: int, tick: Callable[[], None], rough: bool
) -> list[tuple[OutputErrorFit, float]]:
    """
    Refine G, and take poles from it as long as its held-out error stays.

    Least squares spends poles on the noise; what is left of them does no harm where the motion
    speaks, and anything elsewhere.
    """
    found: list[tuple[OutputErrorFit, float]] = []
    trial: Dynamics | None = start
    least = np.inf
    while trial is not None:
        refined = _refined(motion, trial, delay, tick)
        if refined is not None:
            trial = refined[0].dynamics
            if refined[1] > (1.0 + 2.0 * SLACK) * least:
                break
            if _supported(trial, motion):
                found.append(refined)
                least = min(least, refined[1])
                if rough:
                    break
        error = least if np.isfinite(least) else 0.0
        smaller = _smaller(trial, motion, error)
        trial = None if smaller is None else stabilised(smaller)
    return found


def find_linear_part(
    motion: FastMotion,
    max_order: int,
    *,
    delays: Sequence[int] = (),
    given: int | None = None,
    order: tuple[int, int] | None = None,
    rough: bool = False,
    tick: Callable[[float], None] = lambda share: None,
) -> LinearPart | None:
    """
    Return the delay and the order that err least on held-out blocks.

    Parameters
    ----------
    motion : FastMotion
    max_order : int
        Largest na and nb.
    delays : sequence of int, optional
        Delays to try besides none and those around the scan's [samples].
    given : int, optional
        The only delay to try [samples].
    order : tuple of int, optional
        The only (na, nb) to try.
    rough : bool, optional
        No order below the first that does: good enough to improve H by.
    tick : callable, optional
        Called with the share of the work done; may raise to stop it.

    Returns
    -------
    LinearPart or None
        None where there is nothing to fit or to judge by.
    """
    if not motion.fitted or not motion.held:
        return None
    nothing = simulation_error(_moved(motion.held, given or 0), Dynamics.unit())
    pure, pure_error = _pure_delay(motion)
    if given is not None:
        pure, pure_error = Delay(given), nothing
    if pure_error > (1.0 - GAIN) * nothing:
        pure, pure_error = Delay(given or 0), nothing
    errors = {'nothing': nothing, 'delay': pure_error}
    judges = sum(int(e.use.sum()) for e in motion.held)
    size = max(max_order, *(order or (1, 1)))
    factor, loss, scan = None, None, None
    while size >= 2 and factor is None:
        factor = _factor(motion, size, size + max([MAX_DELAY, *delays, given or 0]))
        size = size if factor is not None else size // 2
    if factor is None:
        return LinearPart(pure, None, None, None, errors, judges)
    loss = factor.losses(min(SCAN_ORDER, size), MAX_DELAY)
    scan = delay_from_loss(loss)
    tried = [*delays, scan or 0, max(0, (scan or 0) - 1), 0] if given is None else [given]
    tried = list(dict.fromkeys(tried))
    found: list[tuple[float, int, OutputErrorFit]] = []
    for i, d in enumerate(tried):
        held = _moved(motion.held, d)

        def judged(G: Dynamics, held: list[Excerpt] = held) -> float:
            return simulation_error(held, G) if G.is_stable else np.inf

        near = [(n, n + more) for n in range(1, size) for more in (-1, 0, 1) if n + more > 0]
        orders = [order] if order else near
        ls = min((factor.dynamics(na, nb, d) for na, nb in orders), key=judged)
        moved = _moved(motion.whole, d)
        starts = [min(ls, instruments_of(moved, ls), key=judged)]
        # noise bends least squares, and the more the higher the rate
        first = [(n, n + 1) for n in INSTRUMENTS if order is None and n < size]
        starts += [instruments_of(moved, factor.dynamics(*n, d)) for n in first]
        starts.sort(key=judged)
        done = functools.partial(tick, i / len(tried))
        for start in starts[: 1 if rough else None]:
            fits = _reduced(motion, stabilised(start), d, done, rough)
            found += [(error, d, fit) for fit, error in fits]
    least = min((error for error, *_ in found), default=np.inf)
    if least > (1.0 - GAIN) * pure_error:
        return LinearPart(pure, None, scan, loss, errors, judges, size)
    best = min(
        (f for f in found if f[0] <= (1.0 + SLACK) * least),
        key=lambda f: f[2].dynamics.a.size + f[2].dynamics.b.size,
    )
    errors['dynamics'] = best[0]
    return LinearPart(Delay(best[1]), best[2], scan, loss, errors, judges, size)


def refined_linear_part(motion: FastMotion, linear: LinearPart) -> LinearPart:
    """Return the same order refined on all samples of a motion, held-out blocks included."""
    if linear.fit is None:
        return linear
    both = replace(motion, fitted=motion.whole)
    found = _refined(both, linear.fit.dynamics, linear.delay.samples)
    if found is None or not _supported(found[0].dynamics, both):
        return linear
    return replace(linear, fit=found[0])
