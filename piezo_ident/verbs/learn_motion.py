# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Learn a repeated motion of all axes of a stage.

Each axis corrects its reference by its own error, as `piezo_ident.control.learning` does.  Chains
are inverted one by one, with the wanted motions of the other axes, which the axes approach from
run to run.  Modes that the axes share are inverted for the references of all axes together.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import DataError
from piezo_ident.control.inputs import SLIGHT
from piezo_ident.control.inverse import Inverse
from piezo_ident.control.learning import Learning, SharedLearning
from piezo_ident.model.axis_records import motion_of
from piezo_ident.model.multi_axis import alone, MultiAxisModel
from piezo_ident.model.stage_model import StageModel
from piezo_ident.verbs.invert import invert


class AxesLearning:
    """
    A repeated motion of all axes, learned from run to run.

    A resting axis comes as near to its place as the limits allow.

    Parameters
    ----------
    model : StageModel or MultiAxisModel
    wanted : mapping of str to ndarray, shape (n,)
        Displacement of every axis [m].
    **options
        ``limits`` and ``slew`` of `Learning`; they hold for each axis.

    Attributes
    ----------
    each : dict of str to Learning
        Learning of each axis.

    Raises
    ------
    DataError
        When the motion of an axis is out of reach.
    """

    def __init__(
        self, model: StageModel | MultiAxisModel, wanted: Mapping[str, Array], **options: Any
    ) -> None:
        self.each: dict[str, Learning] = {}
        # the model whose modes are inverted for all axes together
        self._shared: MultiAxisModel | None = None
        if isinstance(model, StageModel):
            self.each['y'] = Learning(model, wanted['y'], **options)
        elif model.modes is None:
            drive = invert(model, wanted, clip=True, **options)
            moved = {motion_of(a): model.own(a).simulate(x.v)[x.lead :] for a, x in drive.items()}
            for axis, x in model.axes.items():
                y = wanted[axis]
                self.each[axis] = Learning(x, y, clip=not np.ptp(y), channels=moved, **options)
        else:
            self._shared, self._options = model, options
            drives = invert(model, wanted, clip=not all(map(np.ptp, wanted.values())), **options)
            for axis, x in alone(model).items():
                _check_reach(drives[axis])
                self.each[axis] = SharedLearning(x, drives[axis])

    def take(self, measured: Mapping[str, Array]) -> None:
        """
        Learn from the displacements under the drives, and plan the next drives.

        Parameters
        ----------
        measured : mapping of str to ndarray
            Displacement of every axis [m]; the last samples belong to its drive.

        Raises
        ------
        DataError
            As `Learning.take`; the axes before the refused axis have learnt.
        """
        try:
            for axis, y in measured.items():
                one = self.each[axis]
                learn = one.take if self._shared is None else one.learn
                learn(y[-one.drive.v.size :])
        except DataError as error:
            if len(self.each) == 1:
                raise
            raise DataError(f'{axis}: {error}') from error
        finally:
            if self._shared is not None:
                # a corrected reference may exceed a limit although the motion does not
                references = {axis: one.reference for axis, one in self.each.items()}
                drives = invert(self._shared, references, clip=True, **self._options)
                for axis, drive in drives.items():
                    self.each[axis].drive = drive


def _check_reach(drive: Inverse) -> None:
    """Raise DataError for a moving axis out of reach; clipping is for resting axes alone."""
    missed = np.abs(drive.wanted - drive.predicted)[drive.clipped]
    span = float(np.ptp(drive.wanted[drive.lead :]))
    if span and missed.size and missed.max() > SLIGHT * span:
        raise DataError(next(text for text in drive.warnings if 'out of reach' in text))
