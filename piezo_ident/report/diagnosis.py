# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A diagnosis for people: its headline, its tables, a page and a summary."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
import math
from platform import python_version

import numpy as np
from piezo_ident import __version__
from piezo_ident.diagnosis.results import (
    Diagnosis,
    Errors,
    FORMULA,
    FoundEffect,
    FoundParameter,
    Unexplained,
)
from piezo_ident.effects import find_effect
from piezo_ident.model import metrics
from piezo_ident.model.multi_axis import EachAxis
from piezo_ident.report.html import Box, named, Page, page_text, pairs, Section, Shown
from piezo_ident.report.refined import law_told
from piezo_ident.report.table import (
    FAULTS,
    length,
    listed,
    number,
    origin_tables,
    share_text,
    Table,
    table,
)
from piezo_ident.uncertainty.weights import NONE, NOTHING

#: columns of every table of errors
STATES = ('as given', 'H refitted', 'refined')
#: beginning of the source of an unknown noise floor
UNKNOWN = 'floor unknown: '
#: candidates in a summary, at most
CANDIDATES = 6
#: sign and length of the bar of a weight of one, and smallest weight that is shown
BAR, BARS, LEAST_WEIGHT = '█', 40, 0.005
FOOTER = (
    'Every error is of a free run, never of one-step prediction. Base model: Gu, Li, Zhu and Su, '
    'IEEE/ASME Trans. Mechatronics 21(3), 2016, doi:10.1109/TMECH.2015.2465868. The folder of '
    'this page also holds model.yaml (the refined model), diagnosis.json and the pictures.'
)


def headline(result: Diagnosis) -> str:
    """Tell the errors on records that took no part, and the verdict in words."""
    texts = [
        f'On {x.record}, which took no part, the model as given errs by {number(x.before)} % of '
        f'stroke, the refined one by {number(x.after)} %.'
        for x in result.unseen
    ]
    return ' '.join([*texts, result.sentence])


def _states(result: Diagnosis) -> list[tuple[str, Errors]]:
    """List the errors to compare; a refined model that refits H alone is the refitted one."""
    states = zip(STATES, (result.before, result.refit, result.after), strict=True)
    return [*states][:: 2 if result.verdict == 'refitted' else 1]


def error_table(result: Diagnosis) -> Table:
    """List the errors before and after: overall, by segment and by frequency of a sine."""
    names, states = zip(*_states(result), strict=True)

    def row(name: str, values: list[float]) -> tuple[str, ...]:
        ratio = values[0] / values[-1] if values[-1] > 0.0 else math.nan
        return (name, *map(number, values), number(ratio, 2))

    # rests and ramps come last
    labels = sorted(
        result.before.by_segment, key=lambda x: x.partition(':')[0] in ('idle', 'ramp')
    )
    frequencies = sorted(result.before.by_frequency, key=float)
    rows = [row('overall', [s.overall for s in states])]
    rows += [row(x, [s.by_segment.get(x, math.nan) for s in states]) for x in labels]
    for f in frequencies:
        values = [s.by_frequency.get(f, math.nan) for s in states]
        rows.append(row(f'sines of {float(f):g} Hz', values))
    note = f'{FORMULA}.'
    if len(names) > 2:
        note += (
            ' H refitted: the same model with its hysteresis and offsets fitted to these data and '
            f'nothing added; {result.blocks} blocks were predicted in turn from the others.'
        )
    return Table('Errors in % of stroke', ('', *names, 'times smaller'), rows, note)


def unseen_tables(result: Diagnosis) -> list[Table]:
    """List the errors on records that took no part, if there are any."""
    rows: list[tuple[str, ...]] = []
    for x in result.unseen:
        errors = (x.before, x.after, x.before_centred, x.after_centred)
        rows.append((x.record, *map(number, errors), str(x.n)))
        rows += [
            (f'{x.record}, {f:g} Hz', number(before), number(after), '', '', '')
            for f, before, after in x.sines
        ]
    return table(
        'Records that took no part, errors in % of stroke',
        ('', STATES[0], STATES[2], f'{STATES[0]}, no mean', f'{STATES[2]}, no mean', 'samples'),
        rows,
        f'{metrics.FORMULA}. No mean: the mean of the error is subtracted, as a sensor may have '
        'been set to zero between two records. Sines: steady state.',
    )


def parameter_rows(result: Diagnosis) -> list[tuple[str, ...]]:
    """List effect, parameter, value with its uncertainty, unit and meaning."""
    rows: list[tuple[str, ...]] = []
    for effect in result.effects:
        meaning = {p.name: p.description for p in find_effect(effect.name).parameters}
        rows += [
            (effect.name, name, value_text(p), p.unit, meaning.get(name, ''))
            for name, p in effect.parameters.items()
        ]
    return rows


def value_text(parameter: FoundParameter) -> str:
    """Format a value, or a list of them, with the uncertainty of each."""
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
        'displacement. ±: standard deviation of a fitted parameter.'
    )
    timed = [e.name for e in result.effects if find_effect(e.name).time_driven]
    if timed:
        note += (
            f' {", ".join(timed)}: values of the longest record. An effect of time differs '
            'between records; the refined model carries its expected size in another record.'
        )
    head = ('effect', 'parameter', 'unit', '', 'value')
    # lists are long, and the last column wraps
    rows = [
        (effect, name, unit, about, x) for effect, name, x, unit, about in parameter_rows(result)
    ]
    return table('Parameters', head, rows, note)


def facts(result: Diagnosis) -> list[tuple[str, str]]:
    """List the few numbers that stand beside the verdict."""
    return [
        ('verdict', result.verdict.replace('_', ' ')),
        ('model', ', '.join(result.changes) or 'stays as given'),
        *((name, f'{number(e.overall)} % of stroke') for name, e in _states(result)),
        *(('another record', p.told) for p in [result.promise] if p and not result.unseen),
        ('added', ', '.join(e.name for e in result.effects) or 'nothing'),
        ('unexplained', f'{number(result.unexplained.rms_percent)} % of stroke'),
    ]


def remains(result: Diagnosis) -> list[tuple[str, str]]:
    """List the remaining error, its validity, H, noise, and the detectable size."""
    left, smallest, floor = result.unexplained, result.smallest_detectable, result.noise_floor
    source = result.noise_source.removeprefix(UNKNOWN)
    rest = f': {left.description}' if left.description else ''
    noise = 'unknown' if floor is None else f'{number(floor)} % of stroke, rms of single samples'
    size = f'{number(left.rms_percent)} % of stroke'
    rows = [
        # a share is known only beside an effect
        ('unexplained', (_share_and_size(left) if result.effects else size) + rest),
        ('error holds', _stands_for(result)),
        *(('hysteresis', text) for text in law_told(result)),
        ('noise floor', f'{noise} ({source})'),
    ]
    if smallest is not None:
        rows.append(('detectable', f'effects from {number(smallest)} % of stroke rms'))
    return rows


def _stands_for(result: Diagnosis) -> str:
    """Describe the motions for which the error of the refined model holds."""
    if not result.kinds:
        return 'for similar motion alone: parts were predicted from the rest of these data'
    kinds = listed(result.kinds)
    return f'for motion of these kinds, each predicted from the others: {kinds}'


def _share_and_size(part: FoundEffect | Unexplained) -> str:
    return (
        f'{share_text(part.share)} of the explainable part, {number(part.rms_percent)} % of stroke'
    )


def _added(result: Diagnosis) -> list[str]:
    return [f'added: {x.name} (slot: {x.slot}), {_share_and_size(x)}' for x in result.effects]


def _alike(result: Diagnosis) -> list[str]:
    if result.group is None:
        return []
    names = ', '.join(result.group.names)
    hide = '' if result.effects else ', which may hide in the base model'
    return [names + hide, f'an experiment that would: {result.group.separating_experiment}']


def _candidate_tables(result: Diagnosis, most: int | None = None) -> list[Table]:
    rows = [(c.name, share_text(c.share), c.why_not) for c in result.candidates]
    title, n = 'Candidates that were not added', len(rows)
    if most is not None and n > most:
        title, rows = f'{title}, the first {most} of {n}', rows[:most]
    note = 'Share: part of the error, with the best hysteresis, that the candidate removes alone.'
    return table(title, ('effect', 'share', 'why not'), rows, note)


def _weight_tables(result: Diagnosis) -> list[Table]:
    rows = [
        (name.replace('+', ' and '), share_text(w), BAR * round(BARS * w))
        for name, w in result.weights.items()
        if w >= LEAST_WEIGHT or name == NOTHING
    ]
    note = f'From kinds of motion held out; the prior of no change is {share_text(NONE)}.'
    return table('Weight of each cause', ('cause', 'weight', ''), rows, note)


def _untestable_tables(result: Diagnosis) -> list[Table]:
    rows = [(x.name, x.needs) for x in result.untestable]
    return table('What these data cannot test', ('effect', 'needs'), rows)


def _fault_tables(result: Diagnosis) -> list[Table]:
    rows = [(x.name, str(x.count), x.where, x.action) for x in result.faults]
    return table('Faults in the data', FAULTS, rows)


def diagnosis_page(
    result: Diagnosis,
    pictures: Sequence[Shown] = (),
    left_out: Sequence[tuple[str, str]] = (),
    candidates: int | None = None,
) -> Page:
    """
    Make the page.

    `left_out` holds titles of missing pictures, with reasons; `candidates` limits their table.
    """
    warnings = list(result.warnings)
    if result.faults:
        warnings.append('the data had faults, see the table near the end')
    versions = {'piezo_ident': __version__, 'python': python_version(), 'numpy': np.__version__}
    origin = origin_tables(asdict(result.settings), 'the whole catalogue', versions)
    errors: list[Shown | Table] = [
        *named(pictures, 'errors'),
        error_table(result),
        *unseen_tables(result),
    ]
    traces = named(pictures, 'residual', 'signature', 'spectrum', 'coherence')
    refined = ', '.join(result.changes) or 'the same as the given model'
    added: list[str | Table] = [
        *_added(result),
        *_parameter_tables(result),
        f'Refined model: {refined}.',
    ]
    remain = [
        Table('Rest', ('', ''), remains(result)),
        *_untestable_tables(result),
        *_fault_tables(result),
    ]
    tried = _weight_tables(result) + _candidate_tables(result, candidates)
    return Page(
        title='Diagnosis of a piezo stage',
        source=', '.join(result.records),
        headline=headline(result),
        facts=facts(result),
        before=(
            Box('warnings', 'Warnings', warnings),
            Box('missing', 'These data cannot tell apart', _alike(result)),
        ),
        sections=(
            Section('Error before and after', errors, brief=True),
            Section('The residual before and after', traces),
            Section('Effects that were found', added, brief=True),
            Section('Candidates', tried, brief=True),
            Section('Remaining error', remain, brief=True),
            Section('Origin', origin),
        ),
        after=(Box('missing', 'Pictures that these data do not allow', pairs(left_out)),),
        footer=FOOTER,
    )


def diagnosis_text(result: Diagnosis | EachAxis[Diagnosis]) -> str:
    """Write verdict, errors before and after, and the effects tried, for a terminal."""
    if isinstance(result, EachAxis):
        return result.told(diagnosis_text)
    return page_text(diagnosis_page(result, candidates=CANDIDATES), result.warnings)


def brief_table(result: Diagnosis) -> Table:
    """List facts and warnings for a notebook."""
    warnings = [('warning', warning) for warning in result.warnings]
    return Table('Diagnosis', ('', ''), [*facts(result), *remains(result)[1:], *warnings])
