# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Records as rows of a regression, cut into blocks that can be held out.

A row is the mean over a few neighbouring samples, so that a minute at 20 kHz stays a small matrix.
The model runs at the full rate before it is averaged, so nothing is aliased.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
import functools

import numpy as np
from piezo_ident.common.arrays import Array, closed, Integers, Mask
from piezo_ident.common.errors import IdentificationError
from piezo_ident.diagnosis.held_out import are_parts, held_out_kinds, stretches
from piezo_ident.diagnosis.results import Errors
from piezo_ident.effects import find_effect
from piezo_ident.identification.prepare import Run, runs_of
from piezo_ident.identification.spectra import highest_frequency
from piezo_ident.model.initial_memory import begins_at_rest, fit_start, forgotten, SWEPT
from piezo_ident.model.metrics import percent, strokes
from piezo_ident.model.sines import sine_frequency
from piezo_ident.model.stage_model import StageModel
from piezo_ident.operators.play import initial_memory
from piezo_ident.record.readings.gaps import FEW
from piezo_ident.record.record import Record
from piezo_ident.residual.stretches import block_means

#: share of the model's voltage range that data must cover for a refitted H to hold in all of it
COVERED = 0.95
#: rows a second that keep what steps and noise excite, and the most rows altogether
ROW_RATE, MOST_ROWS = 5000.0, 200_000
#: fewest rows that can be cut into blocks
FEWEST = 500
#: blocks altogether, about, and how many sets of them are held out in turn
BLOCKS, FOLDS = 80, 5

Memory = Callable[[Array], Array]


@dataclass(frozen=True, eq=False)
class Rows:
    """
    Records ready for a regression.

    Attributes
    ----------
    runs : tuple of Run
        Uniformly sampled pieces, normalised by the model's scaling.
    record : ndarray of int, shape (runs,)
        The record that each run belongs to.
    names : tuple of str
        Names of the records.
    begin : ndarray, shape (runs,)
        When the record of each run began [s]: what drifts began with it, whatever its clock was
        set to.  Zero where an effect of the model follows time already, which it does by the
        clock.
    duration : float
        From the start of a record to its end, of the longest one [s].
    memories : tuple of callable
        Play outputs at the start of each run, as a function of the thresholds.
    m : int
        Samples in a row.
    keep : tuple of ndarray of bool
        For each run, which rows count: most of their samples sound, and all but wide plays off
        their start.
    x : ndarray, shape (n,)
        Measured displacement of the rows, normalised.
    block, of_record : ndarray of int, shape (n,)
        Block and record of each row.
    fold, group : ndarray of int, shape (blocks,)
        Which blocks are held out together: spread over all data, and whole stretches of a kind.
    label : tuple of str
        Segment label of each block.
    labels : tuple of str
        Name of each group.
    stroke : float
        Largest minus smallest displacement of a record, the largest of all, normalised.
    """

    runs: tuple[Run, ...]
    record: Integers
    names: tuple[str, ...]
    begin: Array
    duration: float
    memories: tuple[Memory, ...]
    m: int
    keep: tuple[Mask, ...]
    x: Array
    block: Integers
    of_record: Integers
    fold: Integers
    group: Integers
    label: tuple[str, ...]
    labels: tuple[str, ...]
    stroke: float

    @property
    def n(self) -> int:
        """Number of rows."""
        return int(self.x.size)

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of motion held out in turn; empty where parts of the data stand for them."""
        return () if are_parts(self.labels) else self.labels

    @functools.cached_property
    def highest_frequency(self) -> float:
        """The frequency below which all but a millionth of the moving power of any run lies."""
        found = [0.0]
        for run, keep in zip(self.runs, self.keep, strict=True):
            if (rows := np.flatnonzero(keep)).size:
                u = run.u[rows[0] * self.m : (rows[-1] + 1) * self.m]
                found.append(highest_frequency(u, run.piece.sample_rate))
        return max(found)

    @functools.cached_property
    def reach(self) -> tuple[float, float]:
        """The lowest and the highest command, normalised."""
        return _extremes([run.u for run in self.runs])

    @functools.cached_property
    def driven(self) -> tuple[float, float]:
        """The lowest and the highest voltage [V]."""
        return _extremes([run.piece.v for run in self.runs])

    def covers(self, span: Sequence[float]) -> bool:
        """Return whether they were driven over enough of a span [V] for H to hold in all of it."""
        low, high = self.driven
        return high - low >= COVERED * (span[1] - span[0])

    def leaves(self, span: Sequence[float]) -> bool:
        """Return whether they were driven so far out of a span [V] that H is unknown there."""
        (low, high), (least, most) = self.driven, span
        return most - least < COVERED * (max(high, most) - min(low, least))

    @property
    def passes(self) -> float:
        """How often the command passed over its range, there or back."""
        low, high = self.reach
        # over rows, so that converter steps and noise are no travel
        travel = sum(float(np.abs(np.diff(block_means(run.u, self.m))).sum()) for run in self.runs)
        return travel / (high - low) if high > low else 0.0

    def time(self, i: int) -> Array:
        """Return the time of the samples of a run since its record began [s]."""
        run = self.runs[i]
        return run.piece.time(0, run.u.size) - float(self.begin[i])

    def fading(self, i: int, times: Sequence[float]) -> Array:
        """Return decays with some time constants [s] of a run; 1 until its record counts."""
        run = self.runs[i]
        begin, _ = self._counted.get(int(self.record[i]), (0.0, 0.0))
        t = np.maximum(run.piece.time(0, run.u.size) - begin, 0.0)
        return np.exp(-t / np.asarray(times, np.float64)[:, None])

    @property
    def judged(self) -> float:
        """From the first row to the last of a record, of the longest one [s]."""
        return max(end - begin for begin, end in self._counted.values())

    @property
    def first(self) -> float:
        """When the first row of the record that has most comes, by the clock of `time` [s]."""
        begin = float(self.begin[list(self.record).index(self.longest)])
        return self._counted[self.longest][0] - begin

    @property
    def last(self) -> float:
        """When the last record ends, by the clock of `time` [s]."""
        ends = [run.piece.start_time + run.piece.duration for run in self.runs]
        return float((np.array(ends) - self.begin).max())

    @functools.cached_property
    def _counted(self) -> dict[int, tuple[float, float]]:
        """When the rows of each record begin and end [s]."""
        found: dict[int, list[float]] = {}
        for run, keep, k in zip(self.runs, self.keep, self.record, strict=True):
            t = run.piece.start_time + np.flatnonzero(keep) * self.m / run.piece.sample_rate
            found.setdefault(int(k), []).extend(t[[0, -1]] if t.size else ())
        return {k: (min(t), max(t)) for k, t in found.items() if t}

    @property
    def longest(self) -> int:
        """Number of the record that has most rows."""
        return int(np.bincount(self.of_record, minlength=len(self.names)).argmax())

    @functools.cached_property
    def edges(self) -> Integers:
        """First row of each block, and the end; shape (blocks + 1,)."""
        starts = np.flatnonzero(np.diff(self.block, prepend=-1))
        return np.append(starts, self.n)

    def percent(self, mean_square: float) -> float:
        """Return a mean square, normalised, as rms in % of stroke."""
        return percent(np.sqrt(max(mean_square, 0.0)), self.stroke)

    def square(self, size: float) -> float:
        """Return an rms in % of stroke as a mean square, normalised."""
        return (size * self.stroke / 100.0) ** 2

    def errors(self, e: Array, noise: float) -> Errors:
        """
        Return the errors of a residual of the rows, shape (n,), normalised.

        `noise` is the mean square that averaging took out of rows, and that single samples have.
        """

        def error(part: Array) -> float:
            return self.percent(float(np.mean(part**2)) + noise)

        by_segment: dict[str, float] = {}
        of_frequency: dict[float, list[Array]] = {}
        for label in dict.fromkeys(self.label):
            part = e[np.array([x == label for x in self.label])[self.block]]
            by_segment[label] = error(part)
            frequency = sine_frequency(label)
            if frequency is not None:
                of_frequency.setdefault(frequency, []).append(part)
        by_frequency = {
            f'{f:g}': error(np.concatenate(of_frequency[f])) for f in sorted(of_frequency)
        }
        return Errors(error(e), by_segment, by_frequency)

    def of(self, signals: Sequence[Array]) -> Array:
        """Return the rows, shape (n,), of signals given at the full rate, one a run."""
        parts = [block_means(x, self.m)[keep] for x, keep in zip(signals, self.keep, strict=True)]
        return np.concatenate(parts)


def centred(x: Array, of_record: Integers) -> Array:
    """Return rows without the mean of the record that each belongs to."""
    return np.asarray(x - means(x, of_record)[of_record])


def means(x: Array, of_record: Integers) -> Array:
    """Return the mean of the rows of each record; shape (records,)."""
    return np.asarray(np.bincount(of_record, x) / np.bincount(of_record))


def make_rows(
    model: StageModel, records: Sequence[Record], bad: Sequence[Mask] | None = None
) -> Rows:
    """
    Cut records into rows and blocks, by the scaling and sampling rate of a model.

    `bad` are for each run samples that are not used.  IdentificationError when no record
    has the sampling rate of the model, or nothing is left to judge.
    """
    runs = runs_of(records, model.sample_rate, model.scaling, SWEPT)
    if not runs:
        rates = sorted({p.sample_rate for record in records for p in record})
        raise IdentificationError(
            f'no record is sampled at the {model.sample_rate:g} Hz of the model (they have '
            f'{", ".join(f"{r:g}" for r in rates)} Hz); record at that rate, or identify again'
        )
    names = tuple(dict.fromkeys(run.record for run in runs))
    for i, out in enumerate(bad or ()):
        runs[i] = replace(runs[i], use=runs[i].use & ~out, known=runs[i].known & ~out)
    at_rest = [begins_at_rest(model, run.piece, run.use) for run in runs]
    for i, run in enumerate(runs):
        if not at_rest[i]:
            late = np.arange(run.u.size) >= forgotten(run.u, enough=SWEPT)
            runs[i] = replace(run, known=run.known & late)
    samples = sum(int(run.known.sum()) for run in runs)
    m = max(1, round(model.sample_rate / ROW_RATE), -(-samples // MOST_ROWS))
    keep = tuple(_whole_rows(run.known, m) for run in runs)
    kept = sum(int(k.sum()) for k in keep)
    if kept < FEWEST:
        raise IdentificationError(
            f'{", ".join(names)}: {samples} samples follow from a known start, and '
            f'{FEWEST * m} are needed; give a longer record that begins at rest at the lowest '
            'voltage, or drives the stage over its whole range'
        )
    longest = max(1, kept // BLOCKS)
    blocks, labels = list[Integers](), list[str]()
    first = 0
    for run, good in zip(runs, keep, strict=True):
        number = np.full(good.size, -1)
        for label, start, stop in stretches(run, m):
            count = max(1, round((stop - start) / longest))
            for part in np.array_split(np.arange(start, stop), count):
                if good[part].any():
                    number[part] = first
                    labels.append(label)
                    first += 1
        blocks.append(number[good])
    x = [block_means(run.x, m)[good] for run, good in zip(runs, keep, strict=True)]
    record = np.array([names.index(run.record) for run in runs])
    of_record = np.concatenate(
        [np.full(int(good.sum()), k) for good, k in zip(keep, record, strict=True)]
    )
    block = np.unique(np.concatenate(blocks), return_inverse=True)[1]
    group, group_labels = held_out_kinds(labels, _blocks_of(runs, keep, m, block))
    first_of = {run.record: run.piece.start_time for run in reversed(runs)}
    begin = np.array([0.0 if _has_clock(model) else first_of[run.record] for run in runs])
    return Rows(
        runs=tuple(runs),
        record=record,
        names=names,
        begin=begin,
        duration=max(
            run.piece.duration + (run.piece.start_time - first_of[run.record]) for run in runs
        ),
        memories=tuple(_memory(model, *pair) for pair in zip(runs, at_rest, strict=True)),
        m=m,
        keep=keep,
        x=np.concatenate(x),
        block=block,
        of_record=of_record,
        fold=np.arange(block.max() + 1) % FOLDS,
        group=group,
        label=tuple(labels),
        labels=group_labels,
        stroke=max(strokes((run.record, run.x[run.use]) for run in runs).values()),
    )


def _has_clock(model: StageModel) -> bool:
    """Return whether an effect of the model does more than it would in any other record."""
    found = [(find_effect(setting.name), setting.parameters) for setting in model.effects]
    return any(e.time_driven and not e.same(values, e.elsewhere(values)) for e, values in found)


def _whole_rows(known: Mask, m: int) -> Mask:
    """Return which rows of m samples count: a few lost ones may be no more than half of a row."""
    both = (x[: x.size // m * m].reshape(-1, m) for x in (known, closed(known, FEW)))
    counts, whole = (x.sum(axis=1) for x in both)
    return np.asarray((whole == m) & (2 * counts >= m))


def _blocks_of(runs: Sequence[Run], keep: Sequence[Mask], m: int, block: Integers) -> list[Array]:
    """Return the command of each block, means over rows."""
    u = np.concatenate([block_means(r.u, m)[good] for r, good in zip(runs, keep, strict=True)])
    return np.split(u, np.flatnonzero(np.diff(block)) + 1)


def _memory(model: StageModel, run: Run, at_rest: bool) -> Memory:
    u0 = float(run.u[0])
    start = None if at_rest else fit_start(model, run.piece, run.use)
    if start is None or start.memory is None:
        return lambda r: initial_memory(u0, r)
    at = np.concatenate([[0.0], model.hysteresis.thresholds])
    value = np.concatenate([[u0], np.asarray(start.memory)[: at.size - 1]])
    # a play output falls by at most its threshold; between known ones it is interpolated
    return lambda r: np.clip(np.interp(r, at, value), u0 - r, u0)


def _extremes(signals: Sequence[Array]) -> tuple[float, float]:
    return min(float(x.min()) for x in signals), max(float(x.max()) for x in signals)
