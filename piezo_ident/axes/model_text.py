# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A model of several axes, and its text: YAML that reads back to the same numbers, bit by bit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from piezo_ident.axes.loop_model import LoopModel
from piezo_ident.axes.modal import Modal
from piezo_ident.common.errors import ModelError
from piezo_ident.common.files import load_yaml, write_text
from piezo_ident.model.files import plain
import yaml

#: the key that tells such a text from a model of one axis
KEY = 'several_axes'


@dataclass(frozen=True, eq=False)
class AxesModel:
    """
    A model with what it needs beside its equations.

    Attributes
    ----------
    model : LoopModel
    sample_rate : float
        [Hz]
    inputs, outputs : tuple of str
        Their columns.
    v0 : ndarray, shape (inputs,)
        Voltages about which it holds [V].
    effect : str
        What it has beside linear dynamics.
    error_percent : float
        100 rms(y - yhat) / rms(y) in free run, on records that were held out.

    Examples
    --------
    >>> import numpy as np
    >>> import piezo_ident as pi
    >>> from piezo_ident.axes.loop_model import LoopModel
    >>> from piezo_ident.axes.modal import Modal
    >>> d = np.array([[1e-6, 2e-8]])  # m/V
    >>> stiff = Modal(np.zeros((1, 2, 2)), np.zeros((2, 2)), np.zeros((1, 2)), d)
    >>> model = pi.AxesModel(
    ...     LoopModel.of(stiff), 2e4, ('v', 'v_b'), ('y',), np.zeros(2), 'linear', 0.0
    ... )
    >>> model.save('axes.yaml')
    >>> pi.AxesModel.load('axes.yaml').simulate([[1.0, 0.0], [0.0, 1.0]])
    array([[1.e-06],
           [2.e-08]])
    """

    model: LoopModel
    sample_rate: float
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    v0: NDArray[np.float64]
    effect: str
    error_percent: float

    def simulate(self, v: NDArray[np.float64]) -> NDArray[np.float64]:
        """
        Return the displacements [m], about where they rest at `v0`, under voltages [V] from there.

        Parameters
        ----------
        v : ndarray, shape (n, inputs)

        Returns
        -------
        ndarray, shape (n, outputs)
        """
        return self.model.stream().simulate(np.asarray(v, dtype=float) - self.v0)

    def save(self, path: str | Path) -> None:
        """Write the model as YAML, over what is there."""
        write_text(path, axes_model_to_text(self))

    @classmethod
    def load(cls, path: str | Path) -> AxesModel:
        """Read a model that `save` wrote."""
        return _model_of(load_yaml(path), str(path))


def axes_model_to_text(held: AxesModel) -> str:
    """Return a model as YAML."""
    model = held.model
    arrays = {f.name: getattr(model, f.name) for f in fields(LoopModel) if f.name != 'linear'}
    data = {
        KEY: {
            'sample_rate': held.sample_rate,
            'inputs': [*held.inputs],
            'outputs': [*held.outputs],
            'v0': held.v0,
            'effect': held.effect,
            'error_percent': held.error_percent,
        },
        'linear': {f.name: getattr(model.linear, f.name) for f in fields(Modal)},
        'loop': arrays,
    }
    return yaml.safe_dump(plain(data), sort_keys=False, default_flow_style=None, width=99)


def _model_of(data: Mapping[str, Any], name: str) -> AxesModel:
    try:
        head, loop = data[KEY], dict(data['loop'])
        linear = Modal(*(np.array(data['linear'][f.name], dtype=float) for f in fields(Modal)))
        order, (outputs, inputs) = linear.order, linear.d.shape
        signals, levels = len(loop['f']), int(loop.pop('levels'))
        memory, (low, high) = float(loop.pop('memory')), loop.pop('range')
        r = np.array(loop['r'], dtype=float)
        # a list without rows does not tell how many columns it has
        shapes = {
            'e': (order, signals),
            'h': (outputs, signals),
            'f': (signals, order),
            'g': (signals, inputs),
            'mu': (signals, r.size),
            'r': r.shape,
        }
        arrays = {k: np.array(loop[k], dtype=float).reshape(s) for k, s in shapes.items()}
        model = LoopModel(
            linear, **arrays, levels=levels, memory=memory, range=(float(low), float(high))
        )
        return AxesModel(
            model,
            float(head['sample_rate']),
            tuple(map(str, head['inputs'])),
            tuple(map(str, head['outputs'])),
            np.array(head['v0'], dtype=float),
            str(head['effect']),
            float(head['error_percent']),
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ModelError(
            f'{name}: no model of several axes ({error!r}); see docs/two_axes.md'
        ) from None
