# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Refuse records whose displacement ignores the voltage, and records under position control."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from piezo_ident.common.arrays import Array, true_runs
from piezo_ident.common.errors import IdentificationError
from piezo_ident.operators.play import play_columns
from piezo_ident.record.record import Piece, Record
from piezo_ident.residual.coherence import cross_spectra
from piezo_ident.residual.stretches import block_means
from scipy import signal

#: largest chance at which a coherence proves an answer, and smallest number of samples for the
#: test
CHANCE, MIN_COHERENCE = 1e-7, 256
#: number of means to which a record is thinned for its slow motion
MEANS = 1 << 15
#: number of means into which a stretch is divided to find ramps
RAMP = 64
#: share by which a model with the voltage must err less on held-out parts than without it
BETTER = 0.1
#: error due to rounding [% of stroke]
ROUNDING = 1e-9
#: number of parts that are predicted in turn, of means to which a piece is thinned, and of plays
PARTS, ROWS, PLAYS = 8, 500, 8
#: rates of the decays of a slow drift, in 1 / duration
DECAYS = 2.0 ** np.arange(-1.0, 7.0, 0.5)
#: largest bend of a position under control, as a share of its travel, and smallest ratio of the
#: bend of its drive.  A measured position under control bent by less than 2.4e-4, and its drive 18
#: times as much
STRAIGHT, BENT = 5e-4, 15.0


def refuse_undriven(records: Sequence[Record]) -> None:
    """
    Refuse records whose displacement does not answer the voltage, with an IdentificationError.

    A piece below `MIN_COHERENCE` or either of two proofs accepts the records.  First, the spectra
    of voltage and displacement are more coherent at some frequency than by chance (1e-7).  For
    Gaussian noise the chance of a coherence c over L segments is ``1 - c`` raised to ``L - 1``.
    Each segment is detrended, because two drifts agree by chance.  Segments with their trends
    count, too, if the voltage moves by far more than its noise.  Second, a model with the voltage
    errs by `BETTER` less on predicted parts of a record than all models without it.  A single loop
    of strong hysteresis needs this proof, as its coherence is low.
    """
    pieces = [piece for record in records for piece in record if np.ptp(piece.v) > 0.0]
    if any(piece.n < MIN_COHERENCE for piece in pieces):
        return
    if any(
        _chance(piece, linear=True) < CHANCE
        or (_moves(piece.v) and _chance(piece, linear=False) < CHANCE)
        for piece in pieces
    ):
        return
    errors = [held_out_errors(piece) for piece in pieces if np.ptp(piece.y) > 0.0]
    if not errors:
        return  # `scaling_of` refuses a displacement that never moves
    driven, resting = min(errors, key=lambda pair: pair[0] - (1.0 - BETTER) * pair[1])
    if driven < (1.0 - BETTER) * resting - ROUNDING:
        return
    low, high = (f([getattr(p.v, f.__name__)() for p in pieces]) for f in (min, max))
    raise IdentificationError(
        f'{", ".join(record.name for record in records)}: the displacement does not answer the '
        f'voltage, which stays within {low:.4g} .. {high:.4g} V. A model predicts held-out parts '
        f'to {driven:.3g} % of stroke with the voltage, and to {resting:.3g} % without it; record '
        'the stage while it is driven, and see that the sensor measures it'
    )


def held_out_errors(piece: Piece) -> tuple[float, float]:
    """
    Predict held-out parts by the best model with the voltage, and by the best model without it.

    Both errors are rms values in % of the stroke.  Each of `PARTS` parts is predicted from all
    other parts.  Models without the voltage are a mean, a line, and for slow drift a cubic, a
    logarithm and a decay in time.  Models with the voltage are powers of it, or powers and plays
    whose weight may vary with it, on top of a mean or a line.
    """
    m = max(1, piece.n // ROWS)
    v, y = block_means(piece.v, m), block_means(piece.y, m)
    u, t = v - v.min(), np.linspace(-1.0, 1.0, v.size)
    u = u / max(float(u.max()), np.finfo(float).tiny)
    one = np.ones((t.size, 1))
    line = np.column_stack([one, t])
    drifts = [np.log(np.arange(1.0, t.size + 1.0)), *np.exp(-0.5 * np.outer(DECAYS, t + 1.0))]
    powers = u[:, None] ** np.arange(1, 4)
    r = np.arange(1, PLAYS + 1) / (PLAYS + 1.0)
    plays = play_columns(u, r, u[0] - 0.5 * r).T
    loops = np.hstack([powers, plays, plays * u[:, None]])
    resting = [one, line, np.vander(t, 4), *(np.column_stack([one, x]) for x in drifts)]
    driven = [np.hstack([base, x]) for base in (one, line) for x in (powers, loops)]
    stroke = float(np.ptp(piece.y))
    with_v, without_v = (min(_left_of_parts(A, y) for A in sets) for sets in (driven, resting))
    return 100.0 * with_v / stroke, 100.0 * without_v / stroke


def _left_of_parts(A: Array, y: Array) -> float:
    """Compute the rms error of parts, each predicted by least squares on all other parts."""
    left = 0.0
    for part in np.array_split(np.arange(y.size), PARTS):
        rest = np.delete(np.arange(y.size), part)
        x = np.linalg.lstsq(A[rest], y[rest], rcond=1e-9)[0]
        left += float(np.sum((A[part] @ x - y[part]) ** 2))
    return float(np.sqrt(left / y.size))


def refuse_delay(pieces: Sequence[Piece], delay: int | None) -> None:
    """Refuse a delay [samples] that leaves less than half of the longest piece."""
    longest = max(piece.n for piece in pieces)
    if delay is not None and 2 * delay > longest:
        raise IdentificationError(
            f'delay: {delay} samples are more than half of the longest piece, which has '
            f'{longest}; give fewer (--delay), or record longer'
        )


def _moves(v: Array) -> bool:
    """Tell whether a voltage moves by far more than its noise."""
    rows = v[: v.size // 64 * 64].reshape(64, -1)
    noise = float(np.median(np.std(signal.detrend(rows), axis=1)))
    return bool(np.ptp(rows.mean(axis=1)) > 10.0 * noise)


def _chance(piece: Piece, *, linear: bool) -> float:
    """Bound the chance that noise is as coherent with the displacement as the voltage is."""
    chance = 1.0
    # slow motion shows in a few means of the record, fast motion in short segments
    m = max(1, piece.n // MEANS)
    for block, size in ((m, piece.n // m // 16), (1, 256)):
        v, y = block_means(piece.v, block), block_means(piece.y, block)
        if v.size < 8 * size or chance < CHANCE:
            continue
        s_vv, s_yy, s_vy = cross_spectra(v, y, size, linear=linear)
        # detrending a straight line leaves only rounding, which has no coherence
        power = (s_vv > 1e-12 * s_vv.max(initial=0.0)) & (s_yy > 1e-12 * s_yy.max(initial=0.0))
        if power.any():
            coherence = np.abs(s_vy[power]) ** 2 / (s_vv[power] * s_yy[power])
            # Hann segments that overlap by half are worth 0.95 of their number; 0.6 is careful
            left = (1.0 - min(1.0, float(coherence.max()))) ** (1.2 * v.size / size - 1.6)
            chance = min(chance, float(power.sum()) * left)
    return chance


def refuse_closed_loop(record: Record) -> None:
    """
    Refuse a record under position control, where the voltage answers the position.

    Either observation shows position control: the drive moves while the position is held, or the
    position follows a straight line more closely than the drive.  Under voltage control the stage
    creeps, and its hysteresis bends the displacement, not the voltage.
    """
    span, stroke = float(np.ptp(record.voltage_range)), record.stroke
    if span == 0.0 or stroke == 0.0:
        return
    for refuse in (_refuse_hold, _refuse_ramp):
        for piece in record:
            refuse(record.name, piece, span, stroke)


def _refuse_hold(name: str, piece: Piece, span: float, stroke: float) -> None:
    window = max(16, int(0.5 * piece.sample_rate))
    if piece.n < 4 * window:
        return
    v, y = block_means(piece.v, window), block_means(piece.y, window)
    for start, stop in true_runs(np.abs(np.diff(y)) < 1e-4 * stroke):
        moved = abs(v[stop] - v[start]) / span
        followed = abs(y[stop] - y[start]) / stroke
        if stop - start < 4 or moved <= 0.005 or followed >= 0.05 * moved:
            continue
        t = piece.t[[start * window, min(stop * window, piece.n - 1)]]
        cause = 'a position controller was on'
        if not np.ptp(held := piece.y[(start + 1) * window : stop * window]):
            cause += f', or the sensor is at its stop, as it reads {1e6 * held[0]:.4g} um there'
        raise IdentificationError(
            f'{name}: from {t[0]:.3g} to {t[1]:.3g} s the voltage moves by {moved:.1%} of '
            f'its range while the position moves by {followed:.2%} of its stroke: {cause}, so the '
            'position does not answer the voltage; record in open loop'
        )


def _refuse_ramp(name: str, piece: Piece, span: float, stroke: float) -> None:
    for parts in (1, 2, 4):
        m = piece.n // parts // RAMP
        if m < 4:
            return
        for start in range(0, piece.n - m * RAMP + 1, m * RAMP // 2):
            stop = start + m * RAMP
            v, y = (block_means(x[start:stop], m) for x in (piece.v, piece.y))
            if np.ptp(v) < 0.05 * span or np.ptp(y) < 0.05 * stroke:
                continue
            bend_v, bend_y = _bend(v), _bend(y)
            if bend_y < STRAIGHT and bend_v > BENT * max(bend_y, STRAIGHT / 2.0):
                raise IdentificationError(
                    f'{name}: from {piece.t[start]:.3g} to {piece.t[stop - 1]:.3g} s the '
                    f'position follows a straight line to {bend_y:.3%} of its travel and the '
                    f'voltage only to {bend_v:.2%}. A position controller was on, so the position '
                    'does not answer the voltage; record in open loop'
                )


def _bend(x: Array) -> float:
    """Compute the rms deviation from a straight line, as a share of the travel of the line."""
    k = np.linspace(-0.5, 0.5, x.size)
    travel = float(k @ x / (k @ k))
    return float(np.std(x - travel * k)) / max(abs(travel), np.finfo(float).tiny)
