# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Cut records into rows of a regression, and into blocks that can be held out.

A row is the mean of a few neighbouring samples, so a minute at 20 kHz stays a small matrix.  The
model runs at the full rate and is averaged afterwards, so rows of model and data are averaged
alike.
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
#: rows per second, enough for the motion that steps and noise excite, and the most rows in total
ROW_RATE, MOST_ROWS = 5000.0, 200_000
#: smallest number of rows that can be cut into blocks
FEWEST = 500
#: approximate number of blocks, and number of sets of blocks that are held out in turn
BLOCKS, FOLDS = 80, 5

Memory = Callable[[Array], Array]


@dataclass(frozen=True, eq=False)
class Rows:
    """
    Records, prepared for a regression.

    Attributes
    ----------
    runs : tuple of Run
        Uniformly sampled pieces, normalised by the model's scaling.
    record, names : ndarray of int, shape (runs,), tuple of str
        The record of each run, and the names of the records.
    begin : ndarray, shape (runs,)
        Start of the record of each run [s], as a drift begins with the record, whatever its clock
        was set to.  Zero if an effect of the model already depends on the time of the clock.
    duration : float
        Time from start to end of the longest record [s].
    memories : tuple of callable
        Play outputs at the start of each run, as a function of the thresholds.
    m : int
        Samples in a row.
    keep : tuple of ndarray of bool
        For each run, the rows that count: sound for the most part, and behind the unknown start.
    x : ndarray, shape (n,)
        Measured displacement of the rows, normalised.
    block, of_record : ndarray of int, shape (n,)
        Block and record of each row.
    fold, group : ndarray of int, shape (blocks,)
        Equal numbers are held out together: interleaved blocks (fold), or kinds of motion (group).
    label, labels : tuple of str
        Segment label of each block, and name of each group.
    stroke : float
        Largest range of the displacement in a record, normalised.
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
        """Kinds of motion that are held out in turn; empty if parts of the data replace them."""
        return () if are_parts(self.labels) else self.labels

    @functools.cached_property
    def highest_frequency(self) -> float:
        """Frequency below which all but a millionth of the power of the command lies [Hz]."""
        pairs = ((run, np.flatnonzero(k)) for run, k in zip(self.runs, self.keep, strict=True))
        judged = ((r, slice(k[0] * self.m, (k[-1] + 1) * self.m)) for r, k in pairs if k.size)
        found = (highest_frequency(run.u[cut], run.piece.sample_rate) for run, cut in judged)
        return max(found, default=0.0)

    @functools.cached_property
    def reach(self) -> tuple[float, float]:
        """Lowest and highest command, normalised."""
        return _extremes([run.u for run in self.runs])

    @functools.cached_property
    def driven(self) -> tuple[float, float]:
        """Lowest and highest voltage [V]."""
        return _extremes([run.piece.v for run in self.runs])

    def covers(self, span: Sequence[float]) -> bool:
        """Return whether the voltage covers enough of a span [V] for H to hold in all of it."""
        low, high = self.driven
        return high - low >= COVERED * (span[1] - span[0])

    @property
    def passes(self) -> float:
        """Number of passes of the command over its range, in either direction."""
        low, high = self.reach
        # rows instead of samples, so that converter steps and noise do not count as travel
        travel = sum(float(np.abs(np.diff(block_means(run.u, self.m))).sum()) for run in self.runs)
        return travel / (high - low) if high > low else 0.0

    def time(self, i: int) -> Array:
        """Compute the time of the samples of a run since the start of its record [s]."""
        run = self.runs[i]
        return run.piece.time(0, run.u.size) - float(self.begin[i])

    def fading(self, i: int, times: Sequence[float]) -> Array:
        """Compute decays with time constants [s] over a run; 1 until its record has rows."""
        run = self.runs[i]
        begin, _ = self._counted.get(int(self.record[i]), (0.0, 0.0))
        t = np.maximum(run.piece.time(0, run.u.size) - begin, 0.0)
        return np.exp(-t / np.asarray(times, np.float64)[:, None])

    @property
    def judged(self) -> float:
        """Longest time from the first row to the last row of a record [s]."""
        return max(end - begin for begin, end in self._counted.values())

    @property
    def first(self) -> float:
        """Time of the first row of the record with most rows, on the clock of `time` [s]."""
        begin = float(self.begin[list(self.record).index(self.longest)])
        return self._counted[self.longest][0] - begin

    @property
    def last(self) -> float:
        """Latest end of a record, on the clock of `time` [s]."""
        ends = [run.piece.start_time + run.piece.duration for run in self.runs]
        return float((np.array(ends) - self.begin).max())

    @functools.cached_property
    def _counted(self) -> dict[int, tuple[float, float]]:
        """First and last time of the rows of each record [s]."""
        found: dict[int, list[float]] = {}
        for run, keep, k in zip(self.runs, self.keep, self.record, strict=True):
            t = run.piece.start_time + np.flatnonzero(keep) * self.m / run.piece.sample_rate
            found.setdefault(int(k), []).extend(t[[0, -1]] if t.size else ())
        return {k: (min(t), max(t)) for k, t in found.items() if t}

    @property
    def longest(self) -> int:
        """Number of the record with most rows."""
        return int(np.bincount(self.of_record, minlength=len(self.names)).argmax())

    @functools.cached_property
    def edges(self) -> Integers:
        """First row of each block, and the end; shape (blocks + 1,)."""
        starts = np.flatnonzero(np.diff(self.block, prepend=-1))
        return np.append(starts, self.n)

    def percent(self, mean_square: float) -> float:
        """Convert a normalised mean square to rms in % of stroke."""
        return percent(np.sqrt(max(mean_square, 0.0)), self.stroke)

    def square(self, size: float) -> float:
        """Convert an rms in % of stroke to a normalised mean square."""
        return (size * self.stroke / 100.0) ** 2

    def errors(self, e: Array, noise: float) -> Errors:
        """Compute the errors of a residual, shape (n,); `noise` was lost by averaging to rows."""

        def error(part: Array) -> float:
            return self.percent(float(np.mean(part**2)) + noise)

        labels = np.array(self.label)[self.block]
        parts = {label: e[labels == label] for label in dict.fromkeys(self.label)}
        sines: dict[float, list[Array]] = {}
        for label, part in parts.items():
            frequency = sine_frequency(label)
            if frequency is not None:
                sines.setdefault(frequency, []).append(part)
        by_segment = {label: error(part) for label, part in parts.items()}
        by_frequency = {f'{f:g}': error(np.concatenate(sines[f])) for f in sorted(sines)}
        return Errors(error(e), by_segment, by_frequency)

    def of(self, signals: Sequence[Array]) -> Array:
        """Convert signals at the full rate, one for each run, to rows; shape (n,)."""
        parts = [block_means(x, self.m)[keep] for x, keep in zip(signals, self.keep, strict=True)]
        return np.concatenate(parts)


def centred(x: Array, of_record: Integers) -> Array:
    """Subtract from rows the mean of their record."""
    return np.asarray(x - means(x, of_record)[of_record])


def means(x: Array, of_record: Integers) -> Array:
    """Compute the mean of the rows of each record; shape (records,)."""
    return np.asarray(np.bincount(of_record, x) / np.bincount(of_record))


def make_rows(
    model: StageModel, records: Sequence[Record], bad: Sequence[Mask] | None = None
) -> Rows:
    """
    Cut records into rows and blocks, by the scaling and sampling rate of a model.

    `bad` marks for each run samples that are not used.  Raises IdentificationError if no record
    has the sampling rate of the model, or if too few rows can be judged.
    """
    runs = _sound_runs(model, records, bad)
    names = tuple(dict.fromkeys(run.record for run in runs))
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
    block, labels = _in_blocks(runs, keep, m)
    u, x = (
        np.concatenate([block_means(s, m)[k] for s, k in zip(signals, keep, strict=True)])
        for signals in ([run.u for run in runs], [run.x for run in runs])
    )
    record = np.array([names.index(run.record) for run in runs])
    of_record = np.concatenate(
        [np.full(int(good.sum()), k) for good, k in zip(keep, record, strict=True)]
    )
    commands = np.split(u, np.flatnonzero(np.diff(block)) + 1)
    group, group_labels = held_out_kinds(labels, commands)
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
        x=x,
        block=block,
        of_record=of_record,
        fold=np.arange(block.max() + 1) % FOLDS,
        group=group,
        label=tuple(labels),
        labels=group_labels,
        stroke=max(strokes((run.record, run.x[run.use]) for run in runs).values()),
    )


def _sound_runs(
    model: StageModel, records: Sequence[Record], bad: Sequence[Mask] | None
) -> list[Run]:
    """Return the runs at the sampling rate of a model, without their bad samples."""
    runs = runs_of(records, model.sample_rate, model.scaling, SWEPT)
    if not runs:
        rates = sorted({p.sample_rate for record in records for p in record})
        raise IdentificationError(
            f'no record is sampled at the {model.sample_rate:g} Hz of the model (they have '
            f'{", ".join(f"{r:g}" for r in rates)} Hz); record at that rate, or identify again'
        )
    for i, out in enumerate(bad or ()):
        runs[i] = replace(runs[i], use=runs[i].use & ~out, known=runs[i].known & ~out)
    return runs


def _has_clock(model: StageModel) -> bool:
    """Return whether the model holds time-driven parameters that only apply to one record."""
    found = [(find_effect(setting.name), setting.parameters) for setting in model.effects]
    return any(e.time_driven and not e.same(values, e.elsewhere(values)) for e, values in found)


def _whole_rows(known: Mask, m: int) -> Mask:
    """Select the rows of m samples that count: at most half of a row may be filled gaps."""
    both = (x[: x.size // m * m].reshape(-1, m) for x in (known, closed(known, FEW)))
    counts, whole = (x.sum(axis=1) for x in both)
    return np.asarray((whole == m) & (2 * counts >= m))


def _in_blocks(runs: Sequence[Run], keep: Sequence[Mask], m: int) -> tuple[Integers, list[str]]:
    """Cut rows into blocks; return the block of each row, and the label of each block."""
    longest = max(1, sum(int(k.sum()) for k in keep) // BLOCKS)
    blocks, labels = list[Integers](), list[str]()
    for run, good in zip(runs, keep, strict=True):
        number = np.full(good.size, -1)
        for label, start, stop in stretches(run.record, run.piece, m):
            count = max(1, round((stop - start) / longest))
            for part in np.array_split(np.arange(start, stop), count):
                if good[part].any():
                    number[part] = len(labels)
                    labels.append(label)
        blocks.append(number[good])
    return np.unique(np.concatenate(blocks), return_inverse=True)[1], labels


def _memory(model: StageModel, run: Run, at_rest: bool) -> Memory:
    u0 = float(run.u[0])
    start = None if at_rest else fit_start(model, run.piece, run.use)
    if start is None or start.memory is None:
        return lambda r: initial_memory(u0, r)
    at = np.concatenate([[0.0], model.hysteresis.thresholds])
    value = np.concatenate([[u0], np.asarray(start.memory)[: at.size - 1]])
    # a play output falls by at most its threshold; thresholds between known plays are interpolated
    return lambda r: np.clip(np.interp(r, at, value), u0 - r, u0)


def _extremes(signals: Sequence[Array]) -> tuple[float, float]:
    return min(float(x.min()) for x in signals), max(float(x.max()) for x in signals)
