# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The demonstration: simulated stages identified from nothing, and a measured one if it is there.

First the counterpart of Table I of Gu, Li, Zhu and Su (2016), doi:10.1109/TMECH.2015.2465868, then
a stage that the model cannot hit by luck.
"""

from __future__ import annotations

from collections.abc import Sequence
import os
from pathlib import Path
import time

import numpy as np
from piezo_ident.cli.console import Console
from piezo_ident.common.errors import ConfigError, PiezoIdentError
from piezo_ident.excitation.program import Program
from piezo_ident.identification.identify import identify
from piezo_ident.identification.results import Identification, Settings
from piezo_ident.model.free_run import free_run, sine_errors, SineError
from piezo_ident.model.metrics import FORMULA
from piezo_ident.model.simulated_stage import SimulatedStage
from piezo_ident.nodes.starter import rclpy_is_there
from piezo_ident.record.io import read_record
from piezo_ident.record.record import Record
from piezo_ident.report import text_summary, write_report

__all__ = ['demo', 'find_measured']

#: frequencies [Hz] and the two rows of the paper's Table I, on its real stage
FREQUENCIES = (1, 10, 50, 80, 100, 120)
PAPER_MODEL = (1.03, 1.75, 2.73, 3.15, 3.23, 3.59)
PAPER_STATIC = (1.03, 1.98, 4.85, 7.36, 8.37, 10.06)

MEASURED = 'piezo_1hz.csv'


def find_measured(asked: Path | None) -> Path | None:
    """
    Return the measured record of the demonstration, if it is there.

    Parameters
    ----------
    asked : path or None
        Named by the user, and then it has to be there.

    Raises
    ------
    ConfigError
        When the file that was named is not there.
    """
    if asked is not None:
        if not asked.exists():
            raise ConfigError(f'{asked}: does not exist; check --measured, or leave it out')
        return asked
    folder = os.environ.get('PIEZO_IDENT_DATA') or Path('..', 'shared', 'data')
    path = Path(folder, MEASURED)
    return path if path.is_file() else None


def demo(out: Path, asked: Path | None, console: Console) -> int:
    """
    Run the demonstration.

    Parameters
    ----------
    out : path
        Folder of the reports.
    asked : path or None
        A measured record; looked for when absent.
    console : Console
        Takes the text.

    Returns
    -------
    int
        Exit code: 1 when the graph did not do what it should, though nodes can run here.
    """
    began = time.monotonic()
    measured = find_measured(asked)
    out.mkdir(parents=True, exist_ok=True)
    problem = _paper_stage(out, console)
    _dense_stage(out, console)
    _measured(out, measured, console)
    problem = '; '.join(filter(None, [problem, _lacking(out, console)]))
    console.say(f'reports: {out}    {time.monotonic() - began:.0f} s in all')
    if problem:
        console.note(f'the graph did not get through: {problem}')
    return 1 if problem else 0


def _paper_stage(out: Path, console: Console) -> str:
    """Show the first stage, and return why the graph did not get through with it."""
    problem = ''
    console.say("1. The paper's stage, simulated, identified from voltage and displacement alone")
    if rclpy_is_there():
        try:
            found, sines, problem = _on_the_graph(out, console)
        except PiezoIdentError as error:
            problem = str(error)
            console.say(f'   the graph did not get through: {problem}')
            found, sines = _offline(out, console)
    else:
        console.say('   without ROS: rclpy is not here')
        found, sines = _offline(out, console)
    console.say(text_summary(found))
    console.say()
    console.say(f'Sines over the full range, not fitted: {FORMULA}, in %')
    console.say(_heads(FREQUENCIES))
    console.say(_row('paper, real stage: model', PAPER_MODEL))
    console.say(_row('paper, real stage: hysteresis alone', PAPER_STATIC))
    console.say(_row('here, simulated: model', _percents(sines)))
    console.say(_row('here, simulated: hysteresis alone', _percents(sines, static=True)))
    console.say(
        "The paper's rows were measured on its real stage.  Ours are the flattering case: the\n"
        "stage is the paper's model itself, with nothing hidden, and the fit puts its thresholds\n"
        'just there.  They show that the three steps find a model that is there, no more.'
    )
    console.say()
    return problem


def _on_the_graph(
    out: Path, console: Console
) -> tuple[Identification, tuple[SineError, ...], str]:
    from piezo_ident.cli.graph_demo import graph_demo

    console.say('   six nodes over DDS: excitation, stage, identifier, model, recorder, player')
    run = graph_demo(out, console)
    console.say(
        '   live, replayed from the bag, read from the bag: the largest relative difference of a '
        f'parameter is {max(run.differences.values()):.1e}'
    )
    for where, n in run.lost.items():
        console.say(f'   {n} samples were lost {where}: this machine was too busy')
    for line in run.unclean or ('all nodes ended cleanly',):
        console.say(f'   {line}')
    _keep(run.found, out / 'stage_paper', console, run.record)
    return run.found, run.sines, run.problem


def _offline(out: Path, console: Console) -> tuple[Identification, tuple[SineError, ...]]:
    console.say('   the same, without nodes')
    stage = SimulatedStage.load('stage_paper')
    record = _play(stage, 'identification', 1)
    found = _identify('ten thresholds', record, Settings(thresholds=10), console)
    played = _play(stage, 'validation', 2)
    _keep(found, out / 'stage_paper', console, record, played)
    return found, sine_errors(found.model, played)


def _dense_stage(out: Path, console: Console) -> None:
    stage = SimulatedStage.load('stage_dense')
    console.say('2. A harder stage: forty thresholds, none of them where the fit puts its own')
    record = _play(stage, 'identification', 3)
    sines, loops = _play(stage, 'validation', 4), _play(stage, 'minor_loops', 5)
    ten = _identify('ten thresholds', record, Settings(thresholds=10), console)
    # delay and order are those just found; only the hysteresis is fitted in another way
    same = Settings(order=ten.dynamics.order, delay=ten.delay.samples)
    chosen = _identify('chosen thresholds', record, same, console)
    _keep(chosen, out / 'stage_dense', console, record, sines, loops)
    console.say(f'Not fitted: {FORMULA}, in %')
    console.say(_heads(FREQUENCIES, 'minor loops'))
    for name, found in (('ten', ten), ('chosen', chosen)):
        count = found.hysteresis.hysteresis.thresholds.size
        errors = _percents(sine_errors(found.model, sines))
        loop = free_run(found.model, loops).errors.percent
        console.say(_row(f'{name} thresholds ({count} fitted)', [*errors, loop]))
    console.say()


def _measured(out: Path, path: Path | None, console: Console) -> None:
    console.say('3. A measured record')
    if path is None:
        console.say(
            f'{MEASURED} is not there: neither in ../shared/data nor where PIEZO_IDENT_DATA '
            'points; --measured names another record.\n'
        )
        return
    record = read_record(path)
    found = _identify('ten thresholds', record, Settings(thresholds=10), console)
    _keep(found, out / 'measured', console, record)
    console.say(text_summary(found))
    console.say()


def _lacking(out: Path, console: Console) -> str:
    """Show a diagnosis, and return why the graph did not get through with it."""
    from piezo_ident.cli.diagnosis_demo import diagnosis_demo, offline_diagnosis_demo

    console.say('4. A stage with creep and rate-dependent hysteresis, which nobody declares')
    problem = ''
    if rclpy_is_there():
        console.say('   ~/run, then ~/diagnose, on the running graph')
        try:
            run = diagnosis_demo(out / 'stage_effects', console)
        except PiezoIdentError as error:
            problem = str(error)
            console.say(f'   the graph did not get through: {problem}\n')
            return problem
        problem = '; '.join(run.unclean)
    else:
        run = offline_diagnosis_demo(console)
    for line in run.lines():
        console.say(f'   {line}')
    console.say()
    return problem


def _play(stage: SimulatedStage, program: str, seed: int) -> Record:
    sequence = Program.load(program).build(stage.model.sample_rate)
    return stage.play(sequence, np.random.default_rng([stage.seed, seed]), name=program)


def _identify(title: str, record: Record, settings: Settings, console: Console) -> Identification:
    began = time.monotonic()
    with console.progress() as progress:
        found = identify(record, settings, progress=progress)
    console.say(
        f'   {title}: identified from {record.duration:.1f} s of data ({record.n} samples) in '
        f'{time.monotonic() - began:.1f} s'
    )
    return found


def _keep(found: Identification, folder: Path, console: Console, *records: Record) -> None:
    console.say(f'   report: {write_report(found, records, folder)}\n')


def _percents(errors: Sequence[SineError], *, static: bool = False) -> list[float]:
    by_frequency = {round(e.frequency): e.static_percent if static else e.percent for e in errors}
    return [by_frequency.get(f, float('nan')) for f in FREQUENCIES]


def _heads(frequencies: Sequence[int], *more: str) -> str:
    return (
        f'  {"":36s}'
        + ''.join(f'{f"{f} Hz":>9s}' for f in frequencies)
        + ''.join(f'{name:>13s}' for name in more)
    )


def _row(name: str, values: Sequence[float]) -> str:
    n = len(FREQUENCIES)
    return (
        f'  {name:36s}'
        + ''.join(f'{x:9.3f}' for x in values[:n])
        + ''.join(f'{x:13.3f}' for x in values[n:])
    )
