# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Suggest the next steps after a result: a reason and a command each, the most useful first."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain, count
import math
import shlex

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.diagnosis.next_experiment import Kind, next_experiment
from piezo_ident.diagnosis.results import Diagnosis
from piezo_ident.excitation.program import Program
from piezo_ident.excitation.scaled import scaled
from piezo_ident.identification.results import Identification
from piezo_ident.model.multi_axis import EachAxis
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.record import Piece, Record
from piezo_ident.report.html import Step
from piezo_ident.report.table import listed, number
from piezo_ident.uncertainty.parameters import CLOSED
from scipy.signal import correlate

#: an error of at most this many times the sensor noise leaves little to find
ENOUGH = 2.0
#: the programs of the experiments
PROGRAMS: dict[Kind, str] = {'sweeps': 'diagnosis', 'holds': 'holds'}
#: name of a record that the lab still has to make
OTHER = 'other.csv'
#: averaging time to compare a voltage with a program [s], and least correlation of their means
COARSE, SAME = 0.01, 0.98


@dataclass(frozen=True)
class Prompt:
    """
    Names of the files of a result at the prompt.

    Attributes
    ----------
    model : str
        File of the new model.
    given : str
        File of the diagnosed model.
    records : mapping of str to str
        File of each record by the name of the record; by default the name itself.
    reading : sequence of str
        Options with which the records were read.
    """

    model: str = 'model.yaml'
    given: str = 'model.yaml'
    records: Mapping[str, str] = field(default_factory=dict)
    reading: tuple[str, ...] = ()

    def files(self, names: Iterable[str]) -> list[str]:
        """Name the files of records."""
        return [self.records.get(name, name) for name in names]

    def command(self, verb: str, *words: str, reads: bool = True) -> str:
        """Write a command line."""
        return shlex.join(['piezo_ident', verb, *words, *(self.reading if reads else ())])


def next_steps(
    result: Identification | Diagnosis | EachAxis[Identification] | EachAxis[Diagnosis],
    prompt: Prompt,
) -> list[Step]:
    """
    Suggest the next steps after an identification or a diagnosis.

    Parameters
    ----------
    result : Identification or Diagnosis, or EachAxis of them
    prompt : Prompt
        Names of the files.
    """
    if isinstance(result, EachAxis):
        return [_after_axes(result, prompt)]
    if isinstance(result, Diagnosis):
        return list(_after_diagnosis(result, prompt))
    return list(_after_identification(result, prompt))


def _after_axes(result: EachAxis[Identification] | EachAxis[Diagnosis], prompt: Prompt) -> Step:
    if result.modes is not None or isinstance(next(iter(result.values())), Diagnosis):
        return Step(
            'check the model on a record that took no part',
            prompt.command('predict', prompt.model, OTHER),
        )
    return Step(
        'find the paths between the axes, and missing effects, on a record in which all axes move',
        prompt.command('diagnose', prompt.model, OTHER, '--model', 'refined.yaml'),
    )


def _after_identification(result: Identification, prompt: Prompt) -> Iterator[Step]:
    errors, floor = result.headline, result.noise_floor
    is_validated = errors.data == 'validation'
    times = math.inf if not floor else errors.percent / floor
    # a loop that no play opens needs more thresholds, not another record
    missing = [what for what, why in result.not_identified if why != CLOSED]
    if missing:
        reason = f'{listed(missing)}: not identified'
        yield _experiment(reason, 'identification', result.model, prompt)
    if result.settings.thresholds is not None and times > ENOUGH:
        others = {row.record for row in result.errors if row.data == 'validation'}
        names = [record.name for record in result.records if record.name not in others]
        yield Step(
            'the number of thresholds was given; the data may choose a better number',
            prompt.command(
                *('identify', *prompt.files(names), '--thresholds', 'auto'),
                *('--model', prompt.model, '--overwrite'),
            ),
        )
    if not is_validated:
        reason = 'only the motion of these records was tested'
        yield _experiment(reason, 'validation', result.model, prompt)
    if is_validated and times <= ENOUGH:
        yield _use(f'the error is {number(times, 2)} times the sensor noise', prompt, prompt.model)
        return
    yield Step(
        'find missing effects' + ('' if is_validated else ', on a record that was not fitted'),
        prompt.command(
            *('diagnose', prompt.model),
            *(prompt.files(errors.records) if is_validated else [OTHER]),
            *('--model', 'refined.yaml', '--report', 'diagnosis'),
        ),
    )


def _after_diagnosis(result: Diagnosis, prompt: Prompt) -> Iterator[Step]:
    records = [Record((residual.piece,), residual.record) for residual in result.residuals]
    files = prompt.files(result.records)
    names = chain([OTHER], (f'other_{k}.csv' for k in count(2)))
    other = next(name for name in names if name not in files)
    experiment = None
    if result.verdict != 'none' or result.untestable:
        # a record may lack labels, so its voltage tells which programs were played
        played = [k for k, name in PROGRAMS.items() if any(_plays(r, name) for r in records)]
        experiment = next_experiment(result, records, played)
    if experiment is not None:
        program = PROGRAMS[experiment.kind]
        yield _experiment(experiment.reason, program, result.given, prompt)
        yield Step(
            'diagnose again, with that record',
            prompt.command('diagnose', prompt.given, *files, other),
        )
    is_changed = bool(result.changes)
    if result.verdict == 'none' and not is_changed:
        yield _use('these data show no missing effect', prompt, prompt.given)
    elif not result.unseen and is_changed:
        yield Step(
            'check the refined model on a record that took no part',
            prompt.command('predict', prompt.model, other),
        )


def _plays(record: Record, name: str) -> bool:
    """Tell whether the voltage of a record follows a shipped program, scaled to any range."""
    program = Program.load(name)
    return any(_is_played(program, piece) for piece in record)


def _is_played(program: Program, piece: Piece) -> bool:
    # scaling a program keeps its times
    rate = min(piece.sample_rate, 2000.0)
    built = scaled(program, program.limits, rate).build()
    wanted, v = _means(built.v, rate), _means(piece.v, piece.sample_rate)
    # a program begins and ends at rest, which a record may lack
    wanted = wanted[wanted.size // 10 : -(wanted.size // 10)]
    if v.size < wanted.size:
        return False
    wanted, v, window = wanted - wanted.mean(), v - v.mean(), np.ones(wanted.size)
    mean, square = (correlate(x, window, 'valid') / wanted.size for x in (v, v**2))
    moved = np.sqrt(np.maximum(square - mean**2, 1e-6 * float(v @ v) / v.size))
    like = correlate(v, wanted, 'valid') / wanted.size
    return bool(np.any(like > SAME * float(wanted.std()) * moved))


def _means(v: Array, rate: float) -> Array:
    """Average a voltage over stretches of `COARSE`."""
    edges = np.arange(0.0, v.size / rate, COARSE)
    total = np.concatenate([[0.0], np.cumsum(v)]) / rate
    means: Array = np.diff(np.interp(edges, np.arange(v.size + 1) / rate, total)) / COARSE
    return means


def _experiment(reason: str, program: str, model: StageModel, prompt: Prompt) -> Step:
    low, high = model.scaling.range
    # rounded, because noise at the ends of a measured voltage may exceed the amplifier's range
    digits = -math.floor(math.log10(1.5e-3 * (high - low)))
    ends = [f'{round(end, digits) + 0.0:.12g}' for end in (low, high)]
    return Step(
        f'{reason}; drive the stage with the voltage (columns t and v) that this command makes, '
        'and record it with its labels (column segment)',
        prompt.command(
            *('simulate', '--program', program, '--sample-rate', f'{model.sample_rate:.12g}'),
            *('--limits', *ends, '--voltage-only', 'excitation.csv'),
            reads=False,
        ),
    )


def _use(reason: str, prompt: Prompt, model: str) -> Step:
    return Step(
        f'{reason}; predict a planned motion (columns t and v)',
        prompt.command('predict', model, 'scan.csv', '--out', 'predicted.csv', reads=False),
    )
