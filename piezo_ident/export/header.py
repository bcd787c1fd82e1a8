# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Export a model as a C header: prediction and feed-forward, sample by sample.

Each operator has its C code beside its Python loop (`piezo_ident.operators.c_code.CCode`).  A
header joins this code in the order of the chain.  The feed-forward uses the same code.  With known
memory, the output of the operators in front of G is a function of the next voltage.  The
feed-forward solves this function for the voltage.  `piezo_ident.control.linear_inverse` inverts G
and its delay.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math
import re
import textwrap
from typing import Any

import jinja2
from piezo_ident import __version__
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import ConfigError, expect, ModelError
from piezo_ident.common.kernel import STILL
from piezo_ident.control.hysteresis_inverse import (
    TOLERANCE,
    TRIALS,
    with_rising_hysteresis,
)
from piezo_ident.control.inputs import checked_limits, SHORT
from piezo_ident.control.linear_inverse import (
    check_preview,
    is_filter,
    least_gain,
    linear_inverse,
    LinearInverse,
)
from piezo_ident.effects import find_effect
from piezo_ident.export.links import Link, LinkGroup, links_of
from piezo_ident.model.multi_axis import MultiAxisModel
from piezo_ident.model.stage_model import StageModel

#: largest displacement that the inverse searches [spans]
FAR = 100.0
#: width of a line of numbers or words [characters]
WIDTH = 88
#: reason for the missing feed-forward of a header, if the user does not want it
NOT_WANTED = 'it was not asked for'


@dataclass(frozen=True, eq=False)
class _FeedForward:
    """Values that fill the template of the feed-forward."""

    taps: Array
    ahead: int
    gain: str
    lowest: str
    highest: str
    step: str
    says: Sequence[str]
    front: LinkGroup
    part: str
    inverted: LinkGroup


def export_c(
    model: StageModel,
    name: str = 'stage',
    *,
    limits: tuple[float, float] | None = None,
    slew: float = math.inf,
    preview: int | None = None,
    title: str = '',
    feedforward: bool = True,
) -> str:
    """
    Return a model of one axis as a C header; see `piezo_ident.export_c`.

    Parameters
    ----------
    limits : tuple of float, optional
        Lowest and highest voltage of the feed-forward [V]; by default the identified range.
    slew : float, optional
        Largest speed of the voltage of the feed-forward [V/s].
    preview : int, optional
        Largest number of future samples of the motion; by default every useful sample.
    title : str, optional
        First line of the header.
    feedforward : bool, optional
        Whether the header has a feed-forward.
    """
    expect(model, StageModel, 'export, first argument', 'read a model with load')
    checked_name(name)
    kept = checked_limits(model, limits, slew)
    if preview is not None:
        check_preview(model, preview)
    front, linear, back = links_of(model)
    links = [*front.links, *linear.links, *back.links]
    channels = LinkGroup(links).channels
    ff, why = _feedforward_or_reason(model, kept, preview) if feedforward else (None, NOT_WANTED)
    parts = {'front': front, 'linear': linear, 'back': back}
    if ff is not None and ff.part not in parts:
        parts[ff.part] = ff.front
        links += ff.front.links
    scaling = model.scaling
    values: dict[str, Any] = {
        **common_values(model, name, title),
        **{k: c_number(getattr(scaling, k)) for k in ('v0', 'V', 'y0', 'Y')},
        'links': links,
        'parts': parts,
        'channels': channels,
        'channel_names': [plain_text(name) for name in channels],
        'why': textwrap.wrap(why, WIDTH),
        'ff': ff,
    }
    if ff is not None:
        values['feedforward'] = _feedforward_text(ff, values)
    return render('stage.h', **values)


def common_values(model: StageModel | MultiAxisModel, name: str, title: str) -> dict[str, Any]:
    """List the values of every header: names, title, version, rate and helpers."""
    return {
        'p': name,
        'P': name.upper(),
        'title': textwrap.wrap(plain_text(title) or repr(model), WIDTH),
        'version': __version__,
        'hertz': f'{model.sample_rate:g}',
        'rate': c_number(model.sample_rate),
        'helpers': render(
            'helpers.h', still=c_number(STILL), tolerance=c_number(TOLERANCE), trials=TRIALS
        ),
    }


def _feedforward_or_reason(
    model: StageModel, kept: tuple[float, float, float], preview: int | None
) -> tuple[_FeedForward | None, str]:
    """Invert a model for the template, or give the reason why it has no inverse."""
    try:
        return _feedforward(model, kept, preview), ''
    except ModelError as error:
        return None, str(error)


def _feedforward_text(ff: _FeedForward, values: dict[str, Any]) -> str:
    """Write the part of the header with the feed-forward."""
    # oldest first, as in the memory of the filter
    listed = ', '.join(repr(float(x)) for x in ff.taps[::-1])
    return render(
        'feedforward.h',
        **values,
        taps='\n'.join(textwrap.wrap(listed, WIDTH, break_on_hyphens=False)),
        far=c_number(FAR),
        short=c_number(SHORT),
    )


def _feedforward(
    model: StageModel,
    kept: tuple[float, float, float],
    preview: int | None,
) -> _FeedForward:
    """Invert a model for the template; raises ModelError if it has no inverse."""
    model, lines = with_rising_hysteresis(model)
    front, _, back = links_of(model)
    part = 'front'
    if lines:
        # the changed links become further functions beside the functions of the prediction
        part = 'rising'
        front = LinkGroup([replace(link, tag=f'{part}_{link.tag}') for link in front.links])
    in_front = [link.name for link in front.links]
    rest = tuple(e for e in model.effects if e.name not in in_front)
    Q = whole = linear_inverse(replace(model, effects=rest))
    if preview is not None:
        Q = Q.shortened(preview)
    # an effect that reads the command cannot be inverted: the command is still unknown
    undone = [link for link in back.links if 'v' not in link.signals_in(link.code.step)]
    inverted = LinkGroup([x for x in undone if x.effect and not is_filter(type(x.effect))])
    low, high, most = kept
    for link in front.links:
        # a larger change of the voltage would have no effect
        if link.name == 'slew_limit' and link.effect:
            most = min(most, link.effect.number('limit') * model.scaling.V)
        if link.name == 'saturation' and link.effect and link.effect.number('knee') == 0.0:
            low = max(low, model.scaling.v(link.effect.number('low')))
            high = min(high, model.scaling.v(link.effect.number('high')))
    if not low < high:
        raise ModelError('the voltage limits lie where the amplifier is saturated')
    return _FeedForward(
        taps=Q.taps,
        ahead=Q.ahead,
        gain=c_number(model.dynamics.gain),
        lowest=c_number(low),
        highest=c_number(high),
        step=c_number(most / model.sample_rate),
        says=_says(model, lines, front, inverted, back, Q, whole.ahead),
        front=front,
        part=part,
        inverted=inverted,
    )


def _says(
    model: StageModel,
    lines: Sequence[str],
    front: LinkGroup,
    inverted: LinkGroup,
    back: LinkGroup,
    Q: LinearInverse,
    ahead: int,
) -> list[str]:
    """Describe a feed-forward and its errors."""
    behind = ''
    if inverted.links:
        behind = f' The part behind it ({_named(inverted.links)}) is inverted likewise.'
    text = (
        'The voltage always stays within LOWEST .. HIGHEST and changes by at most STEP from '
        'sample to sample. A y that is not finite is replaced by the last y. f.clipped counts '
        'the samples at which these limits changed the voltage. '
        f'The part in front of G ({_named(front.links)}) is inverted sample by sample, '
        f'with its memory.{behind} G and its delay are undone by a filter of {Q.taps.size} '
        f'samples, {Q.ahead} of them ahead.  The feed-forward does not make up for'
    )
    lacks = [
        'errors of the model, and noise',
        f'motion at which the gain of G is below {least_gain(model):.0%} of the static gain: '
        'there the voltage is kept small',
        *(f'narrow plays: {line}' for line in lines),
    ]
    if Q.ahead < ahead:
        lacks.append(f'samples {Q.ahead + 1} to {ahead} ahead, which the filter would also need')
    for link in back.links:
        if 'v' in link.signals_in(link.code.step):
            lacks.append(f'{link.name}: the voltage in the reading')
        elif link.effect and is_filter(type(link.effect)) and len(back.links) > 1:
            lacks.append(f'the place of {link.name}: it is undone as if it stood beside G')
    if any(find_effect(e.name).time_driven for e in model.effects):
        lacks.append('a clock that starts elsewhere: set f.k where it does, after the reset')
    points = (textwrap.wrap(x, WIDTH, initial_indent='- ', subsequent_indent='  ') for x in lacks)
    return [*textwrap.wrap(text, WIDTH), *(line for point in points for line in point)]


def _named(links: Sequence[Link]) -> str:
    return ', '.join(link.name for link in links if link.code.step)


def checked_name(name: str) -> None:
    """Raise ConfigError for a name that is not allowed in C."""
    if not re.fullmatch(r'[a-z][a-z0-9_]{0,39}', name):
        raise ConfigError(
            f'export: {name!r} is no name for C; give small letters, digits and _, a letter '
            'first, as in --name stage'
        )


def plain_text(text: str) -> str:
    """Remove characters that would end a comment in C, or are not allowed in XML."""
    return ''.join(x for x in text if x.isprintable() and x != '*')


def c_number(x: float) -> str:
    """Write a number in C."""
    if math.isinf(x):
        return 'HUGE_VAL' if x > 0.0 else '(-HUGE_VAL)'
    return repr(float(x)) if x >= 0.0 else f'({float(x)!r})'


def render(template: str, **values: Any) -> str:
    """Fill the values into a template of this room."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader('piezo_ident.export', 'templates'),
        autoescape=False,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    return environment.get_template(template).render(values)
