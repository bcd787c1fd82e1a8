# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The voltage for a wanted motion, where it leads the model, and how far the stage may be off."""

from __future__ import annotations

from matplotlib.figure import Figure
import numpy as np
from piezo_ident.common.arrays import true_runs
from piezo_ident.control.inverse import Inverse
from piezo_ident.report.figures import style
from piezo_ident.report.figures.style import COLOURS, tidy


def drive_figure(drive: Inverse) -> Figure:
    """Draw voltage, wanted and predicted displacement, and their difference, over time."""
    fig = style.figure(5.0)
    volts, motion, error = fig.subplots(
        3, 1, sharex=True, gridspec_kw={'height_ratios': [1, 1.7, 1.2]}
    )
    t = drive.t
    style.line(volts, t, drive.v, COLOURS['model'])
    style.line(motion, t, 1e6 * drive.wanted, COLOURS['under'], 'wanted', linewidth=3.0)
    style.line(motion, t, 1e6 * drive.predicted, COLOURS['model'], 'model under the voltage')
    e = drive.wanted - drive.predicted
    band = drive.expected_rms or 0.0
    limit, largest = style.axis_limit(e)
    unit, scale = style.length_unit(max(largest, band))
    if band:
        its, factor = style.length_unit(band)
        label = f'expected of the stage: {factor * band:.3g} {its} rms without the mean'
        error.axhspan(-scale * band, scale * band, color=COLOURS['band'], alpha=0.6, label=label)
    style.line(error, t, scale * e, COLOURS['model'], 'left by the inversion', linewidth=0.8)
    style.symmetric(error, scale * max(limit, 1.3 * band))
    if cut := style.cut_text(largest, max(limit, 1.3 * band), unit, scale):
        style.note(error, cut)
    # where a limit holds the voltage
    for k, (first, stop) in enumerate(true_runs(drive.clipped)):
        for axes in volts, motion:
            text = 'out of reach' if axes is motion and not k else None
            last = t[min(stop, t.size - 1)]
            axes.axvspan(t[first], last, color=COLOURS['held out'], zorder=0, label=text)
    tidy(volts, '', 'voltage / V')
    tidy(motion, '', 'displacement / µm')
    tidy(error, 'time / s', f'error / {unit}')
    style.percent_axis(error, scale * float(np.ptp(drive.wanted)))
    volts.margins(x=0.01)
    style.legend_above(motion)
    style.legend_above(error)
    fig.align_ylabels([volts, motion, error])
    return fig
