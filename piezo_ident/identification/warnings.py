# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Warnings of an identification: about the fit, its errors and its data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from piezo_ident.common.arrays import Mask
from piezo_ident.identification.prepare import Run
from piezo_ident.identification.results import DynamicsResult, Identification
from piezo_ident.identification.step3_hysteresis import HysteresisFit
from piezo_ident.model.scaling import Scaling
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.channels import role_of
from piezo_ident.record.faults import line_error, misspelt
from piezo_ident.record.record import Piece, Record

#: change of G within the excited band below which the band is too narrow to know G by
HARDLY = 0.1
#: measured and modelled small-signal gain may differ by this share before it is said
SLOPE_TOLERANCE = 0.05
#: zeros of displacement may differ by this share of the stroke before it is said
ZERO_MOVED = 2e-3
#: what each wider law of H has
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
    Return where the steps contradict each other, or the data do not carry what was fitted.

    `records` were fitted; `pieces` are those of them that have the sampling rate of the model.
    """
    warnings = [*_of_fit(result), *_of_band(result.dynamics, result.model)]
    wrong = misspelt([label for record in records for label in record.labels])
    if wrong:
        warnings.append(f'segment labels that mean nothing here: {", ".join(wrong)}')
    return [*warnings, *_of_axes(pieces), *_of_errors(result, pieces)]


def _of_axes(pieces: Sequence[Piece]) -> list[str]:
    """Say when other axes were driven, too."""
    moved = {
        name: None
        for piece in pieces
        for name, x in piece.channels.items()
        if role_of(name) == 'v' and np.ptp(x) > 0.0
    }
    if not moved:
        return []
    return [
        f'{", ".join(moved)} moved, too: what they do to this axis counts as its error and noise; '
        'a stage of several axes is identified by identify_axes (docs/two_axes.md)'
    ]


def _of_law(fit: HysteresisFit) -> list[str]:
    """Say when the loops are no sum of plays."""
    if fit.law == 'plays':
        return []
    ours, plays = (100.0 * fit.errors_of_laws[name] for name in (fit.law, 'plays'))
    return [
        f'the hysteresis is not a sum of plays: H has {LAW_WORDS[fit.law]}, which predicts parts '
        f'of the data from the others to {ours:.2g} % of stroke instead of {plays:.2g} %'
    ]


def _of_fit(result: Identification) -> list[str]:
    delay, dynamics, fit = result.delay, result.dynamics, result.hysteresis
    warnings = []
    if delay.agree is False and delay.step is not None:
        followed = {'steps': 'the steps were', 'scan': 'the fit was'}
        warnings.append(
            f'steps say a delay of {delay.step.samples} samples, the ARX fit says {delay.scan}; '
            f'{followed.get(delay.source, "a free run over the noise was")} followed'
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
    """Say when the excitation ends where G has hardly begun to act."""
    # a band that ends near half the sampling rate leaves nothing to see, and without a G that is
    # said already
    if not dynamics.known_to < 0.2 * model.sample_rate or model.dynamics.is_static:
        return []
    G = model.dynamics.response([dynamics.known_to], model.sample_rate)[0]
    change = float(np.abs(G - 1.0))
    if change > HARDLY:
        return []
    return [
        f'the voltage drives the stage up to {dynamics.known_to:.3g} Hz, where G is within '
        f'{100 * change:.2g} % of its static gain: what it does beyond is not known; record noise '
        'up to higher frequencies'
    ]


def _of_errors(result: Identification, pieces: Sequence[Piece]) -> list[str]:
    warnings = []
    chosen, held = result.error('selection'), result.error('held out')
    error = held if np.isfinite(held) else chosen
    line = line_error(pieces)
    if np.isfinite(error) and error > 0.5 * line:
        warnings.append(
            f'the model errs by {error:.3g} % of stroke, where a straight line errs by '
            f'{line:.3g} %: it explains little of these data'
        )
    easy = [row.percent for row in result.errors if row.data == 'held out' and not row.driven]
    if np.isfinite(chosen) and easy and max(easy) > 2.0 * chosen:
        warnings.append(
            f'where the stage only rests or is moved over, the model errs by up to '
            f'{max(easy):.3g} % of stroke, more than the {chosen:.3g} % on what chose it: the '
            'stage does something that the model lacks; judge it on a record of another kind'
        )
    fitted = result.error('fitted')
    # a record without noise may be fitted exactly
    if result.dynamics.table is None and held > 3.0 * max(fitted, 1e-9):
        warnings.append(
            f'the held-out error is {held / max(fitted, 1e-9):.1f} times the fitted one: this '
            'record does not pin the model down; drive the range more than once'
        )
    return warnings


def warn_of_range(runs: Sequence[Run], fitted: Sequence[Mask], scaling: Scaling) -> list[str]:
    """Return a warning when the held-out parts leave the voltages of the fitted ones."""
    pairs = list(zip(runs, fitted, strict=True))
    parts = [run.u[mask] for run, mask in pairs], [run.u[~mask] for run, mask in pairs]
    spans = [(min(map(np.min, part)), max(map(np.max, part))) for part in parts]
    if spans[1][0] > spans[0][0] - 0.01 and spans[1][1] < spans[0][1] + 0.01:
        return []
    one, other = (f'{scaling.v(low):.3g} .. {scaling.v(high):.3g} V' for low, high in spans)
    return [
        f'the fitted part covers {one}, the held-out part {other}: its error is partly '
        'one of extrapolation'
    ]


def warn_of_zeros(offsets: Mapping[tuple[str, float], float], scaling: Scaling) -> list[str]:
    """Return a warning where the displacement of a run has another zero than the model."""
    return [
        f'{record}: its zero of displacement lies {1e6 * offset:.3g} um from that of the model; '
        'its errors are told without it'
        for (record, _), offset in offsets.items()
        if abs(offset) > ZERO_MOVED * abs(scaling.Y)
    ]


def warn_of_starts(runs: Sequence[Run], used: Sequence[Run]) -> list[str]:
    """Return a warning where the start of a run was left out of the fit of H."""
    return [
        f'{run.record}: H was fitted without its first '
        f'{np.argmax(left.use) / run.piece.sample_rate:.4g} s; what the stage did before is not '
        'known, and no guess suits them. Begin with a sweep over the whole range'
        for run, left in zip(runs, used, strict=True)
        if not np.array_equal(run.use, left.use)
    ]
