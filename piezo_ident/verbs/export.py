# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Export a model of one axis or of several as a C header or an FMU."""

from __future__ import annotations

from collections.abc import Mapping
import os
from typing import Any

from piezo_ident.common.errors import ConfigError
from piezo_ident.export.fmu import write_fmu
from piezo_ident.export.header import c_number, plain_text
from piezo_ident.export.header import export_c as export_axis
from piezo_ident.export.links import LinkGroup, links_of
from piezo_ident.export.modes_header import export_modes
from piezo_ident.model.axis_records import MOTION, motion_of, voltage_of
from piezo_ident.model.multi_axis import models_of, MultiAxisModel
from piezo_ident.model.stage_model import StageModel


def export_c(model: StageModel | MultiAxisModel, name: str = 'stage', **options: Any) -> str:
    """
    Write a model as a C header that predicts and feeds forward sample by sample.

    Parameters
    ----------
    model : StageModel or MultiAxisModel
    name : str, optional
        Beginning of all names in the header.
    **options
        ``limits``, ``slew``, ``preview``, ``title`` and ``feedforward`` of
        `piezo_ident.export.header.export_c`.

    Returns
    -------
    str
        C99 without dependencies.  A comment at its head explains the calls, and names the effects
        that the feed-forward leaves uncorrected.  For several axes, a step of the stage that takes
        all voltages follows the headers of the axes.  Shared modes have this step alone, without a
        feed-forward.

    Raises
    ------
    DataError
        When `model` is of another type, or limits or slew are impossible.
    ConfigError
        When the name is not allowed in C, or two axes have the same names in C.
    ModelError
        When an effect of the model has no C code, or the preview is shorter than the delay.

    Examples
    --------
    >>> import piezo_ident as pi
    >>> header = pi.export_c(pi.SimulatedStage.load('paper').model, limits=(0.0, 10.0))
    >>> 'static inline double stage_step(stage_state *s, double v)' in header
    True
    """
    if not isinstance(model, MultiAxisModel):
        return export_axis(model, name, **options)
    if model.modes is not None:
        return export_modes(model, model.modes, name, **options)
    states = _states(model)
    tags = {member: f'{name}_{member.lower()}' for member in states}
    alike = [axis for axis in model.axes if [*tags.values()].count(tags[axis]) > 1]
    if alike:
        raise ConfigError(
            f'axes {" and ".join(alike)}: differ by case alone, so their C code has the same '
            'names; rename one of them in the model file'
        )
    own = {'feedforward': False}
    texts = [
        export_axis(x, tags[member], **(options if member in model.axes else own))
        for member, x in states.items()
    ]
    return '\n'.join([*texts, _stage(model, name, states, tags)])


def export_fmu(
    model: StageModel | MultiAxisModel, path: str | os.PathLike[str], name: str = 'stage'
) -> None:
    """
    Write a model as an FMU in source: FMI 3.0, co-simulation.

    The inputs are ``voltage`` [V], and ``x_<name>`` for each further channel.  The output is
    ``displacement`` [m].  Axis ``y_b`` has ``voltage_b`` and ``displacement_b``.  An existing file
    is replaced.

    Parameters
    ----------
    model : StageModel or MultiAxisModel
    path : str or path-like
    name : str, optional
        Identifier of the model in C.

    Raises
    ------
    ConfigError
        If the name is not an identifier in C, or two axes have the same names in C.
    ModelError
        If an effect of the model has no C code.
    DataError
        If the file cannot be written.

    Examples
    --------
    >>> import piezo_ident as pi
    >>> pi.export_fmu(pi.SimulatedStage.load('paper').model, 'stage.fmu')
    """
    header = export_c(model, name, feedforward=False)
    states = _states(model)
    write_fmu(
        path,
        name,
        header,
        model.sample_rate,
        rests={axis[1:]: x.scaling.range[0] for axis, x in models_of(model).items()},
        clocks=[f'{member}.k'.removeprefix('.') for member in states],
        channels=_further(states),
    )


def _states(model: StageModel | MultiAxisModel) -> dict[str, StageModel]:
    """Map members of the state of a header to their chains; a single chain has no member."""
    if isinstance(model, StageModel):
        return {'': model}
    if model.modes is not None:
        return {}
    felt = {channel for x in model.axes.values() for channel in channels_of(x)}
    own = {f'own_{a}': model.own(a) for a in model.axes if motion_of(a) in felt}
    return {**own, **model.axes}


def _further(states: Mapping[str, StageModel]) -> dict[str, str]:
    """Map places in the state to the channels that a caller sets there."""
    return {
        f'{member}.channel[{k}]'.removeprefix('.'): channel
        for member, x in states.items()
        for k, channel in enumerate(channels_of(x))
        if not (member and channel.startswith(MOTION))
    }


def channels_of(model: StageModel) -> list[str]:
    """Return the further channels of a model in the order of its C code."""
    links = [link for part in links_of(model) for link in part.links]
    return LinkGroup(links).channels


def _stage(
    model: MultiAxisModel, name: str, states: Mapping[str, StageModel], tags: Mapping[str, str]
) -> str:
    """Write the C code of the whole stage, which follows the headers of its axes."""
    order, n, P = list(model.axes), len(model.axes), name.upper()
    rest, step = [], []
    for member, x in states.items():
        is_own = member not in order
        i = order.index(member.removeprefix('own_'))
        arguments = f'(&s->{member}, v[{i}]);'
        step += [
            f'    s->{member}.channel[{k}] = own_y{channel[len(MOTION) :]};'
            for k, channel in enumerate(channels_of(x))
            if channel.startswith(MOTION)
        ]
        moved = f'const double {member}' if is_own else f'y[{i}]'
        step.append(f'    {moved} = {tags[member]}_step{arguments}')
        rest.append(f'    {"" if is_own else f"y[{i}] = "}{tags[member]}_reset{arguments}')
    further = [f' *     s.{x}  {plain_text(channel)}' for x, channel in _further(states).items()]
    call = f'{name}_state *s, const double v[{n}], double y[{n}]'
    return '\n'.join(
        [
            f'/* The stage of {n} axes: v is {", ".join(map(voltage_of, order))}, '
            f'y is {", ".join(order)}. */',
            *(['/* Before each step the caller sets', *further, ' */'] if further else []),
            f'#ifndef {P}_OF_AXES\n#define {P}_OF_AXES\n',
            f'#define {P}_RATE {c_number(model.sample_rate)} /* samples a second */\n',
            'typedef struct {',
            *(f'    {tags[member]}_state {member};' for member in states),
            f'}} {name}_state;\n',
            f'static inline void {name}_reset({call})\n{{',
            *rest,
            f'}}\n\nstatic inline void {name}_step({call})\n{{',
            *step,
            '}\n\n#endif\n',
        ]
    )
