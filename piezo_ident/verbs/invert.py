# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Invert a model of one axis or of several."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import DataError
from piezo_ident.control.axes.modes_inverse import invert_modes
from piezo_ident.control.inputs import checked_motion
from piezo_ident.control.inverse import Inverse
from piezo_ident.control.inverse import invert as invert_axis
from piezo_ident.model.axis_records import motion_of, voltage_of
from piezo_ident.model.metrics import percent_of_stroke
from piezo_ident.model.multi_axis import EachAxis, MultiAxisModel
from piezo_ident.model.stage_model import StageModel, warn_of_unused

#: most rounds of an inversion of several axes.  The rounds end once each voltage changes by less
#: than this share of the span of the model
ROUNDS, SAME = 6, 1e-5


@dataclass(frozen=True, eq=False, repr=False)
class MultiAxisInverse(EachAxis[Inverse]):
    """
    Voltages that move a stage of several axes along wanted displacements.

    Attributes
    ----------
    axes : mapping of str to Inverse
        Inverse of each axis, with the motions of the other axes known.
    voltages : dict of str to ndarray, shape (n,)
        Voltages by their columns, ``v`` and ``v_b``, from one common beginning [V].
    predicted : dict of str to ndarray, shape (n,)
        Displacement of the whole model under these voltages, by axis [m].
    lead : int
        Samples by which the voltages begin before the wanted motion.
    remaining : dict of str to float
        100 rms(wanted - predicted) / (max wanted - min wanted), without the lead.  For an axis at
        rest the span of the model replaces the denominator.

    Examples
    --------
    >>> import numpy as np
    >>> import piezo_ident as pi
    >>> one = pi.SimulatedStage.load('paper').model
    >>> stage = pi.MultiAxisModel({'y': one, 'y_b': one})
    >>> drive = pi.invert(stage, {'y': np.linspace(20e-6, 30e-6, 500)})
    >>> sorted(drive.voltages), drive.errors['y'] < 0.1
    (['v', 'v_b'], True)
    """

    voltages: Mapping[str, Array]
    predicted: Mapping[str, Array]
    lead: int
    remaining: Mapping[str, float]

    @property
    def errors(self) -> Mapping[str, float]:
        """The errors of the inversion, as `remaining`."""
        return self.remaining

    def __repr__(self) -> str:
        """Describe the inverse of each axis, and the errors of the whole stage."""
        left = ', '.join(f'{axis} {error:.2g}' for axis, error in self.errors.items())
        return f'{super().__repr__()}\n\nleft by the inversion of all [% of stroke]: {left}'


@overload
def invert(model: StageModel, wanted: ArrayLike, **options: Any) -> Inverse: ...


@overload
def invert(
    model: MultiAxisModel, wanted: Mapping[str, ArrayLike], **options: Any
) -> MultiAxisInverse: ...


def invert(
    model: StageModel | MultiAxisModel,
    wanted: ArrayLike | Mapping[str, ArrayLike],
    *,
    channels: Mapping[str, ArrayLike] | None = None,
    **options: Any,
) -> Inverse | MultiAxisInverse:
    """
    Find the voltage that moves a model along a wanted displacement, or the voltages of its axes.

    Parameters
    ----------
    model : StageModel or MultiAxisModel
    wanted : array_like, shape (n,), or mapping of str to array_like
        Displacement [m], sampled at the rate of the model.  A model of several axes needs a
        mapping by axis.  An absent axis rests at the displacement of its lowest voltage; with
        shared modes it rests at the displacement of the middle voltage of their fit.  The stage
        rests before and after the motion: before it in the settled state after one stroke from
        the lowest voltage.  With creep, begin at the displacement of the lowest voltage, which
        does not creep.
    channels : mapping of str to array_like, shape (n,), optional
        Further signals that effects of the model depend on.
    **options
        ``limits``, ``slew``, ``clip``, ``sample_rate`` and ``like`` of
        `piezo_ident.control.inverse.invert`.  These options hold for each axis.

    Returns
    -------
    Inverse or MultiAxisInverse

    Raises
    ------
    DataError
        When the wanted motion is not a vector of finite numbers, or lies beyond the limits.
    ModelError
        When the model has no inverse.

    Notes
    -----
    The motions of the other axes are a known disturbance of each axis.  The first round takes
    the wanted motions of the other axes, each later round the motions under the last voltages.

    Examples
    --------
    >>> import numpy as np
    >>> import piezo_ident as pi
    >>> model = pi.SimulatedStage.load('paper').model
    >>> t = np.arange(4000) / model.sample_rate
    >>> wanted = 30e-6 * (1 - np.cos(2 * np.pi * 10 * t)) + 5e-6
    >>> drive = pi.invert(model, wanted)
    >>> drive.error < 0.01, bool(0 <= drive.v.min() and drive.v.max() <= 10)
    (True, True)
    """
    if not isinstance(model, MultiAxisModel):
        if isinstance(wanted, Mapping):
            raise DataError('invert: the model has one axis; give one motion')
        warn_of_unused([model], channels or {})
        return invert_axis(model, wanted, channels=channels, **options)
    goals = _goals(model, wanted)
    if model.modes is not None:
        return _driven(model, invert_modes(model, model.modes, goals, **options), channels)
    moved, inverses = dict(goals), dict[str, Inverse]()
    for _ in range(ROUNDS):
        last, inverses = inverses, {}
        for axis, x in model.axes.items():
            others = {motion_of(k): m for k, m in moved.items() if k != axis}
            beside = {**(channels or {}), **others}
            inverses[axis] = invert_axis(x, goals[axis], channels=beside, **options)
        for axis, one in inverses.items():
            own = model.own(axis)
            y = own.simulate(one.v, channels=own.used(_led(channels, one.lead)))
            moved[axis] = y[one.lead :]
        if last and all(_alike(last[k], inverses[k], model.axes[k].scaling.V) for k in inverses):
            break
    return _driven(model, inverses, channels)


def _driven(
    model: MultiAxisModel,
    inverses: Mapping[str, Inverse],
    channels: Mapping[str, ArrayLike] | None,
) -> MultiAxisInverse:
    """Run the whole model under the voltages of the axes, from one common beginning."""
    lead = max(one.lead for one in inverses.values())
    v = {
        voltage_of(k): np.pad(one.v, (lead - one.lead, 0), mode='edge')
        for k, one in inverses.items()
    }
    predicted = model.simulate(v, channels=_led(channels, lead))
    errors = {}
    for k, one in inverses.items():
        goal, whole = one.wanted[one.lead :], abs(model.axes[k].scaling.Y)
        errors[k] = percent_of_stroke(goal, predicted[k][lead:], None if np.ptp(goal) else whole)
    return MultiAxisInverse(inverses, v, predicted, lead, errors)


def _goals(model: MultiAxisModel, wanted: ArrayLike | Mapping[str, ArrayLike]) -> dict[str, Array]:
    """
    Return the wanted motion of every axis; raise DataError if the motions do not fit.

    With shared modes an absent axis stays absent.
    """
    if not isinstance(wanted, Mapping):
        raise DataError(
            f'invert: give the motion of each axis by its name, of {", ".join(model.axes)}'
        )
    unknown = [name for name in wanted if name not in model.axes]
    if unknown or not wanted:
        raise DataError(
            f'invert: {", ".join(unknown) or "no motion"}: the axes are {", ".join(model.axes)}'
        )
    goals = {name: checked_motion(y) for name, y in wanted.items()}
    sizes = {y.size for y in goals.values()}
    if len(sizes) > 1:
        raise DataError('invert: the motions of the axes differ in length; give one a sample')
    if model.modes is not None:
        return goals
    rest = {a: model.own(a).simulate([x.scaling.range[0]])[0] for a, x in model.axes.items()}
    return {a: goals.get(a, np.full(max(sizes), rest[a])) for a in model.axes}


def _led(channels: Mapping[str, ArrayLike] | None, lead: int) -> dict[str, Array]:
    """Begin channels `lead` samples earlier by repeating their first values."""
    return {k: np.pad(np.asarray(x), (lead, 0), mode='edge') for k, x in (channels or {}).items()}


def _alike(last: Inverse, one: Inverse, span: float) -> bool:
    a, b = (x.v[x.lead :] for x in (last, one))
    return bool(np.abs(a - b).max() < SAME * abs(span))
