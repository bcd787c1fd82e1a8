# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
A stage of several axes: a chain for each axis, and paths between them.

    y_i = chain_i(v_i) + sum over j of path_ij(m_j),        m_j = chain_j(v_j)

m_j is the motion of axis j by its own voltage.  A path therefore carries the hysteresis, the modes
and the creep of its source.  A path is the effect `cross_coupling` in the model of axis i; its
channel is the motion.  `piezo_ident.model.axis_records` has the names of the axes.

Hysteresis inside the loop of modes that the axes share is no sum of chains.  A model with such
`modes` (`piezo_ident.model.modes.shared_modes`) predicts all displacements by them.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
import os
from pathlib import Path
from types import MappingProxyType
from typing import Any, Generic, TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from piezo_ident.common.arrays import Array, real_array
from piezo_ident.common.errors import DataError, ModelError
from piezo_ident.common.files import write_text
from piezo_ident.model.axis_records import axis_record, columns_of, MOTION, motion_of, voltage_of
from piezo_ident.model.free_run import free_run, predict
from piezo_ident.model.front_door import AxesFrontDoor
from piezo_ident.model.modes.shared_modes import SharedModes
from piezo_ident.model.stage_model import EffectSetting, StageModel, warn_of_unused
from piezo_ident.record.record import Piece, Record

if TYPE_CHECKING:
    from matplotlib.figure import Figure

T = TypeVar('T')

#: entry below `identification` of an axis with what is known of its prediction by shared modes
SHARED_MODES = 'shared_modes'


@dataclass(frozen=True, eq=False, repr=False)
class EachAxis(Mapping[str, T], Generic[T]):
    """
    Results of a verb for each axis of a stage, by the name of its displacement.

    `modes` are modes that the axes share, if the verb found hysteresis inside their loop.

    Examples
    --------
    >>> import piezo_ident as pi
    >>> errors = pi.EachAxis({'y': 0.2, 'y_b': 0.3})
    >>> errors['y_b'], list(errors)
    (0.3, ['y', 'y_b'])
    """

    axes: Mapping[str, T]
    modes: SharedModes | None = field(default=None, kw_only=True)

    def __getitem__(self, axis: str) -> T:
        return self.axes[axis]

    def __iter__(self) -> Iterator[str]:
        return iter(self.axes)

    def __len__(self) -> int:
        return len(self.axes)

    def __repr__(self) -> str:
        return self.told(repr)

    def mapped(self, change: Callable[[str, T], T]) -> EachAxis[T]:
        """Apply a function to the name and the result of each axis."""
        return EachAxis({axis: change(axis, x) for axis, x in self.items()}, modes=self.modes)

    def told(self, text: Callable[[T], str]) -> str:
        """Join a text for each axis, under the name of the axis."""
        return '\n\n'.join(f'-- axis {axis}\n{text(x)}' for axis, x in self.items())

    @property
    def model(self) -> MultiAxisModel:
        """Model of the stage, from results that hold a model for each axis."""
        return MultiAxisModel(self._of_each('model'), self.modes)

    @property
    def errors(self) -> Mapping[str, Any]:
        """The `errors` of each axis."""
        return self._of_each('errors')

    @property
    def warnings(self) -> tuple[str, ...]:
        """The `warnings` of all axes, each behind the name of its axis."""
        warnings = self._of_each('warnings')
        return tuple(f'axis {axis}: {text}' for axis, texts in warnings.items() for text in texts)

    def plot(self) -> dict[str, Figure]:
        """Draw the picture of each axis."""
        return {axis: plot() for axis, plot in self._of_each('plot').items()}

    def to_json(self) -> dict[str, Any]:
        """Convert the results to plain data for strict JSON."""
        import piezo_ident as pi

        return pi.report.to_json(self)

    def _of_each(self, attribute: str) -> dict[str, Any]:
        return {axis: getattr(result, attribute) for axis, result in self.items()}


@dataclass(frozen=True, eq=False)
class MultiAxisModel(AxesFrontDoor):
    """
    Model of a stage of several axes: a model for each axis, with the paths among its effects.

    Parameters
    ----------
    axes : mapping of str to StageModel
        Models by the name of the displacement: ``y``, ``y_b``.
    modes : SharedModes, optional
        Modes that the axes share, with their voltages and displacements in alphabetical order.
        They predict instead of the chains.  The chains keep range and scaling.

    Raises
    ------
    ModelError
        When the axes have different sampling rates, a path has no source, or the modes are of
        another number of axes.

    Examples
    --------
    Two axes of a scanner; the second also moves by 1 % of the motion of the first:

    >>> import numpy as np
    >>> import piezo_ident as pi
    >>> from dataclasses import replace
    >>> from piezo_ident.model.stage_model import EffectSetting
    >>> one = pi.SimulatedStage.load('paper').model
    >>> shape = {'channel': 'motion', 'gain': 0.01 / one.scaling.Y, 'frequency': 1000.0}
    >>> other = replace(one, effects=(EffectSetting('cross_coupling', shape),))
    >>> stage = pi.MultiAxisModel({'y': one, 'y_b': other})
    >>> y = stage.simulate({'v': np.linspace(0, 10, 5000), 'v_b': np.zeros(5000)})
    >>> round(100 * float(y['y_b'][-1] / y['y'][-1]), 2)
    1.0
    >>> stage.save('stage.yaml')
    >>> list(pi.load('stage.yaml').axes)
    ['y', 'y_b']
    """

    axes: Mapping[str, StageModel]
    modes: SharedModes | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, 'axes', MappingProxyType(dict(self.axes)))
        if not self.axes:
            raise ModelError('model: has no axis; see docs/two_axes.md')
        if len({model.sample_rate for model in self.axes.values()}) != 1:
            raise ModelError('model: the axes differ in sample_rate; give axes of one rate')
        if self.modes is not None and self.modes.linear.d.shape != (len(self.axes),) * 2:
            raise ModelError('model: the modes are of another number of axes; diagnose again')
        for axis, model in self.axes.items():
            others = [motion_of(k) for k in self.axes if k != axis]
            for effect in model.effects:
                if effect.channel.startswith(MOTION) and effect.channel not in others:
                    raise ModelError(
                        f'model: {effect.name} of axis {axis} needs {effect.channel}, and the '
                        f'other axes give {", ".join(others) or "none"}'
                    )

    def __repr__(self) -> str:
        lines = (f'  {axis}: {model!r}' for axis, model in self.axes.items())
        shared = []
        if self.modes is not None:
            shared = [f'  shared: {self.modes.linear.order} states{self.modes.creep_told}']
        return '\n'.join(['MultiAxisModel:', *lines, *shared])

    @property
    def sample_rate(self) -> float:
        """Rate of all axes [Hz]."""
        return next(iter(self.axes.values())).sample_rate

    def own(self, axis: str) -> StageModel:
        """Take the paths of the other axes out of the model of an axis."""
        return without_other_axes(self.axes[axis])

    def require_chains(self, verb: str) -> None:
        """Refuse a model with shared modes for a verb that runs chains alone."""
        if self.modes is not None:
            raise ModelError(
                f'{verb}: cannot run the modes that the axes share, with hysteresis inside their '
                'loop; predict can. MultiAxisModel(model.axes) is the model without them'
            )

    def takes(self, piece: Piece) -> bool:
        """Tell whether the model holds at the sampling rate of a piece."""
        return all(model.takes(piece) for model in self.axes.values())

    def check_rate(self, piece: Piece) -> None:
        """Refuse a piece with another sampling rate than the model with a ModelError."""
        next(iter(self.axes.values())).check_rate(piece)

    def check_axes(self, columns: Collection[str], name: str) -> None:
        """Refuse data without the voltage of an axis with a DataError."""
        missing = [voltage_of(axis) for axis in self.axes if voltage_of(axis) not in columns]
        if missing:
            raise DataError(
                f'{name}: has no voltage {", ".join(missing)}; the model holds for '
                f'{", ".join(self.axes)}, and each axis needs its voltage'
            )

    def motions(self, record: Record) -> dict[str, list[Array]]:
        """Compute the motion of each axis by its own voltage, an array for each piece [m]."""
        motions = {}
        for axis in self.axes:
            seen, own = axis_record(record, axis), self.own(axis)
            known = all(np.isfinite(piece.y).all() for piece in seen)
            motions[axis] = [*(free_run(own, seen).pieces if known else predict(own, seen))]
        return motions

    def seen(self, record: Record) -> dict[str, Record]:
        """Split a record by axis, with the motions of the other axes as channels."""
        self.check_axes({c for piece in record for c in columns_of(piece)}, record.name)
        motions = None if self.modes is not None else self.motions(record)
        return {axis: axis_record(record, axis, motions) for axis in self.axes}

    def simulate(
        self, voltages: Mapping[str, ArrayLike], *, channels: Mapping[str, ArrayLike] | None = None
    ) -> dict[str, Array]:
        """
        Predict the displacement of each axis from the voltages, in free run.

        Parameters
        ----------
        voltages : mapping of str to array_like, shape (n,)
            Voltages by their columns, ``v`` and ``v_b`` [V].
        channels : mapping of str to array_like, shape (n,), optional
            Further signals that effects depend on.

        Returns
        -------
        dict of str to ndarray, shape (n,)
            [m]

        Raises
        ------
        DataError
            When the voltage of an axis is missing.
        """
        self.check_axes(voltages, 'simulate')
        columns = {a: voltage_of(a) for a in self.axes}
        v = {a: real_array(voltages[k], f'simulate, {k}') for a, k in columns.items()}
        further = dict(channels or {})
        if len({x.size for x in v.values()}) > 1:
            raise DataError('simulate: the voltages of the axes differ in length')
        warn_of_unused(self.axes.values(), further)
        if self.modes is not None:
            return self.modes.of_axes(v)
        chains = {a: self.own(a) for a in self.axes}
        own = {a: x.simulate(v[a], channels=x.used(further)) for a, x in chains.items()}
        moved = {motion_of(a): m for a, m in own.items()}
        return {
            axis: own[axis]
            if model.effects == chains[axis].effects
            else model.simulate(v[axis], channels=model.used({**further, **moved}))
            for axis, model in self.axes.items()
        }

    def predicted(self, record: Record) -> dict[str, tuple[Array, ...]]:
        """Predict the displacement of each axis from the voltages alone [m], piece by piece."""
        seen = self.seen(record)
        for piece in record:
            self.check_rate(piece)
        if self.modes is None:
            return {axis: predict(x, seen[axis]) for axis, x in self.axes.items()}
        pieces = zip(*seen.values(), strict=True)
        columns = [{a: p.v for a, p in zip(seen, axes, strict=True)} for axes in pieces]
        runs = [self.modes.of_axes(v) for v in columns]
        return {axis: tuple(run[axis] for run in runs) for axis in self.axes}

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the model file; an old file stays whole until the new file is complete."""
        from piezo_ident.model.axes_file import text_of

        write_text(path, text_of(self))


def each_of(result: T | EachAxis[T]) -> Mapping[str, T]:
    """List the result of each axis; the one of a stage of one axis is ``y``."""
    return result if isinstance(result, EachAxis) else {'y': result}


def files_of(result: object, path: Path) -> dict[str, Path]:
    """Name a file for each axis of a result or model; that of a stage of one axis is `path`."""
    if not isinstance(result, EachAxis | MultiAxisModel):
        return {'y': path}
    return {axis: path.with_name(f'{path.stem}_{axis}{path.suffix}') for axis in result.axes}


def mapped(result: T | EachAxis[T], change: Callable[[str, T], T]) -> T | EachAxis[T]:
    """Apply a function to the name and the result of each axis, or to ``y`` and the result."""
    return result.mapped(change) if isinstance(result, EachAxis) else change('y', result)


def models_of(model: StageModel | MultiAxisModel) -> Mapping[str, StageModel]:
    """List the model of each axis; the one of a `StageModel` is ``y``."""
    return {'y': model} if isinstance(model, StageModel) else model.axes


def shares_modes(model: StageModel | MultiAxisModel | None) -> bool:
    """Tell whether modes that the axes share predict instead of chains."""
    return isinstance(model, MultiAxisModel) and model.modes is not None


def require_voltages_only(model: StageModel | MultiAxisModel) -> None:
    """Refuse a model with an effect that needs a measured channel, with a ModelError."""
    several = isinstance(model, MultiAxisModel)
    for effect in (effect for x in models_of(model).values() for effect in x.effects):
        if effect.channel and not (several and effect.channel.startswith(MOTION)):
            raise ModelError(
                f'effect {effect.name} needs the further channel {effect.channel!r}, which '
                'does not come with the voltage; take the effect out of the model'
            )


def without_other_axes(model: StageModel) -> StageModel:
    """Take the paths of other axes out of the model of an axis."""
    kept = tuple(e for e in model.effects if not e.channel.startswith(MOTION))
    return replace(model, effects=kept)


def alone(model: StageModel | MultiAxisModel) -> Mapping[str, StageModel]:
    """
    List the model of each axis without the paths of the others.

    Shared modes predict instead of the chains.  Each model then has the creep, the known errors
    and the band of the modes, not those of its chain.
    """
    if isinstance(model, StageModel):
        return {'y': model}
    if model.modes is not None:
        creep = {a: model.modes.creep_of(j) for j, a in enumerate(sorted(model.axes))}
        return {a: _beside_modes(x, *creep[a]) for a, x in model.axes.items()}
    return {a: model.own(a) for a in model.axes}


def judged_models(model: StageModel | MultiAxisModel) -> Mapping[str, StageModel]:
    """List the model of each axis with the known errors and the band of its prediction."""
    return alone(model) if shares_modes(model) else models_of(model)


def _beside_modes(model: StageModel, gains: Array, taus: Array) -> StageModel:
    known = model.identification.get(SHARED_MODES)
    known = known if isinstance(known, Mapping) else {}
    values = {'gain': gains.tolist(), 'time_constant': (taus / model.sample_rate).tolist()}
    effects = (EffectSetting('creep', values),) if gains.size else ()
    return replace(model, effects=effects, identification=dict(known))


def with_own(
    model: StageModel | MultiAxisModel, own: Mapping[str, StageModel]
) -> StageModel | MultiAxisModel:
    """
    Put changed models of `alone` back into a model, whose paths stay as they are.

    The changed models have the effects that `alone` gave them.  Shared modes take the last gain
    that each axis has learnt, about the zero of its scaling.
    """
    if isinstance(model, StageModel):
        return own['y']
    if model.modes is not None:
        return _with_gains(model, model.modes, own)
    axes = {}
    for axis, x in model.axes.items():
        effects = iter(own[axis].effects)
        kept = tuple(e if e.channel.startswith(MOTION) else next(effects) for e in x.effects)
        axes[axis] = replace(own[axis], effects=kept)
    return replace(model, axes=axes)


def _with_gains(
    model: MultiAxisModel, modes: SharedModes, own: Mapping[str, StageModel]
) -> MultiAxisModel:
    known = {axis: {SHARED_MODES: own[axis].identification} for axis in model.axes}
    axes = {
        a: replace(x, identification={**x.identification, **known[a]})
        for a, x in model.axes.items()
    }
    order = [own[axis] for axis in sorted(own)]
    learnt = [x.identification['adaptation'][-1]['gain']['value'] for x in order]
    zeros = np.array([x.scaling.y0 for x in order])
    return MultiAxisModel(axes, modes.grown(np.array(learnt), zeros))
