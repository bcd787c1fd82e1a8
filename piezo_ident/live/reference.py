# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The reference of a stage, joined over its axes, and the errors of the stage."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Sequence
import math

import numpy as np
from piezo_ident.common.arrays import Array, line_between
from piezo_ident.live.join import held, Join
from piezo_ident.live.monitor import TrackingError
from piezo_ident.live.sample_clock import Kind, Verdict
from piezo_ident.record.blocks import Samples


class Reference:
    """
    Reference of all axes, as one stream.

    `tails` are the suffixes of the topics of all axes, the first one empty.  `join` holds the
    waiting blocks, and `length` is the number of samples of the last stream.
    """

    def __init__(self, tails: Sequence[str], sample_rate: float) -> None:
        self._tails, self._rate = tails, sample_rate
        self._kept: list[Array] = []
        self.length = 0
        self.reset()

    def reset(self, rest: Sequence[float] = ()) -> None:
        """Begin at `rest`, the displacements of the further axes [m]; keep the last stream."""
        self.join = Join(self._tails[1:], self._rate, rest)
        # labels, each with its first sample
        self._labels: deque[tuple[int, str]] = deque()
        self._heard = 0
        self._last = np.full(len(self._tails), math.nan)

    def take(
        self, samples: Samples, verdict: Verdict, resting: Collection[str], longest: float
    ) -> tuple[Array, list[tuple[str, str, int]]]:
        """
        Complete the next block of the first axis; return it with its faults.

        The `verdict` is the clock's verdict on this block.  The `resting` axes have no reference.
        The stream is kept up to the length `longest` [s].

        Returns
        -------
        x : ndarray, shape (k, n)
            The reference [m], with the samples of a gap before the block.
        faults : list
            Kind, text and number of samples of each fault.
        """
        rows, missing = self.join.rows(samples)
        faults = [
            ('not_finite', f'{n} samples of reference{tail} are missing: the last is repeated', n)
            for tail, n in missing.items()
            if tail not in resting
        ]
        if verdict.kind is Kind.START:
            # nothing comes before the first sample of a stream
            self._last[:] = math.nan
            self._kept, self.length = [], 0
        if bad := samples.not_finite:
            about = 'samples of the reference are no numbers: the last one stays in force'
            faults.append(('not_finite', f'{bad} {about}', bad))
        if verdict.kind is Kind.GAP:
            faults.append(('lost', verdict.reason, verdict.missing))
        parts = []
        for row, before in zip(np.atleast_2d(rows.values), self._last.tolist(), strict=True):
            x = held(row, before)
            if verdict.kind is Kind.GAP:
                x = np.append(line_between(before, float(x[0]), verdict.missing), x)
            parts.append(x)
        if not self._labels or self._labels[-1][1] != samples.segment:
            self._labels.append((self._heard, samples.segment))
        x = np.stack(parts)
        self._last, n = x[:, -1].copy(), x.shape[1]
        self._heard, self.length = self._heard + n, self.length + n
        if self.length <= longest * self._rate and np.isfinite(self._last).all():
            self._kept.append(x)
        return x, faults

    def label(self, tick: int) -> str:
        """Return the label at a sample since `reset`; later calls ask for later samples."""
        labels = self._labels
        while len(labels) > 1 and labels[1][0] <= tick:
            labels.popleft()
        return labels[0][1]

    @property
    def kept(self) -> Array | None:
        """The last stream [m], shape (k, n), as far as it is kept; None without one."""
        return np.concatenate(self._kept, axis=1) if self._kept else None


class TrackingErrors:
    """
    Wanted minus measured displacement of each axis.

    `tails` are the suffixes of the topics of all axes, `each` has the error by suffix.  The rms is
    taken over a time `window` [s].  `percents` has the rms of each axis at the last `look` [% of
    the span of the wanted motion].
    """

    def __init__(self, tails: Sequence[str], window: float) -> None:
        self.each = {tail: TrackingError(window, f'tracking_error{tail}') for tail in tails}
        self.percents: dict[str, float] = {}

    def clear(self) -> None:
        """Forget the errors so far."""
        for one in self.each.values():
            one.live.clear()

    def wanted(self, t: Array, rows: Array, segment: str) -> list[Samples]:
        """Take the wanted motion of all axes, a row each; return the errors that it completes."""
        return [
            error
            for one, row in zip(self.each.values(), np.atleast_2d(rows), strict=True)
            for error in one.wanted(Samples(t, row, segment, 'reference'))
        ]

    @property
    def outliers(self) -> int:
        """Number of readings that the errors leave out."""
        return sum(one.live.outliers for one in self.each.values())

    def look(self) -> None:
        """Update `percents`."""
        percents = {tail: one.percent for tail, one in self.each.items()}
        self.percents = {tail: x for tail, x in percents.items() if x is not None}

    def figures(self) -> dict[str, str]:
        """List the errors of the last `look`, for /diagnostics."""
        figures = {}
        for tail, percent in self.percents.items():
            figures[f'tracking_rms{tail}'] = f'{self.each[tail].live.rms:.6g}'
            figures[f'tracking_percent{tail}'] = f'{percent:.4g}'
        return figures
