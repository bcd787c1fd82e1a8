# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Operators as C code, from which `piezo_ident.export` makes a header.

The C statements of an operator process one sample, with the numbers of the Python loop.  They keep
the order of operations of `piezo_ident.operators.kernels`, except in sums.  The order of a sum
changes the last digit only, because a G that would amplify this change runs as sections.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.operators.dynamics import Delay, Dynamics
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.operators.kernels import path_lines

#: constants of an operator, by name
Numbers = dict[str, float | int | Array]
_HERE = 'piezo_ident.operators'


@dataclass(frozen=True, eq=False)
class CCode:
    """
    C code of an operator.

    `numbers` are its constants, `state` the members of the struct with its state.  The statements
    `rest` bring the state to rest; without them the signal passes unchanged.  The statements
    `step` process one sample.  An operator may need one further `channel`.

    The statements read the signal from `x` and write the result to `x`.  They may use the numbers
    and the further channel `c` by name, the state as ``s->name``, the normalised command `v` and
    the time `t` [s].  `u` is the signal into H; in the slot ``hysteresis``, `x` is the output of
    H.  The functions ``piezo_alive``, ``piezo_held`` and ``piezo_curve`` stand for
    `piezo_ident.common.kernel.alive`, and for `held` and `curve` of the kernels.
    """

    numbers: Numbers = field(default_factory=dict)
    state: str = ''
    rest: str = ''
    step: str = ''
    channel: str = ''


def read_c(package: str, name: str, numbers: Numbers, channel: str = '', **options: Any) -> CCode:
    """
    Fill the file ``c/NAME.c`` of a package with numbers and options.

    The file is a template of Jinja.  The lines below ``// state``, ``// rest`` and ``// step`` are
    the parts of the code.  Other comments stay in the file.
    """
    # only an export needs the templates
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader(package, 'c'),
        autoescape=False,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    text = environment.get_template(f'{name}.c').render({**numbers, **options})
    parts = {'': '', 'state': '', 'rest': '', 'step': ''}
    part = ''
    for line in text.splitlines():
        if line.startswith('// ') and line[3:] in parts:
            part = line[3:]
        elif line.strip() and not line.lstrip().startswith('//'):
            parts[part] += f'{line}\n'
    return CCode(numbers, parts['state'], parts['rest'], parts['step'], channel)


def hysteresis_in_c(h: Hysteresis) -> CCode:
    """Write H in C, as `hysteresis`, `wide_hysteresis` and `relaxing` compute it."""
    m = h.thresholds.size
    r, q, p1, p2, p0, low, c = h.for_kernel
    numbers: Numbers = {'p0': p0, 'p1': p1, 'p2': p2}
    numbers |= {'low': low, 'high': h.span[1]}
    if m:
        numbers |= {'m': m, 'r': r[:m], 'q': q[:m]}
    if c.size:
        names = ('c1', 'c2', 'c3', 'kappa', 'width')
        numbers |= {name: row[:m] for name, row in zip(names, c, strict=True)}
    has_lags = h.relaxations is not None and len(h.relaxations) > 0
    if h.relaxations is not None and has_lags:
        n = len(h.relaxations)
        # d1 .. d3, because c1 .. c3 are the curves
        rows = zip(('rate', 'd1', 'd2', 'd3'), h.relaxations.T, strict=True)
        numbers |= {'n': n, 'lines': path_lines(np.array(h.relaxations)).ravel(), **dict(rows)}
    return read_c(
        _HERE,
        'hysteresis',
        numbers,
        has_plays=m > 0,
        has_curves=c.size > 0,
        has_lags=has_lags,
    )


def dynamics_in_c(g: Dynamics) -> CCode:
    """Write G in C, as `dynamics` or `run_sections` computes it."""
    if g.sections is not None:
        return read_c(_HERE, 'sections', {'n': len(g.sections), 'sections': g.sections.ravel()})
    numbers: Numbers = {'nb': g.b.size, 'b': g.b[::-1], 'na': g.a.size, 'a': g.a[::-1]}
    return read_c(_HERE, 'dynamics', {**numbers, 'gain': g.gain})


def delay_in_c(delay: Delay) -> CCode:
    """Write z^-d in C, as `DelayOperator` computes it."""
    if delay.total == 0.0:
        return CCode()
    n = delay.samples + (2 if delay.fraction > 0.0 else 1)
    return read_c(_HERE, 'delay', {'n': n, 'part': delay.fraction})
