# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A diagnosis for people: its headline, its tables, a page and a summary."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
import math
import sys

import numpy as np
from piezo_ident import __version__
from piezo_ident.diagnosis.results import Diagnosis, FORMULA, FoundParameter, Unseen
from piezo_ident.effects import find_effect
from piezo_ident.model import metrics
from piezo_ident.model.free_run import free_run, sine_errors
from piezo_ident.model.stage_model import EffectSetting, StageModel
from piezo_ident.record.record import Record
from piezo_ident.report.html import Box, named, Page, pairs, Section, Shown
from piezo_ident.report.table import columns, FAULTS, length, number, Table, table, wrapped
from piezo_ident.residual.reversals import Way, ways

__all__ = [
    'brief_table',
    'changes',
    'diagnosis_page',
    'diagnosis_text',
    'headline',
    'validated',
]

#: columns of every table of errors
STATES = ('as given', 'H refitted', 'refined')
#: what the source of a noise floor that is unknown may begin with
UNKNOWN = 'floor unknown: '
#: candidates in a summary, at most
CANDIDATES = 6
#: what is near a reversal, share of the voltage range behind it
NEAR = 0.05
#: a residual stands near the reversals when it is this much larger there than elsewhere
STANDS = 1.25
FOOTER = (
    'Every error is of a free run, never of one-step prediction. Base model: Gu, Li, Zhu and Su, '
    'IEEE/ASME Trans. Mechatronics 21(3), 2016, doi:10.1109/TMECH.2015.2465868. Beside this page: '
    'model.yaml (the refined model), diagnosis.json and the pictures.'
)


def validated(result: Diagnosis, records: Sequence[Record]) -> Diagnosis:
    """
    Return a diagnosis with the errors of both models on records that took no part in it.

    Raises
    ------
    ModelError
        When a piece has another sampling rate than the models.
    """
    unseen = [_unseen(result, record) for record in records]
    return replace(result, unseen=(*result.unseen, *unseen))


def _unseen(result: Diagnosis, record: Record) -> Unseen:
    models = (result.given, result.model)
    runs = [free_run(model, record) for model in models]
    before, after = (run.errors_after_start or run.errors for run in runs)
    sines = zip(*(sine_errors(model, record) for model in models), strict=True)
    return Unseen(
        record=record.name,
        before=before.percent,
        after=after.percent,
        before_centred=before.percent_without_offset,
        after_centred=after.percent_without_offset,
        n=after.n,
        sines=tuple((a.frequency, a.percent, b.percent) for a, b in sines),
    )


def headline(result: Diagnosis) -> str:
    """Return the verdict in words, and the errors on records that took no part."""
    texts = [
        f'On {x.record}, which took no part, the model as given errs by {number(x.before)} % of '
        f'stroke, the refined one by {number(x.after)} %.'
        for x in result.unseen
    ]
    return ' '.join([*texts, result.sentence])


def changes(given: StageModel, refined: StageModel) -> tuple[str, ...]:
    """Return how a refined model differs from the one that it came from; empty if not at all."""
    texts = []
    # a play without weight is none
    old, new = (
        np.concatenate([h.thresholds[h.weights > 0.0], h.weights[h.weights > 0.0], [h.p1, h.p2]])
        for h in (given.hysteresis, refined.hysteresis)
    )
    if not np.array_equal(old, new):
        texts.append('H refitted')
    if given.scaling != refined.scaling:
        texts.append('offset refitted')
    if given.delay != refined.delay:
        texts.append('another delay')
    G, other = given.dynamics, refined.dynamics
    if not (np.array_equal(G.a, other.a) and np.array_equal(G.b, other.b)):
        texts.append('G retuned')
    before = {e.name: _frozen(e.parameters) for e in given.effects}
    after = {e.name: _frozen(e.parameters) for e in refined.effects}
    texts += [_with(e) for e in refined.effects if e.name not in before]
    texts += [f'{name} refitted' for name in after if before.get(name, after[name]) != after[name]]
    return (*texts, *(f'without {name}' for name in sorted(set(before) - set(after))))


def _with(added: EffectSetting) -> str:
    idle = find_effect(added.name).is_neutral(added.parameters)
    return f'with {added.name}{", switched off" if idle else ""}'


def _frozen(values: Mapping[str, object]) -> list[tuple[str, str]]:
    return sorted((k, repr(np.asarray(x).tolist())) for k, x in values.items())


def percent_of_explainable(share: float) -> str:
    """Return a share of the explainable part as a percentage."""
    return f'{100.0 * min(1.0, max(0.0, share)):.0f} %' if math.isfinite(share) else '–'


def error_rows(result: Diagnosis) -> tuple[list[tuple[str, ...]], ...]:
    """Return the errors overall, by segment and by frequency, in `STATES` and their ratio."""
    states = (result.before, result.refit, result.after)

    def row(name: str, values: list[float]) -> tuple[str, ...]:
        ratio = values[0] / values[2] if values[2] > 0.0 else math.nan
        return (name, *map(number, values), number(ratio, 2))

    # rests and ramps come last
    easy = ('idle', 'ramp')
    labels = sorted(result.before.by_segment, key=lambda x: x.partition(':')[0] in easy)
    frequencies = sorted(result.before.by_frequency, key=float)
    return (
        [row('overall', [s.overall for s in states])],
        [row(x, [s.by_segment.get(x, math.nan) for s in states]) for x in labels],
        [
            row(f'{float(f):g} Hz', [s.by_frequency.get(f, math.nan) for s in states])
            for f in frequencies
        ],
    )


def error_tables(result: Diagnosis) -> list[Table]:
    """Return the errors before and after, by segment and by frequency, with their formula."""
    overall, segments, frequencies = error_rows(result)
    head = ('', *STATES, 'times smaller')
    note = (
        f'In % of stroke: {FORMULA}. H refitted: the same model with its hysteresis and offsets '
        f'fitted to these data and nothing added, held out likewise. {result.blocks} blocks of '
        'data were predicted in turn from the others.'
    )
    tables = [Table('By segment', head, [*overall, *segments], note)]
    return [*tables, *table('By frequency of a sine', head, frequencies)]


def unseen_tables(result: Diagnosis) -> list[Table]:
    """Return the errors on records that took no part, if there are any."""
    rows: list[tuple[str, ...]] = []
    for x in result.unseen:
        errors = (x.before, x.after, x.before_centred, x.after_centred)
        rows.append((x.record, *map(number, errors), str(x.n)))
        rows += [
            (f'{x.record}, {f:g} Hz', number(before), number(after), '', '', '')
            for f, before, after in x.sines
        ]
    return table(
        'Records that took no part',
        ('', STATES[0], STATES[2], f'{STATES[0]}, no mean', f'{STATES[2]}, no mean', 'samples'),
        rows,
        f'In % of stroke: {metrics.FORMULA}. No mean: without the mean of the error, as a sensor '
        'shows it that was set to zero anew. Sines: steady state.',
    )


def parameter_rows(result: Diagnosis) -> list[tuple[str, ...]]:
    """Return effect, parameter, value with its uncertainty, unit and meaning."""
    rows: list[tuple[str, ...]] = []
    for effect in result.effects:
        meaning = {p.name: p.description for p in find_effect(effect.name).parameters}
        rows += [
            (effect.name, name, value_text(p), p.unit, meaning.get(name, ''))
            for name, p in effect.parameters.items()
        ]
    return rows


def value_text(parameter: FoundParameter) -> str:
    """Return a value, or a list of them, with the uncertainty of each."""
    if isinstance(parameter.value, str):
        return parameter.value
    values = np.atleast_1d(np.asarray(parameter.value, dtype=np.float64)).tolist()
    std = [] if parameter.std is None else np.atleast_1d(parameter.std).tolist()
    if len(std) != len(values):
        std = [math.nan] * len(values)
    return ', '.join(
        number(x, 4) + (f' ± {number(e, 2)}' if e > 0.0 and math.isfinite(e) else '')
        for x, e in zip(values, std, strict=True)
    )


def _parameter_tables(result: Diagnosis) -> list[Table]:
    scaling = result.model.scaling
    note = (
        'In units of the normalised chain: 1 is the full span, '
        f'{number(scaling.V, 4)} V of the voltage or {length(abs(scaling.Y))} of the '
        'displacement. ±: standard deviation; no ± where a parameter was not moved.'
    )
    timed = [e.name for e in result.effects if find_effect(e.name).time_driven]
    if timed:
        note += (
            f' {", ".join(timed)}: of the longest record; such an effect follows time, so the '
            'refined model carries what can be expected of it in another one.'
        )
    head = ('effect', 'parameter', 'value', 'unit', '')
    return table('Parameters', head, parameter_rows(result), note)


def facts(result: Diagnosis) -> list[tuple[str, str]]:
    """Return the few numbers that stand beside the verdict."""
    errors = zip(STATES, (result.before, result.refit, result.after), strict=True)
    return [
        ('verdict', result.verdict.replace('_', ' ')),
        *((name, f'{number(e.overall)} % of stroke') for name, e in errors),
        ('added', ', '.join(e.name for e in result.effects) or 'nothing'),
        ('unexplained', f'{number(result.unexplained.rms_percent)} % of stroke'),
    ]


def remains(result: Diagnosis) -> list[tuple[str, str]]:
    """Return what is left, the noise and the smallest effect that would have been added."""
    left, smallest, floor = result.unexplained, result.smallest_detectable, result.noise_floor
    source = result.noise_source.removeprefix(UNKNOWN)
    rest = f': {left.description}' if left.description else ''
    noise = 'unknown' if floor is None else f'{number(floor)} % of stroke, rms of single samples'
    rows = [
        ('unexplained', _left(left.share, left.rms_percent) + rest),
        ('noise floor', f'{noise} ({source})'),
    ]
    if smallest is not None:
        rows.append(('detectable', f'effects from {number(smallest)} % of stroke rms'))
    return rows


def _left(share: float, rms_percent: float) -> str:
    return (
        f'{percent_of_explainable(share)} of the explainable part, {number(rms_percent)} % of '
        'stroke'
    )


def _setting_tables(result: Diagnosis) -> list[Table]:
    settings = asdict(result.settings)
    if settings['effects'] is None:
        settings['effects'] = 'the whole catalogue'
    rows = [
        (name.replace('_', ' '), ', '.join(x) if isinstance(x, (tuple, list)) else str(x))
        for name, x in settings.items()
    ]
    python = '.'.join(map(str, sys.version_info[:3]))
    versions = (('piezo_ident', __version__), ('python', python), ('numpy', np.__version__))
    return [
        Table('Settings', ('setting', 'value'), [(name, x or 'none') for name, x in rows]),
        Table('Versions', ('software', 'version'), versions),
    ]


def ways_of(result: Diagnosis) -> tuple[Way, ...]:
    """Return the three residuals by the way since a turn [% of stroke]."""
    stroke = max(float(np.ptp(r.piece.y)) for r in result.residuals)
    return ways(
        [(r.piece.v, r.sound, r.piece.sample_rate) for r in result.residuals],
        [[100.0 * e / stroke for e in (r.given, r.before, r.after)] for r in result.residuals],
    )


def _reversal_tables(found: Sequence[Way]) -> list[Table]:
    return table(
        'By the way since the voltage last turned',
        ('share of the range', *STATES, 'means'),
        [
            (f'{100.0 * w.start:g} .. {100.0 * w.stop:g} %', *map(number, w.rms), str(w.n))
            for w in found
        ],
        'In % of stroke: rms of the residual, free run, means over 2 ms; fitted to all of these '
        'data.',
    )


def reversal_text(result: Diagnosis, found: Sequence[Way]) -> str:
    """Return how large the residual near the reversals is; empty where it is no larger there."""
    near = [w for w in found if w.stop <= NEAR]
    far = [w for w in found if w.stop > NEAR]
    if not near or not far:
        return ''
    given, refitted, refined = _rms(near)
    elsewhere = _rms(far)
    if given < STANDS * elsewhere[0]:
        return ''
    text = (
        f'Near the reversals (the first {100.0 * NEAR:g} % of the range behind a turn) the model '
        f'as given misses {number(given)} % of stroke, elsewhere {number(elsewhere[0])} %. '
        f'{100.0 * max(1.0 - (refitted / given) ** 2, 0.0):.0f} % of its square go when H is '
        'refitted on finer thresholds: so far it was the shape of the loop behind a turn'
    )
    if result.effects and refined < refitted:
        names = ' and '.join(e.name.replace('_', ' ') for e in result.effects)
        text += f'; {100.0 * (refitted**2 - refined**2) / given**2:.0f} % with {names}'
    last, there = (refined, elsewhere[2]) if result.effects else (refitted, elsewhere[1])
    return f'{text}. {number(last)} % stay, elsewhere {number(there)} %.'


def _rms(some: Sequence[Way]) -> tuple[float, ...]:
    n = np.array([w.n for w in some])
    squares = np.array([w.rms for w in some]) ** 2
    return tuple(float(x) for x in np.sqrt(n @ squares / n.sum()))


def _added(result: Diagnosis) -> list[str]:
    return [
        f'{effect.name} (slot: {effect.slot}), {_left(effect.share, effect.rms_percent)}'
        for effect in result.effects
    ]


def diagnosis_page(
    result: Diagnosis,
    pictures: Sequence[Shown],
    left_out: Sequence[tuple[str, str]],
) -> Page:
    """Return the page; `left_out` holds titles of pictures that cannot be drawn, with reasons."""
    warnings = list(result.warnings)
    if result.faults:
        warnings.append('the data had faults, see the table near the end')
    group, found = result.group, ways_of(result)
    alike = [] if group is None else [*group.names, f'what would: {group.separating_experiment}']
    changed = ', '.join(changes(result.given, result.model))

    candidates = [(c.name, percent_of_explainable(c.share), c.why_not) for c in result.candidates]
    note = (
        'Share of the explainable part of the residual that each explains when it is added alone.'
    )
    untestable = [(x.name, x.needs) for x in result.untestable]
    faults = [(x.name, str(x.count), x.where, x.action) for x in result.faults]
    return Page(
        title='Diagnosis of a piezo stage',
        source=', '.join(result.records),
        headline=headline(result),
        facts=facts(result),
        before=(
            Box('warnings', 'Warnings', warnings),
            Box('missing', 'These data cannot tell apart', alike),
        ),
        sections=(
            Section(
                'Error before and after',
                [*named(pictures, 'error'), *error_tables(result), *unseen_tables(result)],
            ),
            Section(
                'The residual before and after',
                [
                    reversal_text(result, found),
                    *named(pictures, 'residual', 'signature', 'spectrum', 'coherence'),
                    *_reversal_tables(found),
                ],
            ),
            Section(
                'What was added',
                [
                    *_added(result),
                    *_parameter_tables(result),
                    f'Refined model: {changed or "the same as the one that was given"}.',
                ],
            ),
            Section(
                'What was not, and why',
                [
                    *named(pictures, 'ranking'),
                    *table(
                        'Candidates that were not added',
                        ('effect', 'share', 'why not'),
                        candidates,
                        note,
                    ),
                ],
            ),
            Section(
                'What remains',
                [
                    Table('What the model leaves', ('', ''), remains(result)),
                    *table('What these data cannot test', ('effect', 'needs'), untestable),
                ],
            ),
            Section(
                'Origin',
                [*table('Faults in the data', FAULTS, faults), *_setting_tables(result)],
            ),
        ),
        after=(Box('missing', 'Pictures that these data do not allow', pairs(left_out)),),
        footer=FOOTER,
    )


def diagnosis_text(result: Diagnosis) -> str:
    """Return verdict, errors before and after, what was added and what was not, for a terminal."""
    rows = [row for rows in error_rows(result) for row in rows]
    lines = [*wrapped(headline(result)), '']
    lines += columns(('error / % of stroke', *STATES, 'times smaller'), rows)
    for each in unseen_tables(result):
        lines += ['', *columns((each.title.lower(), *each.head[1:]), each.rows)]
    near = reversal_text(result, ways_of(result))
    lines += ['', *wrapped(near)] if near else []
    lines.append('')
    for what, text in (facts(result)[0], *remains(result)):
        lines += wrapped(f'{what:<14}{text}', ' ' * 14)
    for effect, text in zip(result.effects, _added(result), strict=True):
        lines += ['', *wrapped(f'added: {text}', '  ')]
        for name, parameter, value, unit, _ in parameter_rows(result):
            if name == effect.name:
                of_unit = f' [{unit}]' if unit else ''
                lines += wrapped(f'  {parameter:<16}{value}{of_unit}', ' ' * 18)
    if result.group is not None:
        names = ', '.join(result.group.names)
        what = f'what would: {result.group.separating_experiment}'
        lines += ['', *wrapped(f'these data cannot tell apart: {names}; {what}', '  ')]
    others = [
        f'{c.name} ({percent_of_explainable(c.share)}): {c.why_not}' for c in result.candidates
    ]
    if len(others) > CANDIDATES:
        others[CANDIDATES:] = [f'and {len(others) - CANDIDATES} more']
    lines += _listed('not added', others)
    untestable = [f'{x.name}: needs {x.needs}' for x in result.untestable]
    lines += _listed('not testable with these data', untestable)
    lines += _listed('faults in the data', [str(fault) for fault in result.faults])
    for warning in result.warnings:
        lines += ['', *wrapped(f'warning: {warning}', '  ')]
    return '\n'.join(lines)


def _listed(title: str, items: Sequence[str]) -> list[str]:
    if not items:
        return []
    return ['', f'{title}:', *(x for item in items for x in wrapped(item, '    ', '  '))]


def brief_table(result: Diagnosis) -> Table:
    """Return the facts for a notebook."""
    return Table('Diagnosis', ('', ''), [*facts(result), *remains(result)[1:]])
