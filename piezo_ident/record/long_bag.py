# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Long bags window by window, to the record that reading them whole would give.

The bag is looked through once and read again when its samples are wanted; no more than a few
windows are in memory.  A window ends at a time stamp around which every stream is sound and in
order, and behind which nothing earlier comes, so that what is met in it is met as in the whole.
What is judged over the whole record is gathered on the way (`piezo_ident.record.overall`).

That holds for a sampling clock of one rate whose stamps are ticks over the rate, to the last bits
where the bag names the rate, and that restarts, if ever, from its beginning.  Whatever else there
is - other clocks, blocks that come later than a window, a stream that is absent for longer than
one, a window that would be refused by itself - is met by reading the bag whole.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
import functools
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.errors import DataError
from piezo_ident.record.bags.read import read_bag, record_in
from piezo_ident.record.bags.samples import BagSamples, opened_samples
from piezo_ident.record.capture import record_of_streams, SPARSE, tolerance_of
from piezo_ident.record.long_record import LongRecord, NeedsWhole, Progress
from piezo_ident.record.outlining import Outlining
from piezo_ident.record.overall import Overall
from piezo_ident.record.record import Piece, Record
from piezo_ident.record.stream import Stream
from piezo_ident.record.windows import windows

__all__ = ['WINDOW', 'read_long_bag']

#: samples of a window; up to twice as many are read whole
WINDOW = 1 << 19
#: units of the last digit that a stamp may be off its tick where the rate is named
SLACK = 4


def read_long_bag(
    path: str | Path,
    *,
    namespace: str | None = None,
    voltage_topic: str | None = None,
    displacement_topic: str | None = None,
    displacement_unit: str = 'm',
    voltage_limits: tuple[float, float] | None = None,
    recover: bool = False,
    progress: Progress = lambda step, share: None,
    inspect: Callable[[Record], None] | None = None,
    window: int | None = None,
) -> Record | LongRecord:
    """
    Read a bag; a long one is only looked through, and its samples stay where they are.

    Parameters
    ----------
    path, namespace, voltage_topic, displacement_topic, displacement_unit, voltage_limits, recover
        As for `piezo_ident.record.bags.read.read_bag`.
    progress : callable, optional
        Called as ``progress(step, share)`` while a long bag is looked through.
    inspect : callable, optional
        Gets the windows of a long bag one by one, and raises `DataError` where only the whole
        record will do.
    window : int, optional
        Samples of a window; `WINDOW` when absent.

    Raises
    ------
    DataError
        As for `read_bag`.
    """
    path, window = Path(path), window or WINDOW
    opened = functools.partial(
        opened_samples,
        path,
        namespace=namespace,
        voltage_topic=voltage_topic,
        displacement_topic=displacement_topic,
        recover=recover,
    )
    with opened() as source:
        streams = _collected(source, 2 * window)
    if streams is not None:
        return record_in(source, streams, displacement_unit, voltage_limits)
    reading = _Reading(opened, path, displacement_unit, window)
    overall = Overall(voltage_limits)
    try:
        record = reading.surveyed(overall, inspect, progress)
        if overall.is_guarded:
            # how much is too much is a share of the range, which is known only now
            command = np.array([overall.command.low, overall.command.high])
            reading.tolerance = tolerance_of(command)
            overall = Overall(voltage_limits)
            record = reading.surveyed(overall, inspect, progress)
    except NeedsWhole:
        return read_bag(
            path,
            namespace=namespace,
            voltage_topic=voltage_topic,
            displacement_topic=displacement_topic,
            displacement_unit=displacement_unit,
            voltage_limits=voltage_limits,
            recover=recover,
        )
    overall.check_finite(str(path))
    overall.check_ranges(str(path), displacement_unit)
    return record


def _collected(source: BagSamples, most: int) -> dict[str, Stream] | None:
    """Return all samples, None when a stream has more than so many."""
    streams = {quantity: Stream() for quantity in source.topics}
    rows = dict.fromkeys(streams, 0)
    for quantity, samples, stamp in source.blocks():
        streams[quantity].append(samples, stamp)
        rows[quantity] += samples.t.size
        if rows[quantity] > most:
            return None
    return streams


@dataclass
class _Reading:
    """How a bag is read window by window."""

    opened: Callable[[], AbstractContextManager[BagSamples]]
    path: Path
    unit: str
    window: int
    tolerance: float = float('inf')
    rate: float | None = None

    def surveyed(
        self, overall: Overall, inspect: Callable[[Record], None] | None, progress: Progress
    ) -> LongRecord:
        """Look through the bag, and return the record that it holds."""
        found = Outlining()
        with self.opened() as source:
            self.rate = source.sample_rate
            slack = 0 if self.rate is None else SLACK
            blocks = source.blocks(functools.partial(progress, 'checking'))
            for lap, streams in windows(blocks, source.topics, self.window, self.tolerance):
                with _left_to_the_whole():
                    record = self._record(streams, overall)
                    if self.rate is None:
                        self.rate = record.pieces[0].sample_rate
                    _check_clock(streams['voltage'].times, self.rate, slack)
                    if any(fault.name == SPARSE for fault in record.faults):
                        raise NeedsWhole('a channel is sparse in one window, which is not all')
                    found.add(record, lap, self.rate)
                    if inspect is not None:
                        inspect(record)
        return LongRecord(
            found.pieces(), self.path.name, (*source.faults, *found.faults()), self._samples
        )

    def _samples(self, progress: Progress) -> Iterator[Piece]:
        with self.opened() as source:
            blocks = source.blocks(functools.partial(progress, 'reading'))
            for _, streams in windows(blocks, source.topics, self.window, self.tolerance):
                yield from self._record(streams, Overall())

    def _record(self, streams: Mapping[str, Stream], overall: Overall) -> Record:
        return record_of_streams(
            streams,
            name=str(self.path),
            tolerance=self.tolerance,
            displacement_unit=self.unit,
            sample_rate=self.rate,
            overall=overall,
        )


@contextmanager
def _left_to_the_whole() -> Iterator[None]:
    """Leave to the whole record what would be refused in a window."""
    try:
        yield
    except DataError as error:
        raise NeedsWhole(str(error)) from None


def _check_clock(t: NDArray[np.float64], rate: float, slack: int) -> None:
    """Refuse stamps by which a window does not tell the clock of the whole."""
    t = t[np.isfinite(t)]
    if not np.all(np.abs(np.rint(t * rate) / rate - t) <= slack * np.spacing(np.abs(t))):
        raise NeedsWhole('the stamps are no ticks of one clock')
