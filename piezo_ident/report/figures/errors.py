# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Pictures of measurement against model: loops, time traces, errors over frequency."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray
from piezo_ident.model.free_run import PieceRun, sine_frequency, SineError
from piezo_ident.record.record import Segment
from piezo_ident.report.figures.style import (
    COLOURS,
    envelope,
    figure,
    GREY,
    legend,
    legend_above,
    line,
    note,
    NothingToDraw,
    percent_axis,
    plain_log,
    safe,
    SMALL,
    tidy,
)

__all__ = ['loops_figure', 'overview_figure', 'segments_figure', 'sines_figure']

#: segments shown side by side, and in which order they are chosen
CELLS = 8
ORDER = ('sine', 'staircase', 'hold', 'multisine', 'triangle', 'noise', 'step')
#: of a fast segment this much is shown: periods of a sine, samples of noise
PERIODS, NOISE_SAMPLES = 3, 300
#: points of a loop: it is not read column by column as a trace over time is
LOOP_POINTS = 12_000
#: two errors are drawn on one scale when one is at most so many times the other
READABLE = 6.0
#: at most so many segments are named in an overview
NAMES = 12


def loops_figure(runs: Sequence[PieceRun], edges: Sequence[int | None] = ()) -> Figure:
    """
    Draw displacement over voltage, measured and modelled, with the error below.

    The triangle that covers the widest range is drawn, or the whole piece without one.

    Parameters
    ----------
    runs : sequence of PieceRun
    edges : sequence of (int or None), optional
        For each run the first sample that was not fitted, where its end was kept back.

    Raises
    ------
    NothingToDraw
        When the voltage does not move.
    """
    found = _loop(runs)
    if found is None:
        raise NothingToDraw('the voltage does not move')
    run, s = found
    part = slice(s.start, s.stop)
    v, y, y_hat = run.piece.v[part], 1e6 * run.piece.y[part], 1e6 * run.y_hat[part]
    fig = figure(5.2, 5.2)
    loops, errors = fig.subplots(2, 1, sharex=True, gridspec_kw={'height_ratios': [2.4, 1]})
    k = envelope(y, LOOP_POINTS)
    loops.plot(*_broken(v[k], y[k]), color=COLOURS['under'], linewidth=3.0, label='measured')
    unit, scale = _error_unit(y - y_hat)
    error = scale * (y - y_hat)
    kept = dict(zip(map(id, runs), edges, strict=False)).get(id(run))
    edge = y.size if kept is None else min(max(kept - s.start, 0), y.size)
    for cut, name, colour in (
        (slice(0, edge), 'model', COLOURS['model']),
        (slice(edge, None), 'model, held out', COLOURS['model held out']),
    ):
        if y_hat[cut].size == 0:
            continue
        k = envelope(y_hat[cut], LOOP_POINTS)
        loops.plot(*_broken(v[cut][k], y_hat[cut][k]), color=colour, linewidth=1.0, label=name)
        k = envelope(error[cut], LOOP_POINTS)
        errors.plot(*_broken(v[cut][k], error[cut][k]), color=colour, linewidth=0.6)
    limit, largest = _limit(error)
    _symmetric(errors, limit)
    if largest > limit:
        note(errors, f'axis cut; largest {largest:.3g} {unit}')
    name = ', '.join(filter(None, (safe(run.record), safe(s.label))))
    tidy(loops, '', 'displacement / µm', name)
    tidy(errors, 'voltage / V', f'error / {unit}')
    percent_axis(errors, scale * 1e6 * float(np.ptp(run.piece.y)))
    legend(loops, loc='best')
    fig.align_ylabels([loops, errors])
    return fig


def _loop(runs: Sequence[PieceRun]) -> tuple[PieceRun, Segment] | None:
    """Return the triangle, or else the whole piece, that covers the widest range."""
    candidates = [(run, s) for run in runs for s in run.piece.find('triangle')]
    candidates = candidates or [(run, Segment('', 0, run.piece.n)) for run in runs]

    def width(candidate: tuple[PieceRun, Segment]) -> float:
        run, s = candidate
        return float(np.ptp(run.piece.v[s.start : s.stop]))

    best = max(candidates, key=width, default=None)
    return best if best is not None and width(best) > 0.0 else None


def _broken(
    v: NDArray[np.float64], y: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return a loop without the chords that jumps of the voltage would draw across it."""
    jumps = np.flatnonzero(np.abs(np.diff(v)) > 0.1 * np.ptp(v)) + 1
    return np.insert(v, jumps, np.nan), np.insert(y, jumps, np.nan)


def _error_unit(error: NDArray[np.float64]) -> tuple[str, float]:
    """Return the unit in which an error given in µm is read best, and its factor."""
    return ('µm', 1.0) if float(np.abs(error).max(initial=0.0)) >= 1.0 else ('nm', 1e3)


def _limit(error: NDArray[np.float64]) -> tuple[float, float]:
    """Return where to end an axis for an error, and the largest error; spikes may be cut."""
    sizes = np.abs(error)
    largest = float(sizes.max(initial=0.0))
    usual = 2.5 * float(np.quantile(sizes, 0.995))
    return (usual if 0.0 < 1.6 * usual < largest else largest), largest


def _symmetric(axes: Axes, limit: float) -> None:
    end = 1.08 * limit if limit > 0.0 else 1.0
    axes.set_ylim(-end, end)
    axes.axhline(0.0, color='#555555', linewidth=0.6, zorder=1)


def _draw_error(
    axes: Axes,
    x: NDArray[np.float64],
    e: NDArray[np.float64],
    e_static: NDArray[np.float64],
    width: float,
) -> tuple[str, float]:
    """
    Draw the error of the model, and of the hysteresis alone where both can be read.

    Parameters
    ----------
    axes : Axes
    x : ndarray, shape (n,)
    e, e_static : ndarray, shape (n,)
        [µm]
    width : float
        Of the lines [points].

    Returns
    -------
    unit : str
    scale : float
        From µm to the unit.
    """
    unit, scale = _error_unit(e)
    limit, largest = _limit(scale * e)
    said = [f'axis cut; largest {largest:.3g} {unit}'] if largest > limit else []
    if not np.array_equal(e, e_static):
        static_limit, static_largest = _limit(scale * e_static)
        if static_limit <= READABLE * limit:
            line(
                axes,
                x,
                scale * e_static,
                COLOURS['static'],
                'hysteresis alone',
                linewidth=width,
            )
            limit = max(limit, static_limit)
        else:
            other, factor = _error_unit(e_static)
            static_largest *= factor / scale
            said.append(f'hysteresis alone (not drawn): up to {static_largest:.3g} {other}')
    line(axes, x, scale * e, COLOURS['model'], 'model', linewidth=width)
    _symmetric(axes, limit)
    if said:
        note(axes, '; '.join(said))
    return unit, scale


def overview_figure(run: PieceRun, held_out_from: int | None = None) -> Figure:
    """
    Draw a whole piece: voltage, displacement measured and modelled, and the error.

    Parameters
    ----------
    run : PieceRun
    held_out_from : int, optional
        First sample that was not fitted, where the end of a record was kept back.
    """
    piece = run.piece
    t, y, y_hat, y_static = piece.t, 1e6 * piece.y, 1e6 * run.y_hat, 1e6 * run.y_static
    fig = figure(5.0)
    axes = fig.subplots(3, 1, sharex=True, gridspec_kw={'height_ratios': [1, 1.7, 1.4]})
    line(axes[0], t, piece.v, COLOURS['measured'])
    line(axes[1], t, y, COLOURS['under'], 'measured', linewidth=3.0)
    line(axes[1], t, y_hat, COLOURS['model'], 'model')
    unit, scale = _draw_error(axes[2], t, y - y_hat, y - y_static, 0.8)
    if held_out_from is not None:
        for each in axes:
            each.axvspan(
                t[held_out_from],
                t[-1],
                color=COLOURS['held out'],
                zorder=0,
                label='held out' if each is axes[1] else None,
            )
    tidy(axes[0], '', 'voltage / V')
    tidy(axes[1], '', 'displacement / µm')
    tidy(axes[2], 'time / s', f'error / {unit}')
    _name_segments(axes[0], run)
    percent_axis(axes[2], scale * float(np.ptp(y)))
    axes[0].margins(x=0.01)
    legend_above(axes[1])
    if len(axes[2].lines) > 2:
        legend_above(axes[2])
    fig.align_ylabels(list(axes))
    return fig


def _name_segments(axes: Axes, run: PieceRun) -> None:
    named = [s for s in run.piece.segments if s.kind not in ('idle', 'ramp')]
    if not named or len(named) > NAMES:
        return
    rotated = any(0.012 * len(s.label) > 0.9 * s.n / run.piece.n for s in named)
    for s in named:
        first, last = run.piece.t[s.start], run.piece.t[s.stop - 1]
        axes.axvline(first, color=COLOURS['band'], linewidth=0.8, zorder=1)
        axes.annotate(
            safe(s.label),
            (0.5 * (first + last), 1.0),
            xycoords=('data', 'axes fraction'),
            xytext=(0, 2),
            textcoords='offset points',
            ha='left' if rotated else 'center',
            va='bottom',
            rotation=30 if rotated else 0,
            rotation_mode='anchor',
            fontsize=SMALL,
        )


def segments_figure(
    runs: Sequence[PieceRun], errors: dict[tuple[str, str], str] | None = None
) -> Figure:
    """
    Draw a readable stretch of every segment with its error below.

    Parameters
    ----------
    runs : sequence of PieceRun
    errors : dict, optional
        Error in words for each (record, segment label).

    Raises
    ------
    NothingToDraw
        Without labelled segments.
    """
    found = [
        (ORDER.index(s.kind), run, s)
        for run in runs
        for s in run.piece.segments
        if s.kind in ORDER and np.ptp(run.piece.v[s.start : s.stop]) > 0.0
    ]
    if not found:
        raise NothingToDraw('no segment is labelled with a kind of the programmes')
    found = sorted(found, key=lambda item: item[0])[:CELLS]
    rows = -(-len(found) // 2)
    fig = figure(2.05 * rows + 0.3)
    grid = fig.add_gridspec(
        2 * rows + 1, min(2, len(found)), height_ratios=[0.12] + [1.6, 1.0] * rows
    )
    for i, (_, run, s) in enumerate(found):
        trace = fig.add_subplot(grid[2 * (i // 2) + 1, i % 2])
        error = fig.add_subplot(grid[2 * (i // 2) + 2, i % 2], sharex=trace)
        words = (errors or {}).get((run.record, s.label), '')
        _draw_segment(trace, error, run, s, words)
    head = fig.add_subplot(grid[0, :])
    head.set_axis_off()
    for name, colour, width in (
        ('measured', COLOURS['under'], 3.0),
        ('model', COLOURS['model'], 1.2),
        ('hysteresis alone', COLOURS['static'], 1.2),
    ):
        head.plot([], [], color=colour, linewidth=width, label=name)
    legend(head, loc='center', ncols=3)
    return fig


def _stretch(run: PieceRun, s: Segment) -> tuple[slice, str]:
    """Return what of a segment can be read in a small picture, and how to say so."""
    rate = run.piece.sample_rate
    frequency = sine_frequency(s.label)
    if frequency is not None and s.n > (PERIODS + 1) * rate / frequency:
        return slice(
            s.stop - round(PERIODS * rate / frequency), s.stop
        ), f', last {PERIODS} periods'
    if s.kind in ('noise', 'multisine') and s.n > 2 * NOISE_SAMPLES:
        return slice(s.stop - 2 * NOISE_SAMPLES, s.stop - NOISE_SAMPLES), ', near its end'
    return slice(s.start, s.stop), ''


def _draw_segment(trace: Axes, error: Axes, run: PieceRun, s: Segment, words: str) -> None:
    part, what = _stretch(run, s)
    t = run.piece.t[part]
    long = t[-1] - t[0] > 1.0
    x = t if long else 1e3 * (t - t[0])
    y, y_hat = 1e6 * run.piece.y[part], 1e6 * run.y_hat[part]
    line(trace, x, y, COLOURS['under'], linewidth=3.0)
    line(trace, x, y_hat, COLOURS['model'])
    unit, _ = _draw_error(error, x, y - y_hat, y - 1e6 * run.y_static[part], 0.7)
    tidy(trace, '', 'y / µm', safe(s.label) + (f': {words}' if words else ''))
    tidy(error, f'time / {"s" if long else "ms"}{what}', f'error / {unit}')
    trace.tick_params(labelbottom=False)
    trace.margins(x=0.01)


def sines_figure(errors: Sequence[SineError], floor: float | None = None) -> Figure:
    """
    Draw the steady-state error over the frequency of the sines.

    Parameters
    ----------
    errors : sequence of SineError
    floor : float, optional
        Rms of the sensor noise [% of stroke].

    Raises
    ------
    NothingToDraw
        Without sine errors.
    """
    if not errors:
        raise NothingToDraw(
            'no segment is labelled sine:<f>Hz and lasts a period longer than its first second '
            'and period'
        )
    f = np.array([e.frequency for e in errors])
    fig = figure(3.2, 5.2)
    axes = fig.subplots()
    for values, colour, shape, name in (
        ([e.static_percent for e in errors], COLOURS['static'], 's--', 'hysteresis alone'),
        ([e.percent for e in errors], COLOURS['model'], 'o-', 'model with dynamics'),
    ):
        axes.loglog(f, values, shape, color=colour, markersize=5, linewidth=1.3, label=name)
    tidy(axes, 'frequency of the sine / Hz', 'rms error / % of stroke')
    if floor is not None and floor > 0.0:
        axes.axhline(floor, color=GREY, linestyle=':', linewidth=1.3, label='sensor noise')
    axes.margins(0.06)
    low, high = axes.get_ylim()
    axes.set_ylim(low / 1.6, high)
    plain_log(axes.yaxis, low, high)
    plain_log(axes.xaxis, f.min(), f.max() * 1.5)
    legend(axes, loc='best')
    return fig
