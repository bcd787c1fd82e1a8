# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
How often a diagnosis is right, on stages whose laws are not those of the candidates.

    python benchmarks/study_diagnosis.py docs/diagnosis_study.md

Every case: a stage from `truths`, identified from the package's own program, diagnosed on one
record and judged on another that nothing saw.  Finished cases are kept beside the table in
``build/study_diagnosis.jsonl``, so a study that was stopped goes on.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
import os
from pathlib import Path
import sys
from typing import Any

# two threads of BLAS fight over narrow matrices; one process a core is faster
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import numpy as np
from piezo_ident.diagnosis import diagnose, DiagnosisSettings
from piezo_ident.excitation.program import Program
from piezo_ident.identification.identify import identify
from piezo_ident.identification.results import Settings
from piezo_ident.model.free_run import free_run
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.record import Piece, Record, Segment
from side_by_side import machine
from study_rows import all_rows, counts_of, section, some, write_cases, write_csv
from truths import describe, EFFECTS, make_stage, other_axis, OUTSIDE, program

RATE = 20_000.0
SEEDS = (1, 2, 3)
COLOURS = ('white', '1/f', '10-bit')
#: left-over from which an effect counts, % of stroke
COUNTS = 0.1
PAIRS = (
    ('creep', 'rate_dependent_hysteresis'),
    ('creep', 'periodic_disturbance'),
    ('creep', 'delay_change'),
    ('creep', 'saturation'),
    ('creep', 'changed_dynamics'),
    ('creep', 'cross_coupling'),
    ('creep', 'even_nonlinearity'),
    ('rate_dependent_hysteresis', 'periodic_disturbance'),
    ('rate_dependent_hysteresis', 'even_nonlinearity'),
    ('rate_dependent_hysteresis', 'cross_coupling'),
    ('even_nonlinearity', 'delay_change'),
    ('even_nonlinearity', 'periodic_disturbance'),
    ('saturation', 'periodic_disturbance'),
    ('saturation', 'changed_dynamics'),
    ('sensor_nonlinearity', 'creep'),
    ('sensor_nonlinearity', 'changed_dynamics'),
    ('noncongruent_minor_loops', 'creep'),
    ('input_feedthrough', 'creep'),
    ('preload_loss', 'periodic_disturbance'),
    ('cross_coupling', 'thermal_drift'),
)


@dataclass(frozen=True)
class Case:
    """One stage and what is asked of it."""

    kind: str
    effects: tuple[str, ...]
    size: float
    seed: int
    noise: str = 'white'
    without: tuple[str, ...] = ()

    @property
    def key(self) -> str:
        """Return a name for the file."""
        parts = [self.kind, '+'.join(self.effects), f'{self.size:g}', str(self.seed), self.noise]
        return ' '.join(parts)


@dataclass(frozen=True)
class Row:
    """What came out."""

    key: str
    verdict: str
    found: tuple[str, ...]
    group: tuple[str, ...]
    size: float
    before: float
    after: float
    unseen_before: float
    unseen_after: float
    error: str = ''


def cases() -> Iterator[Case]:
    """Yield every case, the telling ones first."""
    for seed in SEEDS:
        for effect in EFFECTS:
            yield Case('one', (effect,), 0.3, seed)
        for number in range(seed, 21, len(SEEDS)):
            for noise in COLOURS:
                yield Case('none', (), 0.0, number, noise)
        for effect in EFFECTS:
            yield Case('removed', (effect,), 0.3, seed, without=(effect,))
        for effect in OUTSIDE:
            yield Case('outside', (effect,), 0.3, seed)
        for size in (0.1, 1.0):
            for effect in EFFECTS:
                yield Case('one', (effect,), size, seed)
    for pair in PAIRS:
        yield Case('pair', pair, 0.3, 1)


def record_of(
    v: np.ndarray,
    y: np.ndarray,
    labels: Sequence[tuple[str, int, int]],
    name: str,
    channels: dict[str, np.ndarray] | None,
) -> Record:
    """Return a record as a lab would hand it over."""
    segments = tuple(Segment(*label) for label in labels)
    return Record((Piece(v, y, RATE, segments=segments, channels=channels or {}),), name)


@cache
def measured(
    effects: tuple[str, ...], size: float, seed: int, noise: str
) -> tuple[StageModel, Record, Record]:
    """Return model, record to diagnose and unseen record."""
    effect: Any = effects[0] if len(effects) == 1 else effects or None
    stage = make_stage(effect, size, seed, noise=noise)
    coupled = 'cross_coupling' in effects

    def other(t: np.ndarray, number: int) -> dict[str, np.ndarray] | None:
        return {'other': other_axis(t, np.random.default_rng(number))} if coupled else None

    sequence = Program.load('program_identification.yaml').build(sample_rate=RATE)
    t = np.arange(sequence.n) / RATE
    y = stage.respond(t, sequence.v, changed=False, channels=other(t, seed))
    labels = [(s.label, s.start, s.stop) for s in sequence.segments]
    record = record_of(sequence.v, y, labels, 'identification', None)
    model = identify(record, Settings(thresholds=10)).model
    records = []
    for number, kind in enumerate(('diagnosis', 'unseen')):
        t, v, labels = program(kind, seed)
        channels = other(t, 100 + 10 * number + seed)
        y = stage.respond(t, v, changed=True, channels=channels)
        records.append(record_of(v, y, labels, kind, channels))
    return model, records[0], records[1]


def judged(case: Case) -> Row:
    """Run one case."""
    try:
        model, record, unseen = measured(case.effects, case.size, case.seed, case.noise)
        result = diagnose(model, record, DiagnosisSettings(without=case.without))
        errors = [free_run(m, unseen).errors.percent for m in (model, result.model)]
        return Row(
            key=case.key,
            verdict=result.verdict,
            found=tuple(e.name for e in result.effects),
            group=result.group.names if result.group else (),
            size=result.errors_of_laws['plays'],
            before=result.before.overall,
            after=result.after.overall,
            unseen_before=errors[0],
            unseen_after=errors[1],
        )
    # one failed case must not end hours of others
    except Exception as error:  # noqa: BLE001
        nan, reason = float('nan'), f'{type(error).__name__}: {error}'
        return Row(case.key, 'failed', (), (), nan, nan, nan, nan, nan, reason)


def outcome(case: Case, row: Row) -> str:
    """
    Return one of `KINDS`, or 'failed'.

    'hidden': no name, and the truth is among what may hide in the base model.
    """
    truth = set(case.effects)
    if row.verdict == 'named':
        return 'exact' if set(row.found) == truth else 'wrong'
    if row.verdict == 'class':
        others = truth - set(row.found)
        return 'class' if others <= set(row.group) and truth & set(row.group) else 'wrong'
    if not row.found and truth & set(row.group):
        return 'hidden'
    return {'partly_explained': 'partly'}.get(row.verdict, row.verdict)


def is_told(case: Case, row: Row) -> bool:
    """
    Return whether the verdict tells the truth as the second study counts it, and nothing false.

    What stands among the effects is named, however much is left, and the class of a refit is one.
    """
    if row.verdict == 'partly_explained':
        return set(row.found) == set(case.effects)
    kind = outcome(case, row)
    return kind in ('exact', 'class') or (kind == 'hidden' and row.verdict == 'refitted')


KINDS = ('exact', 'class', 'hidden', 'partly', 'refitted', 'unexplained', 'none', 'wrong')
VERDICTS = ('named', 'class', 'partly_explained', 'refitted', 'unexplained', 'none')
PURPOSE = (
    'This page tells whoever must trust a verdict how often it was right on simulated sums of '
    'plays with an effect. [The second study](diagnosis_study_foreign.md) has other hysteresis.'
)
NOTE = (
    'Every stage is identified from the 15.5 s of `program_identification.yaml`, diagnosed on a '
    'record of 17 s, and judged on 12 s of other frequencies, amplitudes and holds. The '
    '[laws of the stages]({laws}) are not those of the candidates. The size of an effect is the '
    'free-run error that a refit of a sum of plays leaves on kinds of motion held out, in % of '
    f'stroke. An effect of {COUNTS} % and more is counted. Hidden: the verdict has no name, and '
    'the effect is among two or three that may hide in the base model.'
)
Done = Sequence[tuple[Case, Row]]


def line(name: str, own: Done) -> list[object]:
    """Return a row of a table: the outcomes, and the median errors on the unseen record."""
    medians = [
        f'{np.median([getattr(r, error) for _, r in own]):.3f}' if own else ''
        for error in ('unseen_before', 'unseen_after')
    ]
    outcomes = counts_of((outcome(case, row) for case, row in own), KINDS)
    return [name, len(own), outcomes, *medians]


def single(done: Done) -> str:
    """Return the section of stages with one effect."""
    counted = [(c, r) for c, r in done if c.kind == 'one' and r.size >= COUNTS]
    outcomes = [outcome(case, row) for case, row in counted]
    exact, named, wrong, hidden = (
        some(outcome in kinds for outcome in outcomes)
        for kinds in (('exact',), ('exact', 'class'), ('wrong',), ('hidden',))
    )
    lines = (line(name, [x for x in counted if x[0].effects == (name,)]) for name in EFFECTS)
    heads = 'effect, counted, outcomes, unseen error before, after'
    text = section('One effect', heads, lines)
    stated = some(set(row.found) == set(case.effects) for case, row in counted)
    told = some(is_told(case, row) for case, row in counted)
    text += (
        f'\n\nExact name: {exact}; exact name or its class: {named}; wrong: {wrong}; no name, and '
        f'among what may hide in the base model: {hidden}. The second study counts an effect as '
        f'named however much is left: {stated}; with classes, that of a refit included: {told}.'
    )
    ratios = [
        r.unseen_before / r.unseen_after for _, r in counted if r.verdict in ('named', 'class')
    ]
    growth = [r.unseen_after / r.unseen_before - 1.0 for _, r in done if r.verdict != 'failed']
    if ratios:
        text += (
            '\n\nUnseen record, where an effect was named: error before over after, median '
            f'{np.median(ratios):.1f}; largest growth of the error in any case of the study '
            f'{max(*growth, 0.0):.1%}.'
        )
    return text


def none(done: Done) -> str:
    """Return the section of stages without an effect."""

    def line(noise: str) -> list[object]:
        own = [r for c, r in done if c.kind == 'none' and c.noise == noise]
        others = [f'{r.verdict} ({", ".join(r.found)})' for r in own if r.verdict != 'none']
        return [noise, len(own), len(own) - len(others), '; '.join(others)]

    return section('No effect', 'noise, cases, none, other verdicts', map(line, COLOURS))


def outside(done: Done) -> str:
    """Return the section of effects that are not among the candidates."""
    own = [(c, r) for c, r in done if c.kind in ('removed', 'outside') and r.size >= COUNTS]

    lines = (
        [what, len(verdicts), counts_of(verdicts, VERDICTS)]
        for what, verdicts in (
            (what, [r.verdict for c, r in own if c.kind == kind])
            for what, kind in (
                ('a candidate taken out of the catalogue', 'removed'),
                ('an effect outside the catalogue', 'outside'),
            )
        )
    )
    text = section('Effects that are no candidates', 'truth, counted, verdicts', lines)
    return f'{text}\n\nA wrong name in {some(r.verdict == "named" for _, r in own)}.'


def pairs(done: Done) -> str:
    """Return the section of stages with two effects."""
    own = [(set(c.effects), set(r.found)) for c, r in done if c.kind == 'pair']
    counts = (
        ('both', sum(found == truth for truth, found in own)),
        ('one of the two', sum(bool(found) and found < truth for truth, found in own)),
        ('an effect that is not there', sum(bool(found - truth) for truth, found in own)),
        ('none', sum(not found for _, found in own)),
    )
    return section('Two effects', 'named, cases', counts)


CASE_HEADS = (
    'kind, truth, strength, seed, noise, verdict, added, class, size, unseen before, unseen after'
)


def case_line(case: Case, row: Row) -> list[object]:
    """Return one case as a line of the CSV file."""
    names = [row.verdict, ', '.join(row.found), ', '.join(row.group)]
    errors = [f'{x:.3f}' for x in (row.size, row.unseen_before, row.unseen_after)]
    truth = ', '.join(case.effects)
    return [case.kind, truth, f'{case.size:g}', case.seed, case.noise, *names, *errors]


def write(rows: dict[str, Row], todo: Sequence[Case], page: Path) -> None:
    """Write the page of the study, and the file of its cases."""
    done = [(case, rows[case.key]) for case in todo if case.key in rows]
    laws = page.with_name(f'{page.stem}_laws.csv')
    write_csv(laws, 'effect, law', ([name, describe(name)] for name in (*EFFECTS, *OUTSIDE)))
    sections = [
        '# How often the diagnosis is right',
        PURPOSE,
        f'Made by `make study`; {len(done)} of {len(todo)} cases done.\nMachine: {machine()}.',
        NOTE.format(laws=laws.name),
        write_cases(page, CASE_HEADS, (case_line(c, r) for c, r in done)),
        single(done),
        none(done),
        outside(done),
        pairs(done),
    ]
    page.write_text('\n\n'.join(sections) + '\n', encoding='utf-8')


def main() -> None:
    """Run what is not done yet, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('out', type=Path)
    parser.add_argument('--kept', type=Path, default=Path('build/study_diagnosis.jsonl'))
    parser.add_argument('--sample', type=int, help='only so many cases, drawn at random')
    parser.add_argument('--processes', type=int, default=os.cpu_count() or 1)
    arguments = parser.parse_args()
    todo = list(cases())
    if arguments.sample:
        # the same ones every time, so that two versions of the package can be compared
        drawn = np.random.default_rng(14).choice(len(todo), arguments.sample, replace=False)
        todo = [todo[i] for i in drawn]
    rows = all_rows(arguments.kept, Row, todo, judged, arguments.processes)
    write(rows, todo, arguments.out)
    sys.stdout.write(f'{arguments.out}\n')


if __name__ == '__main__':
    main()
