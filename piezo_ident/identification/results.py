# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Results of an identification."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from piezo_ident.common.arrays import Mask
from piezo_ident.common.showable import Showable
from piezo_ident.fitting.free_run import Fit
from piezo_ident.identification.settings import Settings
from piezo_ident.identification.step1_delay import DelayResult
from piezo_ident.identification.step2_dynamics import DynamicsResult
from piezo_ident.identification.step3_hysteresis import HysteresisFit
from piezo_ident.model.free_run import piece_runs, PieceRun
from piezo_ident.model.front_door import Parameters
from piezo_ident.model.metrics import KINDS
from piezo_ident.model.stage_model import StageModel
from piezo_ident.model.stream import StartLike
from piezo_ident.operators.dynamics import Dynamics
from piezo_ident.record.record import Record
from piezo_ident.selection.judged import Promise

#: memory at the start of a run, by `piezo_ident.identification.errors.key_of`
Memories = Mapping[tuple[str, float], StartLike]


@dataclass(frozen=True, eq=False)
class Steps:
    """Results of single steps so far."""

    delay: DelayResult | None = None
    dynamics: tuple[DynamicsResult, Dynamics] | None = None

    def beside(self, delay: int | None) -> Steps:
        """Keep these results; drop them if the user gives another delay, or no longer gives it."""
        before = self.delay
        was_given = before is not None and before.source == 'given'
        is_same = before is not None and before.samples == delay
        return Steps() if (was_given or delay is not None) and not is_same else self


@dataclass(frozen=True)
class ErrorRow:
    """
    Free-run error of one stretch of data, and of the hysteresis alone.

    `percent` and `static_percent` refer to the stroke of the whole record, `fit` is
    `piezo_ident.model.metrics.fit_percent`, and `n` counts samples.  `data` is 'fitted',
    'selection' (not fitted, but chose between models), 'held out', or 'validation' (of a record
    that was given for it).
    """

    record: str
    segment: str
    percent: float
    static_percent: float
    fit: float
    n: int
    data: str

    @property
    def driven(self) -> bool:
        """Whether the voltage tests the stage in this stretch, not rest or slow positioning."""
        return self.segment.partition(':')[0] not in ('idle', 'ramp')


@dataclass(frozen=True)
class Headline:
    """
    Error of a model, and of its hysteresis alone, over all `n` driven samples of one kind of data.

    `data` and the percentages are as in `ErrorRow`; the percentages are NaN without samples.
    """

    data: str
    records: tuple[str, ...]
    percent: float
    static_percent: float
    n: int


@dataclass(frozen=True, eq=False)
class FitOutcome:
    """
    Result of a fit, in three steps or by one free-run fit; see `Identification`.

    Attributes
    ----------
    masks : sequence of (fitted, selection)
        For each run, the fitted samples and the samples that only chose between models.
    offsets : mapping
        Zero of displacement of each run, measured from the zero of the model [m].
    judged : (StageModel, Memories) or None
        Model and memories that the held-out samples judged; None if they judged the final model.
    fit : Fit or None
        The fit of all parameters together.
    """

    model: StageModel
    delay: DelayResult
    dynamics: DynamicsResult
    hysteresis: HysteresisFit
    masks: Sequence[tuple[Mask, Mask]]
    warnings: Sequence[str]
    not_identified: Sequence[tuple[str, str]] = ()
    memories: Memories = field(default_factory=dict)
    offsets: Mapping[tuple[str, float], float] = field(default_factory=dict)
    judged: tuple[StageModel, Memories] | None = None
    fit: Fit | None = None


def rms_percent(rows: Sequence[ErrorRow], static: bool = False) -> float:
    """
    Compute the common rms error of rows, weighted by samples; NaN without rows.

    `static` takes the error of the hysteresis alone.
    """
    n = sum(row.n for row in rows)
    squares = sum(row.n * (row.static_percent if static else row.percent) ** 2 for row in rows)
    return float(np.sqrt(squares / n)) if n else float('nan')


@dataclass(frozen=True, eq=False)
class SharedRuns:
    """
    Free runs of modes that several axes share, which predict an axis instead of its chain.

    Attributes
    ----------
    law : str
        Law of the hysteresis inside their loop, and creep, in words.
    errors : mapping of str to float
        Errors of each law and of the chains on multisines held out, % of rms(y) of all axes.
    runs : tuple of PieceRun
        The modes do not run without dynamics: `y_static` is the displacement of the whole model.
    """

    law: str
    errors: Mapping[str, float]
    runs: tuple[PieceRun, ...]

    @property
    def told(self) -> str:
        """The choice in words."""
        errors = ', '.join(f'{law} {error:.3g} %' for law, error in self.errors.items())
        return (
            f'the axes share modes with hysteresis inside their loop ({self.law}), which predict '
            f'instead of chains; on multisines held out of the fit, in % of rms(y): {errors}'
        )


@dataclass(frozen=True, eq=False, repr=False)
class Identification(Showable):
    """
    Result of an identification.

    If axes share modes, errors, warnings and promise are those of the modes.  Delay, dynamics and
    hysteresis are those of the chain of the axis.

    Attributes
    ----------
    noise_floor : float or None
        Rms of the sensor noise, % of stroke.
    stroke : float
        Stroke of the records [m].
    not_identified : tuple of (str, str)
        Quantities that the data could not tell, with reasons.
    records : tuple of Record
        Fitted records, then the records for validation.
    memories : mapping of (str, float) to ndarray or Start
        Fitted play outputs at the start of a piece, and the creep left from earlier motion; keys
        are record name and start time.
    shared : SharedRuns or None
        Prediction by modes that the axes share.

    Examples
    --------
    >>> import numpy as np
    >>> import piezo_ident as pi
    >>> v = 5 - 5 * np.cos(2 * np.pi * np.arange(4000) / 1000)
    >>> y = 7e-6 * v + 2e-6 * np.sin(2 * np.pi * np.arange(4000) / 1000)
    >>> record = pi.Record.from_arrays(v, y, sample_rate=1000)
    >>> result = pi.identify(record, pi.Settings(thresholds=4, order=(1, 1)))
    >>> result.model.simulate(v).shape
    (4000,)
    """

    model: StageModel
    delay: DelayResult
    dynamics: DynamicsResult
    hysteresis: HysteresisFit
    errors: tuple[ErrorRow, ...]
    noise_floor: float | None
    noise_source: str
    stroke: float
    warnings: tuple[str, ...]
    not_identified: tuple[tuple[str, str], ...]
    settings: Settings
    records: tuple[Record, ...] = ()
    memories: Memories = field(default_factory=dict)
    promise: Promise | None = None
    shared: SharedRuns | None = None

    @property
    def runs(self) -> Sequence[PieceRun]:
        """Free runs of the model over the pieces of the records."""
        if self.shared is not None:
            return self.shared.runs
        return piece_runs(self.model, self.records, self.memories)

    @property
    def parameters(self) -> Parameters:
        """All parameters of the model with their standard deviations, printed as a table."""
        return self.model.parameters

    def error(self, data: str) -> float:
        """
        Compute the rms error over one kind of data, weighted by samples; NaN without such data.

        Ramps and rests do not count: they are easy.
        """
        return rms_percent(self._driven(data))

    @property
    def headline(self) -> Headline:
        """Error to quote: on validation data, else on the next best kind of data."""
        data = next((kind for kind in KINDS if self._driven(kind)), 'fitted')
        rows = self._driven(data)
        return Headline(
            data=data,
            records=tuple(dict.fromkeys(row.record for row in rows)),
            percent=rms_percent(rows),
            static_percent=rms_percent(rows, static=True),
            n=sum(row.n for row in rows),
        )

    def _driven(self, data: str) -> list[ErrorRow]:
        return [row for row in self.errors if row.data == data and row.driven]
