# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Whole periods out of records of several axes, and a model identified from them.

A segment whose voltages repeat themselves holds periods; how long they are is found from the
voltages alone.  Segments named alike but for a number, as the realisations of a multisine are, are
of one group.  Models stand for the motion about the mean of the voltages.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
import re

import numpy as np
from numpy.typing import NDArray
from piezo_ident.axes.explain import (
    explain,
    Explanation,
    groups,
    middle_group,
    Score,
    SINGLE,
    WORTH,
)
from piezo_ident.axes.frequency_response import likeness
from piezo_ident.axes.linear_fit import choose_order
from piezo_ident.axes.model_text import AxesModel
from piezo_ident.axes.paths import axis_errors, AxisError, Path, paths_of
from piezo_ident.axes.periodic import Periodicity, periodicity, PeriodicRecord
from piezo_ident.common.errors import DataError
from piezo_ident.identification.prepare import fault_lines
from piezo_ident.record.channels import Axes
from piezo_ident.record.readings.faults import without_faults
from piezo_ident.record.record import Record, records_of

#: most periods of one segment
PERIODS = 64
#: voltages that differ by less than this part of their range are equal: measured ones do by 2e-4
EQUAL = 1e-3
#: inputs of such coherence are one signal: what either moves is known ten times worse than both
ONE_SIGNAL = 0.98
#: orders that are tried
ORDERS = (4, 6, 8, 12, 16, 20, 28, 36)


@dataclass(frozen=True, eq=False)
class Periods:
    """
    The periods in some records, about the mean of the voltages.

    Attributes
    ----------
    records : tuple of PeriodicRecord
    v0 : ndarray, shape (inputs,)
        That mean [V].
    inputs, outputs : tuple of str
        Their columns.
    faults : tuple of str
        What was wrong with the records, and what was done about it.
    """

    records: tuple[PeriodicRecord, ...]
    v0: NDArray[np.float64]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    faults: tuple[str, ...] = ()


def periods_of(records: Sequence[Record]) -> Periods:
    """
    Find the periodic segments of some records of one stage.

    Of three periods or more the first is left out: the stage settles in it.  Readings that cannot
    be the stage's are left out of all that is made of them (`piezo_ident.record.readings.faults`).

    Raises
    ------
    DataError
        When there is none, or they differ in length.
    """
    found, resting = [], set[str]()
    records = [without_faults(record) for record in records]
    every = Axes.of_records(records)
    pieces = [piece for record in records for piece in record]
    for axes, piece in zip(every, pieces, strict=True):
        for segment in piece.segments:
            cut = slice(segment.start, segment.stop)
            still = np.ptp(axes.inputs[cut], axis=0) == 0
            count = _periods(axes.inputs[cut][:, ~still])
            if count < 2:
                continue
            if still.any():
                resting |= {axes.input_names[i] for i in np.flatnonzero(still)}
                continue
            first = 1 if count > 2 else 0
            u, y = (
                x[cut].reshape(count, -1, x.shape[1])[first:] for x in (axes.inputs, axes.outputs)
            )
            found.append((segment.label, u, y))
    if resting and not found:
        raise DataError(
            f'{", ".join(sorted(resting))} rest in segments that repeat; drive all axes at once, '
            'each by a multisine of its own (docs/two_axes.md)'
        )
    sizes = sorted({u.shape[1] for _, u, _ in found})
    if len(sizes) != 1:
        raise DataError(
            f'the records hold periods of {sizes} samples; play one multisine again and again'
            if sizes
            else 'no segment of the records repeats its voltages; give every realisation of a '
            'multisine as a segment of its own, of two whole periods or more (docs/two_axes.md)'
        )
    v0 = np.mean([u.mean(axis=(0, 1)) for _, u, _ in found], axis=0)
    rate = every[0].sample_rate
    return Periods(
        tuple(
            PeriodicRecord(label, re.sub(r'-\d+$', '', label), rate, u - v0, y)
            for label, u, y in found
        ),
        v0,
        every[0].input_names,
        every[0].output_names,
        tuple(fault_lines(records)),
    )


def _periods(u: NDArray[np.float64]) -> int:
    """Return how many periods some voltages are; 1 where they do not repeat, or all rest."""
    n, span = len(u), np.ptp(u, axis=0)
    if not span.size:
        return 1
    for count in range(min(PERIODS, n // 16), 1, -1):
        size = n // count
        if n % count == 0 and (np.abs(u[size:] - u[:-size]).max(axis=0) < EQUAL * span).all():
            return count
    return 1


@dataclass(frozen=True, eq=False, repr=False)
class AxesIdentification:
    """
    A stage of several axes, identified.

    Attributes
    ----------
    model : AxesModel
        With the effect that is named.
    explanation : Explanation
    errors : dict
        In free run on the records held out, by group.
    periodicity : tuple of Periodicity
        Of all records.
    periods : Periods
    axis_errors : tuple of AxisError
        Of each axis alone, on the records held out.
    paths : tuple of Path
        What each input moves of other axes, and by how much the model errs there.
    """

    model: AxesModel
    explanation: Explanation
    errors: dict[str, Score]
    periodicity: tuple[Periodicity, ...]
    periods: Periods
    axis_errors: tuple[AxisError, ...]
    paths: tuple[Path, ...]

    def __repr__(self) -> str:
        told = [f'{c.name:32s}{c.error:8.3g} %' for c in self.explanation.candidates]
        return '\n'.join(
            [
                f'A stage of {len(self.model.outputs)} axes: {self.model.effect}.',
                '',
                '100 rms(y - yhat) / rms(y) on multisines held out; other motion may err more:',
                *told,
                '',
                self._modes(),
                '',
                *(str(x) for x in (*self.axis_errors, *self.paths)),
                *(f'warning: {warning}' for warning in self.warnings),
            ]
        )

    def _modes(self) -> str:
        found = self.explanation
        if found.modes_move is None:
            return 'One amplitude does not tell whether the modes move with it.'
        return (
            f'The modes {"move" if found.modes_move else "stay"} as the amplitude grows: linear '
            f'models of each err by {found.kept_modes:.3g} % with one set of modes, by '
            f'{found.own_modes:.3g} % with their own.'
        )

    @property
    def error(self) -> float:
        """100 rms(y - yhat) / rms(y) on what was held out, quadratic mean of the groups."""
        return self.model.error_percent

    @property
    def linear_error(self) -> float:
        """The same of the linear model."""
        return self.explanation['linear'].error

    @property
    def warnings(self) -> tuple[str, ...]:
        """Faults, records that do not repeat, couplings missed, what the name leaves open."""
        told = [*self.periods.faults, *(str(p) for p in self.periodicity if p.suspicious)]
        told += [
            f'the model does not tell what {p.input} moves of {p.output}: it errs by '
            f'{p.error:.2g} % of the motion of {p.output} there'
            for p in self.paths
            if p.wrong
        ]
        found = self.explanation
        best = min((c for c in found.candidates if c.name in SINGLE), key=lambda c: c.error)
        if found.modes_move is None and found.name != 'linear':
            told.append(
                'hysteresis before the mechanics and inside them look alike at one amplitude; '
                'play a second one'
            )
        elif best.error < (1 - WORTH) * found[found.name].error:
            told.append(
                f'{best.name} errs by {best.error:.3g} % and is not named, since the modes stay '
                'as the amplitude grows: what is before them is no sum of plays'
            )
        return tuple(told)


def identify_axes(
    records: Sequence[Record] | Record,
    *,
    iterations: int = 6,
    progress: Callable[[str, float], None] = lambda step, share: None,
) -> AxesIdentification:
    """
    Identify a stage of several axes from multisines.

    The last realisation of each group is held out; on it the order and the candidates are judged,
    in free run.

    Parameters
    ----------
    records : Record, or sequence of Record
        With segments of at least two periods, each at least twice (realisations).
    iterations : int
        Steps a candidate.
    progress : callable
        Called with the step and its share done.

    Raises
    ------
    DataError
        When the records do not determine a model.

    Examples
    --------
    >>> import piezo_ident as pi
    >>> stage, program = pi.TwoAxisStage.load('two_axes'), pi.Program.load('two_axes')
    >>> found = pi.identify_axes(stage.play(program), iterations=1)
    >>> found.model.inputs, found.error < 0.5 * found.linear_error
    (('v', 'v_b'), True)
    """
    records = records_of(records, 'identify_axes: records')
    periods = periods_of(records)
    parts = groups(periods.records)
    alone = [group for group, members in parts.items() if len(members) < 2]
    if alone:
        raise DataError(
            f'{", ".join(alone)}: one realisation only; play two or more, one of them is held out'
        )
    taught = [r for members in parts.values() for r in members[:-1]]
    _check_separable(taught, periods.inputs)
    held_out = [members[-1] for members in parts.values()]
    repeats = periodicity(periods.records)
    weight = {id(r): p.weight for r, p in zip(periods.records, repeats, strict=True)}
    progress('dynamics', 0.0)
    # order and start at the middle of the amplitudes
    middle = middle_group(periods.records)
    linear, _ = choose_order(middle[:-1], middle[-1:], orders=ORDERS)
    progress('candidates', 0.0)
    told = 0

    def told_of(_: str) -> None:
        nonlocal told
        told += 1
        progress('candidates', min(1.0, told / 6))

    found = explain(
        linear,
        taught,
        held_out,
        weights=[weight[id(r)] for r in taught],
        iterations=iterations,
        report=told_of,
    )
    model = AxesModel(
        found.model,
        periods.records[0].rate,
        periods.inputs,
        periods.outputs,
        periods.v0,
        found.name,
        found[found.name].error,
    )
    return AxesIdentification(
        model,
        found,
        found[found.name].scores,
        repeats,
        periods,
        axis_errors(found.model, held_out, periods.outputs),
        paths_of(found.model, held_out, periods.inputs, periods.outputs),
    )


def _check_separable(records: Sequence[PeriodicRecord], inputs: Sequence[str]) -> None:
    """Refuse axes that were driven by one signal: each may have moved what the other did."""
    for group, members in groups(records).items():
        alike = np.triu(likeness(members), 1)
        first, second = divmod(int(np.argmax(alike)), len(alike))
        if alike[first, second] > ONE_SIGNAL:
            raise DataError(
                f'{group}: {inputs[first]} and {inputs[second]} play one signal, so nothing '
                'tells which of them moved what; give each axis random phases of its own'
            )
