# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The sentence of a diagnosis and its warnings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from piezo_ident.diagnosis.criteria import LEAST_GAIN, LINEAR, SMALLEST_EFFECT, TUNED
from piezo_ident.diagnosis.refined_model import Refined, WANDERS
from piezo_ident.diagnosis.results import Class, Errors, Unexplained
from piezo_ident.diagnosis.rows import Rows
from piezo_ident.diagnosis.state import Added
from piezo_ident.diagnosis.verdict import Findings
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.record import Record
from piezo_ident.residual.noise_floor import NoiseFloor

#: share of the data that needs no word about the rest
NEARLY_ALL = 0.9


def left_over(findings: Findings, smallest: float | None, passes: float) -> str:
    """Return what the unexplained rest is."""
    if smallest is None:
        return (
            f'the voltage passes its range {passes:.1f} times, so nothing that is fitted could be '
            'tested; drive the range back and forth twice or more'
        )
    if findings.left < smallest:
        return f'less than these data can tell apart ({smallest:.2g} % of stroke)'
    if findings.keeps_given:
        return 'a refit of the hysteresis takes it here, which need not last or hold elsewhere'
    if findings.verdict == 'none':
        return 'no effect is claimed for what differs from one part of the data to another'
    if not findings.effects:
        return 'structure that no candidate of the catalogue accounts for'
    return 'structure that the effects added do not account for'


def part_searched(records: Sequence[Record], part: Sequence[Record]) -> str:
    """Return how much of the records was searched."""
    n, of = (sum(r.n for r in some) for some in (part, records))
    seconds, whole = (sum(r.duration for r in some) for some in (part, records))
    return (
        f'{n:,} of {of:,} samples were searched and fitted, the first {seconds:.4g} s of '
        f'{whole:.4g} s (--most-samples)'
    )


def part_judged(rows: Rows) -> list[str]:
    """Return how much of the data was judged, where that is not nearly all."""
    runs = zip(rows.runs, rows.keep, strict=True)
    seconds = sum(rows.m * int(keep.sum()) / run.piece.sample_rate for run, keep in runs)
    whole = sum(run.piece.n / run.piece.sample_rate for run in rows.runs)
    if seconds >= NEARLY_ALL * whole:
        return []
    return [
        f'{seconds:.3g} of {whole:.3g} s were judged: the rest follows from no known start, or '
        'holds faults; let a record begin at rest at the lowest voltage'
    ]


def warnings_of(
    given: StageModel,
    refined: Refined,
    findings: Findings,
    floor: NoiseFloor,
    bent: float,
    crept: float,
) -> list[str]:
    """
    Return what a user of the refined model must know.

    `bent` is the share of the explainable part that goes with a retuned G alone, and `crept` the
    most that crept on from before a record, % of stroke.
    """
    state = refined.state
    found = []
    if not floor.known:
        found.append(f'{floor.source}: every share counts the noise as unexplained')
    if not refined.is_given and np.any(np.abs(state.retuning) > TUNED):
        why = (
            f', and {100.0 * bent:.0f} % of what a refit of the hysteresis leaves goes with that '
            'alone: they were off at the identification, by an effect or for lack of fast motion, '
            'or they have changed since'
        )
        found.append(
            'the dynamics were retuned in the band that the data drive'
            f'{why if bent >= LEAST_GAIN else ""}'
        )
    if state.fading:
        found.append(
            f'the stage still crept from motion before a record, by up to {crept:.2g} % of '
            'stroke; this was fitted and is no part of any error. A free run of such a record '
            'estimates it from the early part; from the voltage alone nothing tells it'
        )
    found += [
        _of_time_driven(a, refined.h_is_given) for a in state.effects if a.effect.time_driven
    ]
    for shift in refined.shifts[refined.shifts != 0.0]:
        found.append(
            f'the zero of the displacement has moved by {1e6 * shift:.3g} um in a record; that is '
            'no part of any error, and the refined model keeps the zero of the given one'
        )
    (low, high), (least, most) = refined.model.scaling.range, given.scaling.range
    if low > least or high < most:
        # an H that stays as it was given was not
        what = 'the effects were fitted' if state.law is None else 'the hysteresis was refitted'
        found.append(
            f'{what} to {low:g} .. {high:g} V alone, and the refined model '
            f'holds there; the given one holds in {least:g} .. {most:g} V'
        )
    return found


def _of_time_driven(added: Added, h_is_given: bool) -> str:
    effect = added.effect
    is_off = all(effect.is_neutral(effect.elsewhere(values)) for values in added.values)
    kept = 'it switched off' if is_off else 'its mean'
    if added.name == WANDERS:
        kept = 'the gain of the given one'
    if h_is_given:
        kept = 'it switched off, and the hysteresis as it was given'
    return (
        f'{added.name} follows time and not the voltage: what was found holds in its own '
        f'record alone, so the refined model carries {kept}'
    )


def sentence(
    findings: Findings,
    errors: tuple[Errors, Errors, Errors],
    rest: Unexplained,
    smallest: float | None,
    is_given: bool,
    bent: float,
) -> str:
    """
    Return the verdict as a sentence.

    The errors are before, with the base refitted, and after; `smallest` is the smallest detectable
    effect [% of stroke], `is_given` says whether the model stays as it was given, and `bent` is
    as in `warnings_of`.
    """
    before, refit, after = (e.overall for e in errors)
    fall = f'the error on held-out data falls from {before:.3g} to {after:.3g} % of stroke'
    if is_given:
        why = 'other motion gains too little'
        if findings.may_follow_time:
            why = 'another record may know nothing of that'
        fall = f'{why}: the model stays as given ({before:.3g} % of stroke)'
    missed = 'what the model missed'
    if findings.of_refit and len(findings.effects) == 1:
        missed = 'what a refit of the hysteresis takes'
    elif findings.effects and not findings.of_refit and refit < 0.5 * before:
        # shares are of what a refit leaves: a sensor set to zero again is no effect
        missed = 'what a refit of the hysteresis leaves'
        fall += '' if is_given else f', with the refit alone to {refit:.3g} %'
    share = f'{100.0 * findings.share:.0f} % of {missed}'
    names = ' and '.join(name.replace('_', ' ') for name in findings.effects)
    was, explains = ('was', 'explains') if len(findings.effects) == 1 else ('were', 'explain')
    tail = '' if is_given else f'; after a refit of the hysteresis {fall}'
    gains = before > np.hypot(refit, SMALLEST_EFFECT)
    if is_given and gains and not findings.keeps_given:
        tail = (
            f'; a refit of the hysteresis lowers the error from {before:.3g} to {refit:.3g} % of '
            'stroke here, and need not hold elsewhere, so the model stays as given'
        )
    if findings.verdict == 'named':
        text = f'{names} {explains} {share}; {fall}.'
    elif findings.verdict == 'class':
        text = f'{_or(findings.group)}: these data do not tell which; {names} {was} added and '
        text += f'{explains} {share}; {fall}.'
    elif findings.verdict == 'partly_explained':
        text = (
            f'{names} {explains} {share}, {rest.rms_percent:.2g} % of stroke stays unexplained; '
        )
        text += f'{fall}.'
        if findings.group:
            text += f' Whether it is {_or(findings.group)}, these data do not tell.'
    elif findings.verdict == 'refitted':
        text = f'the hysteresis of the model is not that of these data: refitted alone, {fall}.'
        if bent >= LINEAR:
            text = (
                'the hysteresis and the dynamics of the model are not those of these data: '
                f'refitted, with no effect added, {fall}.'
            )
        if is_given:
            text = (
                'the hysteresis of the model is not that of these data: a refit lowers the error '
                f'on held-out data from {before:.3g} to {refit:.3g} % of stroke. It gains too '
                'little on the whole record or on other motion, or knows where loops were and not '
                'what they look like, so the model stays as given.'
            )
    elif findings.verdict == 'unexplained':
        why = ' that no candidate explains: unexplained'
        if findings.keeps_given and findings.group:
            why = f', most of it by a gain that is {findings.gain:.4g} times what it was'
        elif findings.keeps_given:
            why = (
                f': a refit of the hysteresis leaves {refit:.3g} % of these data, but does not '
                'hold on motion held out'
            )
        elif smallest is None:
            why = f', unexplained: {rest.description}'
        text = f'The model misses {rest.rms_percent:.2g} % of stroke{why}{tail}.'
    elif smallest is None:
        text = f'{rest.description}{tail}.'
    elif rest.rms_percent >= smallest:
        text = f'No effect shows: the {rest.rms_percent:.2g} % of stroke that are left differ '
        text += f'from one part of the data to another{tail}.'
    else:
        text = 'No effect is missing that these data could show; the smallest would be '
        text += f'{smallest:.2g} % of stroke{tail}.'
    if findings.group and not findings.effects:
        hidden = _or(findings.group).capitalize()
        text += f' {hidden} may hide in the base model, and these data do not tell.'
    return text[0].upper() + text[1:]


def _or(group: Class | None) -> str:
    *most, last = (name.replace('_', ' ') for name in (group.names if group else ('',)))
    return f'{", ".join(most)} or {last}' if most else last
