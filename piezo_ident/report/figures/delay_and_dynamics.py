# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Pictures of the first two steps: delay, frequency response, orders of G."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.arrays import Array
from piezo_ident.identification.results import Identification
from piezo_ident.identification.spectra import FrequencyResponse
from piezo_ident.identification.step1_delay import delay_from_steps, StepDelay
from piezo_ident.model.free_run import PieceRun
from piezo_ident.report.figures import style
from piezo_ident.report.figures.style import COLOURS, NothingToDraw, tidy

#: samples shown ahead of the delay, and behind it
BEFORE, AFTER = 10, 15
#: an error this many times the best ends the colour scale of the orders
WORST = 10.0
#: the axis of magnitudes spans this factor at least
LEAST_RANGE = 4.0
#: largest damping ratio and relative uncertainty of a mode that is named in a response, and
#: smallest distance of two names as a share of the width
DAMPED, UNSURE, APART = 0.5, 0.1, 0.09
#: line of a delay that was found but is not used
UNUSED: dict[str, Any] = {'color': COLOURS['static'], 'linestyle': '--', 'linewidth': 1.2}


def delay_figure(identification: Identification, runs: Sequence[PieceRun]) -> Figure:
    """
    Draw the averaged step response with the delay, and the scan of the ARX loss.

    `runs` hold the response of the model to the same steps.  NothingToDraw without steps and scan.
    """
    result = identification.delay
    step = result.step if result.step is not None and result.step.repeats else None
    if step is None and result.loss is None:
        if result.source == 'given':
            raise NothingToDraw('the delay was given, not measured')
        raise NothingToDraw('a delay is read from steps or a noise segment')
    fig = style.figure(2.7)
    axes = fig.subplots(1, (step is not None) + (result.loss is not None), squeeze=False)[0]
    if step is not None:
        _draw_step(axes[0], identification, step, _model_step(step, runs))
    if result.loss is not None:
        _draw_scan(axes[-1], result.loss, result.scan, result.samples)
    return fig


def _model_step(step: StepDelay, runs: Sequence[PieceRun]) -> Array | None:
    """Average the response of the model to the same steps, if they are all there."""
    before, after = -int(step.lag[0]), int(step.lag[-1]) + 1
    for labelled in (True, False):
        pieces = []
        for run in runs:
            predicted = replace(run.piece, y=run.y_hat)
            if labelled:
                pieces += [predicted.cut(s.start, s.stop) for s in predicted.find('step')]
            else:
                pieces.append(predicted)
        if pieces:
            modelled = delay_from_steps(pieces, before, after)
            if modelled.repeats == step.repeats:
                return modelled.response
    return None


def _draw_step(
    axes: Axes, identification: Identification, step: StepDelay, modelled: Array | None
) -> None:
    """Draw the size of the response where it leaves the noise."""
    rate, d = identification.model.sample_rate, identification.delay.samples
    near = (step.lag >= d - BEFORE) & (step.lag <= d + AFTER)
    # a logarithm shows the noise and the first sample above it side by side
    level = 1e9 * step.threshold
    floor = 0.02 * level
    lag, y = step.lag[near], np.maximum(1e9 * np.abs(step.response[near]), floor)
    band: dict[str, Any] = {'color': COLOURS['band'], 'zorder': 1, 'linewidth': 0}
    axes.axhspan(floor, level, label='noise threshold', **band)
    axes.axvline(d, color=COLOURS['mark'], linewidth=1.3, zorder=2, label=f'used: {d}')
    if step.samples not in (None, d):
        axes.axvline(step.samples, label=f'steps: {step.samples}', **UNUSED)
    if modelled is not None:
        y_hat = np.maximum(1e9 * np.abs(modelled[near]), floor)
        axes.plot(lag, y_hat, color=COLOURS['model'], linewidth=1.2, label='model')
    # a motion to the other side does not begin the response
    back = step.response[near] * step.response[step.lag >= 0].sum() < 0.0
    dots: dict[str, Any] = {'color': COLOURS['measured'], 'markersize': 2.8}
    axes.plot(lag[~back], y[~back], 'o', label='measured', **dots)
    if back.any():
        axes.plot(lag[back], y[back], 'o', fillstyle='none', label='other direction', **dots)
    axes.margins(x=0.03)
    axes.set_yscale('log')
    top = float(y.max(initial=0.0))
    if top > floor > 0.0:
        axes.set_ylim(floor, 2.0 * top)
        style.plain_log(axes.yaxis, floor, 2.0 * top)
    steps = 'one step' if step.repeats == 1 else f'average of {step.repeats} steps'
    title = f'{steps}; d = {_time(d / rate)}'
    tidy(axes, 'samples after the step', '|response| / nm V$^{-1}$', title)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    style.legend(axes, loc='lower right', handlelength=1.2)


def _draw_scan(axes: Axes, loss: Array, scan: int | None, chosen: int) -> None:
    d = np.arange(loss.size)
    axes.semilogy(d, loss / loss.min(), 'o-', color=COLOURS['measured'], markersize=3, linewidth=1)
    axes.axvline(chosen, color=COLOURS['mark'], linewidth=1.4, label=f'used: {chosen}')
    if scan is not None and scan != chosen:
        axes.axvline(scan, label=f'scan: {scan}', **UNUSED)
    tidy(axes, 'delay tried / samples', 'ARX loss / smallest', 'scan of the ARX loss')
    style.plain_log(axes.yaxis, 1.0, float(loss.max() / loss.min()) + 1.0)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    style.legend(axes, loc='best')


def _time(seconds: float) -> str:
    return f'{1e6 * seconds:.4g} µs' if seconds < 1e-3 else f'{1e3 * seconds:.4g} ms'


def response_figure(identification: Identification) -> Figure:
    """
    Draw the frequency response, measured and modelled.

    NothingToDraw when G = 1 and no response was measured.
    """
    model, dynamics = identification.model, identification.dynamics
    measured = dynamics.response
    if measured is None and model.dynamics.is_static:
        raise NothingToDraw('neither motion nor model shows dynamics')
    rate = model.sample_rate
    top = 0.5 * rate if measured is None else float(measured.frequency[-1])
    low = top / 300.0 if measured is None else float(measured.frequency[0])
    f = np.geomspace(low, top, 800)
    # without a slope the measured response is G itself, behind the hysteresis
    slope = dynamics.slope_model
    if not np.isfinite(slope):
        slope = dynamics.slope_measured
    scale, unit = 1.0, 'static gain'
    if np.isfinite(slope):
        scale, unit = 1e6 * abs(model.scaling.Y) / model.scaling.V, 'µm V$^{-1}$'
    else:
        slope = 1.0

    def modelled(frequency: Array) -> NDArray[np.complex128]:
        lag = np.exp(-2j * np.pi * frequency * model.delay.total / rate)
        return np.asarray(scale * slope * model.dynamics.response(frequency, rate) * lag)

    G = modelled(f)
    phase = np.degrees(np.unwrap(np.angle(G)))
    fig = style.figure(4.2)
    axes: list[Axes] = list(fig.subplots(2, 1, sharex=True, gridspec_kw={'height_ratios': [4, 3]}))
    tidy(axes[0], '', f'magnitude / {unit}')
    tidy(axes[1], 'frequency / Hz', 'phase / °')
    axes[0].set_yscale('log')
    if measured is not None:
        x, R = measured.frequency, scale * measured.response
        # the turn that lies nearest to the model: noise cannot make it slip by a whole one
        turns = np.degrees(np.angle(R / modelled(x))) + np.interp(x, f, phase)
        _draw_measured(axes, measured, R, turns)
    driven = f <= (top if measured is not None else dynamics.band)
    for part, dashes, name in ((driven, '-', 'model'), (~driven, ':', 'model, not driven')):
        if part.any():
            look: dict[str, Any] = {'color': COLOURS['model'], 'linewidth': 1.4, 'zorder': 3}
            look |= {'linestyle': dashes}
            axes[0].plot(f[part], np.abs(G[part]), label=name, **look)
            axes[1].plot(f[part], phase[part], **look)
    style.log_range(axes[0], LEAST_RANGE)
    axes[1].set_xscale('log')
    style.plain_log(axes[1].xaxis, low, top)
    axes[1].set_xlim(0.95 * low, 1.05 * top)
    _name_modes(axes, identification, low, top)
    style.legend(axes[0], loc='lower left')
    fig.align_ylabels(axes)
    return fig


def _name_modes(
    axes: Sequence[Axes], identification: Identification, low: float, top: float
) -> None:
    """Mark the least damped modes that are known, and have room for their names."""
    model = identification.model
    modes = model.dynamics.modes(model.sample_rate, identification.dynamics.covariance)
    named: list[float] = []
    for mode in sorted(modes, key=lambda mode: mode.damping):
        known = not mode.frequency_std > UNSURE * mode.frequency
        if not (low < mode.frequency < top and mode.damping <= DAMPED and known):
            continue
        place = float(np.log(mode.frequency / low) / np.log(top / low))
        if all(abs(place - other) >= APART for other in named):
            for each in axes:
                each.axvline(
                    mode.frequency, color=COLOURS['mark'], linewidth=0.8, linestyle=':', zorder=1
                )
            # one name for all
            axes[0].lines[-1].set_label('_' if named else 'modes of G')
            text = f'{mode.frequency:.0f} Hz'
            style.name_above(axes[0], text, mode.frequency, 0.0, color=COLOURS['mark'])
            named.append(place)


def _draw_measured(
    axes: Sequence[Axes], measured: FrequencyResponse, R: NDArray[np.complex128], turns: Array
) -> None:
    x, size, std = measured.frequency, np.abs(R), np.minimum(measured.std, 0.99)
    spread = np.degrees(std)
    dots: dict[str, Any] = {'color': COLOURS['under'], 'fmt': 'o', 'markersize': 3.0}
    dots |= {'elinewidth': 1.0, 'zorder': 2}
    axes[0].errorbar(x, size, size * std, label='measured', **dots)
    axes[1].errorbar(x, turns, spread, **dots)


def orders_figure(identification: Identification) -> Figure:
    """
    Draw the held-out error of every order, with the chosen order and the choices of criteria.

    NothingToDraw when no table of orders was made, or it is a single line.
    """
    table = identification.dynamics.table
    if table is None:
        raise NothingToDraw('orders are compared on a noise segment')
    if min(table.held_out.shape) < 2 or not np.isfinite(table.held_out).any():
        raise NothingToDraw('a single order was tried')
    best = float(np.min(table.held_out))
    if best <= 0.0:
        raise NothingToDraw('the held-out error is zero')
    ratio = np.ma.masked_invalid(table.held_out / best)
    fig = style.figure(4.4, 5.0)
    axes = fig.subplots()
    axes.set_facecolor('#D9D9D9')
    image = axes.imshow(
        ratio,
        origin='lower',
        norm=LogNorm(1.0, WORST),
        cmap='Blues',
        extent=(0.5, ratio.shape[1] + 0.5, 0.5, ratio.shape[0] + 0.5),
        interpolation='nearest',
        aspect='auto',
    )
    tidy(axes, 'nb', 'na')
    axes.grid(False)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(integer=True, steps=[1, 2, 5, 10]))
    chosen = identification.dynamics.order
    # markers of different shape and size, so that criteria that agree are all seen
    marks = {
        f'chosen ({chosen[0]}, {chosen[1]})': (chosen, 's', 13.0, COLOURS['static']),
        'least held-out error': (table.best('held_out'), 'o', 9.0, COLOURS['measured']),
        'least AIC': (table.best('aic'), '^', 6.0, COLOURS['measured']),
        'least BIC': (table.best('bic'), 'x', 6.0, COLOURS['measured']),
    }
    for name, ((na, nb), shape, size, colour) in marks.items():
        mark: dict[str, Any] = {'markersize': size, 'markeredgewidth': 1.5, 'linestyle': 'none'}
        mark |= {'markerfacecolor': 'none', 'markeredgecolor': colour, 'clip_on': False}
        axes.plot(nb, na, shape, label=name, **mark)
    bar = fig.colorbar(image, ax=axes, extend='max', shrink=0.9)
    bar.set_ticks([1, 2, 5, 10], labels=['1', '2', '5', '10'])
    bar.ax.minorticks_off()
    bar.ax.tick_params(labelsize=style.SMALL)
    bar.set_label('held-out free-run error / smallest', fontsize=style.NORMAL)
    place: dict[str, Any] = {'loc': 'lower center', 'bbox_to_anchor': (0.5, 1.0), 'ncols': 2}
    style.legend(axes, frameon=False, handletextpad=0.4, columnspacing=1.2, **place)
    return fig
