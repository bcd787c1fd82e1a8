# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Turn the reference of a stage into its voltage, block by block.

An `AxisDrive` of each axis joins and corrects the reference, and guards the voltage.  `LiveChains`
or `LiveModesInverse` makes the voltages of all axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import DataError
from piezo_ident.control.axes.live_axes import LiveChains
from piezo_ident.control.axes.live_modes import LiveModesInverse
from piezo_ident.control.inputs import FAR
from piezo_ident.control.live_inverse import PREVIEW
from piezo_ident.live.axis_drive import AxisDrive, check_rate, Drive, inverse_of, Successor
from piezo_ident.live.follower import Follower
from piezo_ident.live.guard import GuardSettings
from piezo_ident.live.predictor import check_axes
from piezo_ident.model.multi_axis import alone, models_of, MultiAxisModel
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.blocks import Samples


class Tracker:
    """
    Follows the reference of a stage with a model.

    The stage is at rest before the first block.  Arrays of several axes have a row for each axis.

    Parameters
    ----------
    model : StageModel or MultiAxisModel
    settings : GuardSettings
        Limits and slew of each axis, at the rate of the model.
    preview : int, optional
        Samples by which the stage follows the reference later.
    follow : {'off', 'offset', 'gain'}, optional
        Corrections of each axis by its measured displacement: none; offset and creep from earlier
        motion; or offset, creep and gain.
    axes : sequence of str, optional
        Order of the rows, by the names of the displacements.

    Attributes
    ----------
    inverse : LiveChains or LiveModesInverse
        Makes the voltages.

    Raises
    ------
    DataError, ModelError
        When an axis has no inverse within these limits; see `LiveInverse`.

    Examples
    --------
    >>> import piezo_ident as pi
    >>> model = pi.SimulatedStage.load('paper').model
    >>> tracker = Tracker(model, GuardSettings(0, 10, 40e3, 20, 0, model.sample_rate))
    >>> drive = tracker.process(np.full(20000, 30e-6))
    >>> y = model.simulate(drive.v)
    >>> bool(np.abs(y - drive.wanted).max() < 1e-8), float((1e6 * y[-1]).round(3))
    (True, 30.0)
    """

    def __init__(
        self,
        model: StageModel | MultiAxisModel,
        settings: GuardSettings,
        preview: int = PREVIEW,
        follow: str = 'off',
        axes: Sequence[str] = ('y',),
    ) -> None:
        self.settings, self.preview, self.follow, s = settings, preview, follow, settings
        single = [alone(model)[axis] for axis in axes]
        self.inverse: LiveChains | LiveModesInverse
        if isinstance(model, MultiAxisModel) and model.modes is not None:
            check_rate(single[0], s)
            self.inverse = LiveModesInverse(
                model, axes, limits=(s.low, s.high), slew=s.slew, preview=preview, rest=s.rest
            )
        else:
            each = [inverse_of(x, settings, preview) for x in single]
            self.inverse = LiveChains(each, model, axes)
        self._each = [AxisDrive(x, settings, preview, follow) for x in self.inverse.models]
        self.reset()

    def reset(self) -> None:
        """Begin at rest, with the clock of the voltages at zero."""
        self.inverse.reset()
        for one, start in zip(self._each, self.inverse.position.tolist(), strict=True):
            one.reset(start)

    @property
    def followers(self) -> list[Follower]:
        """The follower of each axis; empty if `follow` is ``'off'``."""
        return [one.follower for one in self._each if one.follower is not None]

    @property
    def rest(self) -> list[float]:
        """Displacement of each axis at rest [m]; after `reset`."""
        return [one.last_reference for one in self._each]

    @property
    def tick(self) -> int:
        """Samples sent so far."""
        return self._each[0].tick

    @property
    def is_at_rest(self) -> bool:
        """Whether the voltage of rest was sent last on every axis."""
        return all(one.is_at_rest for one in self._each)

    def process(self, reference: ArrayLike, restarted: bool = False) -> Drive:
        """
        Make the voltage for the next samples of a reference.

        A sample that is NaN or infinite repeats the last sample.

        Parameters
        ----------
        reference : array_like, shape (n,), or (k, n) for k axes
            [m]
        restarted : bool, optional
            Whether a new stream begins here, which has to be joined.

        Returns
        -------
        Drive
            As many samples of voltage; each belongs to the reference `preview` samples before.
        """
        each = self._each
        rows = zip(each, np.atleast_2d(reference), strict=True)
        wanted = np.stack([one.joined(row, restarted) for one, row in rows])
        goals = zip(each, wanted, self.inverse.goals(wanted), strict=True)
        driven = self.inverse.process(np.stack([one.corrected(*x) for one, *x in goals]))
        drives = [one.drive(*x) for one, *x in zip(each, *driven, strict=True)]
        v, now = (_rows([getattr(drive, x) for drive in drives]) for x in ('v', 'wanted'))
        self._follow(drives[0].t, v)
        return Drive(drives[0].t, v, now, sum(drive.clipped for drive in drives))

    def _follow(self, t: Array, v: Array) -> None:
        """Give the followers the sent voltage, and the motion by it and by the other axes."""
        if not (followers := self.followers) or not t.size:
            return
        rows = np.atleast_2d(v)
        own = np.stack([one.moved(t, row) for one, row in zip(followers, rows, strict=True)])
        moved, felt = self.inverse.moved(rows, own)
        for one, *of_axis in zip(followers, rows, moved, felt, strict=True):
            one.drove(t, *of_axis)

    def measured(self, samples: Samples, axis: int = 0) -> None:
        """Take a block of displacement of an axis [m], on the clock of the voltage."""
        if (follower := self._each[axis].follower) is not None:
            follower.measured(samples)

    def finish(self) -> Drive:
        """Make the voltage for the rest of the reference, whose last sample is repeated."""
        return self.process(np.repeat([[x] for x in self.rest], self.preview, axis=1))

    def play(self, v: Array) -> tuple[Array, Array]:
        """Send a given voltage, limited; return its time and voltage."""
        rows = zip(self._each, np.atleast_2d(v), strict=True)
        return self._sent([one.play(row) for one, row in rows])

    def idle(self, n: int, longest: float = np.inf) -> tuple[Array, Array]:
        """Send n samples of a ramp to rest; return time and voltage.  See `Guard.idle`."""
        return self._sent([one.idle(n, longest) for one in self._each])

    def _sent(self, parts: list[tuple[Array, Array]]) -> tuple[Array, Array]:
        t, v = parts[0][0], _rows([v for _, v in parts])
        self._follow(t, v)
        return t, v

    def hurry(self) -> None:
        """Begin the ramps to rest anew, so that `idle` can shorten them."""
        for one in self._each:
            one.hurry()

    # another model of a single axis

    def successor(self, model: StageModel) -> Successor:
        """Bring a model into the state after the voltage so far; any thread may call this."""
        return self._each[0].successor(model)

    def remembers(self, successor: Successor) -> bool:
        """Return whether each sample of the voltage since a successor was made is still kept."""
        return self._each[0].remembers(successor)

    def take_over(self, successor: Successor) -> None:
        """Go on with another model, from the position that it predicts."""
        self._each[0].take_over(successor)
        if isinstance(self.inverse, LiveChains):
            self.inverse.each[0] = successor.inverse


def _rows(of_axes: list[Array]) -> Array:
    """Give several axes a row each; a single axis stays a vector."""
    return np.stack(of_axes) if of_axes[1:] else of_axes[0]


#: a model with a new tracker, or with the successor of the inverse of the present tracker
Prepared: TypeAlias = tuple[StageModel | MultiAxisModel, Tracker | Successor]


def prepared(
    model: StageModel | MultiAxisModel,
    axes: Sequence[str],
    settings: GuardSettings,
    preview: int,
    follow: str,
    now: Tracker | None,
) -> Prepared:
    """
    Prepare another model for the axes of a node; any thread may call this.

    A model of one axis becomes a successor inside the present tracker, `now`, if this tracker has
    the same settings.

    Raises
    ------
    ModelError
        When the model has other axes.
    """
    check_axes(model, axes)
    if not axes[1:]:
        if isinstance(model, MultiAxisModel):
            model.require_chains('feedforward of one axis')
        (model,) = models_of(model).values()
        if now is not None and (now.settings, now.follow) == (settings, follow):
            return model, now.successor(model)
    return model, Tracker(model, settings, preview, follow, axes)


def check_unit(model: StageModel, x: Array) -> None:
    """Refuse a block of a reference that lies far beyond the stage, with a DataError."""
    s = model.scaling
    least = float(np.nanmin(np.abs(x - s.y0), initial=np.inf))
    if FAR * abs(s.Y) < least < np.inf:
        raise DataError(
            f'it wants the stage {1e6 * least:.3g} um away, which moves by '
            f'{1e6 * abs(s.Y):.3g} um; is the reference in metres?'
        )
