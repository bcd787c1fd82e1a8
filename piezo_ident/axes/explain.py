# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Which effect a linear stage of several axes lacks, named by data that no fit has seen.

Each candidate is one model for all amplitudes, fitted in free run to the records taught, and
judged in free run on those held out:

- ``linear``: nothing else;
- ``input_hysteresis``: plays of the voltages in front of a second path;
- ``loop_hysteresis``: plays of the actuators' extension inside the loop;
- ``softening``: stiffness that follows the level of the extension, without plays;
- ``hysteretic_stiffness``: softening, and plays of extension and voltage inside the loop.

A rival that is none of them, ``changed_dynamics``, is a linear model for each amplitude: it knows
the amplitude beforehand.

What sits inside the loop moves the modes with the amplitude; what sits in front of it changes the
gain alone.  So the candidates inside the loop are named only where models of each amplitude err
clearly less with modes of their own than with those of all.  Without that, a model with more
signals may come nearer to a hysteresis of the voltages than plays of them do, and is no finding.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
import time

import numpy as np
from piezo_ident.axes.frequency_response import frequency_response
from piezo_ident.axes.linear_fit import refined
from piezo_ident.axes.loop_fit import loop_fit
from piezo_ident.axes.loop_model import LoopModel
from piezo_ident.axes.modal import Modal
from piezo_ident.axes.periodic import PeriodicRecord
from piezo_ident.axes.signals import with_input_plays, with_loop_plays, with_softening
from piezo_ident.common.errors import DataError, ModelError

#: a candidate is preferred to simpler ones where it takes at least this part of their error
WORTH = 0.1
#: candidates grow on so many records a group, those of the largest weight
FEW = 2
#: simplest first
SINGLE = ('linear', 'input_hysteresis', 'loop_hysteresis', 'softening', 'hysteretic_stiffness')
#: those that leave the modes where they are
STILL = SINGLE[:2]


@dataclass(frozen=True)
class Score:
    """
    Free-run error over the last period, in steady state, counted in two ways.

    Attributes
    ----------
    pooled : float
        100 rms(y - yhat) / rms(y) over all outputs and records.
    mean : float
        Mean of 100 rms(y - yhat) / rms(y) of each output and record.
    """

    pooled: float
    mean: float


@dataclass(frozen=True, eq=False)
class Rival:
    """
    One explanation.

    Attributes
    ----------
    models : dict
        By group of records; the same model for all, but for ``changed_dynamics``.
    scores : dict
        On the records held out, by group.
    """

    name: str
    models: dict[str, LoopModel]
    scores: dict[str, Score]
    seconds: float

    @property
    def error(self) -> float:
        """Quadratic mean of the pooled errors of the groups in %."""
        return _quadratic_mean(self.scores)


@dataclass(frozen=True, eq=False)
class Explanation:
    """
    The candidates, and which of them is named.

    Attributes
    ----------
    candidates : tuple of Rival
    kept_modes, own_modes : float
        Error in % of linear models of each amplitude, with the modes of all and with their own.
    """

    candidates: tuple[Rival, ...]
    kept_modes: float
    own_modes: float

    def __getitem__(self, name: str) -> Rival:
        return next(c for c in self.candidates if c.name == name)

    @property
    def modes_move(self) -> bool | None:
        """Whether the modes move with the amplitude; None where there is only one."""
        if len(self['linear'].scores) < 2:
            return None
        return self.own_modes < (1 - WORTH) * self.kept_modes

    @property
    def name(self) -> str:
        """Name of the simplest single model that no other beats by much."""
        names = STILL if self.modes_move is False else SINGLE
        errors = {name: self[name].error for name in names}
        limit = min(errors.values()) / (1 - WORTH)
        return next(name for name in names if errors[name] <= limit)

    @property
    def model(self) -> LoopModel:
        """The model of what is named."""
        return next(iter(self[self.name].models.values()))


def _quadratic_mean(found: dict[str, Score]) -> float:
    return float(np.sqrt(np.mean([s.pooled**2 for s in found.values()])))


def groups(records: Sequence[PeriodicRecord]) -> dict[str, list[PeriodicRecord]]:
    """Return the records by group, in the order in which the groups appear."""
    found: dict[str, list[PeriodicRecord]] = {}
    for record in records:
        found.setdefault(record.group, []).append(record)
    return found


def scores(models: dict[str, LoopModel], records: Sequence[PeriodicRecord]) -> dict[str, Score]:
    """Judge the model of each group on its records; one that runs away errs without end."""
    found = {}
    for group, members in groups(records).items():
        errors, powers = [], []
        for record in members:
            powers.append(np.mean(record.y[-1] ** 2, axis=0))
            try:
                errors.append(np.nanmean(models[group].error(record) ** 2, axis=0))
            except ModelError:
                errors.append(np.full(record.y.shape[2], np.inf))
        found[group] = Score(
            100 * float(np.sqrt(np.sum(errors) / np.sum(powers))),
            100 * float(np.mean(np.sqrt(np.array(errors) / np.array(powers)))),
        )
    return found


def explain(
    linear: Modal,
    taught: Sequence[PeriodicRecord],
    held_out: Sequence[PeriodicRecord],
    *,
    weights: Sequence[float] | None = None,
    iterations: int = 10,
    warm_up: int = 1024,
    memory: float = 300.0,
    report: Callable[[str], None] = lambda text: None,
) -> Explanation:
    """
    Fit every candidate, and judge all on the records held out.

    Candidates grow on few records of each group; their last steps are fitted to all.

    Parameters
    ----------
    linear : Modal
        Start: the stage at the middle amplitude.
    weights : sequence of float, optional
        Of the records taught, see `piezo_ident.axes.periodic.periodicity`.
    iterations : int
        Steps a candidate, or a part of ``hysteretic_stiffness``.
    memory : float
        Time constant of the level of the softening in samples.
    report : callable
        Called with a line for each candidate.
    """
    weights = [1.0] * len(taught) if weights is None else list(weights)
    if not set(groups(held_out)) <= set(groups(taught)):
        raise DataError('records of a group were held out of which none was taught')
    by_group = groups(taught)
    weight = {id(record): x for record, x in zip(taught, weights, strict=True)}
    small = [
        record
        for members in by_group.values()
        for record in sorted(members, key=lambda r: -weight[id(r)])[:FEW]
    ]
    small_weights = [weight[id(record)] for record in small]
    found: list[Rival] = []

    def judged(name: str, models: dict[str, LoopModel], since: float) -> None:
        candidate = Rival(name, models, scores(models, held_out), time.monotonic() - since)
        found.append(candidate)
        pooled = ' / '.join(f'{s.pooled:.2f}' for s in candidate.scores.values())
        report(f'{name}: {pooled} % ({candidate.seconds:.0f} s)')

    def grown(model: LoopModel, steps: int, *, still: Sequence[int] = ()) -> LoopModel:
        """Fit how new signals push first, then what they are."""
        for hold, many in ((('f', 'g', 'mu'), 2), ((), steps)):
            model = loop_fit(
                model,
                small,
                weights=small_weights,
                hold=hold,
                still=still,
                iterations=many,
                warm_up=warm_up,
            )
        return model

    def everywhere(model: LoopModel) -> dict[str, LoopModel]:
        return dict.fromkeys(by_group, model)

    plain = LoopModel.of(linear)
    middle = middle_group(small)

    def finished(name: str, model: LoopModel, since: float) -> None:
        """Fit a model of all amplitudes to all that is taught, and judge it."""
        steps = max(1, iterations // 3)
        model = loop_fit(model, taught, weights=weights, iterations=steps, warm_up=warm_up)
        judged(name, everywhere(model), since)

    since = time.monotonic()
    one = loop_fit(plain, small, weights=small_weights, iterations=iterations, warm_up=warm_up)
    finished('linear', one, since)

    since = time.monotonic()
    each = {}
    for group, members in by_group.items():
        good = [r for r in members if weight[id(r)] == 1] or members
        response = frequency_response(good)
        each[group] = LoopModel.of(refined(linear, response, iterations=iterations))
    judged('changed_dynamics', each, since)

    def alone(start: LoopModel, group: str, *hold: str) -> LoopModel:
        """Fit a model to one group."""
        return loop_fit(
            start,
            by_group[group],
            weights=[weight[id(r)] for r in by_group[group]],
            hold=hold,
            iterations=iterations,
            warm_up=warm_up,
        )

    kept = {group: alone(one, group, 'poles') for group in by_group}
    own = {group: alone(model, group) for group, model in kept.items()}
    modes = [_quadratic_mean(scores(models, held_out)) for models in (kept, own)]

    since = time.monotonic()
    signals = range(plain.linear.b.shape[1])
    model = grown(with_input_plays(plain, middle), iterations, still=signals)
    finished('input_hysteresis', model, since)

    since = time.monotonic()
    finished('loop_hysteresis', grown(with_loop_plays(plain, middle), iterations), since)

    since = time.monotonic()
    soft = grown(with_softening(plain, small, memory=memory), iterations)
    finished('softening', soft, since)

    model = grown(with_loop_plays(soft, middle), iterations)
    model = grown(with_input_plays(model, middle), iterations)
    finished('hysteretic_stiffness', model, since)
    return Explanation(tuple(found), *modes)


def middle_group(records: Sequence[PeriodicRecord]) -> list[PeriodicRecord]:
    """Return the records of the group of the middle voltage."""
    parts = sorted(groups(records).values(), key=lambda part: float(np.mean(part[0].u ** 2)))
    return parts[len(parts) // 2]
