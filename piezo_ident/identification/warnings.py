# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What an identification says against itself: remarks on the fit, its errors and its data."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from piezo_ident.identification.prepare import Run
from piezo_ident.identification.results import DelayResult, DynamicsResult, Identification
from piezo_ident.identification.step3_hysteresis import HysteresisFit
from piezo_ident.model.stage_model import Scaling, StageModel
from piezo_ident.record.faults import line_error
from piezo_ident.record.record import Piece

__all__ = ['remark_on_range', 'remarks_on_errors', 'remarks_on_fit']

#: change of G within the excited band below which the band is too narrow to know G by
HARDLY = 0.1
#: measured and modelled small-signal gain may differ by this share before it is said
SLOPE_TOLERANCE = 0.05


def remarks_on_fit(
    model: StageModel,
    delay: DelayResult,
    dynamics: DynamicsResult,
    fit: HysteresisFit,
    floor: float | None,
) -> list[str]:
    """
    Return where the steps contradict each other, or the data do not carry what was fitted.

    Parameters
    ----------
    model : StageModel
    delay, dynamics, fit
        What the steps found.
    floor : float or None
        Rms of the sensor noise [m].
    """
    said, stroke = [], abs(model.scaling.Y)
    if delay.agree is False and delay.step is not None:
        said.append(
            f'steps say a delay of {delay.step.samples} samples, the ARX loss says {delay.scan}; '
            f'{"the steps were" if delay.source == "steps" else "the loss was"} followed'
        )
    measured, modelled = dynamics.slope_measured, dynamics.slope_model
    if np.isfinite(measured) and abs(measured / modelled - 1.0) > SLOPE_TOLERANCE:
        said.append(
            f'the small-signal gain of the noise, {measured:.3g}, is not the slope of H at its '
            f'bias, {modelled:.3g} (normalised)'
        )
    if floor is not None and floor > 0.01 * stroke:
        said.append(f'the sensor noise is {100 * floor / stroke:.2g} % of stroke')
    if fit.swarm is not None and fit.swarm_loss is not None:
        excess = fit.swarm_loss / fit.optimum_loss - 1.0 if fit.optimum_loss > 0 else 0.0
        if excess > 0.01:
            said.append(
                f'the swarm ended {100.0 * excess:.2g} % of the loss above the least-squares '
                f'optimum{", before polishing" if fit.polished else ""}; more iterations bring it '
                'closer'
            )
    return [*said, *_unseen(dynamics, model)]


def _unseen(dynamics: DynamicsResult, model: StageModel) -> list[str]:
    """Say when the excitation ends where G has hardly begun to act."""
    # a band that ends near half the sampling rate leaves nothing to see
    if not dynamics.band < 0.2 * model.sample_rate:
        return []
    G = model.dynamics.response([dynamics.band], model.sample_rate)[0]
    change = float(np.abs(G - 1.0))
    if change > HARDLY:
        return []
    return [
        f'the noise drives the stage up to {dynamics.band:.3g} Hz, where G is within '
        f'{100 * change:.2g} % of its static gain: what it does beyond is not known; record noise '
        'up to higher frequencies'
    ]


def remarks_on_errors(result: Identification, pieces: Sequence[Piece]) -> list[str]:
    """Return what the errors themselves say about the trust that they deserve."""
    said = []
    chosen, held = result.error('selection'), result.error('held out')
    error = held if np.isfinite(held) else chosen
    line = line_error(pieces)
    if np.isfinite(error) and error > 0.5 * line:
        said.append(
            f'the model errs by {error:.3g} % of stroke, where a straight line errs by '
            f'{line:.3g} %: it explains little of these data'
        )
    easy = [
        row.percent
        for row in result.errors
        if row.data == 'held out' and row.segment.partition(':')[0] in ('idle', 'ramp')
    ]
    if np.isfinite(chosen) and easy and max(easy) > 2.0 * chosen:
        said.append(
            f'where the stage only rests or is moved over, the model errs by up to '
            f'{max(easy):.3g} % of stroke, more than the {chosen:.3g} % on what chose it: the '
            'stage does something that the model lacks; judge it on a record of another kind'
        )
    return said


def remark_on_range(run: Run, n_fit: int, scaling: Scaling) -> str:
    """Return what to say when the held-out part leaves the voltages of the fitted one."""
    fitted, held = run.u[:n_fit], run.u[n_fit:]
    if held.min() > fitted.min() - 0.01 and held.max() < fitted.max() + 0.01:
        return ''
    spans = [
        f'{scaling.v0 + scaling.V * u.min():.3g} .. {scaling.v0 + scaling.V * u.max():.3g} V'
        for u in (fitted, held)
    ]
    return (
        f'the fitted part covers {spans[0]}, the held-out part {spans[1]}: its error is partly '
        'one of extrapolation'
    )
