# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Identify or diagnose many records, each on its own and in a process of its own.

The worker that reads a record also writes its results, so workers on other machines only need the
same folders.  A record that fails becomes a row with a reason.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import as_completed
from dataclasses import asdict, dataclass, field
import json
import os
from pathlib import Path
from typing import Any

from piezo_ident import __version__
from piezo_ident.common.errors import ConfigError, PiezoIdentError
from piezo_ident.common.files import unwritable, write_text
from piezo_ident.common.process import Tick
from piezo_ident.diagnosis.results import Diagnosis, DiagnosisSettings
from piezo_ident.identification.results import Identification
from piezo_ident.identification.settings import Settings
from piezo_ident.many.table import diagnosed, identified, natural, Row, Value
from piezo_ident.many.workers import dask, processes
from piezo_ident.model.files import load
from piezo_ident.record import io as record_io
from piezo_ident.record.options import ReadOptions
from piezo_ident.record.record import Record
from piezo_ident.verbs.learn import diagnose_axis, identify_axis

MARK = 'many.json'


@dataclass(frozen=True)
class Identify:
    """Task of identifying one record, by `Settings` and `ReadOptions`."""

    settings: Settings = field(default_factory=Settings)
    reading: ReadOptions = field(default_factory=ReadOptions)
    verb = 'identify'

    def __call__(self, record: Record, name: str) -> tuple[Identification, dict[str, Value]]:
        """Identify a record; return the result and the cells of its row."""
        result = identify_axis(record, self.settings)
        return result, identified(result, record)


@dataclass(frozen=True)
class Diagnose:
    """
    Task of diagnosing one record.

    `models` is a model file for all records, or a folder with ``NAME.yaml`` for each, such as the
    folder that an identification of many records wrote.
    """

    models: Path
    settings: DiagnosisSettings = field(default_factory=DiagnosisSettings)
    reading: ReadOptions = field(default_factory=ReadOptions)
    verb = 'diagnose'

    def model_of(self, name: str) -> Path:
        """Find the model file of a record."""
        if not self.models.is_dir():
            return self.models
        inside = self.models / 'models'
        return (inside if inside.is_dir() else self.models) / f'{name}.yaml'

    def __call__(self, record: Record, name: str) -> tuple[Diagnosis, dict[str, Value]]:
        """Diagnose a record; return the result and the cells of its row."""
        model = self.model_of(name)
        result = diagnose_axis(load(model), record, self.settings)
        return result, {'model': model.name, **diagnosed(result, record)}


Task = Identify | Diagnose


@dataclass(frozen=True)
class _Job:
    """Job for one record; a call in the worker gives a row and never raises."""

    task: Task
    path: Path
    name: str
    folder: Path
    report: bool

    @property
    def row_file(self) -> Path:
        return self.folder / 'rows' / f'{self.name}.json'

    @property
    def model_file(self) -> Path:
        return self.folder / 'models' / f'{self.name}.yaml'

    @property
    def report_folder(self) -> Path:
        return self.folder / 'reports' / self.name

    def settings(self) -> dict[str, Any]:
        """Collect the settings, version and paths that the result depends on."""
        task = json.loads(json.dumps(asdict(self.task), default=str))
        return {'version': __version__, 'path': str(self.path), 'report': self.report, **task}

    def inputs(self) -> list[list[int | str]]:
        """
        List name, size and time of the input files.

        The time of the results alone is not enough: a file that replaces another may be older.
        """
        files = [self.path, *sorted(self.path.iterdir() if self.path.is_dir() else ())]
        if isinstance(self.task, Diagnose):
            files.append(self.task.model_of(self.name))
        return [[f.name, (at := f.stat()).st_size, at.st_mtime_ns] for f in files]

    def earlier(self) -> Row | None:
        """Read the row of an earlier run; None if the record must be processed again."""
        try:
            kept = json.loads(self.row_file.read_text(encoding='utf-8'))
            same = kept['inputs'] == self.inputs() and kept['settings'] == self.settings()
            whole = self.model_file.is_file() and (not self.report or self.report_folder.is_dir())
            if same and whole:
                return Row(self.name, kept['values'])
        except (OSError, ValueError, KeyError, TypeError):
            pass
        return None

    def __call__(self, tick: Tick = lambda step, share: None) -> Row:
        self.row_file.unlink(missing_ok=True)
        try:
            # before the reading, so that a file that changes meanwhile is read again
            inputs = self.inputs()
            result, values = self.task(record_io.read(self.path, self.task.reading), self.name)
            result.model.save(self.model_file)
            if self.report:
                from piezo_ident.report import write_report

                write_report(result, self.report_folder)
            kept = {'settings': self.settings(), 'inputs': inputs, 'values': values}
            write_text(self.row_file, json.dumps(kept))
        # no error of a record may end the run
        except Exception as error:  # noqa: BLE001
            self.model_file.unlink(missing_ok=True)
            return self.failed(error)
        return Row(self.name, values)

    def failed(self, error: BaseException) -> Row:
        if isinstance(error, PiezoIdentError):
            reason = str(error)
        elif isinstance(error, MemoryError):
            reason = 'out of memory; give fewer jobs or shorter records'
        else:
            reason = f'{type(error).__name__}: {error}'
        for known in (f'{self.path}: ', f'{self.path.name}: '):
            reason = reason.removeprefix(known)
        return Row(self.name, reason=' '.join(reason.split()))


def run_many(
    records: Sequence[Path],
    folder: Path,
    task: Task,
    *,
    reports: bool = False,
    jobs: int | None = None,
    scheduler: str | None = None,
    progress: Callable[[int, int, Row | None], None] = lambda done, of, row: None,
) -> list[Row]:
    """
    Identify or diagnose every record on its own.

    A record is skipped if `folder` holds its results from the same file with the same settings.
    The same call therefore continues a stopped run.

    Parameters
    ----------
    records : sequence of path
        Files and bags with different names.
    folder : path
        Folder for ``models/NAME.yaml``, ``rows/NAME.json`` and, with `reports`,
        ``reports/NAME/``.
    task : Identify or Diagnose
    reports : bool, optional
        Whether to write a report of every record.
    jobs : int, optional
        Number of processes; by default one for each core.
    scheduler : str, optional
        Address of a dask scheduler whose workers see the same paths; `jobs` is then not used.
    progress : callable, optional
        Called with the number of finished records, the number of all records, and the new row,
        if any.

    Returns
    -------
    list of Row
        Rows sorted by record name, with numbers by value.

    Raises
    ------
    ConfigError
        If two records have the same name, `folder` holds other files, an input lies in `folder`,
        or no scheduler answers.
    DataError
        If `folder` cannot be written.
    """
    work = _prepare(records, folder, task, reports)
    rows = {job.name: row for job in work if (row := job.earlier()) is not None}
    todo = [job for job in work if job.name not in rows]
    progress(len(rows), len(work), None)
    if todo:
        count = min(jobs or _cores(), len(todo))
        with dask(scheduler) if scheduler else processes(count) as submit:
            futures = {submit(job): job for job in todo}
            try:
                for future in as_completed(futures):
                    job, error = futures[future], future.exception()
                    rows[job.name] = future.result() if error is None else job.failed(error)
                    progress(len(rows), len(work), rows[job.name])
            finally:
                for future in futures:
                    future.cancel()
    return sorted(rows.values(), key=lambda row: natural(row.record))


def _prepare(records: Sequence[Path], folder: Path, task: Task, reports: bool) -> list[_Job]:
    # realpath, because Path.resolve raises its own error for circular links
    target = Path(os.path.realpath(folder))
    places: dict[str, Path] = {}
    for record in records:
        # the workers may have another working directory
        path = Path(os.path.abspath(record))
        name = path.name if path.is_dir() else path.stem
        if name in places:
            raise ConfigError(f'{places[name]} and {path}: both are called {name}; rename one')
        places[name] = path
    models = [task.model_of(name) for name in places] if isinstance(task, Diagnose) else []
    for path in (*places.values(), *models):
        if Path(os.path.realpath(path)).is_relative_to(target):
            raise ConfigError(f'{folder}: holds the input {path}; choose another folder')
    mark = folder / MARK
    try:
        if folder.is_dir() and any(folder.iterdir()) and _mark(mark) != task.verb:
            raise ConfigError(f'{folder}: holds no results of {task.verb}; choose another folder')
        for part in ('models', 'rows'):
            (folder / part).mkdir(parents=True, exist_ok=True)
        write_text(mark, json.dumps({'verb': task.verb}))
    except OSError as error:
        raise unwritable(folder, error) from None
    return [_Job(task, path, name, target, reports) for name, path in places.items()]


def _mark(path: Path) -> object:
    try:
        return json.loads(path.read_text(encoding='utf-8'))['verb']
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _cores() -> int:
    # cores that a container or a batch system leaves to this process, if the system tells them
    if hasattr(os, 'sched_getaffinity'):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
