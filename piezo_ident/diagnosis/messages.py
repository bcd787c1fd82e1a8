# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Word the sentence of a diagnosis and its warnings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from piezo_ident.diagnosis.criteria import SMALLEST_EFFECT
from piezo_ident.diagnosis.refined_model import Refined
from piezo_ident.diagnosis.results import Diagnosis
from piezo_ident.diagnosis.rows import Rows
from piezo_ident.diagnosis.simulator import Simulator
from piezo_ident.diagnosis.state import Added, WANDERS
from piezo_ident.diagnosis.verdict import Findings
from piezo_ident.effects import find_effect
from piezo_ident.record.record import Record
from piezo_ident.residual.noise_floor import NoiseFloor

#: share of the data that must be judged; a smaller share causes a warning
NEARLY_ALL = 0.9
#: retuning of G that causes a warning: samples of delay, or a share of the fast motion
TUNED = 0.05


def left_over(findings: Findings, smallest: float | None, passes: float) -> str:
    """Describe the unexplained error."""
    if smallest is None:
        return (
            f'the voltage passes its range {passes:.1f} times, so no effect could be '
            'tested; drive the range back and forth twice or more'
        )
    if findings.left < smallest:
        return f'less than these data can tell apart ({smallest:.2g} % of stroke)'
    if findings.verdict == 'none':
        return 'no effect is claimed for what differs from one part of the data to another'
    if not findings.effects:
        return 'structure that no candidate of the catalogue accounts for'
    return 'structure that the effects added do not account for'


def part_searched(records: Sequence[Record], part: Sequence[Record]) -> str:
    """Say which part of the records was searched."""
    n, of = (sum(r.n for r in some) for some in (part, records))
    seconds, whole = (sum(r.duration for r in some) for some in (part, records))
    return (
        f'{n:,} of {of:,} samples were searched and fitted, the first {seconds:.4g} s of '
        f'{whole:.4g} s (--most-samples)'
    )


def part_judged(rows: Rows) -> list[str]:
    """Say which part of the data was judged; empty if it is nearly all."""
    runs = zip(rows.runs, rows.keep, strict=True)
    seconds = sum(rows.m * int(keep.sum()) / run.piece.sample_rate for run, keep in runs)
    whole = sum(run.piece.n / run.piece.sample_rate for run in rows.runs)
    if seconds >= NEARLY_ALL * whole:
        return []
    return [
        f'{seconds:.3g} of {whole:.3g} s were judged: the rest follows from no known start, or '
        'holds faults; let a record begin at rest at the lowest voltage'
    ]


def warnings_of(simulator: Simulator, refined: Refined, floor: NoiseFloor) -> list[str]:
    """List the warnings for a user of the refined model."""
    state, given = refined.state, simulator.model
    found = []
    if not floor.known:
        found.append(f'{floor.source}: every share counts the noise as unexplained')
    if not refined.is_given and np.any(np.abs(state.retuning) > TUNED):
        found.append(
            'the dynamics were retuned in the band that the data drive: they were off at the '
            'identification, or they have changed since'
        )
    if state.fading:
        crept = simulator.rows.percent(float(np.max(simulator.crept(state) ** 2)))
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
            f'the zero of the displacement has moved by {1e6 * shift:.3g} um in a record; no '
            'error counts this shift, and the refined model keeps the zero of the given one'
        )
    (low, high), (least, most) = refined.model.scaling.range, given.scaling.range
    if low > least or high < most:
        # an H that stays as given was not fitted
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
    if h_is_given and is_off:
        kept = 'it switched off, and the hysteresis as it was given'
    return (
        f'{added.name} follows time and not the voltage: what was found holds in its own '
        f'record alone, so the refined model carries {kept}'
    )


def sentence(result: Diagnosis) -> str:
    """Word the finding, the fate of the model, and the questions that the data leave open."""
    outcome = _outcome(result)
    texts = ['; '.join(filter(None, (_finding(result), outcome)))]
    if result.group and not result.effects:
        hidden = _or(result.group.names)
        texts.append(f'{hidden} may hide in that hysteresis, and these data do not tell')
    elif result.group and result.verdict == 'partly_explained':
        texts.append(f'whether it is {_or(result.group.names)}, these data do not tell')
    # a measured error on an unseen record says more than a promise
    if result.promise and not result.unseen:
        texts.append(f'another record will show {result.promise.told}')
    if result.outside:
        low, high = result.given.scaling.range
        texts.append(
            f'{100.0 * result.outside:.2g} % of the samples lie outside {low:g} .. {high:g} V, '
            'where the model as given is an extrapolation'
        )
    return ' '.join(f'{text[0].upper()}{text[1:]}.' for text in texts)


def _finding(result: Diagnosis) -> str:
    """Word the verdict."""
    rest, smallest = result.unexplained, result.smallest_detectable
    if result.effects:
        explained = _explained(result)
        if result.verdict == 'class' and result.group:
            return f'{_or(result.group.names)}, these data do not tell which: {explained}'
        if result.verdict == 'partly_explained':
            return f'{explained}, {rest.rms_percent:.2g} % of stroke stays unexplained'
        return explained
    if result.verdict == 'refitted':
        if result.gain:
            share, gain = 100.0 * result.gain.share, result.gain.value
            return (
                f'the gain is {gain:.4g} times that of the model, which explains {share:.0f} % of '
                'what the model missed'
            )
        return 'the hysteresis of the model is not that of these data'
    if result.verdict == 'unexplained':
        return f'{rest.rms_percent:.2g} % of stroke stays unexplained: {rest.description}'
    if smallest is None:
        return rest.description
    if rest.rms_percent >= smallest:
        return (
            f'no effect shows: the {rest.rms_percent:.2g} % of stroke that are left differ from '
            'one part of the data to another'
        )
    return (
        'no effect is missing that these data could show; the smallest would be '
        f'{smallest:.2g} % of stroke'
    )


def _explained(result: Diagnosis) -> str:
    """Say which effects explain which share of the error."""
    missed = 'what the model missed'
    if not result.set_in and result.refit.overall < 0.5 * result.before.overall:
        # shares then refer to the error of a refit: a sensor that was zeroed again is no effect
        missed = 'what a refit of the hysteresis leaves'
    names = ' and '.join(effect.name.replace('_', ' ') for effect in result.effects)
    explains = 'explains' if len(result.effects) == 1 else 'explain'
    share = 100.0 * (1.0 - result.unexplained.share)
    # a line found by its own test may explain less than 1 % of the error
    return f'{names} {explains} {share:{".0f" if share >= 1.0 else ".1g"}} % of {missed}'


def _outcome(result: Diagnosis) -> str:
    """Say whether the model changed, and how its error fell; may be empty."""
    before, refit, after = (e.overall for e in (result.before, result.refit, result.after))
    if result.changes:
        fall = f'the error on held-out data falls from {before:.3g} to {after:.3g} % of stroke'
        if any(find_effect(effect.name).time_driven for effect in result.effects):
            fall += ' in these records alone'
        if not result.effects:
            what = 'with that gain' if result.gain else 'after a refit of the hysteresis'
            return f'{what} {fall}'
        is_larger = not result.set_in and refit < 0.5 * before
        # the refined model is judged on other motion, and may err more than the refit
        easier = ' of blocks between those fitted' if refit < after else ''
        return f'{fall}, with a refit alone to {refit:.3g} %{easier}' if is_larger else fall
    if before > np.hypot(refit, SMALLEST_EFFECT):
        return (
            f'a refit of the hysteresis leaves {refit:.3g} % of blocks between those fitted, but '
            f'not of other motion, so the model stays as given ({before:.3g} % of stroke)'
        )
    return ''


def _or(names: Sequence[str]) -> str:
    *most, last = (name.replace('_', ' ') for name in names)
    return f'{", ".join(most)} or {last}' if most else last
