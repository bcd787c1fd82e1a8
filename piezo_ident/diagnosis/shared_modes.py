# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Find hysteresis inside the loop of modes that several axes share.

Each law is one model for all amplitudes.  It is fitted in free run to multisines, and judged on
one multisine of each amplitude that is held out:

- ``linear``: no hysteresis;
- ``plays in front``: plays of the voltages, in front of the mechanics;
- ``plays``: plays of the actuators' extension inside the loop;
- ``softening``: stiffness that follows the level of the extension;
- ``softening and plays``: softening, and plays of extension and voltage inside the loop.

Hysteresis inside the loop moves the modes with the amplitude.  Hysteresis in front of the
mechanics changes gain and phase, not the modes.  `loop_hysteresis` needs linear models of each
amplitude that err by `LAW_GAIN` less with modes of their own than with common modes.  A law inside
the loop must also leave at most `TAKES` of the mean square error of the chains, H and G by axis.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
import hashlib
from typing import NamedTuple
import warnings

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.choice import simplest
from piezo_ident.common.errors import DataError, IdentificationError, ModelError
from piezo_ident.diagnosis.creep_of_modes import with_creep
from piezo_ident.diagnosis.criteria import SMALLEST_EFFECT, TAKES
from piezo_ident.diagnosis.results import Diagnosis, Errors, FoundEffect, Unexplained
from piezo_ident.fitting.modes.frequency_response import likeness
from piezo_ident.fitting.modes.linear_fit import choose_order
from piezo_ident.fitting.modes.loop_fit import loop_fit
from piezo_ident.fitting.modes.periods import groups, percent_of, PeriodicRecord, periods_of
from piezo_ident.fitting.modes.signals import with_input_plays, with_loop_plays, with_softening
from piezo_ident.identification.prepare import same_rate
from piezo_ident.identification.settings import Progress
from piezo_ident.model.axis_records import axes_of, voltage_of
from piezo_ident.model.modes.shared_modes import SharedModes
from piezo_ident.model.multi_axis import MultiAxisModel
from piezo_ident.record.channels import Axes
from piezo_ident.record.record import Record

NAME = 'loop_hysteresis'
#: description of the remaining error
LEFT = 'structure that the shared modes do not account for'
#: laws, simplest first; the laws `IN_FRONT` do not move the modes
LAWS = ('linear', 'plays in front', 'plays', 'softening', 'softening and plays')
IN_FRONT = LAWS[:2]
#: a law is preferred to simpler ones if it takes this share of their error (taste)
LAW_GAIN = 0.1
#: standard deviation of a normal variable in medians of its size
NORMAL = 1.4826
#: number of records of a group to which laws are fitted, the largest weights first (taste: time)
FEW = 2
#: largest correlation of two voltages: their difference then has a tenth of the size of their sum
ONE_SIGNAL = 0.98
#: orders that are tried (taste)
ORDERS = (4, 6, 8, 12, 16, 20, 28, 36, 44, 52)
#: steps of each part of a fit, and of the last fit to all records (taste: the error falls no more)
STEPS, LAST_STEPS = 10, 6


class Multisines(NamedTuple):
    """
    Periods of multisines of all axes at once, at two amplitudes, of two realisations each.

    Attributes
    ----------
    periods : tuple of PeriodicRecord
        Smallest amplitude first; their voltages are about `v0`.
    v0 : ndarray, shape (axes,)
        [V]
    """

    periods: tuple[PeriodicRecord, ...]
    v0: Array

    @classmethod
    def of(cls, axes: Collection[str], records: Sequence[Record]) -> Multisines | None:
        """Find the multisines of axes in records that can carry shared modes; else None."""
        rates = [piece.sample_rate for record in records for piece in record]
        of_one_rate = same_rate(min(rates), max(rates))
        if not of_one_rate or axes_of(records) != tuple(sorted(axes)):
            return None
        try:
            periods, v0 = periods_of(records)
        except (DataError, IdentificationError):
            return None
        parts = groups(periods).values()
        if len(parts) < 2 or min(map(len, parts)) < 2 or len(v0) != len(axes):
            return None
        return None if max(map(likeness, parts)) > ONE_SIGNAL else cls(periods, v0)

    @property
    def digest(self) -> str:
        """Fingerprint of voltages and displacements."""
        arrays = (np.ascontiguousarray(x) for r in self.periods for x in (r.u, r.y))
        return hashlib.sha256(b''.join(x.tobytes() for x in arrays)).hexdigest()[:16]


class SharedModesFinding(NamedTuple):
    """
    Modes with hysteresis inside their loop, and their law.

    `errors` are those of each law and of ``chains`` on the multisines held out, % of rms(y).
    `held_out` has the mean squared error of the law on them [m^2], in alphabetical order of the
    axes, by the label of each segment of the same amplitude.  `fitted` has the labels of the
    segments that the modes were fitted to.
    """

    modes: SharedModes
    law: str
    errors: Mapping[str, float]
    held_out: Mapping[str, Array]
    fitted: frozenset[str]


def find_shared_modes(
    chains: MultiAxisModel,
    sines: Multisines,
    records: Sequence[Record],
    progress: Progress,
    *,
    tests: bool = False,
) -> SharedModesFinding | None:
    """
    Find hysteresis inside the loop of shared modes, if the chains of the axes err more.

    Parameters
    ----------
    chains : MultiAxisModel
    sines : Multisines
        Multisines in the records.
    records : sequence of Record
    progress : callable
    tests : bool
        Whether the multisines held out stay out of the last fit, to test its modes.

    Returns
    -------
    SharedModesFinding or None
        None for a stage free of such hysteresis.
    """
    try:
        return _found(chains, sines, records, progress, tests)
    except (DataError, IdentificationError, ModelError):
        # the lines leave the order of the model open, or the modes run away on other motion
        return None


def _found(
    chains: MultiAxisModel,
    sines: Multisines,
    records: Sequence[Record],
    progress: Progress,
    tests: bool,
) -> SharedModesFinding | None:
    every, v0 = sines
    to_fit, held_out = held_apart(every)
    errors = {'chains': percent_of(held_out, _steady(chains, held_out, v0))}
    # no law errs by less than the noise
    can_win = _beats(_noise(held_out), errors['chains'])
    if errors['chains'] < _smallest(chains, every) or not can_win:
        return None
    search = LawSearch(every, progress)
    if not search.modes_move():
        return None
    fitted = search.laws()
    errors |= {law: search.error(dict.fromkeys(search.groups, x)) for law, x in fitted.items()}
    law = simplest(LAWS, errors.__getitem__, LAWS.index, 1 / (1 - LAW_GAIN))
    if law in IN_FRONT or not _beats(errors[law], errors['chains']):
        return None
    last = [record for part in to_fit for record in part] if tests else every
    modes = replace(loop_fit(fitted[law], last, iterations=LAST_STEPS), v0=v0)
    modes = _placed(with_creep(modes, records), records)
    progress('shared modes', 1.0)
    judged = modes if tests else fitted[law]
    errors[law] = search.error(dict.fromkeys(search.groups, judged))
    missed = search.missed(judged)
    return SharedModesFinding(
        modes,
        law,
        errors,
        {record.name: missed[record.group] for record in every},
        frozenset(record.name for record in last),
    )


def _beats(error: float, chains: float) -> bool:
    """Tell whether an error is so small that chains are given up."""
    return error**2 <= TAKES * chains**2


def _noise(records: Sequence[PeriodicRecord]) -> float:
    """Compute the noise in one period, in % of rms(y), by medians, as the start may settle."""
    of_each = [NORMAL * np.median(np.abs(r.noise), axis=0) for r in records]
    power = [np.mean(r.y[-1] ** 2, axis=0) for r in records]
    shares = [np.sum(n**2) / np.sum(p) for n, p in zip(of_each, power, strict=True)]
    return 100 * float(np.sqrt(np.mean(shares)))


def _steady(chains: MultiAxisModel, records: Sequence[PeriodicRecord], v0: Array) -> list[Array]:
    """Simulate chains over the second of two equal periods."""
    answers, order = [], sorted(chains.axes)
    for record in records:
        v = np.tile(record.u[-1] + v0, (2, 1))
        with warnings.catch_warnings():
            warnings.simplefilter('ignore')
            y = chains.simulate(dict(zip(map(voltage_of, order), v.T, strict=True)))
        answers.append(np.column_stack([y[axis] for axis in order])[len(v) // 2 :])
    return answers


def _smallest(chains: MultiAxisModel, records: Sequence[PeriodicRecord]) -> float:
    """Compute the smallest effect, in % of rms(y)."""
    spans = [chains.axes[a].scaling.Y for a in sorted(chains.axes)]
    rms = np.sqrt(np.mean([np.mean(r.y**2, axis=(0, 1)) for r in records], axis=0))
    return SMALLEST_EFFECT * float(np.linalg.norm(spans) / np.linalg.norm(rms))


def _placed(modes: SharedModes, records: Sequence[Record]) -> SharedModes:
    """Set the displacements about which the modes hold by the records as a whole."""
    every = [Axes.of(piece) for record in records for piece in record]
    left = np.concatenate([axes.outputs - modes.simulate(axes.inputs) for axes in every])
    return replace(modes, y0=modes.y0 + np.nanmean(left, axis=0))


def held_apart(
    records: Sequence[PeriodicRecord],
) -> tuple[list[list[PeriodicRecord]], list[PeriodicRecord]]:
    """Hold out one record of each group; return the others of each group, and those held out."""
    # the record with the largest weight repeats best, so its error says most
    parts = [sorted(part, key=lambda record: record.weight) for part in groups(records).values()]
    return [part[:-1] for part in parts], [part[-1] for part in parts]


class LawSearch:
    """
    Fits of the laws to periodic records; one record of each group is held out.

    Parameters
    ----------
    records : sequence of PeriodicRecord
        At least two in each group, smallest amplitude first.
    progress : callable
    """

    def __init__(self, records: Sequence[PeriodicRecord], progress: Progress) -> None:
        self._progress = progress
        to_fit, self.held_out = held_apart(records)
        self._few = [record for part in to_fit for record in part[-FEW:]]
        self.groups = [record.group for record in self.held_out]
        middle = len(to_fit) // 2
        self._middle = to_fit[middle][-FEW:]
        progress('shared modes', 0.0)
        start, _ = choose_order(to_fit[middle], [self.held_out[middle]], orders=ORDERS)
        progress('shared modes', 0.1)
        self.plain = SharedModes.of(start)
        self.linear = loop_fit(self.plain, self._few, iterations=STEPS)

    def _grown(self, modes: SharedModes, still: Sequence[int] = ()) -> SharedModes:
        """Fit the effect of new signals alone, then the signals, too."""
        pushes = loop_fit(modes, self._few, hold=('f', 'g', 'mu'), still=still, iterations=2)
        return loop_fit(pushes, self._few, still=still, iterations=STEPS)

    def error(self, models: Mapping[str, SharedModes]) -> float:
        """Compute the error of the model of each group on its record held out, in %."""
        try:
            answers = [models[r.group].steady(r.u[-1]) for r in self.held_out]
        except ModelError:
            return float('inf')
        return percent_of(self.held_out, answers)

    def missed(self, model: SharedModes) -> dict[str, Array]:
        """Compute the mean squared error of a model on the record held out of each group."""
        answers = [r.error(model.steady(r.u[-1])) for r in self.held_out]
        of_groups = zip(self.groups, answers, strict=True)
        return {group: np.nanmean(e**2, axis=0) for group, e in of_groups}

    def modes_move(self) -> bool:
        """Tell whether linear models of each amplitude err less with modes of their own."""
        kept, own = {}, {}
        for group, part in groups(self._few).items():
            kept[group] = loop_fit(self.linear, part, hold=('poles',), iterations=STEPS)
            own[group] = loop_fit(kept[group], part, iterations=STEPS)
        self._progress('shared modes', 0.3)
        return self.error(own) < (1 - LAW_GAIN) * self.error(kept)

    def laws(self) -> dict[str, SharedModes]:
        """Fit every law."""
        plain, inputs = self.plain, range(len(self.plain.v0))
        front = self._grown(with_input_plays(plain, self._middle), inputs)
        self._progress('shared modes', 0.4)
        plays = self._grown(with_loop_plays(plain, self._middle))
        self._progress('shared modes', 0.5)
        soft = self._grown(with_softening(plain, self._middle))
        self._progress('shared modes', 0.6)
        both = self._grown(with_loop_plays(soft, self._middle))
        both = self._grown(with_input_plays(both, self._middle))
        self._progress('shared modes', 0.9)
        return dict(zip(LAWS, (self.linear, front, plays, soft, both), strict=True))


def with_shared_modes(
    result: Diagnosis, finding: SharedModesFinding, predicted: Mapping[tuple[str, float], Array]
) -> Diagnosis:
    """
    Name the hysteresis of shared modes in the diagnosis of an axis.

    The modes have `predicted` its displacement [m], by record and start of the piece [s].
    """
    residuals = []
    for x in result.residuals:
        e = x.piece.y - predicted[x.record, x.piece.start_time][: x.piece.n]
        # the sensor may have been zeroed again
        residuals.append(replace(x, after=e - e[x.sound].mean()))
    sound = [(x.after[x.sound], x.piece.y[x.sound]) for x in residuals]
    left_over, y = (np.concatenate(parts) for parts in zip(*sound, strict=True))
    after = 100 * float(np.sqrt(np.mean(left_over**2)) / np.ptp(y))
    before = result.before.overall
    left = min(1.0, (after / before) ** 2)
    taken = float(np.sqrt(max(before**2 - after**2, 0.0)))
    told = ', '.join(f'{law} {error:.3g} %' for law, error in finding.errors.items())
    sentence = (
        f'The axes share modes with hysteresis inside their loop: {NAME} '
        f'({finding.law}{finding.modes.creep_told}). The error is {after:.3g} % of stroke, '
        f'{before:.3g} % before. On multisines held out, in % of rms(y): {told}.'
    )
    return replace(
        result,
        verdict='named',
        sentence=sentence,
        effects=(FoundEffect(NAME, 'hidden', 1 - left, taken, {}),),
        group=None,
        gain=None,
        set_in=False,
        unexplained=Unexplained(left, after, LEFT),
        after=Errors(after, {}, {}),
        held_out=None,
        residuals=tuple(residuals),
        promise=None,
        weights={},
    )
