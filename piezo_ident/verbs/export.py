# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Export a model of one axis or of several as a C header."""

from __future__ import annotations

from typing import Any

from piezo_ident.common.errors import ConfigError
from piezo_ident.export.header import export_c as export_axis
from piezo_ident.export.header import plain_text
from piezo_ident.export.links import LinkGroup, links_of
from piezo_ident.export.modes_header import export_modes
from piezo_ident.model.axis_records import MOTION, motion_of, voltage_of
from piezo_ident.model.multi_axis import MultiAxisModel
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
        that the feed-forward leaves uncorrected.  A model of several axes has a header for each
        axis, then a step of the stage that takes all voltages.  Modes that the axes share have
        such a step without a feed-forward.

    Raises
    ------
    DataError
        When `model` is something else, or limits or slew are impossible.
    ConfigError
        When the name is not allowed in C, or two axes have the same names there.
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
    tags = {axis: f'{name}_{axis.lower()}' for axis in model.axes}
    alike = [axis for axis in tags if [*tags.values()].count(tags[axis]) > 1]
    if alike:
        raise ConfigError(
            f'axes {" and ".join(alike)}: differ by case alone, so their C code has the same '
            'names; rename one of them in the model file'
        )
    sources = [
        a for a in model.axes if any(motion_of(a) in channels_of(x) for x in model.axes.values())
    ]
    texts = [
        export_axis(model.own(axis), f'{tags[axis]}_own', feedforward=False) for axis in sources
    ]
    texts += [export_axis(x, tags[axis], **options) for axis, x in model.axes.items()]
    return '\n'.join([*texts, _stage(model, name, tags, sources)])


def channels_of(model: StageModel) -> list[str]:
    """Return the further channels of a model in the order of its C code."""
    links = [link for part in links_of(model) for link in part.links]
    return LinkGroup(links).channels


def _stage(model: MultiAxisModel, name: str, tags: dict[str, str], sources: list[str]) -> str:
    """Write the C code of the whole stage, which follows the headers of its axes."""
    order, n = list(model.axes), len(model.axes)
    members = [f'    {tags[a]}_own_state own_{a};' for a in sources]
    members += [f'    {tags[a]}_state {a};' for a in order]
    rest = [f'    {tags[a]}_own_reset(&s->own_{a}, v[{order.index(a)}]);' for a in sources]
    rest += [f'    y[{i}] = {tags[a]}_reset(&s->{a}, v[{i}]);' for i, a in enumerate(order)]
    step, further = [], []
    for a in sources:
        i = order.index(a)
        step.append(f'    const double own_{a} = {tags[a]}_own_step(&s->own_{a}, v[{i}]);')
    for i, (axis, x) in enumerate(model.axes.items()):
        for k, channel in enumerate(channels_of(x)):
            if channel.startswith(MOTION):
                step.append(f'    s->{axis}.channel[{k}] = own_y{channel[len(MOTION) :]};')
            else:
                further.append(f' *     s.{axis}.channel[{k}]  {plain_text(channel)}')
        step.append(f'    y[{i}] = {tags[axis]}_step(&s->{axis}, v[{i}]);')
    call = f'{name}_state *s, const double v[{n}], double y[{n}]'
    return '\n'.join(
        [
            f'/* The stage of {n} axes: v is {", ".join(map(voltage_of, order))}, '
            f'y is {", ".join(order)}. */',
            *(['/* Before each step the caller sets', *further, ' */'] if further else []),
            f'#ifndef {name.upper()}_OF_AXES\n#define {name.upper()}_OF_AXES\n',
            f'typedef struct {{\n{chr(10).join(members)}\n}} {name}_state;\n',
            f'static inline void {name}_reset({call})\n{{',
            *rest,
            f'}}\n\nstatic inline void {name}_step({call})\n{{',
            *step,
            '}\n\n#endif\n',
        ]
    )
