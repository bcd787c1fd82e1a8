# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
From a model and measured data to the effect that the model lacks.

Data faults first; then the base model is refitted by free-run error, so that no physics is blamed
for a weight of H; then candidates are added one after another as long as data that were not
fitted gain; and then comes the judgement.

An effect that was there when G was identified has bent G a little.  Unless a linear change is the
larger part of the story, G is therefore retuned along with the candidates, by a factor
``1 + c_1 (1 - z^-1) + c_2 (1 - z^-1)^2`` and two slow relaxations.  No candidate is chosen for
what that explains; it counts in the share of the effects that are named, and is said beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from piezo_ident.common.errors import IdentificationError, ModelError
from piezo_ident.diagnosis.assemble import assemble
from piezo_ident.diagnosis.beginnings import beginnings, said_of, share_of
from piezo_ident.diagnosis.errors_of import row_noise
from piezo_ident.diagnosis.fit import (
    base_thresholds,
    fit_base,
    fit_jointly,
    Fitted,
)
from piezo_ident.diagnosis.handles import RETUNING
from piezo_ident.diagnosis.results import Diagnosis, DiagnosisSettings
from piezo_ident.diagnosis.rows import centred, make_rows, Rows
from piezo_ident.diagnosis.search import drop_needless, polished, Round, search_round
from piezo_ident.diagnosis.simulator import Simulator, State
from piezo_ident.diagnosis.verdict import judge, PASSES, SMALLEST, takes
from piezo_ident.diagnosis.whole import fitted_to_all, Whole
from piezo_ident.effects import catalogue, find_effect
from piezo_ident.identification.prepare import same_rate
from piezo_ident.identification.results import Progress, silent
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.record import Record
from piezo_ident.residual.faults import find_faults
from piezo_ident.residual.floor import noise_floor
from piezo_ident.residual.lines import find_lines, without_lines
from piezo_ident.residual.stretches import ResidualPart, stretches_of

__all__ = ['diagnose']

#: share of the explainable part from which a linear change is a finding, not a side effect
LINEAR = 0.5
#: share of what a linear change leaves that a bent G and another effect must not exceed
BENT = 0.25
#: share of the displacement's variance beyond which a fitted H explains none of it, and the
#: share of the identified range from which the voltage moves
UNRELATED, TREMBLES = 0.99, 0.01
#: effect that is looked for by its lines
HUM = 'periodic_disturbance'
#: samples with a fault are left out up to this share; beyond it they are all there is
FAULTY = 0.02


def diagnose(
    model: StageModel,
    records: Sequence[Record] | Record,
    settings: DiagnosisSettings | None = None,
    *,
    progress: Progress = silent,
) -> Diagnosis:
    """
    Find what a model lacks, add it, and say how sure that is.

    Parameters
    ----------
    model : StageModel
        From `piezo_ident.identification.identify.identify`; it may hold effects already.
    records : sequence of Record, or Record
        Measured data that the model was not identified from, of its sampling rate.
    settings : DiagnosisSettings, optional
    progress : callable, optional
        Called with the name of the step and the share done; may raise `Cancelled`.

    Returns
    -------
    Diagnosis

    Raises
    ------
    IdentificationError
        When the records carry nothing to judge, or the displacement does not follow the voltage.
    """
    settings = settings or DiagnosisSettings()
    records = [records] if isinstance(records, Record) else list(records)
    used = beginnings(model, records, settings.most_samples)
    if used == records:
        return _diagnosed(model, records, records, settings, progress)
    try:
        return _diagnosed(model, records, used, settings, progress)
    except IdentificationError as error:
        raise IdentificationError(f'{error} ({share_of(records, used)})') from None


def _diagnosed(
    model: StageModel,
    whole: Sequence[Record],
    records: Sequence[Record],
    settings: DiagnosisSettings,
    progress: Progress,
) -> Diagnosis:
    """Return the diagnosis of whole records from their beginnings."""
    progress('residual', 0.0)
    rows = make_rows(model, records)
    given = State(model.hysteresis, np.zeros(len(rows.names)))
    faults = find_faults(_parts(Simulator(model, rows), given))
    if any(bad.any() and bad.mean() < FAULTY for bad in faults.bad):
        rows = make_rows(
            model, records, [bad if bad.mean() < FAULTY else None for bad in faults.bad]
        )
    simulator = Simulator(model, rows)
    progress('residual', 0.5)
    is_long = records != whole
    base = _base(simulator, given, _swing(model, whole) if is_long else 0.0)
    _check_related(rows, base)
    parts = _parts(simulator, base.state)
    stretches = [s for i, part in enumerate(parts) for s in stretches_of(part, i)]
    found = find_lines(parts, stretches)
    lines = found.lines
    # hum is no noise: it can be explained
    resting = _parts(simulator, base.state, whole=True)
    rests = [s for i, part in enumerate(resting) for s in stretches_of(part, i)]
    floor = noise_floor([without_lines(part, lines) for part in resting], rests)
    noise = row_noise(floor, faults, rows.m, abs(model.scaling.Y))
    progress('residual', 1.0)
    frequencies = [line.frequency for line in lines]
    search = _Search(simulator, frequencies, noise, settings, progress)
    rounds, taken, fitted = search.run(base)
    if not taken:
        fitted = base
    findings = judge(rows, base, fitted, taken, noise, search.left_out, search.bent)
    fits: Whole | None = None
    how = 'nothing was fitted to the rest'
    if is_long and findings.effects and not _is_driven(findings.effects):
        try:
            fits = fitted_to_all(
                simulator, given, base, fitted, whole, records, frequencies, progress
            )
            how = 'what was found was fitted to ' + ('all of them' if fits else 'these alone')
        except (IdentificationError, ModelError, np.linalg.LinAlgError) as error:
            how = f'what was found could not be fitted to the rest ({error})'
    progress('verdict', 0.0)
    result = assemble(
        simulator,
        given,
        base,
        fitted,
        rounds,
        taken,
        findings,
        floor,
        noise,
        faults,
        settings,
        fits=fits,
        is_long=is_long,
        # where no line stands out there is nothing to fit
        searched=(HUM,) if found.highest > 0.0 else (),
    )
    further = [warning for record in whole for warning in model.extrapolation(record)]
    if is_long:
        further.append(_said(model, result.model, whole, records, how, progress))
    progress('verdict', 1.0)
    return replace(result, warnings=(*result.warnings, *further))


def _check_related(rows: Rows, base: Fitted) -> None:
    """Refuse displacement that does not follow the voltage: no effect is missing, the stage is."""
    swing = max(float(np.ptp(run.u)) for run in rows.runs)
    moved = float(np.mean(centred(rows.x, rows.of_record) ** 2))
    # where the voltage only trembles all else may well be larger
    if swing > TREMBLES and base.mean_square > UNRELATED * moved:
        raise IdentificationError(
            f'{", ".join(rows.names)}: the displacement does not follow the voltage: of blocks '
            'that were held out a hysteresis fitted to the others accounts for '
            f'{max(0.0, 100.0 * (1.0 - base.mean_square / moved)):.1g} %; is the sensor '
            'connected, and do both columns come from one stage?'
        )


def _is_driven(effects: Sequence[str]) -> bool:
    """Return whether an effect follows time, so that it is another one later."""
    return any(find_effect(name).time_driven for name in effects)


def _said(
    given: StageModel,
    refined: StageModel,
    records: Sequence[Record],
    used: Sequence[Record],
    how: str,
    progress: Progress,
) -> str:
    try:
        return said_of(given, refined, records, used, how, lambda: progress('verdict', 0.5))
    except ModelError as error:
        return f'{share_of(records, used)}; {how}; the rest cannot be predicted: {error}'


def _swing(model: StageModel, records: Sequence[Record]) -> float:
    """Return the largest range of a piece, normalised: later ones need their thresholds too."""
    spans = [
        float(np.ptp(p.v))
        for record in records
        for p in record
        if same_rate(p.sample_rate, model.sample_rate)
    ]
    return max(spans, default=0.0) / abs(model.scaling.V)


def _parts(simulator: Simulator, state: State, *, whole: bool = False) -> list[ResidualPart]:
    """Return the residual of each run [m]; `whole` with what the unknown start still touches."""
    Y = simulator.model.scaling.Y
    return [
        ResidualPart(run.record, run.piece, (run.x - x) * Y, run.sound if whole else run.known)
        for run, x in zip(simulator.rows.runs, simulator.full(state), strict=True)
    ]


def _base(simulator: Simulator, given: State, least: float) -> Fitted:
    """Return the base model refitted on a fine grid of thresholds, over a swing at least."""
    # a run may be wider than the pieces that it joins over gaps
    swing = max(least, *(float(np.ptp(run.u)) for run in simulator.rows.runs))
    if swing == 0.0:
        raise IdentificationError('the voltage never moves; record the stage while it is driven')
    state, columns = fit_base(simulator, given, base_thresholds(swing))
    return fit_jointly(simulator, state, columns)


class _Search:
    """Effects are added one after another as long as held-out data gain."""

    def __init__(
        self,
        simulator: Simulator,
        lines: Sequence[float],
        noise: float,
        settings: DiagnosisSettings,
        progress: Progress,
    ) -> None:
        self._simulator = simulator
        self._lines = lines
        self._noise = noise
        self._most = settings.most_effects
        self._progress = progress
        self._rng = np.random.default_rng(settings.seed)
        names = settings.effects or tuple(catalogue())
        self._candidates = [find_effect(name) for name in names if name not in settings.without]
        have = {setting.name for setting in simulator.model.effects}
        tried = have | {effect.name for effect in self._candidates}
        #: effects that nobody can find, since they are not tried
        self.left_out = frozenset(catalogue()) - tried
        #: what an effect that bent G would leave, where a linear change was preferred
        self.bent: Round | None = None
        self._count = 0

    def run(self, base: Fitted) -> tuple[list[Round], list[Round], Fitted]:
        """Return all rounds, those whose best contender was added, and the fit at the end."""
        state = replace(base.state, retuning=(0.0,) * len(RETUNING))
        retuned = fit_jointly(self._simulator, state, base.base)
        explainable = max(base.mean_square - self._noise, 1e-300)
        if base.mean_square - retuned.mean_square < LINEAR * explainable:
            return self._from(retuned, self._round(retuned))
        # a linear change is the larger part: is it the whole of it?
        linear, bent = self._round(base), None
        if self._left(linear) > self._least:
            bent = self._round(retuned)
        if bent is not None and self._is_taken(bent):
            if self._left(bent) < BENT * self._left(linear):
                return self._from(retuned, bent)
            self.bent = bent
        return self._from(base, linear)

    def _is_taken(self, first: Round) -> bool:
        explainable = max(first.before.mean_square - self._noise, 0.0)
        return self._takes(first, explainable, first=True)

    def _takes(self, this: Round, explainable: float, *, first: bool) -> bool:
        rows = self._simulator.rows
        # a branch that was passed once only cannot be held out
        return rows.passes >= PASSES and takes(rows, this, self._noise, explainable, first=first)

    @property
    def _least(self) -> float:
        """Mean square of the smallest effect."""
        return (SMALLEST * self._simulator.rows.stroke / 100.0) ** 2

    def _left(self, this: Round) -> float:
        best = this.contenders[0].fitted if this.contenders else this.before
        return max(best.mean_square - self._noise, 0.0)

    def _round(self, fitted: Fitted) -> Round:
        have = {setting.name for setting in self._simulator.model.effects}
        have |= {added.name for added in fitted.state.effects}
        left = [effect for effect in self._candidates if effect.name not in have]
        done = self._count
        self._count += 1

        def tick(share: float) -> None:
            # most searches end after two or three rounds: the bar nears its end ever slower
            self._progress('candidates', 1.0 - 0.4 ** (done + share))

        return search_round(
            self._simulator, fitted, left, self._lines, self._noise, self._rng, tick
        )

    def _from(self, start: Fitted, first: Round) -> tuple[list[Round], list[Round], Fitted]:
        simulator, fitted, this = self._simulator, start, first
        rounds, taken = [first], list[Round]()
        explainable = max(start.mean_square - self._noise, 0.0)
        while self._takes(this, explainable, first=not taken):
            taken.append(this)
            fitted, dropped = drop_needless(
                self._simulator, this.contenders[0].fitted, self._least
            )
            for i in dropped:
                del taken[i]
            if len(taken) == self._most or fitted.mean_square - self._noise < self._least:
                break
            this = self._round(fitted)
            rounds.append(this)
        if len(fitted.state.effects) > 1:
            fitted = polished(
                simulator, fitted, self._lines, lambda: self._progress('candidates', 0.95)
            )
        self._progress('candidates', 1.0)
        return rounds, taken, fitted
