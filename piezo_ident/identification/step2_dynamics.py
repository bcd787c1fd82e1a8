# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Step 2: find G from noise, with the hysteresis undone.

Noise moves the plays, and a linear fit takes their motion for slow dynamics.  G is therefore found
twice.  After a first G, a temporary H with fine thresholds is fitted to the triangle.  Its output
w = H[v] replaces the voltage.  The orders are ranked by the held-out free-run error from w to y.
The best few, without slow poles, are refined on noise and steps.  Their held-out error chooses.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
import functools

import numpy as np
from numpy.typing import ArrayLike, NDArray
from piezo_ident.common.arrays import Array, Mask
from piezo_ident.common.errors import IdentificationError
from piezo_ident.identification.prepare import Excerpt, excerpts_of, Run
from piezo_ident.identification.settings import Progress, Settings
from piezo_ident.identification.solvers.arx import (
    arx_factor,
    delayed,
    free_run_error,
    instrumental_variables,
    OrderTable,
    scan_orders,
    stabilised,
)
from piezo_ident.identification.solvers.output_error import output_error, simulation_error
from piezo_ident.identification.spectra import (
    frequency_response,
    FrequencyResponse,
    longest_noise,
    noise_segment,
    NoiseSegment,
)
from piezo_ident.identification.step3_hysteresis import factorise, fine_thresholds, fit_hysteresis
from piezo_ident.operators.dynamics import Delay, Dynamics, filter_arx
from piezo_ident.operators.hysteresis import Hysteresis
from scipy import signal

#: real poles below this frequency come from creep or from errors of H, not from dynamics [Hz]
SLOW_POLE = 40.0
#: same limit at low sampling rates, as a share of the rate
SLOW_POLE_SHARE = 0.01
#: The frequencies of a pole and a zero that form a pair differ by less than the factor `PAIR`.
#: They lie below the share `BELOW_MODES` of the lowest mode that rings.  A mode rings if its
#: damping is below `RINGS`.  A pair may come from errors of H on small motion
PAIR, BELOW_MODES, RINGS = 4.0 / 3.0, 1.0 / 3.0, 0.3
#: orders within this share of the best held-out error count as equal; the smallest is tried first
SLACK = 0.05
#: share by which instrumental variables must err less than least squares to choose the orders
INSTRUMENTS = 0.2
#: share by which a larger order must lower the held-out error
GAIN = 0.005
#: samples that are simulated ahead of the first sample that counts
WARM_UP = 2000
#: number of candidate orders that are refined and judged again
CANDIDATES = 5
#: most iterations that refine a candidate.  Many are needed with a coarse converter at a high
#: rate: least squares and instrumental variables then start far from modes that ring for long
REFINING = 40
#: motion slower than this is creep, not dynamics; it is filtered out before G is refined [Hz]
SLOWEST = 5.0
#: share by which the error must fall if G is refined with another law of H
REFINED = 0.25


@dataclass(frozen=True, eq=False)
class DynamicsResult:
    """
    Result of step 2.

    Attributes
    ----------
    order : tuple of int
        (na, nb); (0, 1) stands for G = 1.
    table : OrderTable or None
        Least squares at every order, after the hysteresis was undone.
    methods : dict of str to float
        Held-out free-run error of each method at the chosen order, in % of the rms of the
        held-out output; infinite if unstable.
    covariance : ndarray, shape (na + nb, na + nb)
        Covariance of (a, b).
    response : FrequencyResponse or None
        Measured response, normalised: from voltage to displacement on a noise segment, else from
        the output of H to displacement on any broadband motion.
    bias, slope_measured, slope_model : float
        Mean voltage of the noise segment, and the small-signal gain in this segment: of the
        measured displacement, and of H.  All are normalised.
    band : float
        Highest frequency with power in the input [Hz].
    others : tuple of Dynamics
        G of other orders whose error counts as equal.
    """

    order: tuple[int, int]
    table: OrderTable | None
    methods: dict[str, float]
    covariance: Array
    response: FrequencyResponse | None = None
    bias: float = float('nan')
    slope_measured: float = float('nan')
    slope_model: float = float('nan')
    band: float = float('nan')
    others: tuple[Dynamics, ...] = ()

    @property
    def known_to(self) -> float:
        """Highest frequency with power in the input, or with a measured response [Hz]."""
        measured = () if self.response is None else self.response.frequency
        return float(np.fmax.reduce(measured, initial=self.band))


def without_slow_part(G: Dynamics, rate: float) -> Dynamics | None:
    """Remove the slow real poles of G, with G(1) = 1; None if a slow pole cannot be removed."""
    slowest = min(SLOW_POLE, SLOW_POLE_SHARE * rate)
    poles = G.poles
    decay = -np.log(np.maximum(np.abs(poles), 1e-300)) * rate / (2.0 * np.pi)
    slow = np.hypot(decay, np.angle(poles) * rate / (2.0 * np.pi)) < slowest
    if not slow.any():
        return G.normalised()
    if np.any(poles[slow].imag != 0.0):
        return None
    faster = G.without_slow_poles(slowest, rate)
    return faster.normalised() if faster.a.size < G.a.size else None


def fast_part(G: Dynamics, rate: float, lean: bool) -> Dynamics:
    """Normalise G to G(1) = 1, without removable slow poles; `lean` removes pairs as well."""
    G = without_pairs(G, rate) if lean else G
    return without_slow_part(G, rate) or G.normalised()


def without_pairs(G: Dynamics, rate: float) -> Dynamics:
    """
    Remove decaying poles far below the modes of G, each with a zero of nearly its frequency.

    Such a pair arises if small loops open less than H predicts, or if the hysteresis depends on
    the rate.  Least squares may also place two such poles off the real axis, strongly damped.
    """
    rings = [mode.frequency for mode in G.modes(rate) if mode.damping < RINGS]
    highest = BELOW_MODES * min(rings, default=0.0)
    poles, zeros = (np.asarray(roots, dtype=complex) for roots in (G.poles, np.roots(G.b)))
    for pole in sorted(poles[_decaying(poles, 0.0, highest, rate)], key=abs, reverse=True):
        frequency = float(_frequency(pole, rate))
        near = np.flatnonzero(_decaying(zeros, frequency / PAIR, frequency * PAIR, rate))
        # a conjugate pair of poles goes with a conjugate pair of zeros
        count = 1 if pole.imag == 0.0 else 2
        chosen = near[np.argsort(np.abs(zeros[near] - pole))][:count]
        if pole.imag < 0.0 or chosen.size < count or abs(zeros[chosen].sum().imag) > 1e-9:
            continue
        zeros = np.delete(zeros, chosen)
        poles = poles[~np.isin(poles, (pole, pole.conjugate()))]
    if poles.size == G.a.size:
        return G
    a, b = (np.atleast_1d(np.real(np.poly(roots))) for roots in (poles, zeros))
    return Dynamics(a[1:], b * G.gain * a.sum() / b.sum())


def _frequency(roots: ArrayLike, rate: float) -> Array:
    """Compute the natural frequencies of roots [Hz]."""
    z = np.asarray(roots, dtype=complex)
    return np.asarray(np.abs(np.log(np.where(z == 0.0, 1e-300, z))) * rate / (2.0 * np.pi))


def _decaying(roots: NDArray[np.complex128], low: float, high: float, rate: float) -> Mask:
    """Mark roots with damping above `RINGS` and frequencies between two limits [Hz]."""
    frequency = _frequency(roots, rate)
    decay = -np.log(np.maximum(np.abs(roots), 1e-300)) * rate / (2.0 * np.pi)
    return np.asarray((frequency > low) & (frequency < high) & (decay > RINGS * frequency))


def _orders(
    noise: NoiseSegment,
    settings: Settings,
    delay: int,
    candidates: int,
    progress: Callable[[float], None],
) -> list[tuple[DynamicsResult, Dynamics]]:
    """Search the orders and refine the best few."""
    size = max(settings.max_order, *(settings.order or (1, 1)))
    u, y = noise.fitted
    factor = arx_factor(u, y, size, size + delay)
    table = scan_orders(
        factor, delay, settings.max_order, *noise.held, lambda share: progress(0.5 * share)
    )
    refined_on = Excerpt(delayed(u, delay), y, np.arange(u.size) >= u.size // 50)

    def held_error(model: Dynamics) -> float:
        return float(100.0 * free_run_error(model, delay, *noise.held) / noise.held[1].std())

    orders = [settings.order] if settings.order else table.ranked(SLACK)
    if not settings.order:
        # noise biases least squares strongly for a mode that rings for thousands of samples
        sizes = range(2, min(table.loss.shape) + 1, 2)
        by_instruments = {
            (n, n): free_run_error(
                instrumental_variables(u, y, factor.dynamics(n, n, delay), delay),
                delay,
                *noise.held,
            )
            for n in sizes
        }
        least = min(by_instruments.values(), default=np.inf)
        if least < (1.0 - INSTRUMENTS) * table.held_out.min():
            orders = [o for o, error in by_instruments.items() if error <= (1.0 + SLACK) * least]
    orders = orders[:candidates]
    if not orders:
        raise IdentificationError(
            'dynamics: no order up to '
            f'({settings.max_order}, {settings.max_order}) gave a stable model; '
            'is the noise segment really noise, and is the displacement its answer?'
        )
    refined = []
    for i, (na, nb) in enumerate(orders):
        ls = factor.dynamics(na, nb, delay)
        iv = instrumental_variables(u, y, ls, delay)
        errors = {'least squares': held_error(ls), 'instrumental variables': held_error(iv)}
        start = iv if errors['instrumental variables'] < errors['least squares'] else ls
        # ticks repeat the share of the work, only so that the caller can stop within an iteration
        tick = functools.partial(progress, 0.5 + 0.5 * i / len(orders))
        fit = output_error([refined_on], stabilised(start), maxiter=REFINING, tick=tick)
        errors['output error'] = held_error(fit.dynamics)
        if np.isfinite(errors['output error']):
            result = DynamicsResult((na, nb), table, errors, fit.covariance, band=noise.band)
            refined.append((result, fit.dynamics))
        progress(0.5 + 0.5 * (i + 1) / len(orders))
    if not refined:
        raise IdentificationError('dynamics: no stable model was found; set --order')
    return refined


def second_step(
    runs: Sequence[Run], delay: Delay, settings: Settings, progress: Progress, lean: bool = False
) -> tuple[DynamicsResult, Dynamics]:
    """
    Find G without hysteresis; the returned dynamics are stable, with G(1) = 1.

    `lean` takes the pairs of `without_pairs` out of G.  Raises IdentificationError if no
    order gives a stable model.
    """
    d = delay.samples
    run, start, stop = longest_noise(runs)

    def part(start: float, width: float) -> Callable[[float], None]:
        return lambda share: progress('dynamics', start + width * share)

    progress('dynamics', 0.0)
    # a first G that is only good enough to undo the hysteresis
    rate = run.piece.sample_rate
    raw = noise_segment(run, run.u, start, stop)
    [(_, first)] = _orders(raw, settings, d, 1, part(0.0, 0.3))
    del raw  # a gigabyte for a record of an hour
    G = fast_part(first, rate, lean)

    excerpts = excerpts_of(runs, 'triangle')
    swing = max(e.swing for e in excerpts)
    r = fine_thresholds(swing, float(np.ptp(run.u[start:stop])))

    def undo(G: Dynamics) -> Hysteresis:
        return fit_hysteresis(factorise(excerpts, r, G, delay), r).hysteresis

    H = undo(G)
    progress('dynamics', 0.45)
    undone = noise_segment(run, run.through(H), start, stop)
    candidates = _orders(undone, settings, d, CANDIDATES, part(0.45, 0.2))
    result, G = _best_in_free_run(candidates, runs, H, delay, progress, lean)
    H = undo(G)
    tick = functools.partial(progress, 'dynamics', 0.85)
    fit = output_error(_stretches(runs, H, delay)[0], G, maxiter=8, tick=tick)
    G = fast_part(fit.dynamics, rate, lean)
    progress('dynamics', 0.95)
    # regress the measured and the modelled displacement alike: the noise drags plays along in both
    noise = slice(max(0, start - WARM_UP), stop)
    g_u, g_w = (
        filter_arx(G.a, G.b, delay.apply(z)[noise])[start - stop :]
        for z in (run.u, run.through(H))
    )
    g_u, g_w, x = (signal.detrend(z) for z in (g_u, g_w, run.x[start:stop]))
    slope_measured, slope_model = float(g_u @ x / (g_u @ g_u)), float(g_u @ g_w / (g_u @ g_u))
    response = frequency_response(run.u[start:stop], run.x[start:stop], rate, result.band)
    progress('dynamics', 1.0)
    complete = replace(
        result,
        order=(G.a.size, G.b.size),
        covariance=fit.normalised_covariance,
        response=response,
        bias=float(run.u[start:stop].mean()),
        slope_measured=slope_measured,
        slope_model=slope_model,
    )
    return complete, G


def _best_in_free_run(
    candidates: Sequence[tuple[DynamicsResult, Dynamics]],
    runs: Sequence[Run],
    H: Hysteresis,
    delay: Delay,
    progress: Progress,
    lean: bool,
) -> tuple[DynamicsResult, Dynamics]:
    """Refine each G by its free run, and choose the best on the held-out samples."""
    # noise alone hardly shows a slow pole with a tiny residue; steps that were not fitted show it
    stretches, held = _stretches(runs, H, delay)
    rate = runs[0].piece.sample_rate
    best, (result, G) = float('inf'), candidates[0]
    G = fast_part(G, rate, lean)
    refined = []
    for i, (candidate, start) in enumerate(candidates):
        tick = functools.partial(progress, 'dynamics', 0.65 + 0.2 * i / len(candidates))
        fit = output_error(stretches, fast_part(start, rate, lean), maxiter=6, tick=tick)
        score = simulation_error(held, fit.dynamics)
        refined.append((score, fast_part(fit.dynamics, rate, lean)))
        # a larger model comes later, and must lower the error to win
        if score < best / (1.0 + GAIN):
            best, result = score, candidate
            G = refined[-1][1]
        progress('dynamics', 0.65 + 0.2 * (i + 1) / len(candidates))
    others = tuple(x for score, x in refined if x is not G and score <= (1.0 + SLACK) * best)
    return replace(result, others=others), G


def beside_law(
    runs: Sequence[Run],
    H: Hysteresis,
    dynamics: DynamicsResult,
    G: Dynamics,
    delay: Delay,
    lean: bool = False,
) -> tuple[DynamicsResult, Dynamics] | None:
    """
    Refine G with an H of another law than the law with which G was found.

    The result is None unless the refined G lowers the held-out error by the share `REFINED`.
    """
    stretches, held = _stretches(runs, H, delay)
    fit = output_error(stretches, G, maxiter=8)
    refined = fast_part(fit.dynamics, runs[0].piece.sample_rate, lean)
    if simulation_error(held, refined) > (1.0 - REFINED) * simulation_error(held, G):
        return None
    return replace(dynamics, covariance=fit.normalised_covariance), refined


def _stretches(
    runs: Sequence[Run], H: Hysteresis, delay: Delay
) -> tuple[list[Excerpt], list[Excerpt]]:
    """Cut out the excerpts that refine G, and the same excerpts with the held-out samples only."""
    fitted: list[Excerpt] = []
    held: list[Excerpt] = []
    for run in runs:
        out = run.held_out()
        use = run.mask('step', 'settle', 'noise') & run.use
        if use.any():
            # the samples before the first used sample let the transient die away
            first, last = np.flatnonzero(use)[[0, -1]]
            part = slice(max(0, int(first) - WARM_UP), int(last) + 1)
            w, y = delay.apply(run.through(H))[part], run.x[part]
            w, y = w - w[0], y - y[:20].mean()
            if run.piece.sample_rate > 2.0 * SLOWEST:
                # input and output pass the same filter, so G still leads from one to the other
                sos = signal.butter(2, SLOWEST, 'high', fs=run.piece.sample_rate, output='sos')
                w, y = signal.sosfilt(sos, w), signal.sosfilt(sos, y)
            for stretches, mask in ((fitted, use & ~out), (held, use & out)):
                if mask.any():
                    stretches.append(Excerpt(w, y, mask[part]))
    return fitted, held
