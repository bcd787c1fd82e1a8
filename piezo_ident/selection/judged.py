# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Errors of a model sample by sample, and its promise: the errors on other records."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from piezo_ident.common.arrays import Array, Mask
from piezo_ident.record.record import Piece

if TYPE_CHECKING:
    # at run time this import would load scipy.signal for each prediction
    from piezo_ident.fitting.free_run import Fit


@dataclass(frozen=True, eq=False)
class JudgedRun:
    """
    Free run of a model on one piece, with its errors.

    Attributes
    ----------
    record : str
    piece : Piece
    predicted : ndarray, shape (n,)
        Displacement [m].
    use : ndarray of bool, shape (n,)
        Samples that count.
    held : ndarray of bool, shape (n,)
        Samples that no fit of the judged model used.
    zero : float, optional
        Known zero of displacement of the record, relative to the zero of the model [m].
    """

    record: str
    piece: Piece
    predicted: Array
    use: Mask
    held: Mask
    zero: float = 0.0

    @property
    def error(self) -> Array:
        """Measured minus predicted displacement [m], shape (n,)."""
        return np.asarray(self.piece.y - self.predicted)


@dataclass(frozen=True, eq=False)
class Judged:
    """
    Runs from which the promise, the band and the deviations of an identification follow.

    `fit` is the fit of all parameters together, or None for a model that was identified in steps.
    """

    runs: tuple[JudgedRun, ...]
    fit: Fit | None = None

    @property
    def tests_other_motion(self) -> bool:
        """Whether some motion was not fitted: a segment, or the parts that `fit` held out."""
        return self.fit is not None or any(
            s.kind not in ('idle', 'ramp') and run.held[s.start : s.stop].all()
            for run in self.runs
            for s in run.piece.segments
        )


@dataclass(frozen=True)
class Promise:
    """
    Expected free-run errors on another record of the same stage, % of stroke.

    `same` is for the same kinds of motion in the same shares.  `other` is for motion of another
    kind within the swings and speeds of these records.  `other` is unknown (None) if every segment
    of motion was fitted, or if all motion has one kind.  Hum, drift and other effects of time
    count in full, because another record has them and the model lacks them.
    """

    same: float
    other: float | None

    @property
    def told(self) -> str:
        """The promise in words."""
        if self.other is None:
            return (
                f'{self.same:.3g} % of stroke on such motion; the error on another kind of motion '
                'is not known until another kind is held out: play `identification_loops`'
            )
        return f'{self.same:.3g} % of stroke, {self.other:.3g} % on another kind of motion'
