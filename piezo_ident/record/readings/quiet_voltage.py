# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Remove the noise of a measured voltage.

Many labs record the monitor of the amplifier instead of the command.  The noise of a monitor adds
a path of many spans a minute, which the stage does not follow.  Laws with lags along the path
would follow time, and a hold would be a motion.  A play as wide as the noise therefore replaces
the voltage while only noise moves it.  The voltage of a motion stays.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.operators.play import play_columns
from piezo_ident.record.record import Fault, Piece, Record
from scipy.ndimage import maximum_filter1d, minimum_filter1d, uniform_filter1d

#: samples of a window, and share of the windows [%] that may be quieter than the noise
WINDOW, QUIET = 100, 10.0
#: width of the play, in standard deviations of the noise
WIDTH = 8.0
#: widest play, as a share of the range: larger noise belongs to a program
MOST = 5e-3
#: least widths by which a moving voltage moves, within so many samples
MOVES, AROUND = 3.0, 9
#: samples over which the lag of a play is averaged and removed
BACK = 300
#: least rms of second over first differences of white noise; sqrt(3) is expected
WHITE = 1.4
#: least share of the power of second differences of white noise below a fifth of the sampling
#: rate; 0.027 is expected
LOW = 0.009
#: harmless path of noise [ranges]
SHORT = 0.01


def with_quiet_voltage(record: Record) -> Record:
    """
    Return a record without noise of a voltage at rest or in slow motion.

    A fault of the record gives the size of the noise; a record without noise comes back as it is.
    """
    span = float(np.ptp(record.voltage_range))
    if span == 0.0 or any(fault.name == 'voltage_noise' for fault in record.faults):
        return record
    # a monitor is noisy in all pieces; noise of a single piece belongs to a program
    long = [piece.v for piece in record if piece.n >= 3 * WINDOW]
    deviation = min(map(_deviation, long), default=0.0)
    width = WIDTH * deviation
    if not 0.0 < width <= MOST * span:
        return record
    pieces = tuple(_quieted(piece, width) for piece in record)
    gone = sum(_path(one) - _path(other) for one, other in zip(record, pieces, strict=True))
    if gone < SHORT * span:
        return record
    fault = Fault(
        'voltage_noise',
        f'of {1e3 * deviation:.2g} mV rms, as of a monitor',
        record.n,
        f'taken out where the voltage moves by less than {MOVES * width:.2g} V in {AROUND} '
        'samples; give the command instead if it was recorded',
    )
    return replace(record, pieces=pieces, faults=(*record.faults, fault))


def _deviation(v: Array) -> float:
    """Return the standard deviation of white noise [V] in the quietest parts of a voltage."""
    # differences leave little of a smooth motion
    one, two = (
        d[: d.size // WINDOW * WINDOW].reshape(-1, WINDOW).std(axis=1)
        for d in (np.diff(v), np.diff(v, 2))
    )
    quiet = np.percentile(two, QUIET)
    # sines and small multisines are no white noise
    near = (two <= quiet) & (two > 0.5 * quiet)
    if not near.any() or np.median(two[near] / one[: two.size][near]) <= WHITE:
        return 0.0
    # a dither of a program lacks power at low frequencies
    rows = np.diff(v, 2)[: two.size * WINDOW].reshape(-1, WINDOW)[near] * np.hanning(WINDOW)
    power = np.sum(np.abs(np.fft.rfft(rows)) ** 2, axis=0)
    is_white = power[: WINDOW // 5].sum() > LOW * power.sum()
    return float(quiet / np.sqrt(6.0)) if is_white else 0.0


def _quieted(piece: Piece, width: float) -> Piece:
    before = piece.before and _quieted(piece.before, width)
    return replace(piece, v=_quiet(piece.v, width), before=before)


def _quiet(v: Array, width: float) -> Array:
    """Return a voltage [V] without noise of some width; a moving voltage stays."""
    still = _played(v, width)
    reach = maximum_filter1d(still, AROUND) - minimum_filter1d(still, AROUND)
    # the play lags by half a width: its mean lag is removed, without the noise of the mean
    near = still + uniform_filter1d(v - still, BACK)
    return np.where(reach > MOVES * width, v, _played(near, width / np.sqrt(BACK)))


def _played(v: Array, width: float) -> Array:
    """Return the middle of a play of some width [V]."""
    u = v - v.min()
    play = play_columns(u, [width], np.array([u[0] - 0.5 * width]))[0]
    return np.asarray(play + 0.5 * width + v.min())


def _path(piece: Piece) -> float:
    return float(np.abs(np.diff(piece.v)).sum())
