# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The tables of a diagnosis, as plain text cells, and what changed in the model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
import math
import sys

import numpy as np
from piezo_ident import __version__
from piezo_ident.diagnosis.results import Diagnosis, FORMULA, FoundParameter
from piezo_ident.effects import find_effect
from piezo_ident.model.stage_model import EffectSetting, StageModel
from piezo_ident.report.numbers import length, moves, number
from piezo_ident.report.tables import Table

__all__ = [
    'STATES',
    'UNKNOWN',
    'Unseen',
    'candidate_table',
    'changes',
    'diagnosis_facts',
    'error_rows',
    'error_tables',
    'fault_table',
    'parameter_rows',
    'parameter_table',
    'percent_of_explainable',
    'setting_tables',
    'unseen_table',
    'untestable_table',
]

#: columns of every table of errors
STATES = ('as given', 'H refitted', 'refined')
#: what a source that tells of no floor may begin with
UNKNOWN = 'floor unknown: '


@dataclass(frozen=True)
class Unseen:
    """
    Errors on a record that took no part in a diagnosis, % of its stroke.

    Attributes
    ----------
    record : str
    before, after : float
        Of the model as given and of the refined one; of a record that does not start at rest,
        behind the part from which its start is estimated.
    before_centred, after_centred : float
        The same without the mean of the error: a sensor may have been set to zero anew.
    n : int
        Samples judged.
    sines : tuple of (float, float, float)
        Frequency [Hz] and errors before and after, in steady state.
    """

    record: str
    before: float
    after: float
    before_centred: float
    after_centred: float
    n: int
    sines: tuple[tuple[float, float, float], ...] = ()


def percent_of_explainable(share: float) -> str:
    """Return a share of the explainable part as a percentage for people."""
    if not math.isfinite(share):
        return '–'
    return f'{100.0 * min(1.0, max(0.0, share)):.0f} %'


def changes(given: StageModel, refined: StageModel) -> tuple[str, ...]:
    """Return how a refined model differs from the one that it came from; empty if not at all."""
    found = []
    # a play without weight is none
    old, new = (
        np.concatenate([h.thresholds[h.weights > 0.0], h.weights[h.weights > 0.0], [h.p1, h.p2]])
        for h in (given.hysteresis, refined.hysteresis)
    )
    if not np.array_equal(old, new):
        found.append('H refitted')
    if given.scaling != refined.scaling:
        found.append('offset refitted')
    if given.delay != refined.delay:
        found.append('another delay')
    if not (
        np.array_equal(given.dynamics.a, refined.dynamics.a)
        and np.array_equal(given.dynamics.b, refined.dynamics.b)
    ):
        found.append('G retuned')
    before = [(e.name, _frozen(dict(e.parameters))) for e in given.effects]
    after = [(e.name, _frozen(dict(e.parameters))) for e in refined.effects]
    kept = {name for name, _ in before}
    found += [_with(e) for e in refined.effects if e.name not in kept]
    found += [f'{x[0]} refitted' for x in after if x[0] in kept and x not in before]
    gone = kept - {name for name, _ in after}
    return (*found, *(f'without {name}' for name in sorted(gone)))


def _with(added: EffectSetting) -> str:
    idle = find_effect(added.name).is_neutral(added.parameters)
    return f'with {added.name}{", switched off" if idle else ""}'


def _frozen(values: Mapping[str, object]) -> tuple[tuple[str, str], ...]:
    return tuple((k, repr(np.asarray(x).tolist())) for k, x in sorted(values.items()))


def error_rows(diagnosis: Diagnosis) -> tuple[list[tuple[str, ...]], ...]:
    """
    Return the errors overall, by segment and by frequency.

    Returns
    -------
    tuple of three lists of tuple of str
        Name, then as given, with H refitted, refined, and how many times smaller it became.
    """
    states = (diagnosis.before, diagnosis.refit, diagnosis.after)

    def row(name: str, values: list[float]) -> tuple[str, ...]:
        ratio = values[0] / values[2] if values[2] > 0.0 else math.nan
        return (name, *map(number, values), number(ratio, 2))

    # what rests or only moves over comes last
    labels = sorted(diagnosis.before.by_segment, key=lambda label: not moves(label))
    frequencies = sorted(diagnosis.before.by_frequency, key=float)
    return (
        [row('overall', [state.overall for state in states])],
        [row(x, [state.by_segment.get(x, math.nan) for state in states]) for x in labels],
        [
            row(f'{float(f):g} Hz', [state.by_frequency.get(f, math.nan) for state in states])
            for f in frequencies
        ],
    )


def error_tables(diagnosis: Diagnosis) -> list[Table]:
    """Return the errors before and after, by segment and by frequency, with their formula."""
    overall, segments, frequencies = error_rows(diagnosis)
    blocks = f'{diagnosis.blocks} blocks of data'
    note = (
        f'In % of stroke: {FORMULA}. H refitted: the same model with its hysteresis and offsets '
        f'fitted to these data and nothing added, held out likewise. {blocks} were predicted in '
        'turn from the others.'
    )
    head = (*STATES, 'times smaller')
    tables = [Table('By segment', ('', *head), (*overall, *segments), note)]
    if frequencies:
        tables.append(Table('By frequency of a sine', ('', *head), tuple(frequencies)))
    return tables


def unseen_table(unseen: Sequence[Unseen]) -> Table | None:
    """Return the errors on records that took no part; None without any."""
    rows: list[tuple[str, ...]] = []
    for x in unseen:
        centred = (number(x.before_centred), number(x.after_centred))
        rows.append((x.record, number(x.before), number(x.after), *centred, str(x.n)))
        rows += [
            (f'{x.record}, {f:g} Hz', number(before), number(after), '', '', '')
            for f, before, after in x.sines
        ]
    if not rows:
        return None
    return Table(
        'Records that took no part',
        ('', STATES[0], STATES[2], f'{STATES[0]}, no mean', f'{STATES[2]}, no mean', 'samples'),
        tuple(rows),
        'In % of stroke: 100 rms(y - y_hat) / (max y - min y), free run. No mean: without the '
        'mean of the error, as a sensor shows it that was set to zero anew. Sines: steady state.',
    )


def parameter_rows(diagnosis: Diagnosis) -> list[tuple[str, ...]]:
    """Return effect, parameter, value with its uncertainty, unit and meaning."""
    rows: list[tuple[str, ...]] = []
    for effect in diagnosis.effects:
        meaning = {p.name: p.description for p in find_effect(effect.name).parameters}
        rows += [
            (effect.name, name, value_text(found), found.unit, meaning.get(name, ''))
            for name, found in effect.parameters.items()
        ]
    return rows


def value_text(found: FoundParameter) -> str:
    """Return a value, or a list of them, with the uncertainty of each."""
    if isinstance(found.value, str):
        return found.value
    values = np.atleast_1d(np.asarray(found.value, dtype=np.float64)).tolist()
    std = [] if found.std is None else np.atleast_1d(found.std).tolist()
    if len(std) != len(values):
        std = [math.nan] * len(values)
    return ', '.join(
        number(x, 4) + (f' ± {number(e, 2)}' if e > 0.0 and math.isfinite(e) else '')
        for x, e in zip(values, std, strict=True)
    )


def parameter_table(diagnosis: Diagnosis) -> Table | None:
    """Return the parameters of the effects that were added; None without any."""
    rows = parameter_rows(diagnosis)
    if not rows:
        return None
    scaling = diagnosis.model.scaling
    note = (
        'In units of the normalised chain: 1 is the full span, '
        f'{number(scaling.V, 4)} V of the voltage or {length(abs(scaling.Y))} of the '
        'displacement. ±: standard deviation; no ± where a parameter was not moved.'
    )
    timed = [e.name for e in diagnosis.effects if find_effect(e.name).time_driven]
    if timed:
        note += (
            f' {", ".join(timed)}: of the longest record; such an effect follows time, so the '
            'refined model carries what can be expected of it in another one.'
        )
    return Table('Parameters', ('effect', 'parameter', 'value', 'unit', ''), tuple(rows), note)


def candidate_table(diagnosis: Diagnosis) -> Table | None:
    """Return the candidates that were not added and why; None without any."""
    rows = tuple(
        (c.name, percent_of_explainable(c.share), c.why_not) for c in diagnosis.candidates
    )
    if not rows:
        return None
    return Table(
        'Candidates that were not added',
        ('effect', 'share', 'why not'),
        rows,
        'Share of the explainable part of the residual that each explains when it is added alone.',
    )


def untestable_table(diagnosis: Diagnosis) -> Table | None:
    """Return the effects that these data cannot show; None without any."""
    rows = tuple((x.name, x.needs) for x in diagnosis.untestable)
    if not rows:
        return None
    return Table('What these data cannot test', ('effect', 'needs'), rows)


def fault_table(diagnosis: Diagnosis) -> Table | None:
    """Return what was wrong with the data; None when nothing was."""
    rows = tuple((x.name, str(x.count), x.where, x.action) for x in diagnosis.faults)
    if not rows:
        return None
    return Table('Faults in the data', ('fault', 'count', 'where', 'action'), rows)


def diagnosis_facts(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    """Return the few numbers that stand beside the verdict."""
    left = diagnosis.unexplained
    facts = [
        ('verdict', diagnosis.verdict.replace('_', ' ')),
        ('error as given', f'{number(diagnosis.before.overall)} % of stroke'),
        ('with H refitted', f'{number(diagnosis.refit.overall)} % of stroke'),
        ('refined', f'{number(diagnosis.after.overall)} % of stroke'),
        ('added', ', '.join(e.name for e in diagnosis.effects) or 'nothing'),
        (
            'unexplained',
            f'{percent_of_explainable(left.share)}, {number(left.rms_percent)} % of stroke',
        ),
        (
            'noise floor',
            'unknown'
            if diagnosis.noise_floor is None
            else f'{number(diagnosis.noise_floor)} % of stroke',
        ),
    ]
    if diagnosis.smallest_detectable is not None:
        said = f'{number(diagnosis.smallest_detectable)} % of stroke'
        facts.append(('smallest detectable', said))
    return facts


def setting_tables(diagnosis: Diagnosis) -> list[Table]:
    """Return the settings and the versions."""
    settings = asdict(diagnosis.settings)
    chosen = settings.pop('effects')
    rows = [('candidates', 'the whole catalogue' if chosen is None else ', '.join(chosen))]
    rows += [
        (name.replace('_', ' '), ', '.join(x) if isinstance(x, (tuple, list)) else str(x))
        for name, x in settings.items()
    ]
    versions = (
        ('piezo_ident', __version__),
        ('python', '.'.join(map(str, sys.version_info[:3]))),
        ('numpy', np.__version__),
    )
    return [
        Table('Settings', ('setting', 'value'), tuple((a, b or 'none') for a, b in rows)),
        Table('Versions', ('software', 'version'), versions),
    ]
