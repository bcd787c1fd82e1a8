# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Write the operators of a model as C functions, and parts of its chain as calls of them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
import re
import textwrap

import numpy as np
from piezo_ident.effects import Effect
from piezo_ident.model.stage_model import StageModel
from piezo_ident.operators.c_code import CCode, delay_in_c, dynamics_in_c, hysteresis_in_c
from piezo_ident.operators.chain import Operator
from piezo_ident.operators.dynamics import DelayOperator, DynamicsOperator
from piezo_ident.operators.hysteresis import HysteresisOperator

#: signals that the statements of a link may read
_SIGNALS = ('u', 'v', 't', 'c')


@dataclass(frozen=True, eq=False)
class Link:
    """
    Operator of the chain in C.

    The `tag`, unique within the model, names the member with the state of the link, and the
    functions of the link.
    """

    name: str
    tag: str
    code: CCode
    effect: Effect | None = None

    @property
    def members(self) -> list[str]:
        """Members of the struct with its state."""
        return self.code.state.split('\n')[:-1]

    def signals_in(self, text: str) -> list[str]:
        """List the signals of `_SIGNALS` that a text uses."""
        return [name for name in _SIGNALS if name in _words(text)]

    def body(self, text: str) -> str:
        """Put definitions of the used numbers in front of a text, without empty lines."""
        used = _words(text)
        lines = [_constant(name, x) for name, x in self.code.numbers.items() if name in used]
        text = textwrap.dedent(text)
        return '\n'.join([*lines, *(line for line in text.split('\n') if line.strip())])

    def call(self, prefix: str, what: str, state: str) -> str:
        """Write the statement that passes `x` through the link."""
        text = getattr(self.code, what)
        if not text:
            return ''
        arguments = [f'&{state}->{self.tag}'] if self.code.state else []
        arguments += ['x', *self.signals_in(text)]
        return f'x = {prefix}_{self.tag}_{what}({", ".join(arguments)});'


@dataclass(frozen=True, eq=False)
class LinkGroup:
    """Neighbouring links; the links of the slot ``hysteresis`` share the signal into H."""

    links: Sequence[Link]

    @property
    def channels(self) -> list[str]:
        """Further channels that the links need."""
        return list(dict.fromkeys(x.code.channel for x in self.links if x.code.channel))

    def statements(self, prefix: str, what: str, channels: Sequence[str]) -> Iterator[str]:
        """Yield the statements that pass `x` through the group; its state is ``*s``."""
        for link in self.links:
            if self.is_wrapped and link.name == 'H':
                yield 'u = x;'
            call = link.call(prefix, what, 's')
            if link.code.channel:
                call = call.replace(', c)', f', channel[{channels.index(link.code.channel)}])')
            if call:
                yield call

    @property
    def is_wrapped(self) -> bool:
        """Whether an effect of the group needs the signal into H."""
        return any('u' in _words(link.code.step) for link in self.links)


def links_of(model: StageModel) -> tuple[LinkGroup, LinkGroup, LinkGroup]:
    """
    List the links in front of G, G with its delay, and the links behind, in their order.

    Raises ModelError if an effect has no C code.
    """
    front: list[Link] = []
    linear: list[Link] = []
    back: list[Link] = []
    part = front
    for operator in _unwrapped(model.chain().operators):
        match operator:
            case HysteresisOperator():
                part.append(Link('H', 'hysteresis', hysteresis_in_c(operator.hysteresis)))
            case DynamicsOperator():
                part = linear
                part.append(Link('G', 'dynamics', dynamics_in_c(operator.dynamics)))
            case DelayOperator():
                part.append(Link('z^-d', 'delay', delay_in_c(operator.delay)))
                part = back
            case Effect():
                tag = f'{operator.name}_{len(front) + len(linear) + len(back)}'
                part.append(Link(operator.name, tag, operator.c_code(), operator))
    return LinkGroup(front), LinkGroup(linear), LinkGroup(back)


def _unwrapped(operators: Iterable[Operator]) -> Iterator[Operator]:
    """Yield the operators, with H before the effects that wrap it."""
    for operator in operators:
        if isinstance(operator, Effect) and operator.slot == 'hysteresis':
            yield from _unwrapped([operator.inner])
        yield operator


def _words(text: str) -> set[str]:
    # members of the state do not count
    return set(re.findall(r'(?<![>.\w])[A-Za-z_]\w*', text))


def _constant(name: str, value: object) -> str:
    """Write the definition of a number or of a list of numbers."""
    if isinstance(value, int):
        return f'enum {{ {name} = {value} }};'
    if not isinstance(value, np.ndarray):
        return f'const double {name} = {float(value)!r};'  # type: ignore[arg-type]
    listed = ', '.join(repr(float(x)) for x in value)
    text = f'static const double {name}[{value.size}] = {{{listed}}};'
    return '\n'.join(textwrap.wrap(text, 92, subsequent_indent='    ', break_on_hyphens=False))
