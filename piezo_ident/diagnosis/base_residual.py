# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Leave out faults, refit H, and find lines and noise in the residual, before effects are searched.

The residual of the model as given shows faults of the data.  H is then refitted as plays and by a
wide law.  The residual of the wide law shows lines (hum), further channels (axes) and the noise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from piezo_ident.common.errors import IdentificationError
from piezo_ident.diagnosis.criteria import IN_PROPORTION
from piezo_ident.diagnosis.earlier_motion import with_earlier_motion
from piezo_ident.diagnosis.joint_fit import fit_jointly, Fitted
from piezo_ident.diagnosis.refits import refits
from piezo_ident.diagnosis.rows import centred, make_rows, means
from piezo_ident.diagnosis.simulator import Simulator
from piezo_ident.diagnosis.state import CREEP, State
from piezo_ident.identification.prepare import filled_in
from piezo_ident.identification.spectra import high_passed
from piezo_ident.model.metrics import REVERSED, runs_against
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.record import Fault, Record
from piezo_ident.residual.beyond_drive import channel_tests, ChannelTest, without_channels
from piezo_ident.residual.faults import FaultSearch, find_faults
from piezo_ident.residual.lines import find_lines, LineSearch, without_lines
from piezo_ident.residual.noise_floor import NoiseFloor, residual_noise_floor
from piezo_ident.residual.stretches import all_stretches, ResidualPart

#: effect with a test of its own, by its lines
HUM = 'periodic_disturbance'
#: share of the voltage range within which the command counts as resting with noise
TREMBLES = 0.01
#: the displacement ignores the voltage if a fitted H leaves more than this share of its variance
UNRELATED = 0.99
#: the displacement runs against the model if their correlation is lower.  No change of a stage
#: turns its direction
AGAINST = -0.9


def prepared(model: StageModel, records: Sequence[Record]) -> tuple[Simulator, FaultSearch]:
    """Cut records to rows without the faults that the residual shows; fill the gaps."""
    rows = make_rows(model, records)
    given = State(model.hysteresis, np.zeros(len(rows.names)))
    faults = find_faults(_parts(Simulator(model, rows), given))
    if any(bad.any() for bad in faults.bad):
        rows = make_rows(model, records, faults.bad)
    if not all(run.use.all() for run in rows.runs):
        pairs = zip(rows.runs, Simulator(model, rows).full(given), strict=True)
        runs = tuple(filled_in(run, model.scaling.y(x), model.scaling) for run, x in pairs)
        rows = replace(rows, runs=runs, x=rows.of([run.x for run in runs]))
    return Simulator(model, rows), faults


@dataclass(frozen=True, eq=False)
class BaseResidual:
    """
    The model with another H, and the findings in its residual.

    Attributes
    ----------
    given : State
        The diagnosed model, with an offset in each record.
    plays, wide : Fitted
        H refitted as plays, and as the better of the wide laws.
    channels, lines, floor
        Tests of further channels, search for lines, and noise floor.
    noise, single : float
        Mean squares of the noise of a row, and of single samples (None if unknown).
    missed : float
        Possible error of G on this motion, rms in % of stroke.
    faults : tuple of Fault
        Faults of the data in the residual of the diagnosed model.
    """

    given: State
    plays: Fitted
    wide: Fitted
    channels: tuple[ChannelTest, ...]
    lines: LineSearch
    floor: NoiseFloor
    noise: float
    single: float | None
    missed: float
    faults: tuple[Fault, ...]

    @property
    def significant(self) -> list[str]:
        """Effects whose own tests are significant."""
        # motion of another axis makes lines, too: the lines left beside its model are hum
        is_coupled = any(test.significant for test in self.channels)
        tests = {'cross_coupling': is_coupled, HUM: bool(self.lines.lines)}
        return [name for name, is_seen in tests.items() if is_seen]

    @property
    def tested(self) -> set[str]:
        """Effects whose own tests could search these data, so that no candidate is needed."""
        found = {HUM} if self.lines.searched else set()
        return found | ({'cross_coupling'} if any(test.tells for test in self.channels) else set())


def base_residual(simulator: Simulator, faults: FaultSearch) -> BaseResidual:
    """Refit H, and find lines and noise of the residual."""
    model, rows = simulator.model, simulator.rows
    given = State(model.hysteresis, np.zeros(len(rows.names)))
    # each record has its own offset, as the sensor may have been zeroed again
    given = replace(given, offsets=means(rows.x - simulator.run(given), rows.of_record))
    if any(setting.name == CREEP for setting in model.effects):
        given = with_earlier_motion(simulator, fit_jointly(simulator, given)).state
    plays, wide = refits(simulator, given)
    _check_related(simulator, given, plays)
    parts = _parts(simulator, wide.state)
    channels = channel_tests(parts)
    # another axis that moves in sines causes lines, too
    parts = without_channels(parts, channels)
    lines = find_lines(parts, all_stretches(parts))
    # effects can explain hum and another axis: only the rest is noise
    resting = _parts(simulator, wide.state, whole=True)
    quiet = [without_lines(part, lines.lines) for part in without_channels(resting, channels)]
    floor = residual_noise_floor(quiet, all_stretches(resting))
    noise, single = floor.squares(faults.quantum, rows.m, abs(model.scaling.Y))
    left = float(np.mean((rows.x - simulator.run(given)) ** 2))
    # the estimated noise is too large while a memory settles: periods then differ.  No model errs
    # by less than the noise, so the smallest error bounds the noise
    excess = max(noise - min(left, plays.mean_square, wide.mean_square), 0.0)
    single = None if single is None else single - excess
    missed, noise = missed_now(simulator), noise - excess
    return BaseResidual(
        given, plays, wide, channels, lines, floor, noise, single, missed, faults.faults
    )


def _parts(simulator: Simulator, state: State, *, whole: bool = False) -> list[ResidualPart]:
    """Compute the residual of each run [m]; `whole` includes samples after an unknown start."""
    Y = simulator.model.scaling.Y
    return [
        ResidualPart(run.record, run.piece, (run.x - x) * Y, run.use if whole else run.known)
        for run, x in zip(simulator.rows.runs, simulator.full(state), strict=True)
    ]


def _check_related(simulator: Simulator, given: State, base: Fitted) -> None:
    """Raise IdentificationError if the displacement does not follow the voltage."""
    rows = simulator.rows
    swing = max(float(np.ptp(run.u)) for run in rows.runs)
    # disturbances may exceed the answer to a voltage that only trembles
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


def missed_then(model: StageModel) -> float:
    """Return the error on fast motion at the identification [% of stroke]; 0 if unknown."""
    known = _entries(model, 'errors')
    if 'fast_motion' in known:
        known = {'fast_motion': known['fast_motion']}
    # a file without this entry has the error on all motion
    return max((float(x) for x in known.values() if isinstance(x, int | float)), default=0.0)


def missed_now(simulator: Simulator) -> float:
    """
    Estimate the error of G on the motion in these data, % of stroke.

    The error of G grows with fast motion.  A part of the known error belongs to H, so only the
    share `IN_PROPORTION` of a proportional growth counts.
    """
    model = simulator.model
    then = _entries(model, 'fast_displacement').get('percent_of_stroke')
    missed = missed_then(model)
    if not isinstance(then, int | float) or not then > 0.0:
        return missed
    fast = [high_passed(run.x, run.piece.sample_rate)[run.use] for run in simulator.rows.runs]
    now = 100.0 * float(np.sqrt(np.mean(np.concatenate(fast) ** 2)))
    return missed * max(1.0, IN_PROPORTION * now / float(then))


def _entries(model: StageModel, name: str) -> Mapping[str, Any]:
    found = model.identification.get(name)
    return found if isinstance(found, Mapping) else {}
