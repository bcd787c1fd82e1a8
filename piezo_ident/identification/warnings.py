# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Warnings of an identification: about the fit, its errors and its data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from piezo_ident.common.arrays import Array, Mask
from piezo_ident.identification.errors import Prediction
from piezo_ident.identification.prepare import Excerpt, MOVES, Run
from piezo_ident.identification.results import Identification
from piezo_ident.identification.step1_delay import DelayResult, no_step
from piezo_ident.identification.step2_dynamics import DynamicsResult
from piezo_ident.identification.step3_choice import PAPER_COUNT
from piezo_ident.identification.step3_hysteresis import HysteresisFit
from piezo_ident.model.scaling import Scaling
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.channels import role_of
from piezo_ident.record.readings.suspicions import line_error, misspelt
from piezo_ident.record.record import Piece, Record

#: change of G within the excited band below which the band is too narrow to know G
HARDLY = 0.1
#: measured and modelled small-signal gain may differ by this share without a warning
SLOPE_TOLERANCE = 0.05
#: smallest error that counts, % of stroke; a record without noise may be fitted exactly
TINY = 1e-9
#: zeros of displacement may differ by this share of the stroke without a warning
ZERO_MOVED = 2e-3
#: crossings of the range, two for each sweep up and down, that make more than a single sweep
CROSSINGS = 4.0
#: number of parts of the range in which the two branches of a loop are compared, and the number
#: that must hold data
BINS, SEEN = 16, 12
#: smallest distance of the branches at both ends that is reported, relative to the distance in the
#: middle, and as a share of the stroke
OPEN, OPENING = 2.0, 0.1
#: terms of each wider law of H, in words
LAW_WORDS = {
    'square': 'a square of the voltage',
    'bias': 'plays whose weight goes with the voltage',
    'preisach': 'a Preisach density that goes with the bias',
    'duhem': 'a Preisach density that goes with the bias, and lags along the path of the voltage',
}


def warnings_of(
    result: Identification, records: Sequence[Record], pieces: Sequence[Piece]
) -> list[str]:
    """
    List contradictions between the steps, and fits that the data do not support.

    `records` were fitted; `pieces` are their pieces at the sampling rate of the model.
    """
    warnings = [*_of_fit(result), *_of_band(result.dynamics, result.model)]
    wrong = misspelt([label for record in records for label in record.labels])
    if wrong:
        warnings.append(f'segment labels that mean nothing here: {", ".join(wrong)}')
    return [*warnings, *_of_axes(pieces), *warn_of_errors(result, pieces)]


def _of_axes(pieces: Sequence[Piece]) -> list[str]:
    """Warn if other axes were driven, too."""
    moved = {
        name: None
        for piece in pieces
        for name, x in piece.channels.items()
        # the voltage monitor of an axis at rest still shows noise
        if role_of(name) == 'v' and np.ptp(x) > MOVES * np.ptp(piece.v)
    }
    if not moved:
        return []
    return [
        f'{", ".join(moved)} moved, too: their effect on this axis counts as its error and noise; '
        'record the displacements of these axes, too, and identify all of them (docs/two_axes.md)'
    ]


def _of_law(fit: HysteresisFit) -> list[str]:
    """Report a wider law of H than the sum of plays."""
    if fit.law == 'plays':
        return []
    ours, plays = (100.0 * fit.errors_of_laws[name] for name in (fit.law, 'plays'))
    return [
        f'the hysteresis is not a sum of plays: H has {LAW_WORDS[fit.law]}, which predicts parts '
        f'of the data from the others to {ours:.2g} % of stroke instead of {plays:.2g} %'
    ]


def warn_of_delay(delay: DelayResult) -> list[str]:
    """Warn if noise alone tells the delay, with the reason why the steps do not."""
    if delay.step is not None and delay.step.samples is not None:
        return []
    if delay.source == 'scan':
        return [f'{no_step(delay.step)}; the delay was read from the ARX loss alone']
    if delay.source == 'free run' and delay.scan is None:
        return [
            f'{no_step(delay.step)}, and the ARX loss tells no delay; a free run over the noise '
            f'allows {delay.samples} samples, give or take {delay.std:.2g}; add larger steps, or '
            'set --delay'
        ]
    return []


def _of_fit(result: Identification) -> list[str]:
    delay, dynamics, fit = result.delay, result.dynamics, result.hysteresis
    warnings = []
    if delay.agree is False and delay.step is not None:
        followed = {
            'steps': 'the steps were',
            'scan': 'the fit was',
            'free run': 'a free run over the noise was',
        }.get(delay.source, 'neither was')
        warnings.append(
            f'steps say a delay of {delay.step.samples} samples, the ARX fit says {delay.scan}; '
            f'{followed} followed'
        )
    measured, modelled = dynamics.slope_measured, dynamics.slope_model
    if np.isfinite(measured) and abs(measured / modelled - 1.0) > SLOPE_TOLERANCE:
        warnings.append(
            f'the small-signal gain of the noise, {measured:.3g}, is not the slope of H at its '
            f'bias, {modelled:.3g} (normalised)'
        )
    if result.noise_floor is not None and result.noise_floor > 1.0:
        warnings.append(f'the sensor noise is {result.noise_floor:.2g} % of stroke')
    warnings += _of_law(fit)
    if fit.swarm is not None and fit.swarm_loss is not None:
        excess = fit.swarm_loss / fit.optimum_loss - 1.0 if fit.optimum_loss > 0 else 0.0
        if excess > 0.01:
            warnings.append(
                f'the swarm ended {100.0 * excess:.2g} % of the loss above the least-squares '
                f'optimum{", before polishing" if fit.polished else ""}; more iterations bring it '
                'closer'
            )
    return warnings


def _of_band(dynamics: DynamicsResult, model: StageModel) -> list[str]:
    """Warn if the excitation ends before G acts."""
    # a band up to nearly half the sampling rate is wide enough; a static G has its own message
    if not dynamics.known_to < 0.2 * model.sample_rate or model.dynamics.is_static:
        return []
    G = model.dynamics.response([dynamics.known_to], model.sample_rate)[0]
    change = float(np.abs(G - 1.0))
    if change > HARDLY:
        return []
    return [
        f'the voltage drives the stage up to {dynamics.known_to:.3g} Hz, where G is within '
        f'{100 * change:.2g} % of its static gain. G is unknown at higher frequencies; record '
        'noise of higher frequencies'
    ]


def warn_of_errors(result: Identification, pieces: Sequence[Piece]) -> list[str]:
    """Warn if the errors say that the model explains little, or lacks an effect."""
    warnings = []
    chosen, held = result.error('selection'), result.error('held out')
    error = held if np.isfinite(held) else chosen
    line, y = line_error(pieces), np.concatenate([piece.y for piece in pieces])
    resting = 100.0 * float(y.std() / max(np.ptp(y), np.finfo(float).tiny))
    # a stage without hysteresis is a line with noise, and its model cannot beat the line
    if np.isfinite(error) and error > max(0.5 * line, 2.0 * (result.noise_floor or 0.0)):
        warnings.append(
            f'the model errs by {error:.3g} % of stroke, where a straight line errs by '
            f'{line:.3g} % and a constant by {resting:.3g} %: it explains '
            + ('little of these data' if error > 0.5 * resting else 'little more than the line')
        )
    easy = [row.percent for row in result.errors if row.data == 'held out' and not row.driven]
    if np.isfinite(chosen) and easy and max(easy) > 2.0 * max(chosen, TINY):
        warnings.append(
            f'on rests and ramps the model errs by up to {max(easy):.3g} % of stroke, more than '
            f'the {chosen:.3g} % on the data that chose it. The model lacks an effect of the '
            'stage: diagnose it, or identify it with the solver joint, which fits all motion '
            'together'
        )
    fitted = result.error('fitted')
    if result.dynamics.table is None and held > 3.0 * max(fitted, TINY):
        span = max(float(np.ptp(piece.v)) for piece in pieces)
        times = sum(float(np.abs(np.diff(piece.v)).sum()) for piece in pieces) / span
        once = f'the voltage crosses its range {times:.2g} times; drive it more often'
        warnings.append(
            f'the held-out error is {held / max(fitted, TINY):.1f} times the fitted error: this '
            'record does not determine the model, '
            + (f'as {once}' if times < CROSSINGS else 'or the stage changes in it')
        )
    return warnings


def only_jumps(excerpts: Sequence[Excerpt]) -> str:
    """Describe the gap between levels of the voltage if it only jumps; else empty."""
    gap = min(map(_jumped_over, (e.u for e in excerpts)))
    # on as many levels as the paper has plays, a staircase is as good as a triangle
    if PAPER_COUNT * gap <= 1.0:
        return ''
    return (
        f'the voltage only jumps between levels, and {gap:.0%} of its range lies between two '
        'neighbours and was never seen; add a slow triangle'
    )


def _jumped_over(u: Array) -> float:
    """
    Compute the widest gap between levels at which a voltage rests, as a share of its range.

    The gap is 0 unless the voltage rests most of the time and moves in a few large jumps.
    """
    du, span = np.abs(np.diff(u)), float(np.ptp(u))
    large = du > 0.02 * span
    if span == 0.0 or du[large].sum() <= 0.9 * du.sum() or np.mean(large) >= 0.1:
        return 0.0
    return float(np.diff(np.sort(u[1:][~large])).max(initial=0.0)) / span


def warn_of_shape(predictions: Sequence[Prediction], scaling: Scaling) -> list[str]:
    """
    Warn of a measured loop whose shape no H of this package has.

    The branches of H rise.  The even part of its loop, the same for a rise of the voltage from the
    middle as for a fall, therefore has less than half of the variance.  Loops of plays are widest
    in the middle.
    """
    measured = _branches(predictions, [p.run.piece.y / scaling.Y for p in predictions])
    modelled = _branches(predictions, [p.y_hat / scaling.Y for p in predictions])
    seen = np.isfinite(measured[0] + measured[1])
    thirds = [slice(0, 6), slice(6, 10), slice(10, BINS)]
    if seen.sum() < SEEN or not all(seen[third].any() for third in thirds):
        return []
    warnings, middle = [], scaling.v(0.5)
    rise, fall = measured[0], measured[1, ::-1]
    even, odd = (float(np.nanvar(x)) for x in (rise + fall, rise - fall))
    if even > odd:
        warnings.append(
            f'{even / (even + odd):.0%} of the displacement is even in the voltage about '
            f'{middle:.4g} V, the same for a rise as for a fall (variance of its mean loop). '
            'The branches of H rise, so less than half of its loop is even'
        )
    apart, of_model = (
        [float(np.nanmean((x[1] - x[0])[third])) for third in thirds] for x in (measured, modelled)
    )
    if all(
        abs(apart[i]) > max(OPEN * abs(apart[1]), OPENING)
        and abs(apart[i] - of_model[i]) > 0.5 * abs(apart[i])
        for i in (0, 2)
    ):
        low, mid, high = (1e6 * abs(scaling.Y) * abs(w) for w in apart)
        warnings.append(
            f'the loops open towards the ends: rising and falling branch are {low:.3g} um apart '
            f'below {middle:.4g} V, {high:.3g} um above, and {mid:.3g} um around it; the loops of '
            'H are widest in the middle'
        )
    return warnings


def _branches(predictions: Sequence[Prediction], signals: Sequence[Array]) -> Array:
    """Average signals in parts of the range, shape (2, BINS), on rising and falling branch."""
    u, x = np.concatenate([p.run.u for p in predictions]), np.concatenate(signals)
    du = np.concatenate([np.gradient(p.run.u) for p in predictions])
    use = np.concatenate([p.run.use for p in predictions])
    bins = np.clip((u * BINS).astype(int), 0, BINS - 1)
    branches = np.full((2, BINS), np.nan)
    for branch, there in zip(branches, (use & (du > 0.0), use & (du < 0.0)), strict=True):
        count = np.bincount(bins[there], minlength=BINS)
        total = np.bincount(bins[there], x[there], minlength=BINS)
        np.divide(total, count, out=branch, where=count > 0)
    return branches


def warn_of_thresholds(held: Sequence[Excerpt], count: int | None, law: str) -> list[str]:
    """Warn if the triangle has no held-out block, which would choose the thresholds of plays."""
    if count is not None or law != 'plays' or any(e.use.any() for e in held):
        return []
    return [
        'the triangle turns too often, or has too few samples, to hold a part of it out: the '
        f'number of thresholds could not be chosen and is {PAPER_COUNT}; use a slower triangle'
    ]


def warn_of_triangle(lowest: float, highest: float, scaling: Scaling) -> list[str]:
    """Warn if the triangle, between two normalised voltages, does not cover the record."""
    if lowest <= 0.01 and highest >= 0.99:
        return []
    return [
        'the triangle does not cover the voltages of the record: it reaches '
        f'{scaling.v(lowest):.3g} .. {scaling.v(highest):.3g} V'
    ]


def warn_of_range(runs: Sequence[Run], fitted: Sequence[Mask], scaling: Scaling) -> list[str]:
    """Warn if samples that are held out leave the voltage range of the samples that are fitted."""
    pairs = list(zip(runs, fitted, strict=True))
    sides = ([run.u[run.use & (mask == side)] for run, mask in pairs] for side in (True, False))
    spans = [(part.min(), part.max()) for part in map(np.concatenate, sides) if part.size]
    if len(spans) < 2 or (spans[1][0] > spans[0][0] - 0.01 and spans[1][1] < spans[0][1] + 0.01):
        return []
    one, other = (f'{scaling.v(low):.3g} .. {scaling.v(high):.3g} V' for low, high in spans)
    return [
        f'the fitted part covers {one}, the held-out part {other}: part of the held-out error '
        'comes from extrapolation'
    ]


def warn_of_zeros(offsets: Mapping[tuple[str, float], float], scaling: Scaling) -> list[str]:
    """Warn if the displacement of a run has another zero than the model."""
    return [
        f'{record}: its zero of displacement lies {1e6 * offset:.3g} um from the zero of the '
        'model; its errors do not include this shift'
        for (record, _), offset in offsets.items()
        if abs(offset) > ZERO_MOVED * abs(scaling.Y)
    ]
