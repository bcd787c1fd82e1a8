# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
How often a diagnosis is right on stages that are no sums of plays.

    python benchmarks/study_foreign.py --set tuning docs/diagnosis_study_foreign.md

Every case: a stage from `foreign`, identified from one record, diagnosed on another and judged on
a third that nothing saw.  The sets `tuning` and `known` may be looked at; nothing may be tuned on
the laws of `final`.  One case in Python:

    from study_foreign import case_records, judged
    records = case_records(draw('tuning', 7))
    records.identification, records.diagnosis, records.unseen, records.truth

Finished cases are kept in ``build/study_foreign_SET.jsonl``, so a study that was stopped goes on.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
import os
from pathlib import Path
import re
import sys

# two threads of BLAS fight over narrow matrices; one process a core is faster
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

from foreign import Case, CASES, draw, make_stage, Motion, record_motion, references, Stage
from foreign.families import SETS
from foreign.faults import NAMES, spoilt
from foreign.references import basis, FORMS, remainder, ROWS
from foreign.sizes import scaled
import numpy as np
from piezo_ident.diagnosis import diagnose
from piezo_ident.effects import find_effect
from piezo_ident.excitation.program import parse_program
from piezo_ident.identification.identify import identify
from piezo_ident.model.free_run import free_run, same_part_errors
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.record import Record
from side_by_side import machine
from study_rows import all_rows, counts_of, part_of, section, some, write_cases
from truths import other_axis

#: in the data, not in the stage: they count whatever their size
ADDED = ('periodic_disturbance', 'cross_coupling')
#: what follows time is another in every record, and no model predicts it
OF_TIME = ('thermal_drift', 'gain_drift', 'periodic_disturbance')
#: of the package's own `program_identification.yaml`, in other ranges and a little shorter
PROGRAM = """
limits: [{low}, {high}]
rest: {rest}
seed: 1
slew: {slew}
segments:
  - {{signal: idle, duration: 0.3}}
  - {{signal: step, bias: {middle}, size: {step}, hold: 0.06, count: 12}}
  - {{signal: settle, bias: {middle}, amplitude: {settle}, cycles: 16, frequency: 20}}
  - {{signal: noise, bias: {middle}, amplitude: {noise}, cutoff: {cutoff}, duration: {duration}}}
  - {{signal: triangle, slope: {slope}}}
  - {{signal: idle, duration: 0.3}}
"""


@dataclass(frozen=True, eq=False)
class Records:
    """
    What a case hands over, and what is true of it.

    Attributes
    ----------
    identification, diagnosis, unseen : Record
    truth : dict of str to float
        Every hidden effect and its size on the diagnosis record: the rms of what it changes
        behind offset and gain, % of stroke.
    left : dict of str to float
        What a refit of forty plays leaves of each, % of stroke.
    fault : str
    misfit : float
        Error of forty plays with the true linear part, fitted on the identification, of the stage
        without its effects, on the unseen record, % of stroke.
    unseen_forms : dict of str to float
        Error on the unseen record of each form of the hysteresis, likewise.
    stage : Stage
        With the effects in it.
    """

    identification: Record
    diagnosis: Record
    unseen: Record
    truth: dict[str, float]
    left: dict[str, float]
    fault: str
    misfit: float
    unseen_forms: dict[str, float]
    stage: Stage


@dataclass(frozen=True)
class Row:
    """What came out; errors in % of stroke."""

    key: str
    verdict: str
    effects: tuple[str, ...] = ()
    group: tuple[str, ...] = ()
    sentence: str = ''
    untestable: tuple[str, ...] = ()
    faults: tuple[str, ...] = ()
    truth: dict[str, float] = field(default_factory=dict)
    left: dict[str, float] = field(default_factory=dict)
    fault: str = ''
    misfit: float = float('nan')
    unseen_forms: dict[str, float] = field(default_factory=dict)
    before: float = float('nan')
    refit: float = float('nan')
    after: float = float('nan')
    unseen_before: float = float('nan')
    unseen_after: float = float('nan')
    centred_before: float = float('nan')
    centred_after: float = float('nan')
    error: str = ''

    @property
    def after_is_worse(self) -> bool:
        """Whether the unseen error grew by more than 5 %, its mean aside."""
        return self.centred_after > 1.05 * self.centred_before


def motions(case: Case, stage: Stage) -> dict[str, Motion]:
    """Return what each record of a case is driven with, in parts of the range."""
    (low, high), rng = stage.limits, np.random.default_rng([606, case.seed])
    # a bipolar amplifier often rests at 0 V, which is not its lowest voltage
    rest = -low / (high - low) if low < 0 and rng.random() < 0.5 else 0.0
    found = {}
    for name in ('identification', 'diagnosis', 'unseen'):
        if name == 'identification' and case.labelled:
            found[name] = programmed(stage, rest)
        else:
            found[name] = record_motion(
                name,
                stage.rate,
                np.random.default_rng([len(name), case.seed]),
                labelled=case.labelled,
                poorer=case.poorer if name == 'diagnosis' else '',
                first=stage.linear.modes[0][0],
                rest=rest,
            )
    return found


def programmed(stage: Stage, rest: float) -> Motion:
    """Return the program of the identification in the stage's range."""
    low, high = stage.limits
    span, fast = high - low, stage.rate > 30_000
    text = PROGRAM.format(
        low=low,
        high=high,
        rest=low + rest * span,
        slew=3.0 * span,
        middle=low + 0.5 * span,
        step=0.1 * span,
        settle=0.048 * span,
        noise=0.04 * span,
        cutoff=min(3000.0, 0.3 * stage.rate),
        duration=2.0 if fast else 3.0,
        slope=(1.6 if fast else 1.1) * span,
    )
    sequence = parse_program(text).build(sample_rate=stage.rate)
    labels = tuple((s.label, s.start, s.stop) for s in sequence.segments)
    return Motion((sequence.v - low) / span, labels)


def case_records(case: Case, forms: bool = True) -> Records:
    """
    Return the records of a case, and the truth.

    Parameters
    ----------
    case : Case
        Of `foreign.draw`.
    forms : bool
        Also compare forms of the hysteresis, which takes some seconds.
    """
    stage = make_stage(case.core, case.seed, case.effects, further=case.group != 'tuning')
    low, high = stage.limits
    moved = motions(case, stage)
    volts = {name: low + (high - low) * m.u for name, m in moved.items()}
    plain = {
        name: (v, stage.read(stage.respond(v, name, {}, clean=True), name))
        for name, v in volts.items()
        if name != 'diagnosis'
    }
    sweeps = [x[1:] for x in moved['identification'].labels if x[0].startswith('triangle')]
    best = references(stage, plain, FORMS if forms else ('forty plays',), sweeps)
    misfit = best['forty plays']
    coupled = 'cross_coupling' in case.effects
    others = {
        name: other_axis(
            np.arange(v.size) / stage.rate, np.random.default_rng([len(name), 7, case.seed])
        )
        * (high - low)
        / 10.0
        for name, v in volts.items()
        if name != 'identification' and (coupled or case.idle_channel)
    }
    gains, truth, left = {}, {}, {}
    v = volts['diagnosis']
    if case.effects:
        X, _ = basis(stage, v, 'diagnosis', 'forty plays')
        without = stage.respond(v, 'diagnosis', {}, clean=True)
    for effect, factor in zip(case.effects, case.factors, strict=True):
        other = others.get('diagnosis')
        gains[effect], truth[effect] = scaled(stage, effect, factor * misfit, v, other)
        change = stage.respond(v, 'diagnosis', {effect: gains[effect]}, other, clean=True)
        change = (change - without)[:: max(1, v.size // ROWS)]
        left[effect] = 100.0 * remainder(X, change) / float(np.ptp(without))
    stage = replace(stage, gains=gains)
    made = {}
    for name, v in volts.items():
        other = others.get(name) if coupled else None
        y = stage.respond(v, name, other=other)
        if case.fault and name == 'diagnosis':
            y = stage.respond(v, name, clean=True)
            rng = np.random.default_rng([77, case.seed])
            # a clock's jitter is older than the sensor's noise
            if case.fault == 'jitter':
                y = stage.read(spoilt(y, case.fault, stage.rate, rng), name)
            else:
                y = spoilt(stage.read(y, name), case.fault, stage.rate, rng)
            y = stage.offset + stage.stroke * y
        labels = moved[name].labels
        made[name] = Record.from_arrays(
            v,
            y,
            sample_rate=stage.rate,
            segments=([x[0] for x in labels], [x[1] for x in labels]) if labels else None,
            channels={'other': others[name]} if name in others else None,
            name=name,
        )
    return Records(
        **made,
        truth=truth,
        left=left,
        fault=case.fault,
        misfit=misfit,
        unseen_forms=best,
        stage=stage,
    )


def unseen_errors(record: Record, *models: StageModel) -> list[tuple[float, float]]:
    """Return the errors on a record behind its unknown start, and without its mean."""
    errors = same_part_errors(*(free_run(model, record) for model in models))
    return [(e.percent, e.percent_without_offset) for e in errors]


def judged(case: Case) -> Row:
    """Run one case."""
    try:
        records = case_records(case)
        model = identify(records.identification).model
        result = diagnose(model, records.diagnosis)
        errors = unseen_errors(records.unseen, model, result.model)
        return Row(
            key=case.key,
            verdict=result.verdict,
            effects=tuple(e.name for e in result.effects),
            group=result.group.names if result.group else (),
            sentence=result.sentence,
            untestable=tuple(u.name for u in result.untestable),
            faults=tuple(dict.fromkeys(f.name for f in result.faults)),
            truth=records.truth,
            left=records.left,
            fault=records.fault,
            misfit=records.misfit,
            unseen_forms=records.unseen_forms,
            before=result.before.overall,
            refit=result.refit.overall,
            after=result.after.overall,
            unseen_before=errors[0][0],
            unseen_after=errors[1][0],
            centred_before=errors[0][1],
            centred_after=errors[1][1],
        )
    # one failed case must not end hours of others
    except Exception as error:  # noqa: BLE001
        return Row(case.key, 'failed', error=f'{type(error).__name__}: {error}')


def counted(row: Row) -> tuple[str, ...]:
    """Return the effects that must be found: added signals always, others from the misfit on."""
    return tuple(n for n, size in row.truth.items() if n in ADDED or size >= row.misfit)


def false_names(row: Row) -> tuple[str, ...]:
    """Return the names that are neither true nor in a class that holds the truth."""
    held = set(row.group) if set(row.group) & set(row.truth) else set()
    return tuple(n for n in row.effects if n not in row.truth and n not in held)


def lasting(row: Row) -> bool:
    """Return whether no refit of plays would hide what counts."""
    return all(n in ADDED or row.left[n] >= row.misfit for n in counted(row))


def is_lacked(row: Row) -> bool:
    """Return whether the model errs by half the mean square of what counts: it holds the rest."""
    return all(n in ADDED or row.before**2 >= 0.5 * row.truth[n] ** 2 for n in counted(row))


def follows_path(row: Row) -> bool:
    """Return whether something that counts follows the path of the voltage: a wide H is one."""
    return any(find_effect(name).rate_independent for name in counted(row))


def refit_holds_it(row: Row) -> bool:
    """Return whether a refit is the finding, and all that counts is in its class."""
    truth = set(counted(row))
    return row.verdict == 'refitted' and bool(truth) and truth <= set(row.group)


def false_faults(row: Row) -> tuple[str, ...]:
    """Return the faults of the data that are reported and are none; a coarse step may be real."""
    true = NAMES.get(row.fault, ())
    known = {n for names in NAMES.values() for n in names}
    return tuple(n for n in row.faults if n in known and n not in true)


def outcome(row: Row) -> str:
    """
    Return what a row says.

    'false' where a false name is given; else 'named', 'class' or 'part' for all of what counts,
    all of it in classes, or some of it; 'hidden' where it is among what may hide in the base
    model; 'abstained'.  Where nothing counts: 'none', or 'small' for a true name of a small
    effect.
    """
    if row.verdict == 'failed':
        return 'failed'
    if false_names(row):
        return 'false'
    if row.fault:
        return 'named' if set(NAMES[row.fault]) & set(row.faults) else 'abstained'
    truth = set(counted(row))
    group = set(row.group) if row.effects else set()
    named = {n for n in truth if n in row.effects and n not in group}
    classed = {n for n in truth if n in group} | {n for n in truth if n in row.effects}
    if not truth:
        return 'small' if row.effects else 'none'
    if named == truth:
        return 'named'
    if classed == truth:
        return 'class'
    if classed:
        return 'part'
    if truth & set(row.group):
        return 'hidden'
    return 'abstained'


OUTCOMES = ('named', 'class', 'part', 'hidden', 'abstained', 'false', 'failed')
PURPOSE = (
    'This page tells whoever must trust a verdict how often it was right on simulated stages with '
    'other families of hysteresis than sums of plays.'
)
NOTE = (
    'Every stage has two or three lightly damped modes and a delay of any fraction of a sample. '
    'Rates are 10, 20 or 50 kHz, ranges 0..10, 0..100 or -20..130 V, strokes 5 to 200 um of '
    'either sign. The noise is white, 1/f, or a converter of 10 or 12 bits. Two thirds of the '
    "cases are labelled and follow the package's own program. The others are one stretch each "
    'that starts anywhere. Each stage is identified from one record, diagnosed on another, and '
    'judged on a third of other motion. An effect that would change the identified G or H sets in '
    'behind the identification.\n\n'
    'The misfit of a core is the unseen error of the same stage without its effects, by forty '
    'plays with the true linear part. The size of an effect is the rms of its change of the '
    'diagnosis record, behind an offset and a gain, in % of stroke. Lines, channels and faults of '
    'the data count whatever their size, other effects from the misfit on. A name is false if '
    'neither the name nor its class holds the truth.'
)


def spread(values: Sequence[float]) -> str:
    """Return median and 90th percentile."""
    sound = [x for x in values if np.isfinite(x)]
    if not sound:
        return '-'
    return f'{np.median(sound):.2f}, {np.quantile(sound, 0.9):.2f}'


def summary(rows: Sequence[Row]) -> str:
    """Return the figures in which the study ends."""
    sound = [r for r in rows if r.verdict != 'failed']
    nothing = [r for r in sound if not r.truth and not r.fault]
    large = [r for r in sound if counted(r) or r.fault]
    small = [r for r in sound if r.truth and not counted(r)]
    predictable = [r for r in sound if not set(r.truth) & set(OF_TIME)]
    plain = [r for r in predictable if not r.truth and not r.fault]

    def share(*kinds: str) -> str:
        return part_of(sum(outcome(r) in kinds for r in large), len(large))

    def is_found(row: Row) -> bool:
        return outcome(row) in ('named', 'class')

    def most(ratios: Iterable[float]) -> str:
        return f'{max(ratios, default=0.0):.2f}'

    lines = [
        ['nothing hidden: an effect named', some(r.effects for r in nothing)],
        [
            '- no name, and two or three that may hide in the base model',
            some(r.group for r in nothing),
        ],
        ['an effect that counts: its name or class', share('named', 'class')],
        [
            '- where it follows the path of the voltage alone',
            some(is_found(r) for r in large if follows_path(r)),
        ],
        [
            '- elsewhere',
            some(is_found(r) for r in large if not follows_path(r)),
        ],
        ['- a false name instead or beside', share('false')],
        ['- one of two', share('part')],
        ['- abstained', share('abstained')],
        ['- no name, and it is among what may hide in the base model', share('hidden')],
        [
            '- its name, its class, or the class of a refit (`refitted`)',
            some(is_found(r) or refit_holds_it(r) for r in large),
        ],
        [
            '- no name, and the class of a refit does not hold it',
            some(r.verdict == 'refitted' and not r.fault and not refit_holds_it(r) for r in large),
        ],
        [
            '- where a refit of forty plays leaves the misfit at least: its name or class',
            some(is_found(r) for r in large if lasting(r)),
        ],
        [
            '- where the model as identified errs by half its mean square at least',
            some(is_found(r) for r in large if is_lacked(r)),
        ],
        [
            '- where both hold',
            some(is_found(r) for r in large if lasting(r) and is_lacked(r)),
        ],
        ['a smaller effect: a false name', some(false_names(r) for r in small)],
        ['a fault of the data that is none', some(false_faults(r) for r in sound)],
        ['unseen over promised', spread([r.unseen_after / r.after for r in predictable])],
        ['- without the mean', spread([r.centred_after / r.after for r in predictable])],
        ['unseen over before, most', most(r.unseen_after / r.unseen_before for r in sound)],
        ['- without the mean', most(r.centred_after / r.centred_before for r in sound)],
        [
            '- grown by more than 5 %',
            some(r.after_is_worse for r in sound),
        ],
    ]
    for way in ('labelled', 'unlabelled'):
        own = [r for r in plain if r.key.endswith(f' {way}')]
        ratios = [r.centred_before / min(r.unseen_forms.values()) for r in own]
        lines.append([f'nothing hidden, {way}: as identified over the best form', spread(ratios)])
    return section('In short', 'what, share or median and 90th percentile', lines)


def by_effect(rows: Sequence[Row]) -> str:
    """Return the section of single effects and faults that count."""
    names: dict[str, list[Row]] = {}
    for row in rows:
        if row.fault:
            names.setdefault(row.fault, []).append(row)
        elif len(row.truth) == 1 and counted(row):
            names.setdefault(next(iter(row.truth)), []).append(row)
    lines = []
    for name in sorted(names):
        outcomes = [outcome(r) for r in names[name]]
        lines.append([name, len(outcomes), counts_of(outcomes, OUTCOMES)])
    return section('One effect or fault', 'hidden, cases, outcomes', lines)


def by_core(rows: Sequence[Row]) -> str:
    """Return how each family of cores fares."""
    lines = []
    for core in sorted({r.key.split()[1] for r in rows}):
        own = [r for r in rows if r.key.split()[1] == core and r.verdict != 'failed']
        outcomes = [outcome(r) for r in own if counted(r) or r.fault]
        nothing = [r for r in own if not r.truth and not r.fault]
        false = sum(bool(r.effects) for r in nothing)
        lines.append(
            [
                core,
                f'{np.median([r.misfit for r in own]):.3f}' if own else '',
                part_of(false, len(nothing)),
                part_of(sum(x in ('named', 'class') for x in outcomes), len(outcomes)),
                part_of(outcomes.count('false'), len(outcomes)),
            ]
        )
    heads = 'core, misfit, named though nothing is hidden, found, false name'
    return section('Cores', heads, lines)


CASE_HEADS = (
    'case, misfit, size (left by a refit), verdict, named, class, faults, outcome, '
    'before, refit, promised, unseen before, unseen after'
)


def case_line(r: Row) -> list[object]:
    """Return one case as a line of the CSV file."""
    sizes = ', '.join(f'{r.truth[n]:.2f} ({r.left[n]:.2f})' for n in r.truth)
    errors = (r.before, r.refit, r.after, r.centred_before, r.centred_after)
    said = outcome(r)
    if false_names(r):
        said += ': ' + ', '.join(false_names(r))
    return [
        r.key,
        f'{r.misfit:.2f}',
        sizes,
        r.verdict if r.verdict != 'failed' else r.error,
        ', '.join(r.effects),
        ', '.join(r.group),
        ', '.join(r.faults),
        said,
        *(f'{x:.3f}' for x in errors),
    ]


def write(rows: dict[str, Row], todo: Sequence[Case], group: str, page: Path) -> None:
    """Write the page of the study, and the file of its cases."""
    done = [rows[case.key] for case in todo if case.key in rows]
    sections = [
        '# How often the diagnosis is right on stages of another family',
        PURPOSE,
        f'Made by `make study`, set `{group}`; {len(done)} of {len(todo)} cases done.\n'
        f'Machine: {machine()}.',
        NOTE,
        write_cases(page, CASE_HEADS, map(case_line, done)),
        summary(done),
        by_effect(done),
        by_core(done),
    ]
    page.write_text('\n\n'.join(sections) + '\n', encoding='utf-8')


def main() -> None:
    """Run what is not done yet, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('out', type=Path)
    parser.add_argument('--set', choices=tuple(SETS), default='final', dest='group')
    parser.add_argument('--only', default='', help='regular expression for the keys of cases')
    parser.add_argument('--first', type=int, help='only so many cases')
    parser.add_argument('--kept', type=Path, help='build/study_foreign_SET.jsonl when absent')
    parser.add_argument('--processes', type=int, default=os.cpu_count() or 1)
    arguments = parser.parse_args()
    group = arguments.group
    todo = [draw(group, k) for k in range(CASES[group])][: arguments.first]
    todo = [case for case in todo if re.search(arguments.only, case.key)]
    path = arguments.kept or Path(f'build/study_foreign_{group}.jsonl')
    rows = all_rows(path, Row, todo, judged, arguments.processes)
    write(rows, todo, group, arguments.out)
    sys.stdout.write(f'{arguments.out}\n')


if __name__ == '__main__':
    main()
