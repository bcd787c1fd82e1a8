# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Diagnose a model: from measured data to the effect that the model lacks.

1. Faults of the data are found and left out.
2. H is refitted by the free-run error, so that an error of H is not mistaken for an effect.
3. The remaining residual gives lines and the noise floor, and thereby the error to explain.
4. The candidates are fitted: each treatment of H and G, with each effect, then with one more
   (`candidates`, by rounds of `search`).
5. One ratio decides (`decision`).  A walk over whole kinds of motion gives H (`refits`).  The
   verdict (`verdict`) and the refined model (`refined_model`) follow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from piezo_ident.common.errors import expect, IdentificationError
from piezo_ident.diagnosis.candidates import CandidateSearch
from piezo_ident.diagnosis.decision import decide
from piezo_ident.diagnosis.earlier_motion import with_earlier_motion
from piezo_ident.diagnosis.joint_fit import base_at, fit_jointly, Fitted
from piezo_ident.diagnosis.messages import (
    left_over,
    part_judged,
    part_searched,
    sentence,
    warnings_of,
)
from piezo_ident.diagnosis.refined_model import found_effects, refine, Refined
from piezo_ident.diagnosis.refits import law_of, refits, walk, with_numerator
from piezo_ident.diagnosis.results import (
    Diagnosis,
    DiagnosisSettings,
    Residual,
)
from piezo_ident.diagnosis.rows import centred, make_rows, means
from piezo_ident.diagnosis.simulator import Simulator
from piezo_ident.diagnosis.state import CREEP, State, TESTED
from piezo_ident.diagnosis.verdict import (
    candidates_of,
    errors_of_laws,
    errors_of_sets,
    judge,
    missed_now,
    smallest_detectable,
    untestable_of,
)
from piezo_ident.effects import catalogue
from piezo_ident.identification.prepare import filled_in, same_rate
from piezo_ident.identification.settings import Progress, silent
from piezo_ident.model.metrics import REVERSED, runs_against
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.readings.faults import without_faults
from piezo_ident.record.readings.quiet_voltage import with_quiet_voltage
from piezo_ident.record.readings.suspicions import suspicions
from piezo_ident.record.record import Record, records_of
from piezo_ident.residual import (
    all_stretches,
    channel_tests,
    ChannelTest,
    find_faults,
    find_lines,
    LineSearch,
    NoiseFloor,
    residual_noise_floor,
    ResidualPart,
    without_channels,
    without_lines,
)

#: effect with a test of its own, by its lines
HUM = 'periodic_disturbance'
#: share of the voltage range within which the command counts as resting with noise
TREMBLES = 0.01
#: the displacement does not follow the voltage if a larger share of its variance stays unexplained
UNRELATED = 0.99
#: the displacement runs against the model if their correlation is lower; no change of a stage
#: causes this
AGAINST = -0.9


def diagnose(
    model: StageModel,
    records: Sequence[Record] | Record,
    settings: DiagnosisSettings | None = None,
    *,
    progress: Progress = silent,
) -> Diagnosis:
    """Find what a model of one axis lacks; see `piezo_ident.diagnose`."""
    settings = DiagnosisSettings() if settings is None else settings
    records = records_of(records, 'diagnose, second argument')
    expect(model, StageModel, 'diagnose, first argument', 'read a model with load')
    expect(settings, DiagnosisSettings, 'diagnose, settings', 'give several records as a list')
    if not records:
        raise IdentificationError('no record was given')
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
    # faults found by the reader are reported there, not here
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
    """
    Cut records to their beginnings, in proportion to their lengths, to `most` samples in total.

    A search needs 0.9 to 1.3 kB of memory for each sample.  Creep and hysteresis depend on earlier
    motion, and only the beginning of a record has none.
    """
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
    model: StageModel,
    records: Sequence[Record],
    settings: DiagnosisSettings,
    progress: Progress,
) -> Diagnosis:
    progress('residual', 0.0)
    # 1. faults of the data
    rows = make_rows(model, records)
    given = State(model.hysteresis, np.zeros(len(rows.names)))
    faults = find_faults(_parts(Simulator(model, rows), given))
    if any(bad.any() for bad in faults.bad):
        rows = make_rows(model, records, faults.bad)
    if not all(run.use.all() for run in rows.runs):
        pairs = zip(rows.runs, Simulator(model, rows).full(given), strict=True)
        runs = tuple(filled_in(run, model.scaling.y(x), model.scaling) for run, x in pairs)
        rows = replace(rows, runs=runs, x=rows.of([run.x for run in runs]))
    simulator = Simulator(model, rows)
    progress('residual', 0.5)
    # 2. H refitted, as plays and as the better of the wide laws
    # each record has its own offset, as the sensor may have been zeroed again
    shifts = means(rows.x - simulator.run(given), rows.of_record)
    given = replace(given, offsets=shifts)
    if any(setting.name == CREEP for setting in model.effects):
        as_given = fit_jointly(simulator, given, base_at(simulator, given))
        given = with_earlier_motion(simulator, as_given).state
    plays, wide = refits(simulator, given)
    _check_related(simulator, given, plays)
    # 3. lines and noise of the residual
    channels, lines, floor = _beside_the_drive(simulator, wide.state)
    noise, single = floor.squares(faults.quantum, rows.m, abs(model.scaling.Y))
    left = float(np.mean((rows.x - simulator.run(given)) ** 2))
    # while a memory settles, periods differ by more than the noise, and the estimated noise is too
    # large; no model errs by less than the noise, so the smallest error bounds it
    excess = max(noise - min(left, plays.mean_square, wide.mean_square), 0.0)
    noise -= excess
    single = None if single is None else single - excess
    progress('residual', 1.0)
    # 4. the candidates
    have = {setting.name for setting in model.effects}
    names = [n for n in settings.effects or catalogue() if n not in {*settings.without, *have}]
    search = CandidateSearch(
        simulator,
        given,
        [line.frequency for line in lines.lines],
        noise,
        missed_now(simulator),
        [name for name in names if name not in TESTED],
        np.random.default_rng(settings.seed),
        lambda share: progress('candidates', share),
    )
    # motion of another axis makes lines, too: the lines left beside its model are hum
    tests = {
        'cross_coupling': any(test.significant for test in channels),
        HUM: bool(lines.lines),
    }
    base, shown = search.shown(wide, [n for n, is_seen in tests.items() if is_seen and n in names])
    candidates = search.of(plays, base, settings.most_effects - len(shown))
    progress('candidates', 1.0)

    # 5. the decision, the refined model and the verdict
    def tick() -> None:
        progress('verdict', 0.5)

    decision = decide(candidates)
    last = with_numerator(simulator, walk(simulator, given, candidates, decision.best, tick))
    untried = set(catalogue()) - set(names) - have
    findings = judge(candidates, decision, last, shown, wide.mean_square, untried)
    # noise of single samples that the averaging to rows removes
    lost = 0.0 if single is None else max(single - noise, 0.0)
    without = wide if shown else candidates.without().fitted
    before, refit, held_out, after = (
        rows.errors(e, lost)
        for e in (
            rows.x - simulator.run(given),
            without.held_out_residual(rows),
            last.fitted.held_out_residual(rows),
            last.fitted.held_out_residual(rows, rows.group),
        )
    )
    refined = refine(simulator, given, last, findings, (before, after))
    if refined.is_given:
        held_out = after = before
    smallest = smallest_detectable(candidates, findings)
    # a search without a line, or without a coherent channel, leaves nothing to fit
    tested = {HUM} if lines.searched else set()
    tested |= {'cross_coupling'} if any(test.tells for test in channels) else set()
    tested |= {*settings.without, *have}
    crept = rows.percent(float(np.max(simulator.crept(refined.state) ** 2)))
    progress('verdict', 1.0)
    return Diagnosis(
        verdict=findings.verdict,
        sentence='',
        given=model,
        model=refined.model,
        effects=found_effects(rows, findings, last.fitted),
        group=findings.group,
        unexplained=findings.unexplained(left_over(findings, smallest, rows.passes)),
        candidates=candidates_of(candidates, search.rounds, findings),
        before=before,
        refit=refit,
        after=after,
        noise_floor=None if single is None else rows.percent(single),
        noise_source=floor.source,
        smallest_detectable=smallest,
        untestable=untestable_of(search.rounds, settings, tested),
        faults=faults.faults,
        residuals=_residuals(simulator, given, without.state, refined),
        records=rows.names,
        blocks=int(rows.fold.size),
        warnings=(
            *part_judged(rows),
            *warnings_of(model, refined, floor, crept),
            *(warning for one in search.rounds for warning in one.warnings),
        ),
        settings=settings,
        law='' if refined.keeps_h or last.way == 'gain' else law_of(last.fitted),
        errors_of_laws=errors_of_laws(candidates),
        kinds=rows.kinds,
        gain=findings.gain,
        set_in=decision.set_in,
        held_out=held_out,
        errors_of_sets=errors_of_sets(candidates),
    )


def _parts(simulator: Simulator, state: State, *, whole: bool = False) -> list[ResidualPart]:
    """Compute the residual of each run [m]; `whole` includes samples after an unknown start."""
    Y = simulator.model.scaling.Y
    return [
        ResidualPart(run.record, run.piece, (run.x - x) * Y, run.use if whole else run.known)
        for run, x in zip(simulator.rows.runs, simulator.full(state), strict=True)
    ]


def _beside_the_drive(
    simulator: Simulator, state: State
) -> tuple[tuple[ChannelTest, ...], LineSearch, NoiseFloor]:
    """Test a state's residual for further channels and lines, and estimate the remaining noise."""
    parts = _parts(simulator, state)
    channels = channel_tests(parts)
    # another axis that moves in sines causes lines, too
    parts = without_channels(parts, channels)
    found = find_lines(parts, all_stretches(parts))
    # hum and another axis are no noise, as an effect can explain them
    resting = _parts(simulator, state, whole=True)
    quiet = [without_lines(part, found.lines) for part in without_channels(resting, channels)]
    return channels, found, residual_noise_floor(quiet, all_stretches(resting))


def _check_related(simulator: Simulator, given: State, base: Fitted) -> None:
    """Raise IdentificationError if the displacement does not follow the voltage."""
    rows = simulator.rows
    swing = max(float(np.ptp(run.u)) for run in rows.runs)
    # other disturbances may be larger if the voltage only trembles
    if swing <= TREMBLES:
        return
    names = ', '.join(rows.names)
    moved = float(np.mean(centred(rows.x, rows.of_record) ** 2))
    if base.mean_square > UNRELATED * moved:
        raise IdentificationError(
            f'{names}: the displacement does not follow the voltage: a hysteresis accounts for '
            f'only {max(0.0, 100.0 * (1.0 - base.mean_square / moved)):.1g} % of blocks that it '
            'was not fitted to; is the sensor connected, and do both columns come from one stage?'
        )
    known, of_each = simulator.run(given), (rows.of_record == k for k in np.unique(rows.of_record))
    # the voltage moves, as checked above, so small motion counts here, too
    if runs_against(((rows.x[own], known[own]) for own in of_each), 0.0, AGAINST):
        raise IdentificationError(f'{names}: {REVERSED}')


# -- the result ----------------------------------------------------------------------------------


def _residuals(
    simulator: Simulator, given: State, without: State, refined: Refined
) -> tuple[Residual, ...]:
    Y = simulator.model.scaling.Y
    # a refit without effects has no model between the given and the refined one
    is_refit = not refined.is_given and not refined.state.effects
    before = refined.state if is_refit else without
    full = [simulator.full(s) for s in (given, before, refined.state)]
    residuals = []
    for i, run in enumerate(simulator.rows.runs):
        as_given, between, after = ((run.x - x[i]) * Y for x in full)
        residuals.append(
            Residual(run.record, run.piece, as_given, between, after, sound=run.known)
        )
    return tuple(residuals)
