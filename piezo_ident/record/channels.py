# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Channels of a stage with several axes, and their names in each format.

The first axis is ``v`` and ``y``.  Voltage and displacement of another axis are the channels
``v_<name>`` and ``y_<name>``, which code for one axis treats as further signals.

| channel | column of a table | topic, and quantity of its blocks |
|---|---|---|
| ``v_<name>`` | ``v_<name>`` | ``voltage_<name>`` |
| ``y_<name>`` | ``y_<name>`` | ``displacement_<name>`` |
| any other | ``x_<channel>`` | ``x_<channel>`` |
"""

from __future__ import annotations

from dataclasses import dataclass
import re

import numpy as np
from piezo_ident.common.arrays import Array, frozen_array
from piezo_ident.common.errors import DataError
from piezo_ident.record.options import plain_unit, UNITS
from piezo_ident.record.record import Piece

#: topic with the voltage that the amplifier of the first axis applied
APPLIED = 'applied_voltage'
_QUANTITIES = {'v': 'voltage', 'y': 'displacement'}
_AXIS = re.compile(r'([vy])_(\w{1,60})', re.ASCII)


def role_of(channel: str) -> str:
    """
    Return ``v`` or ``y`` for a channel of another axis, else ''; a unit names no axis.

    >>> [role_of(x) for x in ('v_b', 'y_tilt', 'temperature', 'y_um', 'v')]
    ['v', 'y', '', '', '']
    """
    match = _AXIS.fullmatch(channel)
    unit = plain_unit(match[2]) if match else ''
    is_unit = unit != 'min' and any(unit in units for units in UNITS.values())
    return '' if match is None or is_unit else match[1]


def column_of(channel: str) -> str:
    """Return the column of a channel."""
    return channel if role_of(channel) else f'x_{channel}'


def channel_of_column(column: str) -> str:
    """
    Return the channel in a column, empty for a column without a channel.

    >>> [channel_of_column(x) for x in ('v_b', 'x_heat', 'v', 'offset')]
    ['v_b', 'heat', '', '']
    """
    if role_of(column):
        return column
    return column[2:] if column.startswith('x_') else ''


def quantity_of_channel(channel: str) -> str:
    """
    Return the quantity of the blocks of a channel, which is the name of their topic too.

    >>> [quantity_of_channel(x) for x in ('v_b', 'y_b', 'heat')]
    ['voltage_b', 'displacement_b', 'x_heat']
    """
    role = role_of(channel)
    return f'{_QUANTITIES[role]}_{channel[2:]}' if role else f'x_{channel}'


def channel_of_quantity(quantity: str) -> str:
    """
    Return the channel that blocks carry, empty for blocks of the first axis.

    >>> [channel_of_quantity(x) for x in ('voltage_b', 'x_heat', 'voltage', 'prediction')]
    ['v_b', 'heat', '', '']
    """
    for role, name in _QUANTITIES.items():
        if quantity.startswith(f'{name}_'):
            return channel_of_column(f'{role}{quantity[len(name) :]}')
    return quantity[2:] if quantity.startswith('x_') else ''


def applied_key(quantity: str) -> str:
    """
    Return the topic with the applied voltage for a voltage, empty for other quantities.

    >>> [applied_key(x) for x in ('voltage', 'voltage_b', 'displacement', 'x_heat')]
    ['applied_voltage', 'applied_voltage_b', '', '']
    """
    is_voltage = quantity == 'voltage' or role_of(channel_of_quantity(quantity)) == 'v'
    return f'applied_{quantity}' if is_voltage else ''


@dataclass(frozen=True, eq=False)
class Axes:
    """
    A piece of a record as several inputs and outputs.

    Attributes
    ----------
    inputs : ndarray, shape (n, m)
        Command voltages [V].
    outputs : ndarray, shape (n, p)
        Displacements [m], NaN for readings that were left out.
    input_names, output_names : tuple of str
        Names of the columns: the first axis, then the others in alphabetical order.
    sample_rate : float
        [Hz]

    Examples
    --------
    >>> import numpy as np
    >>> import piezo_ident as pi
    >>> x = np.random.default_rng(0).normal(size=(2, 100))
    >>> record = pi.Record.from_arrays(
    ...     x[0], 1e-6 * x[0], sample_rate=1000, channels={'v_b': x[1], 'y_b': 1e-6 * x[1]}
    ... )
    >>> axes = pi.Axes.of(record.pieces[0])
    >>> axes.input_names, axes.output_names, axes.outputs.shape
    (('v', 'v_b'), ('y', 'y_b'), (100, 2))
    """

    inputs: Array
    outputs: Array
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    sample_rate: float

    @classmethod
    def of(cls, piece: Piece) -> Axes:
        """
        Return the axes of a piece; inputs and outputs may differ in number.

        Raises
        ------
        DataError
            If a sample of a voltage is unknown, or all of a displacement.
        """
        columns = {'v': piece.v, 'y': piece.measured, **piece.channels}
        names = {
            role: (role, *sorted(k for k in piece.channels if role_of(k) == role)) for role in 'vy'
        }
        for name in names['y']:
            if not np.isfinite(columns[name]).any():
                raise DataError(f'{name}: the displacement is not known; record it too')
        for name in names['v']:
            if not np.isfinite(columns[name]).all():
                raise DataError(f'{name}: the voltage is not known at every sample; record it too')
        inputs, outputs = (
            frozen_array(np.column_stack([columns[k] for k in names[role]])) for role in 'vy'
        )
        return cls(inputs, outputs, names['v'], names['y'], piece.sample_rate)
