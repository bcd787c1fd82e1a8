# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Measurement against free run: loops, traces over time, segments, errors over frequency."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.model.free_run import PieceRun
from piezo_ident.model.sines import sine_frequency, SineError
from piezo_ident.record.record import Record, Segment
from piezo_ident.report.figures import style
from piezo_ident.report.figures.style import COLOURS, NothingToDraw, tidy

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


def loops_figure(runs: Sequence[PieceRun]) -> Figure:
    """
    Draw displacement over voltage, measured and modelled, with the error below.

    The triangle that covers the widest range is drawn, or the whole piece without one.
    NothingToDraw when the voltage does not move.
    """
    run, s = _widest_loop(runs)
    part = slice(s.start, s.stop)
    v, y, y_hat = run.piece.v[part], run.piece.measured[part], run.y_hat[part]
    fig = style.figure(5.2, 5.2)
    loops, errors = fig.subplots(2, 1, sharex=True, gridspec_kw={'height_ratios': [2.4, 1]})
    limit, largest = style.axis_limit(y - y_hat)
    unit, scale = style.length_unit(largest)
    _loop(loops, v, 1e6 * y, COLOURS['under'], 'measured', 3.0)
    _loop(loops, v, 1e6 * y_hat, COLOURS['model'], 'model')
    _loop(errors, v, scale * (y - y_hat), COLOURS['model'], width=0.6)
    style.symmetric(errors, scale * limit)
    if cut := style.cut_text(largest, limit, unit, scale):
        style.note(errors, cut)
    name = ', '.join(filter(None, (style.safe(run.record), style.safe(s.label))))
    tidy(loops, '', 'displacement / µm', name)
    tidy(errors, 'voltage / V', f'error / {unit}')
    style.percent_axis(errors, scale * float(np.ptp(run.piece.y)))
    style.legend(loops, loc='best')
    fig.align_ylabels([loops, errors])
    return fig


def _widest_loop(runs: Sequence[PieceRun]) -> tuple[PieceRun, Segment]:
    loops = [(run, s) for run in runs for s in run.piece.find('triangle')]
    loops = loops or [(run, Segment('', 0, run.piece.n)) for run in runs]
    width = [float(np.ptp(run.piece.v[s.start : s.stop])) for run, s in loops]
    if not any(width):
        raise NothingToDraw('the voltage does not move')
    return loops[int(np.argmax(width))]


def _loop(
    axes: Axes, v: Array, y: Array, colour: str, label: str = '', width: float = 1.0
) -> None:
    k = style.envelope(y, LOOP_POINTS)
    v, y = v[k], y[k]
    # no chords across the loop where the voltage jumps
    jumps = np.flatnonzero(np.abs(np.diff(v)) > 0.1 * np.ptp(v)) + 1
    v, y = np.insert(v, jumps, np.nan), np.insert(y, jumps, np.nan)
    axes.plot(v, y, color=colour, linewidth=width, label=label)


def _draw_error(
    axes: Axes, x: Array, e: Array, e_static: Array, width: float
) -> tuple[str, float]:
    """Draw errors [m], with the hysteresis alone if both are readable; return the unit."""
    limit, largest = style.axis_limit(e)
    unit, scale = style.length_unit(largest)
    remarks = [style.cut_text(largest, limit, unit, scale)] if largest > limit else []
    if not np.array_equal(e, e_static, equal_nan=True):
        static_limit, static_largest = style.axis_limit(e_static)
        if static_limit <= READABLE * limit:
            style.line(
                axes, x, scale * e_static, COLOURS['static'], 'hysteresis alone', linewidth=width
            )
            limit = max(limit, static_limit)
        else:
            other, factor = style.length_unit(static_largest)
            remarks.append(
                f'hysteresis alone (not drawn): up to {factor * static_largest:.3g} {other}'
            )
    style.line(axes, x, scale * e, COLOURS['model'], 'model', linewidth=width)
    style.symmetric(axes, scale * limit)
    style.note(axes, '; '.join(remarks))
    return unit, scale


def record_figure(record: Record) -> Figure:
    """Draw voltage and displacement of a record over time."""
    fig = style.figure(3.6)
    axes = fig.subplots(2, 1, sharex=True)
    for piece in record:
        style.line(axes[0], piece.t, piece.v, COLOURS['measured'])
        style.line(axes[1], piece.t, 1e6 * piece.measured, COLOURS['measured'])
    tidy(axes[0], '', 'voltage / V')
    tidy(axes[1], 'time / s', 'displacement / µm')
    axes[0].margins(x=0.01)
    fig.align_ylabels(list(axes))
    return fig


def overview_figure(run: PieceRun, remark: str = '', half_width: Array | None = None) -> Figure:
    """Draw voltage, displacement, error and band of a piece, with a remark on its model."""
    piece, t, y = run.piece, run.piece.t, run.piece.measured
    fig = style.figure(5.0)
    axes = fig.subplots(3, 1, sharex=True, gridspec_kw={'height_ratios': [1, 1.7, 1.4]})
    style.line(axes[0], t, piece.v, COLOURS['measured'])
    style.line(axes[1], t, 1e6 * y, COLOURS['under'], 'measured', linewidth=3.0)
    style.line(axes[1], t, 1e6 * run.y_hat, COLOURS['model'], 'model')
    unit, scale = _draw_error(axes[2], t, y - run.y_hat, y - run.y_static, 0.8)
    if half_width is not None:
        _draw_band(axes[2], t, scale * half_width)
    tidy(axes[0], '', 'voltage / V')
    tidy(axes[1], '', 'displacement / µm')
    lost = np.count_nonzero(~piece.mask)
    remarks = [remark, f'{lost} readings left out' if lost else '']
    style.note(axes[1], '; '.join(filter(None, remarks)))
    tidy(axes[2], 'time / s', f'error / {unit}')
    _name_segments(axes[0], run)
    style.percent_axis(axes[2], scale * float(np.ptp(piece.y)))
    axes[0].margins(x=0.01)
    style.legend_above(axes[1])
    if len(axes[2].lines) > 2:
        style.legend_above(axes[2])
    fig.align_ylabels(list(axes))
    return fig


def _draw_band(axes: Axes, t: Array, half: Array) -> None:
    """Draw a band around zero, with gaps where it is not known, and make room for most of it."""
    known = half[np.isfinite(half)]
    half = np.where(np.isfinite(half), half, np.nan)
    for sign, name in ((1.0, 'band'), (-1.0, '')):
        style.line(axes, t, sign * half, COLOURS['static'], name, linewidth=0.8)
    if known.size:
        error = axes.get_ylim()[1]
        # a band of an unknown start may be hundreds of times the error, which stays readable
        most = READABLE * max(error, float(known.min()))
        style.symmetric(axes, max(error, min(most, 1.1 * float(np.quantile(known, 0.95)))))


def _name_segments(axes: Axes, run: PieceRun) -> None:
    named = [s for s in run.piece.segments if s.kind not in ('idle', 'ramp')]
    if not named or len(named) > NAMES:
        return
    rotated = any(0.012 * len(s.label) > 0.9 * s.n / run.piece.n for s in named)
    for s in named:
        first, last = run.piece.t[s.start], run.piece.t[s.stop - 1]
        axes.axvline(first, color=COLOURS['band'], linewidth=0.8, zorder=1)
        style.name_above(axes, s.label, 0.5 * (first + last), 30.0 if rotated else 0.0)


def segments_figure(runs: Sequence[PieceRun], errors: Mapping[tuple[str, str], str]) -> Figure:
    """
    Draw a readable stretch of every segment with its error below; NothingToDraw without any.

    `errors` holds a text on the error of each (record, segment label).
    """
    cells = [
        (run, s)
        for run in runs
        for s in run.piece.segments
        if s.kind in ORDER and np.ptp(run.piece.v[s.start : s.stop]) > 0.0
    ]
    if not cells:
        raise NothingToDraw('no segment is labelled with a kind of the programs')
    cells = sorted(cells, key=lambda cell: ORDER.index(cell[1].kind))[:CELLS]
    rows = -(-len(cells) // 2)
    fig = style.figure(2.05 * rows + 0.3)
    heights = [0.12] + [1.6, 1.0] * rows
    grid = fig.add_gridspec(2 * rows + 1, min(2, len(cells)), height_ratios=heights)
    for i, (run, s) in enumerate(cells):
        # the last of an odd number takes the whole row
        across = slice(None) if i % 2 == 0 and i + 1 == len(cells) else i % 2
        trace = fig.add_subplot(grid[2 * (i // 2) + 1, across])
        error = fig.add_subplot(grid[2 * (i // 2) + 2, across], sharex=trace)
        _draw_segment(trace, error, run, s, errors.get((run.record, s.label), ''))
    head = fig.add_subplot(grid[0, :])
    head.set_axis_off()
    for name, colour, width in (
        ('measured', COLOURS['under'], 3.0),
        ('model', COLOURS['model'], 1.2),
        ('hysteresis alone', COLOURS['static'], 1.2),
    ):
        head.plot([], [], color=colour, linewidth=width, label=name)
    style.legend(head, loc='center', ncols=3)
    return fig


def _readable(run: PieceRun, s: Segment) -> tuple[slice, str]:
    """Choose the readable part of a segment for a small picture; return the part and its name."""
    frequency = sine_frequency(s.label)
    if frequency is not None:
        period = run.piece.sample_rate / frequency
        if s.n > (PERIODS + 1) * period:
            return slice(s.stop - round(PERIODS * period), s.stop), f', last {PERIODS} periods'
    if s.kind in ('noise', 'multisine') and s.n > 2 * NOISE_SAMPLES:
        return slice(s.stop - 2 * NOISE_SAMPLES, s.stop - NOISE_SAMPLES), ', near its end'
    return slice(s.start, s.stop), ''


def _draw_segment(trace: Axes, error: Axes, run: PieceRun, s: Segment, remark: str) -> None:
    part, what = _readable(run, s)
    t, y, y_hat = run.piece.t[part], run.piece.measured[part], run.y_hat[part]
    long = t[-1] - t[0] > 1.0
    x = t if long else 1e3 * (t - t[0])
    style.line(trace, x, 1e6 * y, COLOURS['under'], linewidth=3.0)
    style.line(trace, x, 1e6 * y_hat, COLOURS['model'])
    unit, _ = _draw_error(error, x, y - y_hat, y - run.y_static[part], 0.7)
    tidy(trace, '', 'y / µm', style.safe(s.label) + (f': {remark}' if remark else ''))
    tidy(error, f'time / {"s" if long else "ms"}{what}', f'error / {unit}')
    trace.tick_params(labelbottom=False)
    trace.margins(x=0.01)


def sines_figure(errors: Sequence[SineError]) -> Figure:
    """Draw the steady-state error over the frequency of the sines; NothingToDraw without any."""
    if not errors:
        raise NothingToDraw(
            'no segment is labelled sine:<f>Hz and lasts a period longer than its first second '
            'and period'
        )
    f = np.array([e.frequency for e in errors])
    fig = style.figure(3.2, 5.2)
    axes = fig.subplots()
    for values, colour, shape, name in (
        ([e.static_percent for e in errors], COLOURS['static'], 's--', 'hysteresis alone'),
        ([e.percent for e in errors], COLOURS['model'], 'o-', 'model with dynamics'),
    ):
        axes.loglog(f, values, shape, color=colour, markersize=5, linewidth=1.3, label=name)
    tidy(axes, 'frequency of the sine / Hz', 'rms error / % of stroke')
    axes.margins(0.06)
    low, high = axes.get_ylim()
    axes.set_ylim(low / 1.6, high)
    style.plain_log(axes.yaxis, low, high)
    style.plain_log(axes.xaxis, f.min(), f.max() * 1.5)
    style.legend(axes, loc='best')
    return fig
