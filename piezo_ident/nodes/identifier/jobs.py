# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Jobs of the worker process of the identifier, independent of ROS.

The node sends a function of this module and its arguments; the process adds the argument `tick`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
import functools
import json
from pathlib import Path
from typing import TypeVar

import numpy as np
from piezo_ident.common.process import Tick
from piezo_ident.diagnosis import Diagnosis, DiagnosisSettings
from piezo_ident.diagnosis.next_experiment import Experiment, Kind, next_experiment
from piezo_ident.excitation.program import parse_program
from piezo_ident.identification.identify import first_steps
from piezo_ident.identification.results import Identification, Steps
from piezo_ident.identification.settings import Settings
from piezo_ident.live.capture import (
    records_of_runs,
    refuse_incomplete,
    refuse_missing,
    Snapshot,
)
from piezo_ident.model.axes_file import text_of
from piezo_ident.model.axis_records import voltage_of
from piezo_ident.model.free_run import piece_runs, PieceRun
from piezo_ident.model.multi_axis import each_of, EachAxis, mapped, models_of, MultiAxisModel
from piezo_ident.model.simulated_stage import SimulatedStage
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.record import Record
from piezo_ident.report import headline, json_text, steps_to_json, write_report
from piezo_ident.verbs.learn import diagnose, identify, identify_axis

T = TypeVar('T')

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
    'shared modes': (0.98, 1.0),
}


@dataclass(frozen=True, eq=False)
class Outcome:
    """
    Result of a job, as the node publishes it.

    Attributes
    ----------
    message, brief : str
        One line for people, and the same in few words, a number first.
    figures : mapping of str to str
        Numbers of the message.
    report, model : str
        JSON, and the new model as YAML; empty without one.
    warnings : int
        Number of warnings, and of faults of the data, in the report.
    """

    message: str = ''
    brief: str = ''
    figures: Mapping[str, str] = field(default_factory=dict)
    report: str = ''
    model: str = ''
    warnings: int = 0


@dataclass(frozen=True, eq=False)
class IdentificationOutcome(Outcome):
    """Result of an identification, or of one step; `steps` are the results of steps so far."""

    steps: Steps | None = None
    identification: Identification | EachAxis[Identification] | None = None


@dataclass(frozen=True, eq=False)
class DiagnosisOutcome(Outcome):
    """
    Result of a diagnosis; a capture that lacks motion leaves the `diagnosis` None.

    `judged` is the diagnosed model as YAML, `wanted` an experiment that would decide a question.
    """

    diagnosis: Diagnosis | EachAxis[Diagnosis] | None = None
    judged: str = ''
    wanted: Experiment | None = None


def with_warnings(text: str, count: int) -> str:
    """Append the number of warnings in the report to a text."""
    if not count or not text:
        return text
    return f'{text.rstrip(".")}; {count} warning{"s" * (count > 1)} in the report'


def settings_of(values: dict[str, object]) -> Settings:
    """
    Make the settings of an identification from the parameters of the node.

    ConfigError when a value is out of range.
    """
    delay = int(str(values['delay']))
    return Settings(
        thresholds=int(str(values['thresholds'])) or None,
        solver=str(values['solver']),  # type: ignore[arg-type]
        polish=values['solver'] == 'swarm' and bool(values.get('polish')),
        max_order=int(str(values['max_order'])),
        delay=None if delay < 0 else delay,
        swarm_size=int(str(values['swarm_size'])),
        swarm_iterations=int(str(values['swarm_iterations'])),
        seed=int(str(values['seed'])),
    )


def percent_of(step: str, share: float, axes: Sequence[str] = ('y',)) -> float:
    """
    Return the progress of the whole work in percent.

    With several axes the name of a step begins with the name of its axis, one of `axes` in turn.
    """
    axis, _, what = step.rpartition(': ')
    low, high = _SHARES.get(what, (0.0, 1.0))
    done = low + (high - low) * share
    return 100.0 * ((axes.index(axis) + done) / len(axes) if axis in axes else done)


def identify_capture(
    snapshot: Snapshot,
    settings: Settings,
    which: str,
    steps: Steps | None,
    before: StageModel | MultiAxisModel | None,
    axes: Sequence[str],
    tick: Tick,
) -> IdentificationOutcome:
    """
    Make a record of a capture and identify it.

    `which` names a step, or is ``all``.  A single step goes on from the results `steps` of earlier
    steps.  `before` is an earlier model of this stage, and `axes` are the names of further axes.
    """
    tick('record', 0.0)
    record = snapshot.record('capture')
    refuse_missing(record, axes)
    tick('record', 0.01)
    refuse_incomplete(record, snapshot.sent())
    records = [record]
    if which == 'delay' or which == 'dynamics':
        step = first_steps(records, settings, which=which, steps=steps, progress=tick)
        data = steps_to_json(step, record.pieces[0].sample_rate, records)
        return IdentificationOutcome(
            _sentence(step), report=json.dumps(data), warnings=len(record.faults), steps=step
        )
    if axes:
        each = identify(records, settings, progress=tick)
        return _identified(mapped(each, functools.partial(_with_sign, before)))
    known = (steps or Steps()) if which == 'hysteresis' else None
    one = identify_axis(records, settings, steps=known, progress=tick)
    one = _with_sign(before, 'y', one)
    tick('report', 0.98)
    runs = piece_runs(one.model, records, one.memories)
    tick('report', 0.99)
    steps = Steps(one.delay, (one.dynamics, one.model.dynamics))
    return replace(_identified(one, runs), steps=steps)


def _each(result: T | EachAxis[T]) -> dict[str, T]:
    """List the results of the axes, by the ends of their topics; '' is the first axis."""
    return {axis[1:]: x for axis, x in each_of(result).items()}


def _joined(result: T | EachAxis[T], text: Callable[[T], str]) -> str:
    """Join a text about each axis, under its name if there are several."""
    if isinstance(result, EachAxis):
        return '; '.join(f'{axis}: {text(x).rstrip(".")}' for axis, x in result.items())
    return text(result)


def _figures(result: T | EachAxis[T], of: Callable[[T], dict[str, str]]) -> dict[str, str]:
    """Collect the figures of each axis; the name of a further axis ends its figures."""
    return {f'{k}{tail}': x for tail, one in _each(result).items() for k, x in of(one).items()}


def _identified(
    result: Identification | EachAxis[Identification], runs: Sequence[PieceRun] = ()
) -> IdentificationOutcome:
    def figures(x: Identification) -> dict[str, str]:
        error, static = x.headline.percent, x.headline.static_percent
        known = {'error_percent': error, 'static_percent': static}
        # shared modes have no hysteresis that acts alone
        return {k: f'{e:.3g}' for k, e in known.items() if np.isfinite(e) or x.shared is None}

    def brief(x: Identification) -> str:
        error, *static = figures(x).values()
        alone = f', hysteresis alone {static[0]} %' if static else ''
        return f'{error} % of stroke{alone}'

    return IdentificationOutcome(
        message=_joined(result, headline),
        brief=_joined(result, brief),
        figures=_figures(result, figures),
        report=json_text(result, runs),
        warnings=sum(len(x.warnings) for x in _each(result).values()),
        identification=result,
        model=text_of(result.model),
    )


def _with_sign(
    before: StageModel | MultiAxisModel | None, axis: str, result: Identification
) -> Identification:
    """Add a warning if the displacement of an axis has changed its sign."""
    known = models_of(before).get(axis) if before is not None else None
    scaling = result.model.scaling
    if known is None or scaling.Y * known.scaling.Y > 0.0:
        return result
    y, y0 = 1e6 * scaling.Y, 1e6 * known.scaling.Y
    warning = (
        f'the displacement has changed its sign: Y = {y:.4g} um, {y0:.4g} um in the model '
        "before; look at the sensor's wires, or at the sign in its driver"
    )
    return replace(result, warnings=(*result.warnings, warning))


def _sentence(steps: Steps) -> str:
    if steps.dynamics is not None:
        na, nb = steps.dynamics[0].order
        return f'dynamics: na = {na}, nb = {nb}'
    delay = steps.delay
    return '' if delay is None else f'delay: {delay.samples} samples ({delay.source})'


def diagnose_capture(
    snapshot: Snapshot,
    model: StageModel | MultiAxisModel,
    asked: tuple[Kind, ...],
    settings: DiagnosisSettings,
    tick: Tick,
) -> DiagnosisOutcome:
    """
    Make records of a capture and diagnose a model by them.

    The `snapshot` lacks the samples that the model was identified from.  The excitation has played
    the experiments `asked` before.
    """
    tick('record', 0.0)
    record = snapshot.record('capture')
    records = [r for r in records_of_runs(record) if _is_driven(model, r)]
    if not records:
        return DiagnosisOutcome(wanted=next_experiment(None, asked=asked))
    result = diagnose(model, records, settings, progress=tick)
    # every run is a record of its own, so a restart of the clock is harmless
    faults = tuple(fault for fault in record.faults if fault.name != 'restart')
    result = mapped(result, lambda _, x: replace(x, faults=(*faults, *x.faults)))
    tick('report', 0.99)
    each = [*_each(result).values()]
    wishes = (next_experiment(x, records, asked) for x in each)
    return DiagnosisOutcome(
        diagnosis=result,
        message=_joined(result, lambda x: x.sentence),
        brief=_joined(result, _brief),
        figures=_figures(result, _verdict_of),
        report=json_text(result),
        model=text_of(result.model),
        judged=text_of(model),
        warnings=sum(len(x.warnings) + sum(not f.is_note for f in x.faults) for x in each),
        wanted=next(filter(None, wishes), None),
    )


def _verdict_of(result: Diagnosis) -> dict[str, str]:
    before, after = (f'{e.overall:.3g}' for e in (result.before, result.after))
    return {'verdict': result.verdict, 'before_percent': before, 'after_percent': after}


def _brief(result: Diagnosis) -> str:
    _, before, after = _verdict_of(result).values()
    names = ' and '.join(effect.name for effect in result.effects)
    return f'{after} % of stroke, before {before} %: {result.verdict} {names}'.rstrip()


def _is_driven(model: StageModel | MultiAxisModel, record: Record) -> bool:
    for axis, x in models_of(model).items():
        columns = ({**piece.channels, 'v': piece.v}.get(voltage_of(axis), 0.0) for piece in record)
        ends = [end for v in columns for end in (np.min(v), np.max(v))]
        if np.ptp(ends) >= DRIVEN * np.ptp(x.scaling.range):
            return True
    return False


def save(
    identified: Identification | EachAxis[Identification] | None,
    diagnosis: Diagnosis | EachAxis[Diagnosis] | None,
    folder: str,
    tick: Tick,
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
