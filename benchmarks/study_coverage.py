# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Whether bands, promises, deviations and weights hold, on stages of families that the model lacks.

    python benchmarks/study_coverage.py docs/coverage.md --picture docs/images/coverage.png

Every stage is one of `truths.draw` with a seed from `SEED` on, which nobody used while this was
built.  Two stages of three play the program `identification_loops`, the others motion without
labels.  `identified` stages have nothing hidden: a model from one record predicts the same motion
again, and other motion.  `diagnosed` stages hide what their case says.  Finished stages are kept
in ``build/coverage.jsonl``, so a study that was stopped goes on.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
import os
from pathlib import Path

# two threads of BLAS fight over narrow matrices; one process a core is faster
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import numpy as np
from parameter_draws import Draw, drawn, Quantity, table, todo_draws
import piezo_ident as pi
from piezo_ident.record.record import Piece
from piezo_ident.report.figures import style
from piezo_ident.uncertainty.prediction import half_widths
from piezo_ident.uncertainty.weights import NOTHING
from side_by_side import machine
from study_records import case_records
from study_rows import all_rows, part_of, section, write_csv
from truths import Case, draw, FamilyStage

#: first seed of the draw, and the group of families whose laws may be looked at
SEED, GROUP = 9700, 'known'
#: levels of the bands, and the one of the tables
LEVELS = (0.5, 0.7, 0.8, 0.9, 0.95)
MAIN = LEVELS.index(0.9)
#: heads of the widths, and what they mean
WIDTHS = 'width / oracle, geometric'
ORACLE = (
    'The oracle is, for each stage and kind, the constant half width that holds 90 %. Width / '
    'oracle: mean half width over the mean of the oracle; geometric: mean ratio.'
)
#: measured records and the share that is identified; the rest is predicted
MEASURED = (('piezo_levels.csv', 0.6), ('piezo_1hz.csv', 0.86))
DATA = Path(os.environ.get('PIEZO_IDENT_DATA', Path(__file__).parents[2] / '../shared/data'))
#: title and heads of the table of quantities, and what stands below it
PARAMETERS = 'Parameters: 95 % intervals over draws of the noise of one record'
QUANTITIES = (
    'stage and record, quantity, number x draws, held %, without bias, least, scatter / stated, '
    'largest, bias / scatter'
)
OFF = (
    'Intervals that hold the reference / the same without the bias [%], and scatter over stated '
    'deviation. On the grid the reference is the truth, off the grid the fit of the same record '
    'without noise. The noise is 1e-4 of the stroke. Bias, and the least and largest of each: '
    '[coverage.csv](coverage.csv).'
)
#: of quantities, in the order of the page
KINDS = ('static gain', 'loop width', 'gain', 'phase', 'modes')
#: a kind of motion of a record, the shares inside at `LEVELS`, the mean half width at 0.9 and the
#: constant half width that holds 90 % [% of stroke], and the share of samples that are not known
Cell = tuple[str, tuple[float, ...], float, float, float]


@dataclass(frozen=True)
class Todo:
    """A stage to judge: `what` is 'identified', 'diagnosed', or the name of a measured record."""

    what: str
    number: int

    @property
    def key(self) -> str:
        """Name in the file."""
        return f'{self.what} {self.number}'


@dataclass(frozen=True)
class Covered:
    """What came out; errors in % of stroke."""

    key: str
    kinds: tuple[Cell, ...] = ()
    same: tuple[float, float] = (np.nan, np.nan)
    other: tuple[float, float] = (np.nan, np.nan)
    noise: float = np.nan
    weight: float = np.nan
    is_right: bool = False
    error: str = ''


def case_of(todo: Todo) -> Case:
    """Return the case of a number, with a seed of this draw."""
    case = replace(draw(GROUP, todo.number % 216), seed=SEED + todo.number, fault='', poorer='')
    if todo.what == 'identified':
        return replace(case, effects=(), factors=(), idle_channel=False)
    return case


def judged(todo: Todo) -> Covered:
    """Run one stage."""
    try:
        if todo.what.endswith('.csv'):
            return _measured(todo)
        return _identified(todo) if todo.what == 'identified' else _diagnosed(todo)
    # one failed stage must not end hours of others
    except Exception as error:  # noqa: BLE001
        return Covered(todo.key, error=f'{type(error).__name__}: {error}')


def _identified(todo: Todo) -> Covered:
    records = case_records(case_of(todo), forms=False, loops=True)
    result = pi.identify(records.identification)
    again = _again(records.stage, records.identification)
    same, other = (result.model.score(r).percent for r in (again, records.unseen))
    # what the sensor adds: to a displacement of zero, so that its steps count, too
    v = records.identification.pieces[0].v
    clean = records.stage.respond(v, 'identification', {}, clean=True)
    noise = 100.0 * float(np.std(records.stage.read(clean, 'identification') - clean))
    return Covered(
        todo.key,
        tuple(_kinds(result.model, records.unseen)),
        (same, result.promise.same),
        (other, result.promise.other),
        (result.noise_floor or np.nan) / noise,
    )


def _diagnosed(todo: Todo) -> Covered:
    records = case_records(case_of(todo), forms=False, loops=True)
    result = pi.diagnose(pi.identify(records.identification).model, records.diagnosis)
    other = result.model.score(records.unseen).percent
    same = np.nan
    if not any(piece.channels for piece in records.diagnosis):
        same = result.model.score(_again(records.stage, records.diagnosis)).percent
    name = '+'.join(sorted(e.name for e in result.effects)) or NOTHING
    truth = '+'.join(sorted(records.truth)) or NOTHING
    return Covered(
        todo.key,
        tuple(_kinds(result.model, records.unseen)),
        (same, result.promise.same),
        (other, result.promise.other),
        weight=result.weights.get(name, np.nan),
        is_right=name == truth,
    )


def _measured(todo: Todo) -> Covered:
    name, share = next(x for x in MEASURED if x[0] == todo.what)
    record = pi.read(DATA / name)
    (piece,) = record.pieces
    at = round(share * piece.n)
    result = pi.identify(pi.Record((piece.cut(0, at),), name))
    rest = pi.Record((piece.cut(at, piece.n),), f'rest of {name}')
    error = result.model.score(rest).percent
    kinds = tuple(_kinds(result.model, rest))
    return Covered(todo.key, kinds, (error, result.promise.same), (error, result.promise.other))


def _again(stage: FamilyStage, record: pi.Record) -> pi.Record:
    """Measure the same motion once more, with another noise, phase and past."""
    (piece,) = record.pieces
    y = stage.respond(piece.v, 'again')
    again = Piece(piece.v, y, piece.sample_rate, segments=piece.segments)
    return pi.Record((again,), 'again')


def _kinds(model: pi.StageModel, record: pi.Record) -> Iterator[Cell]:
    """Yield the coverage of each kind of motion of a record, behind its unknown start."""
    run = model.predict(record)
    halves = [half_widths(model, run.record, run.pieces, level, run.estimated) for level in LEVELS]
    rows: dict[str, list[np.ndarray]] = {}
    for i, piece in enumerate(run.record):
        e = np.abs([piece.y - run.pieces[i], *(half[i] for half in halves)])
        judged = piece.mask & (np.arange(piece.n) >= run.late[i])
        for label, start, stop in [(s.label, s.start, s.stop) for s in piece.segments] or [
            ('unlabelled', 0, piece.n)
        ]:
            own = judged[start:stop]
            rows.setdefault(label.partition(':')[0], []).append(e[:, start:stop][:, own])
    scale = 100.0 / record.stroke
    for kind, parts in rows.items():
        e, *half = np.hstack(parts)
        known = np.isfinite(half[MAIN])
        if e.size < 20:
            continue
        unknown = 1.0 - float(known.mean())
        if not known.any():
            yield kind, (), np.nan, np.nan, unknown
            continue
        inside = tuple(float(np.mean((e <= h)[known])) for h in half)
        oracle = max(float(np.quantile(e[known], LEVELS[MAIN])), 1e-15)
        yield kind, inside, scale * float(half[MAIN][known].mean()), scale * oracle, unknown


# -- the page ------------------------------------------------------------------------------------


def _spread(values: Sequence[float]) -> str:
    known = np.array(values)[np.isfinite(values)]
    if not known.size:
        return '–'
    return f'{np.median(known):.2f} | {np.quantile(known, 0.9):.2f}'


def _coverage(rows: Sequence[Covered]) -> Iterator[tuple[object, ...]]:
    by_kind: dict[str, list[Cell]] = {}
    for row in rows:
        for cell in row.kinds:
            by_kind.setdefault(cell[0], []).append(cell)
    for kind, cells in {**by_kind, 'all': [c for own in by_kind.values() for c in own]}.items():
        held = [c for c in cells if c[1]]
        if held:
            shares = np.mean([c[1] for c in held], axis=0)
            width, oracle = np.array([c[2:4] for c in held]).T
            yield (
                kind,
                len(held),
                *(f'{100 * s:.0f}' for s in shares),
                f'{width.mean() / oracle.mean():.2f}',
                f'{np.exp(np.mean(np.log(width / oracle))):.2f}',
                f'{np.mean([c[4] for c in cells]):.0%}',
            )


def _low(rows: Sequence[Covered]) -> str:
    own = [np.mean([k[1][MAIN] for k in row.kinds if k[1]]) for row in rows if row.kinds]
    return part_of(sum(x < 0.6 for x in own), len(own))


def _calibration_error(w: np.ndarray, right: np.ndarray) -> float:
    bins = np.array_split(np.arange(w.size), 5)
    return float(sum(b.size * abs(w[b].mean() - right[b].mean()) for b in bins) / w.size)


def _weights(rows: Sequence[Covered]) -> str:
    known = sorted((r.weight, r.is_right) for r in rows if np.isfinite(r.weight))
    if len(known) < 5:
        return 'Too few diagnoses for the calibration of weights.'
    w, right = np.array(known, dtype=np.float64).T
    error = _calibration_error(w, right)
    # a small number of verdicts scatters about weights that hold, too
    draws = np.random.default_rng(0).random((1000, w.size)) < w
    held = np.mean([_calibration_error(w, draw) for draw in draws])
    brier, base = float(np.mean((w - right) ** 2)), float(right.mean() * (1.0 - right.mean()))
    return (
        f'Weight of the first verdict, {w.size} diagnoses in five bins of equal count: expected '
        f'calibration error {error:.2f} (wanted 0.07; weights that hold have {held:.2f}, by the '
        f'scatter of so many verdicts); Brier score {brier:.3f}, of the base rate {base:.3f}. '
        f'Right, set for set: {part_of(int(right.sum()), right.size)}.'
    )


def _pooled(quantities: Sequence[Quantity]) -> Iterator[tuple[object, ...]]:
    for variant, kind in dict.fromkeys((q.variant, q.kind) for q in quantities):
        own = [q for q in quantities if (q.variant, q.kind) == (variant, kind)]
        held, beside = ([getattr(q, what) for q in own] for what in ('held', 'beside'))
        ratios = [q.ratio for q in own]
        yield (
            variant,
            kind,
            f'{len(own)} x {max(q.draws for q in own)}',
            *(f'{100 * x:.0f}' for x in (np.mean(held), np.mean(beside), min(beside))),
            f'{np.median(ratios):.2f}',
            f'{max(ratios):.2f}',
            f'{np.median([abs(q.bias) for q in own]):.2f}',
        )


def _in_short(quantities: Sequence[Quantity]) -> Iterator[tuple[object, ...]]:
    pooled = {row[:2]: f'{row[3]} / {row[4]}, {row[6]}' for row in _pooled(quantities)}
    for variant in dict.fromkeys(variant for variant, _ in pooled):
        yield variant, *(pooled.get((variant, kind), '') for kind in KINDS)


def page(rows: Sequence[Covered], quantities: Sequence[Quantity], draws: int) -> str:
    """Return the page."""
    groups = {
        what: [r for r in rows if r.key.startswith(what) and not r.error]
        for what in ('identified', 'diagnosed')
    }
    measured = [r for r in rows if '.csv' in r.key and not r.error]
    heads = 'motion, stages, ' + ', '.join(f'{100 * p:g} %' for p in LEVELS)
    parts = [
        '# Coverage',
        'This page shows whether [bands, promises and weights](bands.md) hold on stages of '
        f'families that the model lacks (`benchmarks/truths`, group {GROUP}; seeds from {SEED} on '
        'that nobody had used). Two stages of three play the program `identification_loops`, '
        'the others motion without labels. `make coverage` writes this page. This run: '
        f'**{len(groups["identified"])} identified stages, {len(groups["diagnosed"])} diagnosed '
        f'ones, {len(measured)} measured records, {draws} draws of parameters**, '
        f'{sum(bool(r.error) for r in rows)} failed; the whole study has 150, 50, 2 and 20. '
        f'{machine()}.',
        '![Nominal against measured coverage by kind of motion](images/coverage.png)',
        ORACLE,
    ]
    for what, own in groups.items():
        title = f'Prediction bands, {what} stages'
        parts.append(
            section(title, f'{heads}, {WIDTHS}, not known', _coverage(own))
            + f'\n\nStages below 60 %: {_low(own)}.'
        )
    parts.append(
        section('Bands on measured records', f'{heads}, {WIDTHS}, not known', _coverage(measured))
    )
    told = [
        (what, len(own), *(_spread([s[0] / (s[1] or np.nan) for s in pairs]) for pairs in both))
        for what, own in {**groups, 'measured': measured}.items()
        for both in [([r.same for r in own], [r.other for r in own])]
    ]
    parts.append(
        section(
            'Promises: error of another record over the promised one, median \\| 90th percentile',
            'stages, number, same motion, other motion',
            [tuple(str(c).replace(' | ', ' \\| ') for c in row) for row in told],
        )
    )
    parts.append(f'## Weights\n\n{_weights(groups["diagnosed"])}')
    noise = [r.noise for r in groups['identified'] if np.isfinite(r.noise)]
    near = sum(1 / 1.5 <= x <= 1.5 for x in noise)
    parts.append(
        f'## Sensor noise\n\nStated over true: median {np.median(noise or [np.nan]):.2f}; within '
        f'1.5 times of the truth: {part_of(near, len(noise))}.'
    )
    parts.append(
        section(PARAMETERS, f'stage and record, {", ".join(KINDS)}', _in_short(quantities))
    )
    parts.append(OFF)
    return '\n\n'.join(parts) + '\n'


def picture(rows: Sequence[Covered], target: Path) -> None:
    """Draw nominal against measured coverage by kind of motion."""
    fig = style.figure(4.2, 5.2)
    axes = fig.subplots()
    axes.plot([0, 1], [0, 1], color=style.GREY, linewidth=0.8)
    for kind, n, *shares, _, _, _ in _coverage([r for r in rows if not r.error]):
        values = [float(s) / 100.0 for s in shares]
        axes.plot(
            LEVELS,
            values,
            'o-',
            markersize=3,
            linewidth=2.2 if kind == 'all' else 0.9,
            label=f'{kind} ({n})',
        )
    style.tidy(axes, 'nominal coverage', 'measured coverage')
    style.legend(axes, loc='upper left', ncols=2)
    target.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(target, dpi=style.DPI)


def main() -> None:
    """Run the study and write the page."""
    parser = argparse.ArgumentParser(description=__doc__.partition('\n\n')[0])
    parser.add_argument('page', type=Path)
    parser.add_argument('--picture', type=Path, default=Path('docs/images/coverage.png'))
    parser.add_argument('--identified', type=int, default=150, help='number of stages')
    parser.add_argument('--diagnosed', type=int, default=50, help='number of stages')
    parser.add_argument('--draws', type=int, default=20, help='draws of each noise')
    parser.add_argument('--processes', type=int, default=os.cpu_count() or 1)
    parser.add_argument('--kept', type=Path, default=Path('build/coverage.jsonl'))
    args = parser.parse_args()
    todo = [Todo(name, 0) for name, _ in MEASURED if (DATA / name).exists()]
    todo += [Todo('identified', k) for k in range(args.identified)]
    todo += [Todo('diagnosed', k) for k in range(args.diagnosed)]
    rows = all_rows(args.kept, Covered, todo, judged, args.processes)
    own = [rows[one.key] for one in todo if one.key in rows]
    draws = todo_draws(args.draws, SEED, draw(GROUP, 0)) if args.draws else []
    of_draws = all_rows(args.kept.with_suffix('.draws.jsonl'), Draw, draws, drawn, args.processes)
    quantities = table(of_draws, draws)
    args.page.write_text(page(own, quantities, args.draws), encoding='utf-8')
    write_csv(args.page.with_suffix('.csv'), QUANTITIES, _pooled(quantities))
    picture(own, args.picture)


if __name__ == '__main__':
    main()
