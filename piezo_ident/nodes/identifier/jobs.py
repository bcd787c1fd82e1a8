# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Jobs of the worker process of the identifier, independent of ROS.

Each job is a function of this module, which is sent to another process.  The worker adds its last
argument, `tick`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
import json
from pathlib import Path

import numpy as np
from piezo_ident.common.process import Tick
from piezo_ident.diagnosis import Diagnosis, DiagnosisSettings
from piezo_ident.diagnosis.next_experiment import Experiment, Kind, next_experiment
from piezo_ident.excitation.program import parse_program
from piezo_ident.identification.identify import first_steps
from piezo_ident.identification.results import Identification, Settings, Steps
from piezo_ident.live.capture import refuse_incomplete, Snapshot
from piezo_ident.model.files import model_to_yaml
from piezo_ident.model.free_run import piece_runs
from piezo_ident.model.simulated_stage import SimulatedStage
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.record import Piece, Record
from piezo_ident.report import headline, json_text, steps_to_json, write_report
from piezo_ident.verbs.learn import diagnose_axis, identify_axis

#: a program as short as all three steps allow
_SMALL = """
limits: [0, 10]
slew: 500
segments:
  - {signal: idle, duration: 0.1}
  - {signal: step, bias: 5, size: 1, hold: 0.02, count: 8}
  - {signal: settle, bias: 5, amplitude: 0.48, cycles: 4, frequency: 100}
  - {signal: noise, bias: 5, amplitude: 0.4, cutoff: 3000, duration: 0.5}
  - {signal: triangle, slope: 100}
"""

#: smallest motion of the voltage of a driven record, as a share of the range of the model
DRIVEN = 0.01
#: folder of the report of a diagnosis, inside the folder of the identification
FOLDER = 'diagnosis'

#: shares of the whole work at which each step begins and ends
_SHARES = {
    'delay': (0.02, 0.05),
    'dynamics': (0.05, 0.8),
    'hysteresis': (0.8, 0.98),
    'residual': (0.02, 0.1),
    'candidates': (0.1, 0.95),
    'verdict': (0.95, 0.98),
}


@dataclass(frozen=True, eq=False)
class IdentificationOutcome:
    """
    Result of an identification, or of one of its steps.

    Attributes
    ----------
    message : str
        One line for people.
    brief : str
        The message in few words, a number first.
    figures : mapping of str to str
        Numbers of the message.
    report : str
        JSON.
    warnings : int
        Number of warnings in the report.
    steps : Steps or None
        Results of the steps so far.
    identification : Identification or None
    model : str
        YAML; empty without a model.
    """

    message: str
    brief: str = ''
    figures: Mapping[str, str] = field(default_factory=dict)
    report: str = ''
    warnings: int = 0
    steps: Steps | None = None
    identification: Identification | None = None
    model: str = ''


def with_warnings(text: str, count: int) -> str:
    """Append the number of warnings in the report to a text."""
    if not count or not text:
        return text
    return f'{text.rstrip(".")}; {count} warning{"s" * (count > 1)} in the report'


def settings_of(values: dict[str, object]) -> Settings:
    """
    Make the settings of an identification from the parameters of the node.

    Raises
    ------
    ConfigError
        When a value is out of range.
    """
    swarm = values['solver'] == 'swarm'
    delay = int(str(values['delay']))
    return Settings(
        thresholds=int(str(values['thresholds'])) or None,
        solver=str(values['solver']),  # type: ignore[arg-type]
        polish=swarm and bool(values.get('polish')),
        max_order=int(str(values['max_order'])),
        delay=None if delay < 0 else delay,
        swarm_size=int(str(values['swarm_size'])),
        swarm_iterations=int(str(values['swarm_iterations'])),
        seed=int(str(values['seed'])),
    )


def percent_of(step: str, share: float) -> float:
    """Return the progress of the whole work in percent."""
    low, high = _SHARES.get(step, (0.0, 1.0))
    return 100.0 * (low + (high - low) * share)


def identify_capture(
    snapshot: Snapshot,
    settings: Settings,
    which: str,
    steps: Steps | None,
    before: StageModel | None,
    tick: Tick,
) -> IdentificationOutcome:
    """
    Make a record of a capture and identify it.

    Parameters
    ----------
    snapshot : Snapshot
    settings : Settings
    which : {'all', 'delay', 'dynamics', 'hysteresis'}
    steps : Steps or None
        Results of earlier steps; for single steps only.
    before : StageModel or None
        Earlier model of this stage.
    tick : callable
    """
    tick('record', 0.0)
    record = snapshot.record('capture')
    tick('record', 0.01)
    refuse_incomplete(record, snapshot.sent())
    records = [record]
    if which == 'delay' or which == 'dynamics':
        step = first_steps(records, settings, which=which, steps=steps, progress=tick)
        data = steps_to_json(step, record.pieces[0].sample_rate, records)
        return IdentificationOutcome(
            _sentence(step), report=json.dumps(data), warnings=len(record.faults), steps=step
        )
    known = (steps or Steps()) if which == 'hysteresis' else None
    result = identify_axis(records, settings, steps=known, progress=tick)
    result = replace(result, warnings=(*result.warnings, *_reversed(result.model, before)))
    tick('report', 0.98)
    runs = piece_runs(result.model, records, result.memories)
    tick('report', 0.99)
    error, static = (f'{x:.3g}' for x in (result.headline.percent, result.headline.static_percent))
    return IdentificationOutcome(
        message=headline(result),
        brief=f'{error} % of stroke, hysteresis alone {static} %',
        figures={'error_percent': error, 'static_percent': static},
        report=json_text(result, runs),
        warnings=len(result.warnings),
        steps=Steps(result.delay, (result.dynamics, result.model.dynamics)),
        identification=result,
        model=model_to_yaml(result.model),
    )


def _reversed(model: StageModel, before: StageModel | None) -> Iterator[str]:
    """Yield a warning if the displacement has changed its sign."""
    if before is not None and model.scaling.Y * before.scaling.Y < 0.0:
        y, y0 = 1e6 * model.scaling.Y, 1e6 * before.scaling.Y
        yield (
            f'the displacement has changed its sign: Y = {y:.4g} um, {y0:.4g} um in the model '
            "before; look at the sensor's wires, or at the sign in its driver"
        )


def _sentence(steps: Steps) -> str:
    if steps.dynamics is not None:
        na, nb = steps.dynamics[0].order
        return f'dynamics: na = {na}, nb = {nb}'
    delay = steps.delay
    return '' if delay is None else f'delay: {delay.samples} samples ({delay.source})'


@dataclass(frozen=True, eq=False)
class DiagnosisOutcome:
    """
    Result of a diagnosis.

    Attributes
    ----------
    diagnosis : Diagnosis or None
        None if the capture lacks motion.
    message, brief, report, model, given : str
        Verdict as a sentence, and in few words; diagnosis as JSON; refined and given model as
        YAML.
    figures : mapping of str to str
        Numbers of the sentence.
    warnings : int
        Number of warnings and faults of the data in the report.
    wanted : Experiment or None
        Experiment that would decide an open question.
    """

    diagnosis: Diagnosis | None
    message: str = ''
    brief: str = ''
    figures: Mapping[str, str] = field(default_factory=dict)
    report: str = ''
    model: str = ''
    given: str = ''
    warnings: int = 0
    wanted: Experiment | None = None


def records_of_runs(record: Record) -> list[Record]:
    """
    Split a record into one record for each run of the sample clock.

    An unknown time passes between two runs, so everything that depends on time starts again.
    """
    runs: list[list[Piece]] = []
    for piece in record:
        if runs and piece.start_time > runs[-1][-1].start_time:
            runs[-1].append(piece)
        else:
            runs.append([piece])
    if len(runs) == 1:
        return [record]
    return [Record(tuple(pieces), f'{record.name} {i}') for i, pieces in enumerate(runs, 1)]


def diagnose_capture(
    snapshot: Snapshot,
    given: StageModel,
    asked: tuple[Kind, ...],
    settings: DiagnosisSettings,
    tick: Tick,
) -> DiagnosisOutcome:
    """
    Make records of a capture and diagnose a model by them.

    Parameters
    ----------
    snapshot : Snapshot
        Capture without the samples that the model was identified from.
    given : StageModel
    asked : tuple of {'sweeps', 'holds'}
        Experiments that the excitation has played already.
    settings : DiagnosisSettings
    tick : callable
    """
    tick('record', 0.0)
    record = snapshot.record('capture')
    records = [r for r in records_of_runs(record) if _is_driven(given, r)]
    if not records:
        return DiagnosisOutcome(None, wanted=next_experiment(None, asked=asked))
    result = diagnose_axis(given, records, settings, progress=tick)
    # every run is a record of its own, so a restart of the clock is harmless
    faults = (fault for fault in record.faults if fault.name != 'restart')
    result = replace(result, faults=(*faults, *result.faults))
    tick('report', 0.99)
    before, after = (f'{e.overall:.3g}' for e in (result.before, result.after))
    return DiagnosisOutcome(
        result,
        message=result.sentence,
        brief=f'{after} % of stroke, before {before} %: {_verdict(result)}',
        figures={'verdict': result.verdict, 'before_percent': before, 'after_percent': after},
        report=json_text(result),
        model=model_to_yaml(result.model),
        given=model_to_yaml(given),
        warnings=len(result.warnings) + sum(not fault.is_note for fault in result.faults),
        wanted=next_experiment(result, records, asked),
    )


def _verdict(result: Diagnosis) -> str:
    names = ' and '.join(effect.name for effect in result.effects)
    return f'{result.verdict} {names}'.rstrip()


def _is_driven(model: StageModel, record: Record) -> bool:
    low, high = model.scaling.range
    return bool(np.ptp(record.voltage_range) >= DRIVEN * (high - low))


def save(
    identified: Identification | None, diagnosis: Diagnosis | None, folder: str, tick: Tick
) -> str:
    """Write models, reports and pictures; a diagnosis gets a folder of its own inside."""
    tick('drawing', 0.0)
    pages: list[Path] = []
    share = 0.5 if identified and diagnosis else 1.0

    def progress(step: str, done: float) -> None:
        tick(step, share * (len(pages) + done))

    if identified is not None:
        pages.append(write_report(identified, folder, progress=progress))
    if diagnosis is not None:
        pages.append(write_report(diagnosis, Path(folder, FOLDER), progress=progress))
    return ' and '.join(map(str, pages))


def warm_up() -> None:
    """Compile or load the kernels of an identification, so that the first is as fast as others."""
    stage = SimulatedStage.load('paper')
    sequence = parse_program(_SMALL).build(stage.model.sample_rate)
    record = stage.play(sequence, np.random.default_rng(0))
    settings = Settings(thresholds=3, max_order=2, solver='swarm', swarm_size=4)
    identify_axis(record, replace(settings, swarm_iterations=100))
