# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The findings put together: refined model, errors before and after, parameters and words."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
from piezo_ident.diagnosis.errors_of import errors_of, held_out_residual, row_noise
from piezo_ident.diagnosis.fit import Fitted
from piezo_ident.diagnosis.results import (
    Diagnosis,
    DiagnosisSettings,
    FoundEffect,
    FoundParameter,
    Residual,
)
from piezo_ident.diagnosis.rows import Rows
from piezo_ident.diagnosis.scatter import refit_holds
from piezo_ident.diagnosis.search import Round
from piezo_ident.diagnosis.simulator import Added, Simulator, State
from piezo_ident.diagnosis.verdict import (
    candidates_of,
    Findings,
    percent,
    smallest_taken,
    untestable_of,
)
from piezo_ident.diagnosis.whole import Whole
from piezo_ident.effects import find_effect
from piezo_ident.model.stage_model import StageModel
from piezo_ident.residual.faults import FaultSearch
from piezo_ident.residual.floor import NoiseFloor

__all__ = ['assemble']

#: held-out gain of the refitted base below which the model stays as it was given
WORTH_REFIT = 0.05
#: the same where structure stays unexplained: a refit that only bends H towards it helps nobody
WORTH_IN_DOUBT = 0.5
#: retuning of G that is worth a word: samples of delay, or a share of the fast motion
TUNED = 0.05
#: a weight below this is left out of the refined model, normalised
NOTHING = 1e-9
#: share of the given range that records must cover for a refitted H to hold in all of it
COVERED = 0.95


def assemble(
    simulator: Simulator,
    given: State,
    base: Fitted,
    fitted: Fitted,
    rounds: Sequence[Round],
    taken: Sequence[Round],
    findings: Findings,
    floor: NoiseFloor,
    noise: float,
    faults: FaultSearch,
    settings: DiagnosisSettings,
    *,
    fits: Whole | None = None,
    is_long: bool = False,
    searched: Collection[str] = (),
) -> Diagnosis:
    """
    Return the diagnosis.

    Parameters
    ----------
    simulator : Simulator
    given : State
        The model as it was given.
    base, fitted : Fitted
        Refitted without and with what was found.
    rounds, taken : sequence of Round
        All, and those whose best contender was added.
    findings : Findings
    floor : NoiseFloor
    noise : float
        Mean square of the noise of a row.
    faults : FaultSearch
    settings : DiagnosisSettings
    fits : Whole, optional
        Fits to whole records, of which all the rest is about the beginnings: errors, parameters
        and model are theirs, shares and pictures those of the beginnings.
    is_long : bool, optional
        Whether the records are longer than what the rest is about.
    searched : collection of str, optional
        Effects that were looked for by other means than a fit.
    """
    rows, model = simulator.rows, simulator.model
    span = abs(model.scaling.Y)
    rms = None if not floor.known else max(floor.rms or 0.0, faults.quantum / np.sqrt(12.0))
    e_given = rows.x - simulator.run(given)
    judged = fits or Whole(simulator, e_given, base, fitted)
    # what single samples have more of noise than rows
    of_row = row_noise(floor, faults, judged.simulator.rows.m, span)
    lost = 0.0 if rms is None else max((rms / span) ** 2 - of_row, 0.0)
    before, refit, after = (
        errors_of(judged.simulator.rows, e, lost)
        for e in (
            judged.e,
            held_out_residual(judged.simulator.rows, judged.base),
            held_out_residual(judged.simulator.rows, judged.fitted),
        )
    )
    lasting = [name for name in findings.effects if not find_effect(name).time_driven]
    worth = WORTH_IN_DOUBT if findings.verdict == 'unexplained' else WORTH_REFIT
    if not findings.effects and (
        is_long
        or refit.overall > (1.0 - worth) * before.overall
        or not refit_holds(rows, e_given, base)
    ):
        # nor does a beginning know how H goes on
        state, refined, after = given, model, before
    elif findings.effects and not lasting:
        # H was refitted beside a drift that another record will not repeat
        state = fitted.state
        silent = replace(given, effects=_silenced(state.effects))
        refined = _refined(simulator, silent, findings, model.scaling.range)
    else:
        state = judged.fitted.state
        refined = _refined(judged.simulator, state, findings, _range(judged.simulator))
    full = [simulator.full(s) for s in (given, base.state, state)]
    residuals = tuple(
        Residual(
            run.record,
            run.piece,
            given=(run.x - full[0][i]) * model.scaling.Y,
            before=(run.x - full[1][i]) * model.scaling.Y,
            after=(run.x - full[2][i]) * model.scaling.Y,
            sound=run.known,
        )
        for i, run in enumerate(rows.runs)
    )
    effects = _effects(rows, base, fitted, taken, findings, noise, judged)
    smallest = smallest_taken(rows, base, fitted, rounds, taken, noise)
    rest = replace(findings.unexplained, description=_rest(findings, smallest, rows.passes))
    bent = base.mean_square - rounds[0].before.mean_square
    warnings = _warnings(
        state, findings, lasting, floor, bent / max(base.mean_square - noise, 1e-300)
    )
    (low, high), (least, most) = refined.scaling.range, model.scaling.range
    if low > least or high < most:
        warnings += (
            f'the hysteresis was refitted to {low:g} .. {high:g} V alone, and the refined model '
            f'holds there; the given one holds in {least:g} .. {most:g} V',
        )
    result = Diagnosis(
        verdict=findings.verdict,
        sentence='',
        given=model,
        model=refined,
        effects=effects,
        group=findings.group,
        unexplained=rest,
        candidates=candidates_of(rows, rounds, findings, noise),
        before=before,
        refit=refit,
        after=after,
        noise_floor=None if rms is None else 100.0 * rms / (rows.stroke * span),
        noise_source=floor.source,
        smallest_detectable=smallest,
        untestable=untestable_of(
            rounds, settings, {*searched, *(setting.name for setting in model.effects)}
        ),
        faults=faults.faults,
        residuals=residuals,
        records=rows.names,
        blocks=int(rows.fold.size),
        warnings=warnings,
        settings=settings,
    )
    return replace(result, sentence=_sentence(result, findings))


def _range(simulator: Simulator) -> tuple[float, float]:
    """Return the voltages between which an H refitted to the rows holds."""
    pieces = [run.piece for run in simulator.rows.runs]
    low, high = min(float(p.v.min()) for p in pieces), max(float(p.v.max()) for p in pieces)
    least, most = simulator.model.scaling.range
    # plays of larger thresholds than what was driven have no weight any more
    if high - low < COVERED * (most - least):
        return low, high
    return min(least, low), max(most, high)


def _refined(
    simulator: Simulator, state: State, findings: Findings, span: tuple[float, float]
) -> StageModel:
    """Return the model of a state, in the record that holds the most rows, and its range."""
    rows = simulator.rows
    k = int(np.bincount(rows.of_record, minlength=len(rows.names)).argmax())
    h = state.hysteresis
    alive = h.weights > NOTHING
    slim = replace(h, thresholds=h.thresholds[alive], weights=h.weights[alive])
    kept = tuple(_lasting(added) for added in state.effects)
    model = simulator.model_of(replace(state, hysteresis=slim, effects=kept), k)
    scaling = model.scaling
    moved = replace(scaling, y0=scaling.y0 + float(state.offsets[k]) * scaling.Y, range=span)
    story = dict(model.identification)
    story['diagnosis'] = {
        'verdict': findings.verdict,
        'effects': list(findings.effects),
        'records': list(rows.names),
    }
    return replace(model, scaling=moved, identification=story)


def _lasting(added: Added) -> Added:
    """Return an effect as the model keeps it: what belongs to one record is left out."""
    if not added.effect.time_driven:
        return added
    return Added(added.name, tuple(added.effect.elsewhere(values) for values in added.values))


def _is_off(added: Added) -> bool:
    """Return whether nothing is left of an effect in another record."""
    effect = added.effect
    return all(effect.is_neutral(effect.elsewhere(values)) for values in added.values)


def _silenced(effects: Sequence[Added]) -> tuple[Added, ...]:
    """Return effects with all amplitudes at nothing."""
    return tuple(
        Added(added.name, tuple(added.effect.neutral(values) for values in added.values))
        for added in effects
    )


def _effects(
    rows: Rows,
    base: Fitted,
    fitted: Fitted,
    taken: Sequence[Round],
    findings: Findings,
    noise: float,
    judged: Whole,
) -> tuple[FoundEffect, ...]:
    explainable = max(base.mean_square - noise, 1e-300)
    std = _deviations(judged.simulator.rows, judged.fitted)
    longest = int(np.bincount(judged.simulator.rows.of_record).argmax())
    found = []
    level = base.mean_square
    for i, name in enumerate(findings.effects):
        last = i == len(findings.effects) - 1
        after = (fitted if last else taken[i].contenders[0].fitted).mean_square
        gain = max(level - after, 0.0)
        level = after
        added = judged.fitted.state.effects[i]
        parameters = {}
        for p in added.effect.parameters:
            value = added.values[longest][p.name]
            spread = [
                std.get((i, k, p.name, index))
                for index in (range(np.size(value)) if p.vector else [None])
                for k in ([longest] if (i, longest, p.name, index) in std else [None])
            ]
            numbers = tuple(0.0 if s is None else s for s in spread)
            known = any(s is not None for s in spread)
            parameters[p.name] = FoundParameter(
                value=_plain(value),
                unit=p.unit,
                std=None if not known else numbers if p.vector else numbers[0],
            )
        found.append(
            FoundEffect(
                name=name,
                slot=find_effect(name).slot,
                share=float(np.clip(gain / explainable, 0.0, 1.0)),
                rms_percent=percent(rows, gain),
                parameters=parameters,
            )
        )
    return tuple(found)


def _plain(value: object) -> float | str | tuple[float, ...]:
    if isinstance(value, str):
        return value
    array = np.asarray(value, dtype=np.float64)
    return tuple(float(x) for x in array) if array.ndim else float(array)


def _deviations(
    rows: Rows, fitted: Fitted
) -> dict[tuple[int | None, int | None, str, int | None], float]:
    """Return the standard deviation of each handle; neighbouring rows count once a block."""
    M = fitted.J[:, fitted.free]
    size = np.linalg.norm(M, axis=0)
    A = M.T @ M / np.outer(size, size)
    A[np.diag_indices_from(A)] += 1e-10
    # sandwich over blocks: what one block pulls is one observation, however many rows it has
    pull = np.stack(
        [
            M[start:stop].T @ fitted.e[start:stop] / size
            for start, stop in zip(rows.edges[:-1], rows.edges[1:], strict=True)
        ]
    )
    inverse = np.linalg.pinv(A, hermitian=True)
    covariance = inverse @ (pull.T @ pull) @ inverse
    deviation = np.full(fitted.free.size, np.nan)
    deviation[fitted.free] = np.sqrt(np.maximum(np.diag(covariance), 0.0)) / size
    found = {}
    first = fitted.J.shape[1] - len(fitted.handles)
    for j, handle in enumerate(fitted.handles, start=first):
        if np.isfinite(deviation[j]):
            # of a logarithm, so relative
            factor = abs(handle.get(fitted.state)) if handle.logarithmic else 1.0
            key = (handle.effect, handle.record, handle.name, handle.index)
            found[key] = float(deviation[j]) * factor
    return found


def _rest(findings: Findings, smallest: float | None, passes: float) -> str:
    left = findings.unexplained.rms_percent
    if smallest is None:
        return (
            f'the voltage passes its range {passes:.1f} times, so nothing that is fitted could be '
            'tested; drive the range back and forth twice or more'
        )
    if left < smallest:
        return f'less than these data can tell apart ({smallest:.2g} % of stroke)'
    if not findings.effects:
        return 'structure that no candidate of the catalogue accounts for'
    return 'structure that the effects added do not account for'


def _warnings(
    state: State, findings: Findings, lasting: Sequence[str], floor: NoiseFloor, bent: float
) -> tuple[str, ...]:
    said = []
    if not floor.known:
        said.append(f'{floor.source}: every share counts the noise as unexplained')
    if lasting and np.any(np.abs(state.retuning) > TUNED):
        said.append(
            f'the dynamics were retuned along with the effect, and {100.0 * max(bent, 0.0):.0f} % '
            'of what the model missed goes with that alone: the effect bent them at the '
            'identification, or they have changed since'
        )
    for added in state.effects:
        if not added.effect.time_driven:
            continue
        # beside a lasting effect the rest was fitted to the mean of what wanders
        kept = 'its mean' if lasting and not _is_off(added) else 'it switched off'
        if not lasting:
            kept += ' beside the hysteresis as it was given'
        said.append(
            f'{added.name} follows time and not the voltage: what was found holds in its own '
            f'record alone, so the refined model carries {kept}'
        )
    return tuple(said)


def _sentence(result: Diagnosis, findings: Findings) -> str:
    before, refit, after = result.before, result.refit, result.after
    errors = (
        f'the error on held-out data falls from {before.overall:.3g} to {after.overall:.3g} % of '
        'stroke'
    )
    names = ' and '.join(e.name.replace('_', ' ') for e in result.effects)
    rest = result.unexplained.rms_percent
    missed = 'what the model missed'
    if result.effects and refit.overall < (1.0 - WORTH_IN_DOUBT) * before.overall:
        # of which a share is told: a sensor set to zero anew is no effect
        missed = 'what a refit of the hysteresis leaves'
        errors += f', with the refit alone to {refit.overall:.3g} %'
    share = f'{100.0 * findings.share:.0f} % of {missed}'
    if result.verdict == 'named':
        verb = 'explains' if len(result.effects) == 1 else 'explain'
        return _capital(f'{names} {verb} {share}; {errors}.')
    if result.verdict == 'class' and result.group is not None:
        group = ' or '.join(n.replace('_', ' ') for n in result.group.names)
        return _capital(
            f'{group}: these data do not tell which; {names} was added and explains '
            f'{share}; {errors}.'
        )
    if result.verdict == 'partly_explained':
        return _capital(
            f'{names} explains {share}, {rest:.2g} % of stroke stays unexplained; {errors}.'
        )
    tail = f'; after a refit of the hysteresis {errors}' if after is not before else ''
    if result.verdict == 'unexplained':
        why = ' that no candidate explains: unexplained'
        if result.smallest_detectable is None:
            why = f', unexplained: {result.unexplained.description}'
        return f'The model misses {rest:.2g} % of stroke{why}{tail}.'
    if result.smallest_detectable is None:
        return _capital(f'{result.unexplained.description}{tail}.')
    return (
        'No effect is missing that these data could show; the smallest would be '
        f'{result.smallest_detectable:.2g} % of stroke{tail}.'
    )


def _capital(text: str) -> str:
    return text[0].upper() + text[1:]
