# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0


"""
The part of the identifier's helper that asks what the model lacks; nothing here knows of topics.

Jobs go to another process, so that each is a partial of a function of this module.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
import functools
from pathlib import Path

import numpy as np
from piezo_ident.diagnosis import diagnose, Diagnosis, DiagnosisSettings
from piezo_ident.diagnosis.diagnosis_json import json_text
from piezo_ident.diagnosis.next_experiment import Experiment, Kind, next_experiment
from piezo_ident.identification.results import Identification
from piezo_ident.model.files import model_to_yaml
from piezo_ident.model.stage_model import StageModel
from piezo_ident.nodes.jobs import save_job, Tick
from piezo_ident.record.capture import Snapshot
from piezo_ident.record.record import Piece, Record
from piezo_ident.report import write_diagnosis_report

__all__ = ['Judgement', 'diagnose_job', 'records_of_runs', 'save_both_job']

#: what moves by less than this share of the model's range has not been driven
DRIVEN = 0.01
#: folder of the report of a diagnosis, inside that of the identification
FOLDER = 'diagnosis'


@dataclass(frozen=True, eq=False)
class Judgement:
    """
    What a diagnosis brings home.

    Attributes
    ----------
    diagnosis : Diagnosis or None
        None when the capture holds no motion.
    message, report, model : str
        The sentence, the diagnosis as JSON, the refined model as YAML.
    wanted : Experiment or None
        What would decide what is open.
    """

    diagnosis: Diagnosis | None
    message: str = ''
    report: str = ''
    model: str = ''
    wanted: Experiment | None = None


def records_of_runs(record: Record) -> list[Record]:
    """
    Return each run of the sample clock as a record of its own.

    Where the clock began anew nobody knows how long the stage was left alone: what belongs to
    time, as an offset that creeps, starts over.
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


def diagnose_job(
    snapshot: Snapshot, given: StageModel, asked: tuple[Kind, ...], settings: DiagnosisSettings
) -> Callable[[Tick], Judgement]:
    """
    Return a job that makes records of what was captured, and judges a model by them.

    Parameters
    ----------
    snapshot : Snapshot
        Without what the model was identified from.
    given : StageModel
    asked : tuple of {'sweeps', 'holds'}
        What the excitation was asked for already.
    settings : DiagnosisSettings
    """
    return functools.partial(_diagnose, snapshot, given, asked, settings)


def _diagnose(
    snapshot: Snapshot,
    given: StageModel,
    asked: tuple[Kind, ...],
    settings: DiagnosisSettings,
    tick: Tick,
) -> Judgement:
    tick('record', 0.0)
    record = snapshot.record('capture')
    records = [r for r in records_of_runs(record) if _is_driven(given, r)]
    if not records:
        return Judgement(None, wanted=next_experiment(None, asked=asked))
    found = diagnose(given, records, settings, progress=tick)
    # every run is a record of its own, so that the clock begins anew is no fault
    met = (fault for fault in record.faults if fault.name != 'restart')
    found = replace(found, faults=(*met, *found.faults))
    tick('report', 0.99)
    return Judgement(
        found,
        message=found.sentence,
        report=json_text(found, indent=None),
        model=model_to_yaml(found.model),
        wanted=next_experiment(found, records, asked),
    )


def _is_driven(model: StageModel, record: Record) -> bool:
    low, high = model.scaling.range
    return bool(np.ptp(record.voltage_range) >= DRIVEN * (high - low))


def save_both_job(
    identified: tuple[Identification, Record] | None, found: Diagnosis | None, folder: str
) -> Callable[[Tick], str]:
    """
    Return a job that writes models, reports and pictures of all that was found.

    Parameters
    ----------
    identified : (Identification, Record) or None
    found : Diagnosis or None
        Goes into a folder ``diagnosis`` inside the other.
    folder : str
    """
    return functools.partial(_save_both, identified, found, folder)


def _save_both(
    identified: tuple[Identification, Record] | None,
    found: Diagnosis | None,
    folder: str,
    tick: Tick,
) -> str:
    share = 0.5 if identified and found else 1.0
    written = []
    if identified:
        job = save_job(*identified, folder)
        written.append(job(lambda step, done: tick(step, share * done)))
    if found:
        first = 1.0 - share
        page = write_diagnosis_report(
            found,
            Path(folder, FOLDER),
            progress=lambda step, done: tick(step, first + share * done),
        )
        written.append(str(page))
    return ' and '.join(written)
