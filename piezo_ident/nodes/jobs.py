# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0


"""
What the identifier's helper does; nothing here knows of topics.

Jobs go to another process, so that each is a partial of a function of this module.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
import functools
import json

import numpy as np
from piezo_ident.common.errors import ConfigError
from piezo_ident.excitation.program import parse_program
from piezo_ident.identification.identify import identify
from piezo_ident.identification.results import Identification, Settings, Steps
from piezo_ident.identification.single_steps import find_delay, find_dynamics, find_hysteresis
from piezo_ident.model.files import model_to_yaml
from piezo_ident.model.free_run import piece_runs
from piezo_ident.model.simulated_stage import SimulatedStage
from piezo_ident.record.capture import refuse_incomplete, Snapshot
from piezo_ident.record.record import Record
from piezo_ident.report import steps_to_json, to_json, verdict, write_report

__all__ = ['Outcome', 'identify_job', 'save_job', 'settings_of', 'share_of', 'warm_up']

Tick = Callable[[str, float], None]

#: the shortest programme that all three steps take
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

#: where each step stands in the whole, by how long it takes
_SHARES = {
    'delay': (0.02, 0.05),
    'dynamics': (0.05, 0.8),
    'hysteresis': (0.8, 0.98),
    'residual': (0.02, 0.1),
    'candidates': (0.1, 0.95),
    'whole records': (0.95, 0.95),
    'verdict': (0.95, 0.98),
}


@dataclass(frozen=True, eq=False)
class Outcome:
    """
    What a job brings home.

    Attributes
    ----------
    message : str
        One line for people.
    report : str
        JSON; empty when there is nothing to report.
    warnings : int
        How many there are in the report.
    steps : Steps or None
        What single steps found.
    identification, record : Identification and Record, or None
    model : str
        YAML; empty without a model.
    """

    message: str
    report: str = ''
    warnings: int = 0
    steps: Steps | None = None
    identification: Identification | None = None
    record: Record | None = None
    model: str = ''


def settings_of(values: dict[str, object]) -> Settings:
    """
    Return the settings that a node's parameters ask for.

    Raises
    ------
    ConfigError
        When a value is out of range.
    """
    text = str(values['thresholds']).strip()
    if text != 'auto' and not text.isdecimal():
        raise ConfigError(f"thresholds must be a number of 2 to 400, or 'auto', got {text!r}")
    swarm = values['solver'] == 'swarm'
    return Settings(
        thresholds=None if text == 'auto' else int(text),
        solver=str(values['solver']),  # type: ignore[arg-type]
        polish=swarm and bool(values.get('polish')),
        max_order=int(str(values['max_order'])),
        swarm_size=int(str(values['swarm_size'])),
        swarm_iterations=int(str(values['swarm_iterations'])),
        seed=int(str(values['seed'])),
    )


def share_of(step: str, share: float) -> float:
    """Return the progress of the whole in percent."""
    low, high = _SHARES.get(step, (0.0, 1.0))
    return 100.0 * (low + (high - low) * share)


def identify_job(
    snapshot: Snapshot, settings: Settings, which: str = 'all', steps: Steps | None = None
) -> Callable[[Tick], Outcome]:
    """
    Return a job that makes a record of what was captured, and takes the steps.

    Parameters
    ----------
    snapshot : Snapshot
    settings : Settings
    which : {'all', 'delay', 'dynamics', 'hysteresis'}
    steps : Steps, optional
        What was found already; for single steps only.
    """
    return functools.partial(_identify, snapshot, settings, which, steps)


def _identify(
    snapshot: Snapshot, settings: Settings, which: str, steps: Steps | None, tick: Tick
) -> Outcome:
    tick('record', 0.0)
    record = snapshot.record('capture')
    tick('record', 0.01)
    refuse_incomplete(record, snapshot.sent())
    records = [record]
    if which in ('delay', 'dynamics'):
        if which == 'delay':
            found = find_delay(records, settings, progress=tick)
        else:
            found = find_dynamics(records, settings, steps=steps, progress=tick)
        data = steps_to_json(found, record.pieces[0].sample_rate, records)
        return Outcome(_said(found), json.dumps(data), len(record.faults), found)
    if which == 'hysteresis':
        result = find_hysteresis(records, settings, steps=steps, progress=tick)
    else:
        result = identify(records, settings, progress=tick)
    tick('report', 0.98)
    runs = piece_runs(result.model, records, result.memories)
    tick('report', 0.99)
    return Outcome(
        message=verdict(result),
        report=json.dumps(to_json(result, records, runs)),
        warnings=len(result.warnings),
        steps=Steps(result.delay, (result.dynamics, result.model.dynamics)),
        identification=result,
        record=record,
        model=model_to_yaml(result.model),
    )


def _said(steps: Steps) -> str:
    if steps.dynamics is not None:
        na, nb = steps.dynamics[0].order
        return f'dynamics: na = {na}, nb = {nb}'
    delay = steps.delay
    return '' if delay is None else f'delay: {delay.samples} samples ({delay.source})'


def save_job(identification: Identification, record: Record, folder: str) -> Callable[[Tick], str]:
    """Return a job that writes model, report and pictures."""
    return functools.partial(_save, identification, record, folder)


def _save(identification: Identification, record: Record, folder: str, tick: Tick) -> str:
    tick('drawing', 0.0)
    return str(write_report(identification, record, folder, progress=tick))


def warm_up() -> None:
    """Compile, or load, all that an identification needs, so that the first one is not slower."""
    stage = SimulatedStage.load('paper')
    sequence = parse_program(_SMALL).build(stage.model.sample_rate)
    record = stage.play(sequence, np.random.default_rng(0))
    settings = Settings(thresholds=3, max_order=2, solver='swarm', swarm_size=4)
    identify(record, replace(settings, swarm_iterations=100))
