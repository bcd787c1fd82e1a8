# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
How often a diagnosis is right, on stages whose laws are not those of the candidates.

    python benchmarks/study_diagnosis.py docs/diagnosis_study.md
    python benchmarks/study_diagnosis.py docs/diagnosis_study_foreign.md --set next

Every case: a stage of `truths`, identified from one record, diagnosed on another and judged on a
third that nothing saw.  Finished cases are kept in ``build/``, so a stopped study goes on.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
import os
from pathlib import Path
import re
import sys

import alone  # noqa: F401 - one thread of BLAS
import numpy as np
from piezo_ident.diagnosis import diagnose, DiagnosisSettings
from piezo_ident.effects import find_effect
from piezo_ident.identification.identify import identify
from piezo_ident.model.free_run import free_run, same_part_errors
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.record import Record
from side_by_side import machine
from study_records import case_records, measured
from study_rows import all_rows, counts_of, section, some, write_cases, write_csv
from truths import Case, CASES, describe, draw, EFFECTS, OUTSIDE, sum_cases, SumCase
from truths.cases import SUM_SEEDS
from truths.faults import NAMES

#: in the data, not in the stage: they count whatever their size
ADDED = ('periodic_disturbance', 'cross_coupling')
#: what follows time is another in every record, and no model predicts it
OF_TIME = ('thermal_drift', 'gain_drift', 'periodic_disturbance')
#: left-over from which an effect of a sum of plays counts, % of stroke
COUNTS = 0.1
#: kinds of cases whose effect is no candidate
NO_CANDIDATES = ('removed', 'outside')


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
    size: float = float('nan')
    before: float = float('nan')
    refit: float = float('nan')
    after: float = float('nan')
    unseen_before: float = float('nan')
    unseen_after: float = float('nan')
    centred_before: float = float('nan')
    centred_after: float = float('nan')
    error: str = ''


def unseen_errors(record: Record, *models: StageModel) -> list[tuple[float, float]]:
    """Return the errors on a record behind its unknown start, and without its mean."""
    errors = same_part_errors(*(free_run(model, record) for model in models))
    return [(e.percent, e.percent_without_offset) for e in errors]


def with_truth(row: Row, case: SumCase) -> Row:
    """Return the row of a sum of plays with its truth, which rows of old did not keep."""
    sizes = [row.size] if len(case.effects) == 1 else [case.size] * len(case.effects)
    truth = dict(zip(case.effects, sizes, strict=True))
    centred = (row.centred_before, row.centred_after)
    if np.isnan(centred[0]):
        centred = (row.unseen_before, row.unseen_after)
    return replace(
        row,
        truth=truth,
        left=truth,
        misfit=COUNTS,
        centred_before=centred[0],
        centred_after=centred[1],
    )


def judged(case: Case | SumCase) -> Row:
    """Run one case."""
    try:
        known: dict[str, object] = {}
        if isinstance(case, SumCase):
            model, record, unseen = measured(case.effects, case.size, case.seed, case.noise)
            result = diagnose(model, record, DiagnosisSettings(without=case.without))
            known['size'] = result.errors_of_laws['plays']
        else:
            records = case_records(case)
            model, unseen = identify(records.identification).model, records.unseen
            result = diagnose(model, records.diagnosis)
            kept = ('truth', 'left', 'fault', 'misfit', 'unseen_forms')
            known = {name: getattr(records, name) for name in kept}
        (before, centred), (after, centred_after) = unseen_errors(unseen, model, result.model)
        row = Row(
            key=case.key,
            verdict=result.verdict,
            effects=tuple(e.name for e in result.effects),
            group=result.group.names if result.group else (),
            sentence=result.sentence,
            untestable=tuple(u.name for u in result.untestable),
            faults=tuple(dict.fromkeys(f.name for f in result.faults)),
            before=result.before.overall,
            refit=result.refit.overall,
            after=result.after.overall,
            unseen_before=before,
            unseen_after=after,
            centred_before=centred,
            centred_after=centred_after,
            **known,
        )
    # one failed case must not end hours of others
    except Exception as error:  # noqa: BLE001
        return Row(case.key, 'failed', error=f'{type(error).__name__}: {error}')
    return row


def counted(row: Row) -> tuple[str, ...]:
    """Return the effects that must be found: added signals always, others from the misfit on."""
    return tuple(n for n, size in row.truth.items() if n in ADDED or size >= row.misfit)


def is_candidate(row: Row) -> bool:
    """Return whether the truth is among the candidates."""
    return row.key.split()[0] not in NO_CANDIDATES


def false_names(row: Row) -> tuple[str, ...]:
    """Return the names that are neither true nor in a class that holds the truth."""
    held = set(row.group) if set(row.group) & set(row.truth) else set()
    return tuple(n for n in row.effects if n not in row.truth and n not in held)


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
    truth, said = set(counted(row)), set(row.effects)
    group = set(row.group) if row.effects else set()
    if not truth:
        return 'small' if row.effects else 'none'
    if truth <= said - group:
        return 'named'
    if truth <= said | group:
        return 'class'
    if truth & (said | group):
        return 'part'
    return 'hidden' if truth & set(row.group) else 'abstained'


def is_found(row: Row) -> bool:
    """Return whether the name or its class is said, and nothing false."""
    return outcome(row) in ('named', 'class')


OUTCOMES = ('named', 'class', 'part', 'hidden', 'abstained', 'small', 'none', 'false', 'failed')
PURPOSES = {
    True: (
        '# How often the diagnosis is right',
        'This page counts verdicts on simulated sums of plays with an effect. '
        '[The second study](diagnosis_study_foreign.md) has other hysteresis.',
    ),
    False: (
        '# How often the diagnosis is right on stages of another family',
        'This page counts verdicts on simulated stages with other families of hysteresis than '
        'sums of plays.',
    ),
}
SUMS = (
    'Every stage is identified from the 15.5 s of `program_identification.yaml`, and diagnosed on '
    'a record of 17 s. A record of 12 s with other frequencies, amplitudes and holds judges it. '
    'The [laws of the stages]({laws}) differ from the candidates. The size of an effect is the '
    'free-run error that a refit of a sum of plays leaves on kinds of motion held out [% of '
    f'stroke]. Effects of {COUNTS} % and more count. A name is false if the name and its class '
    'miss the truth. Removed: a candidate was taken out of the catalogue. Outside: the effect is '
    'not in it.'
)
FAMILIES = (
    'Every stage has two or three lightly damped modes and a delay of any fraction of a sample. '
    'Rates are 10, 20 or 50 kHz, ranges 0..10, 0..100 or -20..130 V, strokes 5 to 200 um of '
    'either sign. The noise is white, 1/f, or of a converter of 10 or 12 bits. Two thirds of the '
    "cases are labelled and follow the package's own program, the others are one stretch that "
    'starts anywhere. Each stage is identified from one record, diagnosed on another, and judged '
    'on a third of other motion. An effect that would change the identified G or H sets in behind '
    'the identification.\n\n'
    'The misfit of a core is the unseen error of the same stage without its effects, by forty '
    'plays with the true linear part. The size of an effect is the rms of its change of the '
    'diagnosis record, behind an offset and a gain, in % of stroke. Lines, channels and faults of '
    'the data count whatever their size, other effects from the misfit on. A name is false if the '
    'name and its class miss the truth.'
)


def spread(values: Iterable[float]) -> str:
    """Return median and 90th percentile."""
    sound = [x for x in values if np.isfinite(x)]
    if not sound:
        return '-'
    return f'{np.median(sound):.2f}, {np.quantile(sound, 0.9):.2f}'


def summary(rows: Sequence[Row]) -> str:
    """Return the figures in which the study ends."""
    sound = [r for r in rows if r.verdict != 'failed']
    nothing = [r for r in sound if not r.truth and not r.fault]
    strangers = [r for r in sound if not is_candidate(r)]
    large = [r for r in sound if is_candidate(r) and (counted(r) or r.fault)]
    small = [r for r in sound if r.truth and not counted(r)]
    predictable = [r for r in sound if not set(r.truth) & set(OF_TIME)]

    def share(holds: Callable[[Row], bool], own: Sequence[Row] = large) -> str:
        return some(holds(r) for r in own)

    def said(kind: str) -> str:
        return share(lambda r: outcome(r) == kind)

    def found(holds: Callable[[Row], bool]) -> str:
        return share(is_found, [r for r in large if holds(r)])

    def most(ratios: Iterable[float]) -> str:
        return f'{max(ratios, default=0.0):.2f}'

    worse = [r.centred_after / r.centred_before for r in sound]
    lines = [
        ['nothing hidden: an effect named', share(lambda r: bool(r.effects), nothing)],
        [
            '- no name, some may hide in the base model',
            share(lambda r: bool(r.group), nothing),
        ],
        ['an effect that counts: its name or class', share(is_found)],
        ['- where it follows the path of the voltage', found(follows_path)],
        ['- elsewhere', found(lambda r: not follows_path(r))],
        ['- a false name instead or beside', said('false')],
        ['- one of two', said('part')],
        ['- abstained', said('abstained')],
        ['- no name, it may hide in the base model', said('hidden')],
        [
            '- its name, its class, or the class of a refit',
            share(lambda r: is_found(r) or refit_holds_it(r)),
        ],
        [
            '- no name, not in the class of a refit',
            share(lambda r: r.verdict == 'refitted' and not r.fault and not refit_holds_it(r)),
        ],
        ['an effect that is no candidate: a false name', some(map(false_names, strangers))],
        ['a smaller effect: a false name', some(map(false_names, small))],
        ['a fault of the data that is none', some(map(false_faults, sound))],
        ['unseen over promised', spread(r.unseen_after / r.after for r in predictable)],
        ['- without the mean', spread(r.centred_after / r.after for r in predictable)],
        ['unseen over before, most', most(r.unseen_after / r.unseen_before for r in sound)],
        ['- without the mean', most(worse)],
        ['- grown by more than 5 %', some(x > 1.05 for x in worse)],
    ]
    for way in ('labelled', 'unlabelled'):
        own = [r for r in nothing if r.key.endswith(f' {way}')]
        ratios = [r.centred_before / min(r.unseen_forms.values()) for r in own]
        lines.append([f'nothing hidden, {way}: as identified over the best form', spread(ratios)])
    kept = [line for line in lines if line[1] not in ('0 of 0', '-')]
    return section('In short', 'what, share or median and 90th percentile', kept)


def kind_of(row: Row) -> str:
    """Return what kind of thing is hidden."""
    if not is_candidate(row):
        return row.key.split()[0]
    if row.fault:
        return 'a fault of the data'
    return ('nothing', 'one effect', 'two effects')[len(row.truth)]


def stage_of(row: Row) -> str:
    """Return the family of the core, or the noise of a sum of plays."""
    words = row.key.split()
    return words[1] if words[-1].endswith('labelled') else words[-1]


def by(title: str, name: Callable[[Row], str], rows: Sequence[Row]) -> str:
    """Return a section of outcomes and errors, a line for each name that is not empty."""
    names = sorted({name(r) for r in rows} - {''})
    # the misfit of a sum of plays is the same for all
    errors = ['misfit', 'centred_before', 'centred_after'][len({r.misfit for r in rows}) == 1 :]
    lines = []
    for own in ([r for r in rows if name(r) == key] for key in names):
        sizes = ([getattr(r, e) for r in own] for e in errors)
        medians = [f'{np.nanmedian(x):.3f}' if np.isfinite(x).any() else '' for x in sizes]
        lines.append([name(own[0]), len(own), counts_of(map(outcome, own), OUTCOMES), *medians])
    misfit = 'misfit, ' * (len(errors) == 3)
    return section(
        title, f'{title.lower()}, cases, outcomes, {misfit}unseen error before, after', lines
    )


CASE_HEADS = (
    'case, misfit, size (left by a refit), verdict, named, class, faults, outcome, '
    'before, refit, promised, unseen before, unseen after'
)


def case_line(r: Row) -> list[object]:
    """Return one case as a line of the CSV file."""
    sizes = ', '.join(f'{r.truth[n]:.2f} ({r.left[n]:.2f})' for n in r.truth)
    errors = (r.before, r.refit, r.after, r.centred_before, r.centred_after)
    false = ', '.join(false_names(r))
    return [
        r.key,
        f'{r.misfit:.2f}',
        sizes,
        r.verdict if r.verdict != 'failed' else r.error,
        *(', '.join(names) for names in (r.effects, r.group, r.faults)),
        outcome(r) + (f': {false}' if false else ''),
        *(f'{x:.3f}' for x in errors),
    ]


def write(
    rows: dict[str, Row], todo: Sequence[Case | SumCase], group: str, page: Path, drawn: str
) -> None:
    """Write the page of the study, and the file of its cases."""
    of_sums = group in SUM_SEEDS
    done = [rows[case.key] for case in todo if case.key in rows]
    note = FAMILIES
    if of_sums:
        done = [with_truth(rows[case.key], case) for case in todo if case.key in rows]
        laws = page.with_name(f'{page.stem}_laws.csv')
        write_csv(laws, 'effect, law', ([name, describe(name)] for name in (*EFFECTS, *OUTSIDE)))
        note = SUMS.format(laws=laws.name)
    sections = [
        *PURPOSES[of_sums],
        f'Made by `make study`, set `{group}`; {len(done)} of {len(todo)} cases{drawn} done.\n'
        f'Machine: {machine()}.',
        note,
        write_cases(page, CASE_HEADS, map(case_line, done)),
        summary(done),
        by('Hidden', kind_of, done),
        by('Noise' if of_sums else 'Core', stage_of, done),
    ]
    page.write_text('\n\n'.join(sections) + '\n', encoding='utf-8')


def main() -> None:
    """Run what is not done yet, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('out', type=Path)
    parser.add_argument('--set', choices=(*SUM_SEEDS, *CASES), default='sums', dest='group')
    parser.add_argument('--only', default='', help='regular expression for the keys of cases')
    parser.add_argument('--first', type=int, help='only so many cases')
    parser.add_argument('--sample', type=int, help='only so many cases, drawn at random')
    parser.add_argument('--kept', type=Path, help='file of the finished cases')
    parser.add_argument('--processes', type=int, default=os.cpu_count() or 1)
    arguments = parser.parse_args()
    group, of_sums = arguments.group, arguments.group in SUM_SEEDS
    every = sum_cases(group) if of_sums else (draw(group, k) for k in range(CASES[group]))
    todo, drawn = list(every)[: arguments.first], ''
    if arguments.sample:
        # the same ones every time, so that two versions of the package can be compared
        chosen = np.random.default_rng(14).choice(len(todo), arguments.sample, replace=False)
        drawn = f', drawn at random from {len(todo)},'
        todo = [todo[i] for i in chosen]
    todo = [case for case in todo if re.search(arguments.only, case.key)]
    name = 'study_diagnosis' if of_sums else f'study_foreign_{group}'
    path = arguments.kept or Path(f'build/{name}.jsonl')
    rows = all_rows(path, Row, todo, judged, arguments.processes)
    write(rows, todo, group, arguments.out, drawn)
    sys.stdout.write(f'{arguments.out}\n')


if __name__ == '__main__':
    main()
