# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Diagnose a model: from measured data to the effect that the model lacks.

1. `rows` cuts the records into rows and blocks, and `simulator` runs the model over them.
   `base_residual` leaves faults of the data out and refits H.  The rest gives lines and the noise.
2. `candidates` fits each treatment of H and G, then with each effect, then with one more effect.
   `search` finds the effects of a round: `trial_scores` scores them, `joint_fit` fits the best.
3. `decision` takes a set of effects by ratios of errors on held-out data.
4. `refits` chooses the H of the refined model, by whole kinds of motion.
5. `verdict` judges, `refined_model` builds the model, and `messages` words the result.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from piezo_ident.common.errors import expect, IdentificationError
from piezo_ident.diagnosis.base_residual import base_residual, BaseResidual, prepared
from piezo_ident.diagnosis.candidates import CandidateSearch
from piezo_ident.diagnosis.decision import Candidates, decide, FittedSet
from piezo_ident.diagnosis.joint_fit import Fitted
from piezo_ident.diagnosis.messages import (
    left_over,
    part_judged,
    part_searched,
    sentence,
    warnings_of,
)
from piezo_ident.diagnosis.refined_model import found_effects, refine, Refined
from piezo_ident.diagnosis.refits import law_of, walk, with_numerator
from piezo_ident.diagnosis.results import Diagnosis, DiagnosisSettings, Errors, Residual
from piezo_ident.diagnosis.search import Round
from piezo_ident.diagnosis.simulator import Simulator
from piezo_ident.diagnosis.state import State, TESTED
from piezo_ident.diagnosis.verdict import (
    candidates_of,
    errors_of_laws,
    errors_of_sets,
    Findings,
    judge,
    smallest_detectable,
    untestable_of,
)
from piezo_ident.effects import catalogue
from piezo_ident.identification.prepare import same_rate
from piezo_ident.identification.settings import Progress, silent
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.readings.faults import without_faults
from piezo_ident.record.readings.quiet_voltage import with_quiet_voltage
from piezo_ident.record.readings.suspicions import suspicions
from piezo_ident.record.record import Record, records_of


def diagnose(
    model: StageModel,
    records: Sequence[Record] | Record,
    settings: DiagnosisSettings | None = None,
    *,
    progress: Progress = silent,
) -> Diagnosis:
    """Find the effects that a model of one axis lacks; see `piezo_ident.diagnose`."""
    settings = DiagnosisSettings() if settings is None else settings
    records = records_of(records, 'diagnose, second argument')
    expect(model, StageModel, 'diagnose, first argument', 'read a model with load')
    hint = 'make them with DiagnosisSettings(...), and give several records as one list'
    expect(settings, DiagnosisSettings, 'diagnose, settings', hint)
    if not records:
        raise IdentificationError('diagnose: no record was given; give one record, or a list')
    for record in records:
        record.require_displacement()
    measured = [without_faults(record) for record in records]
    quiet = [with_quiet_voltage(record) for record in measured]
    part = _beginnings(model, quiet, settings.most_samples)
    is_whole = part == quiet
    try:
        result = _diagnosed(model, part, settings, progress)
    except IdentificationError as error:
        if is_whole:
            raise
        raise IdentificationError(f'{error} ({part_searched(records, part)})') from None
    except np.linalg.LinAlgError as error:
        names = ', '.join(record.name for record in records)
        raise IdentificationError(
            f'{names}: a fit is singular ({error}); are all values of a plausible size?'
        ) from None
    warnings = [
        warning
        for record in measured
        for warning in (*suspicions(record), *model.extrapolation(record))
    ]
    if not is_whole:
        warnings.append(part_searched(records, part))
    # the reader has reported the faults that it found
    lost = (
        replace(fault, where=f'in {record.name}, {fault.where}')
        for record, sound in zip(records, measured, strict=True)
        for fault in sound.faults[len(record.faults) :]
    )
    pieces = [piece for record in records for piece in record]
    outside = sum(int(model.outside(p.v).sum()) for p in pieces) / sum(p.n for p in pieces)
    result = replace(
        result,
        faults=(*lost, *result.faults),
        warnings=(*result.warnings, *warnings),
        outside=outside,
    )
    return replace(result, sentence=sentence(result))


def _beginnings(model: StageModel, records: Sequence[Record], most: int) -> list[Record]:
    """Cut records to their beginnings, in proportion to their lengths, to `most` samples."""
    # creep and hysteresis depend on earlier motion, so a part begins where its record begins
    usable = [
        (record, [p for p in record if same_rate(p.sample_rate, model.sample_rate)])
        for record in records
    ]
    total = sum(p.n for _, pieces in usable for p in pieces)
    if total <= most:
        return list(records)
    part = []
    for record, pieces in usable:
        left = max(1, sum(p.n for p in pieces) * most // total)
        begun = []
        for piece in pieces:
            if left > 0:
                begun.append(piece if piece.n <= left else piece.cut(0, left))
                left -= begun[-1].n
        if begun:
            part.append(Record(tuple(begun), record.name, record.faults))
    return part


def _diagnosed(
    model: StageModel, records: Sequence[Record], settings: DiagnosisSettings, progress: Progress
) -> Diagnosis:
    """Diagnose sound records; the result holds no sentence yet."""
    progress('residual', 0.0)
    simulator, faults = prepared(model, records)
    progress('residual', 0.5)
    residual = base_residual(simulator, faults)
    progress('residual', 1.0)
    have = {setting.name for setting in model.effects}
    names = [n for n in settings.effects or catalogue() if n not in {*settings.without, *have}]
    search = CandidateSearch(
        simulator,
        residual,
        [name for name in names if name not in TESTED],
        np.random.default_rng(settings.seed),
        lambda share: progress('candidates', share),
    )
    base, shown = search.shown([name for name in residual.significant if name in names])
    candidates = search.of(base, settings.most_effects - len(shown))
    progress('candidates', 1.0)
    decision = decide(candidates)
    tick = partial(progress, 'verdict', 0.5)
    last = walk(simulator, residual.given, candidates, decision.best, tick)
    last = with_numerator(simulator, last)
    untried = set(catalogue()) - set(names) - have
    findings = judge(candidates, decision, last, shown, residual.wide.mean_square, untried)
    result = _result(simulator, residual, search.rounds, candidates, findings, last, settings)
    progress('verdict', 1.0)
    return result


# -- the result ----------------------------------------------------------------------------------


def _result(
    simulator: Simulator,
    residual: BaseResidual,
    rounds: Sequence[Round],
    candidates: Candidates,
    findings: Findings,
    last: FittedSet,
    settings: DiagnosisSettings,
) -> Diagnosis:
    """Report the findings, without a sentence."""
    model, rows = simulator.model, simulator.rows
    # all candidates contain the effects whose own tests are significant
    best = candidates.without().fitted
    without = residual.wide if best.state.effects else best
    before, refit, held_out, after = _errors(simulator, residual, without, last.fitted)
    refined = refine(simulator, residual.given, last, findings, (before, after))
    if refined.is_given:
        held_out = after = before
    smallest = smallest_detectable(candidates, findings)
    tested = residual.tested | {*settings.without, *(one.name for one in model.effects)}
    return Diagnosis(
        verdict=findings.verdict,
        sentence='',
        given=model,
        model=refined.model,
        effects=found_effects(rows, findings, last.fitted),
        group=findings.group,
        unexplained=findings.unexplained(left_over(findings, smallest, rows.passes)),
        candidates=candidates_of(candidates, rounds, findings),
        before=before,
        refit=refit,
        after=after,
        noise_floor=None if residual.single is None else rows.percent(residual.single),
        noise_source=residual.floor.source,
        smallest_detectable=smallest,
        untestable=untestable_of(rounds, settings, tested),
        faults=residual.faults,
        residuals=_residuals(simulator, residual.given, without.state, refined),
        records=rows.names,
        blocks=int(rows.fold.size),
        warnings=(
            *part_judged(rows),
            *warnings_of(simulator, refined, residual.floor),
            *(warning for one in rounds for warning in one.warnings),
        ),
        settings=settings,
        law='' if refined.h_is_given or last.way == 'gain' else law_of(last.fitted),
        errors_of_laws=errors_of_laws(candidates),
        kinds=rows.kinds,
        gain=findings.gain,
        set_in=findings.set_in,
        held_out=held_out,
        errors_of_sets=errors_of_sets(candidates),
    )


def _errors(
    simulator: Simulator, residual: BaseResidual, without: Fitted, last: Fitted
) -> list[Errors]:
    """Compute the errors as given, refitted, refined on held-out blocks, and on other motion."""
    rows, single = simulator.rows, residual.single
    # noise of single samples that the averaging to rows removes
    lost = 0.0 if single is None else max(single - residual.noise, 0.0)
    parts = (
        rows.x - simulator.run(residual.given),
        without.held_out_residual(rows),
        last.held_out_residual(rows),
        last.held_out_residual(rows, rows.group),
    )
    return [rows.errors(e, lost) for e in parts]


def _residuals(
    simulator: Simulator, given: State, without: State, refined: Refined
) -> tuple[Residual, ...]:
    """Compute the residuals of each piece as given, before, and after the refinement [m]."""
    runs, Y = simulator.rows.runs, simulator.model.scaling.Y
    # if no effect was added, the refitted base model is the refined model
    is_refit = not refined.is_given and not refined.state.effects
    before = refined.state if is_refit else without
    full = [simulator.full(state) for state in (given, before, refined.state)]
    return tuple(
        Residual(
            run.record, run.piece, Y * (run.x - a), Y * (run.x - b), Y * (run.x - c), run.known
        )
        for run, a, b, c in zip(runs, *full, strict=True)
    )
