# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""``--each``: every record on its own, many at once, with a table and pictures of them all."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
import logging
import os
from pathlib import Path
import shutil
import tempfile
from typing import Any

from piezo_ident.cli.common import check_bag_options, check_limits, expand
from piezo_ident.cli.console import Console
from piezo_ident.cli.interrupts import interrupts
from piezo_ident.cli.outputs import check_folder
from piezo_ident.common.errors import ConfigError, DataError
from piezo_ident.diagnosis.results import DiagnosisSettings
from piezo_ident.identification.results import Settings
from piezo_ident.many.executors import cluster, cores, Places, run_all
from piezo_ident.many.ledger import Ledger, unwritable
from piezo_ident.many.run import Diagnose, failed, fingerprint, Identify, Outcome, Reading, Row
from piezo_ident.many.spread import in_order, QUANTITIES, Spread, spread_of
from piezo_ident.many.table import columns_of, unit_of, write_tables
from piezo_ident.model.files import load_model, model_to_yaml, write_text

__all__ = ['check_each', 'diagnose_each', 'identify_each']

Job = Identify | Diagnose
#: records whose reason, or whose standing out, is printed
SAID = 10
#: what stands beside the models and the reports
SUMMARY = ('records.csv', 'records.parquet', 'errors.png', 'parameters.png', 'effects.png')


def check_each(args: argparse.Namespace) -> None:
    """
    Refuse options that go with --each only, or not with it.

    Raises
    ------
    ConfigError
    """
    if args.each is None:
        for option in ('jobs', 'scheduler', 'reports'):
            if getattr(args, option):
                raise ConfigError(f'--{option} goes with --each DIR; add it, or leave this out')
        return
    for option, instead in (
        ('model', f'the models go to {args.each / "models"}'),
        ('report', 'say --reports for a report of every record'),
        ('validation', 'each record is judged on its own segments'),
    ):
        if getattr(args, option):
            raise ConfigError(f'--{option} does not go with --each: {instead}')
    if args.scheduler is not None and args.jobs is not None:
        raise ConfigError('--jobs is for this machine; with --scheduler its workers set how many')
    if args.jobs == 0:
        raise ConfigError('--jobs 0: give at least 1')


def identify_each(args: argparse.Namespace, settings: Settings, console: Console) -> None:
    """``piezo_ident identify RECORD... --each DIR``."""
    if args.reports:
        from piezo_ident.report.each import identification_files
    reading = _reading(args)
    jobs = [
        Identify(name, path, reading, settings, identification_files if args.reports else None)
        for name, path in _named(_records(args, console))
    ]
    _each(args, jobs, 'identified', console)


def diagnose_each(args: argparse.Namespace, settings: DiagnosisSettings, console: Console) -> None:
    """``piezo_ident diagnose MODEL RECORD... --each DIR``."""
    if args.reports:
        from piezo_ident.report.each import diagnosis_files
    reading = _reading(args)
    find = _models(args.model_file)
    jobs = []
    for name, path in _named(_records(args, console)):
        model, text = find(name)
        jobs.append(
            Diagnose(
                name,
                path,
                text,
                model,
                reading,
                settings,
                diagnosis_files if args.reports else None,
            )
        )
    _each(args, jobs, 'diagnosed', console)


def _records(args: argparse.Namespace, console: Console) -> list[Path]:
    paths = expand(args.records, console)
    check_bag_options(paths, args)
    return paths


def _reading(args: argparse.Namespace) -> Reading:
    return Reading(
        displacement_unit=args.displacement_unit,
        voltage_limits=check_limits(args),
        namespace=args.namespace,
        voltage_topic=args.voltage_topic,
        displacement_topic=args.displacement_topic,
    )


def _named(paths: Sequence[Path]) -> list[tuple[str, str]]:
    """Return name and place of records; the workers may have another working directory."""
    found: dict[str, Path] = {}
    for path in paths:
        # of '.' too, and of a link as it is called
        place = Path(os.path.abspath(path))
        name = place.name if path.is_dir() else place.stem
        if name in found:
            raise ConfigError(
                f'{found[name]} and {path} are both called {name}; rename one, or give them in '
                'two calls with a folder each'
            )
        found[name] = path
    return [(name, os.path.abspath(path)) for name, path in found.items()]


def _folder_of_models(path: Path) -> Path:
    """Return a folder of models, or the one in what identify --each wrote."""
    return path / 'models' if (path / 'models').is_dir() else path


def _models(path: Path) -> Callable[[str], tuple[str, str]]:
    """Return what finds the model of a record, as its name and its text."""
    if not path.is_dir():
        # one for all; read here, so that what is wrong with it is said once
        text = model_to_yaml(load_model(path))
        return lambda name: (path.name, text)
    folder = _folder_of_models(path)

    def find(name: str) -> tuple[str, str]:
        file = folder / f'{name}.yaml'
        try:
            return file.name, file.read_text(encoding='utf-8')
        except (OSError, UnicodeDecodeError):
            # the row says that it is missing
            return file.name, ''

    if not any(folder.glob('*.yaml')):
        raise ConfigError(
            f'{path}: holds no models; give a model file, or a folder with NAME.yaml'
        )
    return find


@dataclass(frozen=True)
class _Folder:
    """Where the results go."""

    path: Path

    @property
    def models(self) -> Path:
        return self.path / 'models'

    def model(self, name: str) -> Path:
        return self.models / f'{name}.yaml'

    def report(self, name: str) -> Path:
        return self.path / 'reports' / name

    def make(self) -> None:
        try:
            self.models.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise unwritable(self.path, error) from None

    def holds(self, job: Job) -> bool:
        """Whether the files of a record that is done are still there."""
        return self.model(job.name).is_file() and (
            job.report is None or self.report(job.name).is_dir()
        )

    def keep(self, outcome: Outcome) -> None:
        """Write the model and the report of a record; those of an earlier run go."""
        name = outcome.row.record
        if outcome.model:
            write_text(self.model(name), outcome.model)
        else:
            self.model(name).unlink(missing_ok=True)
        target = self.report(name)
        try:
            if target.exists():
                shutil.rmtree(target)
            if outcome.files:
                target.parent.mkdir(exist_ok=True)
                work = Path(tempfile.mkdtemp(prefix='.report.', dir=target.parent))
                for file, content in outcome.files.items():
                    (work / file).write_bytes(content)
                work.chmod(0o755)
                work.rename(target)
        except OSError as error:
            raise unwritable(target, error) from None


def _each(args: argparse.Namespace, jobs: Sequence[Job], done: str, console: Console) -> None:
    folder = _Folder(args.each)
    check_folder(folder.path)
    ledger = Ledger(folder.path, args.verb)
    _refuse_inputs(folder.path, args.records, jobs)
    _refuse_targets(folder, jobs, getattr(args, 'model_file', None), ledger.exists)
    keys = [_key(job) for job in jobs]
    rows: dict[int, Row] = {}
    for i, (job, key) in enumerate(zip(jobs, keys, strict=True)):
        ledger.check_place(job.name, job.path, key)
        row = ledger.done(job.name, key)
        if row is not None and folder.holds(job):
            rows[i] = row
    kept = len(rows)
    folder.make()
    ledger.begin()
    todo = [i for i in range(len(jobs)) if i not in rows]
    try:
        with console.progress() as progress:

            def tick() -> None:
                progress('records', len(rows) / len(jobs))

            if todo:
                with _places(args, len(todo)) as places:
                    for number, outcome in _run([jobs[i] for i in todo], places, tick):
                        i = todo[number]
                        with interrupts.waiting():
                            folder.keep(outcome)
                            ledger.add(keys[i], outcome, jobs[i].path)
                        rows[i] = outcome.row
    except KeyboardInterrupt:
        console.note(
            f'{len(rows)} of {len(jobs)} records are done and kept; the same command goes on '
            'with the rest'
        )
        raise
    found = [rows[i] for i in range(len(jobs))]
    with interrupts.quitting():
        from piezo_ident.many.figures import write_spread
    with interrupts.waiting():
        files = [*write_tables(found, folder.path), *write_spread(found, folder.path)]
    good = [row for row in found if row.good]
    if not good:
        raise DataError(
            f'none of {len(found)} records could be {done}, see {files[0]}; the first: '
            f'{found[0].record}: {found[0].reason}'
        )
    _say(found, kept, done, files, folder.path, console)
    console.result(_data(found, files, folder.path))


def _run(jobs: Sequence[Job], places: Places, tick: Callable[[], None]) -> Any:
    def lost(number: int, error: BaseException) -> Outcome:
        return failed(jobs[number].name, jobs[number].path, error)

    return run_all(jobs, places, lost, tick)


def _refuse_inputs(out: Path, named: Sequence[Path], jobs: Sequence[Job]) -> None:
    # its table would be taken for a record the next time
    records = {Path(job.path).resolve() for job in jobs}
    folders = {path.parent for path in records} | {path.resolve() for path in named}
    if out.resolve() in records | folders:
        raise ConfigError(f'{out}: is where the records are; choose another folder for --each')


def _refuse_targets(
    folder: _Folder, jobs: Sequence[Job], model: Path | None, is_ours: bool
) -> None:
    """Refuse to put results where an input stands, or what no earlier run has put there."""
    inputs = {Path(job.path).resolve() for job in jobs}
    if model is not None and model.is_dir():
        given = _folder_of_models(model).resolve()
        inputs |= {given / f'{job.name}.yaml' for job in jobs}
    elif model is not None:
        inputs.add(model.resolve())
    inside = {above for path in inputs for above in (path, *path.parents)}
    for job in jobs:
        for target in (folder.model(job.name), folder.report(job.name)):
            if target.resolve() in inside:
                raise ConfigError(
                    f'{target}: is an input, or holds one; choose another folder for --each'
                )
    if is_ours:
        return
    results = [place(job.name) for job in jobs for place in (folder.model, folder.report)]
    for target in (*results, *(folder.path / name for name in SUMMARY)):
        if target.exists():
            raise ConfigError(
                f'{target}: is there already, and not of an earlier --each; choose another folder'
            )


def _key(job: Job) -> str:
    try:
        return f'{job.settled()} {fingerprint(job.path)}'
    except OSError:
        # reading it will say what is wrong
        return ''


def _places(args: argparse.Namespace, jobs: int) -> AbstractContextManager[Places]:
    if args.scheduler is not None:
        # what it logs when a scheduler goes is said in one line by us
        logging.getLogger('distributed').setLevel(logging.CRITICAL)
        return cluster(args.scheduler)
    return cores(min(args.jobs or _core_count(), jobs))


def _core_count() -> int:
    # what a container or a batch system leaves us, where that can be asked for
    if hasattr(os, 'sched_getaffinity'):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _say(
    rows: Sequence[Row],
    kept: int,
    done: str,
    files: Sequence[Path],
    folder: Path,
    console: Console,
) -> None:
    bad = [row for row in rows if not row.good]
    earlier = f', {kept} of them earlier' if kept else ''
    console.say(
        f'{len(rows) - len(bad)} of {len(rows)} records {done}{earlier}; {len(bad)} failed'
    )
    for row in bad[:SAID]:
        console.say(f'  {row.record}: {row.reason}')
    if len(bad) > SAID:
        console.say(f'  and {len(bad) - SAID} more, see {files[0]}')
    verdicts = [str(row.values.get('verdict', '')) for row in rows if row.values.get('verdict')]
    for verdict in dict.fromkeys(sorted(verdicts, key=lambda v: -verdicts.count(v))):
        effects = [
            str(row.values.get('effects'))
            for row in rows
            if row.values.get('verdict') == verdict and row.values.get('effects')
        ]
        counted = sorted(set(effects), key=lambda e: (-effects.count(e), e))
        named = ', '.join(f'{e.replace(" ", " + ")} ({effects.count(e)})' for e in counted[:4])
        console.say(f'  {verdict}: {verdicts.count(verdict)}{"   " if named else ""}{named}')
    spreads = _spreads(rows)
    if spreads:
        console.say(
            f'\n{"":30s}{"lowest":>11s}{"5 %":>11s}{"median":>11s}{"95 %":>11s}'
            f'{"highest":>11s}   first to last'
        )
    for s in spreads:
        cells = ''.join(f'{x:11.4g}' for x in (s.lowest, s.low, s.median, s.high, s.highest))
        drift = 'no trend' if s.drift is None else f'{s.drift:+.3g}'
        console.say(f'{f"{s.quantity.name} / {s.quantity.unit}":30s}{cells}   {drift}')
    far = {name: None for s in spreads for name in s.far}
    for name in list(far)[:SAID]:
        what = ', '.join(s.quantity.name for s in spreads if name in s.far)
        console.say(f'  {name} stands out: {what}')
    if len(far) > SAID:
        console.say(f'  and {len(far) - SAID} more')
    console.say(f'\nmodels: {folder / "models"}')
    console.say(f'table and pictures: {", ".join(map(str, files))}')


def _spreads(rows: Sequence[Row]) -> list[Spread]:
    ordered = in_order([row for row in rows if row.good])
    return [s for q in QUANTITIES if (s := spread_of(ordered, q)) is not None]


def _data(rows: Sequence[Row], files: Sequence[Path], folder: Path) -> dict[str, Any]:
    return {
        'records': len(rows),
        'failed': sum(not row.good for row in rows),
        'units': {name: unit_of(name) for name in columns_of(rows) if unit_of(name)},
        'rows': [
            {'record': row.record, 'reason': row.reason or None, **row.values} for row in rows
        ],
        'spread': [asdict(s) for s in _spreads(rows)],
        'files': {
            'models': str(folder / 'models'),
            **{path.name: str(path) for path in files},
        },
    }
