# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
One record of many: identified or diagnosed on its own, and never raising.

What comes back is plain data and text, so that it can come from another process or machine; the
record itself is read where the work is done.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field
import hashlib
import json
import math
import os
from pathlib import Path
import time

from piezo_ident import __version__
from piezo_ident.common.errors import ConfigError, PiezoIdentError
from piezo_ident.diagnosis.procedure import diagnose
from piezo_ident.diagnosis.results import Diagnosis, DiagnosisSettings
from piezo_ident.identification.identify import identify
from piezo_ident.identification.results import Identification, Settings
from piezo_ident.many.figures_of_merit import character
from piezo_ident.model.files import model_from_dict, model_to_yaml, parse_yaml
from piezo_ident.record.io import read_record
from piezo_ident.record.record import Record

__all__ = [
    'Diagnose',
    'Identify',
    'Outcome',
    'Reading',
    'Row',
    'Value',
    'failed',
    'fingerprint',
]

#: what stands in a cell of the table
Value = str | float | int | None


@dataclass(frozen=True)
class Reading:
    """
    How to read a record; see `piezo_ident.record.io.read_record`.

    Attributes
    ----------
    displacement_unit : {'m', 'mm', 'um', 'nm'}
    voltage_limits : tuple of float, optional
        [V]
    namespace, voltage_topic, displacement_topic : str, optional
    """

    displacement_unit: str = 'm'
    voltage_limits: tuple[float, float] | None = None
    namespace: str | None = None
    voltage_topic: str | None = None
    displacement_topic: str | None = None

    def read(self, path: str) -> Record:
        """
        Read a record.

        Raises
        ------
        DataError
            When it cannot be used.
        """
        return read_record(
            path,
            displacement_unit=self.displacement_unit,
            voltage_limits=self.voltage_limits,
            namespace=self.namespace,
            voltage_topic=self.voltage_topic,
            displacement_topic=self.displacement_topic,
        )


@dataclass(frozen=True)
class Row:
    """
    A line of the table.

    Attributes
    ----------
    record : str
    values : mapping of str to Value
        By column; empty where it failed.
    reason : str
        Why it failed, in one line; empty where it did not.
    """

    record: str
    values: Mapping[str, Value] = field(default_factory=dict)
    reason: str = ''

    @property
    def good(self) -> bool:
        """Whether the record carried a result."""
        return not self.reason


@dataclass(frozen=True)
class Outcome:
    """
    What became of a record.

    Attributes
    ----------
    row : Row
    model : str
        Text of the model file; empty where it failed.
    files : mapping of str to bytes
        The report, by file name, where one was asked for.
    seconds : float
        That it took [s]; no part of the row, which is to be the same wherever it is made.
    """

    row: Row
    model: str = ''
    files: Mapping[str, bytes] = field(default_factory=dict)
    seconds: float = 0.0


@dataclass(frozen=True)
class Identify:
    """
    The identification of one record; called without arguments, it returns an `Outcome`.

    Attributes
    ----------
    name : str
        Of its row.
    path : str
        Where it is read, by whoever does the work.
    reading : Reading
    settings : Settings
    report : callable, optional
        Makes the files of a report; a function of a module, so that it can be sent.
    """

    name: str
    path: str
    reading: Reading = Reading()
    settings: Settings = field(default_factory=Settings)
    report: Callable[[Identification, Record], Mapping[str, bytes]] | None = None

    def __call__(self) -> Outcome:
        """Do it; whatever goes wrong is the reason of a failed row."""
        return _attempt(self.name, self.path, self._work)

    def settled(self) -> str:
        """Return a digest of all that the result depends on, but for the record itself."""
        return _digest(self)

    def _work(self) -> Outcome:
        record = self.reading.read(self.path)
        found = identify(record, self.settings)
        files = {} if self.report is None else self.report(found, record)
        values = identified(found, record)
        return Outcome(Row(self.name, values), model_to_yaml(found.model), files)


@dataclass(frozen=True)
class Diagnose:
    """
    The diagnosis of one record; called without arguments, it returns an `Outcome`.

    Attributes
    ----------
    name, path, reading
        As of `Identify`.
    settings : DiagnosisSettings
    model : str
        Text of the model file.
    model_name : str
        What to call it.
    report : callable, optional
        As of `Identify`.
    """

    name: str
    path: str
    model: str
    model_name: str
    reading: Reading = Reading()
    settings: DiagnosisSettings = field(default_factory=DiagnosisSettings)
    report: Callable[[Diagnosis], Mapping[str, bytes]] | None = None

    def __call__(self) -> Outcome:
        """Do it; whatever goes wrong is the reason of a failed row."""
        return _attempt(self.name, self.path, self._work)

    def settled(self) -> str:
        """Return a digest of all that the result depends on, but for the record itself."""
        return _digest(self)

    def _work(self) -> Outcome:
        if not self.model:
            raise ConfigError(f'there is no model {self.model_name} for it')
        given = model_from_dict(parse_yaml(self.model, self.model_name), self.model_name)
        record = self.reading.read(self.path)
        found = diagnose(given, record, self.settings)
        files = {} if self.report is None else self.report(found)
        values = {'model': self.model_name, **diagnosed(found, record)}
        return Outcome(Row(self.name, values), model_to_yaml(found.model), files)


def failed(name: str, path: str, error: BaseException) -> Outcome:
    """Return the row of a record over which something went wrong."""
    if isinstance(error, PiezoIdentError):
        text = str(error)
    elif isinstance(error, MemoryError):
        text = 'out of memory; give fewer --jobs or shorter records'
    elif isinstance(error, OSError):
        text = f'cannot be read ({error.strerror or error}); check the file'
    else:
        text = f'{type(error).__name__}: {error}'
    # the place is that of whoever read it; the record is named in its own column
    for known in (f'{path}: ', f'{Path(path).name}: '):
        text = text.removeprefix(known)
    return Outcome(Row(name, reason=' '.join(text.split()) or type(error).__name__))


def _attempt(name: str, path: str, work: Callable[[], Outcome]) -> Outcome:
    began = time.perf_counter()
    try:
        done = work()
    # one record among many must not end the run, whatever it dies of
    except Exception as error:  # noqa: BLE001
        done = failed(name, path, error)
    return Outcome(done.row, done.model, done.files, time.perf_counter() - began)


def _digest(job: Identify | Diagnose) -> str:
    kept = {
        'verb': type(job).__name__,
        'version': __version__,
        'reading': asdict(job.reading),
        'settings': asdict(job.settings),
        'model': getattr(job, 'model', ''),
        'report': job.report is not None,
    }
    text = json.dumps(kept, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def fingerprint(path: str) -> str:
    """
    Return what changes when a record is written anew: number of files, sizes, latest change.

    Parameters
    ----------
    path : str
        A file, or the folder of a bag.

    Raises
    ------
    OSError
        When it cannot be looked at.
    """
    names = [entry.path for entry in os.scandir(path)] if os.path.isdir(path) else [path]
    files = [os.stat(name) for name in names]
    size, last = sum(f.st_size for f in files), max((f.st_mtime_ns for f in files), default=0)
    return f'{len(files)}-{size}-{last}'


def _head(record: Record) -> dict[str, Value]:
    low, high = record.voltage_range
    return {
        'sample_rate': record.pieces[0].sample_rate,
        'samples': record.n,
        'duration': record.duration,
        'voltage_low': low,
        'voltage_high': high,
        'stroke': record.stroke,
    }


def _number(value: float | None) -> float | None:
    return float(value) if value is not None and math.isfinite(value) else None


def identified(found: Identification, record: Record) -> dict[str, Value]:
    """
    Return the cells of an identification.

    Parameters
    ----------
    found : Identification
    record : Record

    Returns
    -------
    dict of str to Value
        By the columns of `piezo_ident.many.table.COLUMNS`; SI units, errors in % of stroke.
    """
    model = found.model
    h, stage = model.hysteresis, character(model)
    values: dict[str, Value] = {
        **_head(record),
        'method': str(model.identification['method']),
        'error_held_out': _number(found.error('held out')),
        'error_selection': _number(found.error('selection')),
        'error_fitted': _number(found.error('fitted')),
        'noise_floor': _number(found.noise_floor),
        'gain': stage.gain,
        'loop_width': stage.loop_width,
        'delay': model.delay.total / model.sample_rate,
        'delay_samples': model.delay.total,
        'delay_std': _number(found.delay.std),
        'bandwidth': stage.bandwidth,
        'resonance': stage.resonance,
        'resonance_peak': stage.peak,
        'order_a': model.dynamics.a.size,
        'order_b': model.dynamics.b.size,
        'p1': h.p1,
        'p2': h.p2,
    }
    for i, (r, q) in enumerate(zip(h.thresholds, h.weights, strict=True), 1):
        values[f'r{i}'], values[f'q{i}'] = float(r), float(q)
    values['warnings'] = _joined(found.warnings)
    return values


def diagnosed(found: Diagnosis, record: Record) -> dict[str, Value]:
    """
    Return the cells of a diagnosis.

    Parameters
    ----------
    found : Diagnosis
    record : Record

    Returns
    -------
    dict of str to Value
        By the columns of `piezo_ident.many.table.COLUMNS`, and for every effect that was added
        ``<effect>.share``, ``<effect>.rms`` and its parameters, in the units of the catalogue.
    """
    values: dict[str, Value] = {
        **_head(record),
        'verdict': found.verdict,
        'effects': ' '.join(effect.name for effect in found.effects),
        'alike': '' if found.group is None else ' '.join(found.group.names),
        'error_before': _number(found.before.overall),
        'error_refit': _number(found.refit.overall),
        'error_after': _number(found.after.overall),
        'unexplained': _number(found.unexplained.rms_percent),
        'noise_floor': _number(found.noise_floor),
        'smallest_detectable': _number(found.smallest_detectable),
    }
    for effect in found.effects:
        values[f'{effect.name}.share'] = _number(effect.share)
        values[f'{effect.name}.rms'] = _number(effect.rms_percent)
        for name, parameter in effect.parameters.items():
            values.update(_cells(f'{effect.name}.{name}', parameter.value))
    values['faults'] = _joined(found.faults)
    values['warnings'] = _joined(found.warnings)
    return values


def _cells(column: str, value: float | str | tuple[float, ...]) -> dict[str, Value]:
    if isinstance(value, str):
        return {column: value}
    if isinstance(value, tuple):
        return {f'{column}.{i}': _number(x) for i, x in enumerate(value, 1)}
    return {column: _number(value)}


def _joined(items: Iterable[object]) -> str:
    # lines would make a table hard to read elsewhere
    return ' | '.join(' '.join(str(x).split()) for x in items)
