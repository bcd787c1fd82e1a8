# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Export modes that several axes share as a C header: prediction, sample by sample.

The sums have the order of `piezo_ident.model.modes.kernels.trajectory`.  C and Python therefore
agree to the last bit, unless the compiler contracts products and sums.
"""

from __future__ import annotations

import math
import textwrap
from typing import Any

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import ConfigError
from piezo_ident.export.header import c_number, checked_name, common_values, render, WIDTH
from piezo_ident.model.axis_records import voltage_of
from piezo_ident.model.modes.shared_modes import SharedModes
from piezo_ident.model.multi_axis import MultiAxisModel


def export_modes(
    model: MultiAxisModel,
    modes: SharedModes,
    name: str,
    *,
    title: str = '',
    feedforward: bool = True,
    **drive: Any,
) -> str:
    """
    Write shared modes as a C header; see `piezo_ident.export_c`.

    Parameters
    ----------
    model : MultiAxisModel
    modes : SharedModes
        Modes of the model.
    name : str
        Beginning of all names in the header.
    title : str, optional
        First line of the header.
    feedforward : bool, optional
        Ignored, because a header of shared modes has no feed-forward.
    **drive
        Settings of a feed-forward, which are refused.

    Raises
    ------
    ConfigError
        When the name is not allowed in C, or settings of a feed-forward are given.
    """
    checked_name(name)
    if settings := [key for key, x in drive.items() if x is not None and x != math.inf]:
        raise ConfigError(
            f'export: a header of shared modes has no feed-forward, which {", ".join(settings)} '
            'would set; leave them out'
        )
    order, loop = sorted(model.axes), modes.loop
    plays = bool(modes.signals > modes.levels)
    tables = {k: getattr(loop, k) for k in ('b', 'c', 'd', 'e', 'f', 'g', 'h')}
    tables |= {'blocks': loop.blocks.reshape(-1, 4), 'v0': modes.v0, 'y0': modes.y0}
    if plays:
        tables |= {'mu': loop.mu, 'r': loop.r}
    if modes.taus.size:
        tables |= {'creep': loop.creep, 'share': loop.share}
    return render(
        'modes.h',
        **common_values(model, name, title),
        axes=list(model.axes),
        voltages=', '.join(map(voltage_of, model.axes)),
        columns=[list(model.axes).index(axis) for axis in order],
        order=modes.linear.order,
        signals=modes.signals,
        levels=modes.levels,
        plays=plays,
        thresholds=len(modes.r),
        creep=len(modes.taus),
        middle=list(map(c_number, modes.v0)),
        settling=modes.settling,
        low=c_number(loop.low),
        high=c_number(loop.high),
        kappa=c_number(loop.kappa),
        rest=c_number(1.0 - loop.kappa),
        constants=[line for k, x in tables.items() if x.size for line in _table(k, x)],
    )


def _table(name: str, x: Array) -> list[str]:
    """Write an array as a constant of C."""
    sizes = ''.join(f'[{n}]' for n in x.shape)
    rows = [', '.join(repr(float(value)) for value in row) for row in np.atleast_2d(x)]
    listed = rows[0] if x.ndim == 1 else ', '.join(f'{{{row}}}' for row in rows)
    text = f'static const double {name}{sizes} = {{{listed}}};'
    return textwrap.wrap(text, WIDTH, subsequent_indent='    ', break_on_hyphens=False)
