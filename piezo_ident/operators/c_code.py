# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Operators as C code, from which `piezo_ident.export` makes a header.

The C statements of an operator process one sample with the numbers of the Python loop.  The loops
of `piezo_ident.operators.kernels` keep their order of operations here, except in sums.  The order
of a sum only changes the last digit: a G that would amplify the change runs as sections.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.operators.dynamics import Delay, Dynamics
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.operators.kernels import path_lines

#: constants of an operator, by name
Numbers = dict[str, float | int | Array]


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


_PLAYS = """
int i;
double w = 0.0;
for (i = 0; i < m; i++) {
    s->f[i] = piezo_held(s->f[i], x - r[i], x);
    w += q[i] * s->f[i];
}
"""
_WIDE = """
for (i = 0; i < m; i++)
    w += kappa[i] * (x - low) * (s->f[i] - low)
        + piezo_curve(c1[i], c2[i], c3[i], width[i], s->f[i] - low);
"""
_PLAYS_AT_REST = """
{
    int i;
    for (i = 0; i < m; i++)
        s->f[i] = piezo_held(0.0, x - r[i], x);
}
"""
# `lags` becomes the sum of the lags after the voltage went to `to`
_LAGS = """
{
    const double length = fabs(to - s->last);
    const double *const line = lines + (to > s->last ? 3 * n : 0);
    double left = 0.0;
    int j;

    lags = 0.0;
    for (j = 0; j < n; j++) {
        if (length > 0.0) {
            const double e0 = line[j], e1 = line[n + j], e2 = line[2 * n + j];
            const double now = e0 + to * (e1 + to * (e2 + to * d3[j]));
            const double was = e0 + s->last * (e1 + s->last * (e2 + s->last * d3[j]));
            left = j > 0 && rate[j] == 2.0 * rate[j - 1] ? left * left : exp(-rate[j] * length);
            s->z[j] = now + (s->z[j] - was) * left;
        }
        lags += s->z[j] - to * (d1[j] + to * (d2[j] + to * d3[j]));
    }
    s->last = to;
}
"""
_LAGS_AT_REST = """
{
    const double way[5] = {high, low, high, low, x};
    double lags;
    int i;

    for (i = 0; i < n; i++)
        s->z[i] = low * (d1[i] + low * (d2[i] + low * d3[i]));
    s->last = low;
    for (i = 0; i < 5; i++) {
        const double to = way[i];
        LAGS
    }
    (void)lags;
}
"""


def hysteresis_in_c(h: Hysteresis) -> CCode:
    """Write H in C, as `hysteresis`, `wide_hysteresis` and `relaxing` compute it."""
    m = h.thresholds.size
    r, q, p1, p2, p0, low, c = h.for_kernel
    numbers: Numbers = {'p0': p0, 'p1': p1, 'p2': p2}
    numbers |= {'low': low, 'high': h.span[1]}
    state, rest, step = '', '', 'double w = 0.0;\n'
    if m:
        numbers |= {'m': m, 'r': r[:m], 'q': q[:m]}
        state, rest, step = f'double f[{m}];\n', _PLAYS_AT_REST, _PLAYS
    if c.size:
        names = ('c1', 'c2', 'c3', 'kappa', 'width')
        numbers |= {name: row[:m] for name, row in zip(names, c, strict=True)}
        step += _WIDE
    if h.relaxations is not None and len(h.relaxations):
        n = len(h.relaxations)
        # these names differ from the names of the curves
        rows = zip(('rate', 'd1', 'd2', 'd3'), h.relaxations.T, strict=True)
        numbers |= {'n': n, 'lines': path_lines(np.array(h.relaxations)).ravel(), **dict(rows)}
        state += f'double z[{n}];\ndouble last;\n'
        rest += _LAGS_AT_REST.replace('LAGS', _LAGS)
        step += f'{{\nconst double to = x;\ndouble lags;\n{_LAGS}\nw += lags;\n}}\n'
    step += 'x = w + ((p1 * x + p0) * x + p2) * x;\n'
    # at rest, H has processed its voltage once
    return CCode(numbers, state, f'{rest}{{\n{step}}}\n', step)


# two sums run side by side, and neither waits for the other
_G = """
const double *past;
double y = 0.0, other = 0.0;
int i;

s->w[s->at_w] = s->w[s->at_w + nb] = x;
s->at_w = s->at_w + 1 < nb ? s->at_w + 1 : 0;
past = s->w + s->at_w;

for (i = nb % 2; i < nb; i += 2) {
    other += b[i] * past[i];
    y += b[i + 1] * past[i + 1];
}
if (nb % 2)
    y += b[0] * past[0];
"""
_G_BACK = """
past = s->y + s->at_y;
for (i = na % 2; i < na; i += 2) {
    other -= a[i] * past[i];
    y -= a[i + 1] * past[i + 1];
}

if (na % 2)
    other -= a[0] * past[0];
y = piezo_alive(y + other);
s->y[s->at_y] = s->y[s->at_y + na] = y;
s->at_y = s->at_y + 1 < na ? s->at_y + 1 : 0;
"""
_G_AT_REST = """
{
    int i;
    s->at_w = 0;
    for (i = 0; i < 2 * nb; i++)
        s->w[i] = x;
}
x *= gain;
"""
_G_BACK_AT_REST = """
{
    int i;
    s->at_y = 0;
    for (i = 0; i < 2 * na; i++)
        s->y[i] = x;
}
"""
_SECTIONS = """
double (*z)[2] = s->z;
const double *g = sections;
int i;

for (i = 0; i < n; i++, g += 5) {
    const double y = g[0] * x + z[i][0];
    z[i][0] = piezo_alive((g[1] * x + z[i][1]) - g[3] * y);
    z[i][1] = piezo_alive(g[2] * x - g[4] * y);
    x = y;
}
"""
_SECTIONS_AT_REST = """
{
    const double *g = sections;
    int i;
    for (i = 0; i < n; i++, g += 5) {
        const double y = x * (g[0] + g[1] + g[2]) / (1.0 + g[3] + g[4]);
        s->z[i][0] = y - g[0] * x;
        s->z[i][1] = g[2] * x - g[4] * y;
        x = y;
    }
}
"""


def dynamics_in_c(g: Dynamics) -> CCode:
    """Write G in C, as `dynamics` or `run_sections` computes it."""
    if g.sections is not None:
        n = len(g.sections)
        numbers: Numbers = {'n': n, 'sections': g.sections.ravel()}
        return CCode(numbers, f'double z[{n}][2];\n', _SECTIONS_AT_REST, _SECTIONS)
    na, nb = g.a.size, g.b.size
    numbers = {'nb': nb, 'b': g.b[::-1], 'na': na, 'a': g.a[::-1], 'gain': g.gain}
    # every sample is stored twice, so that the past is always contiguous
    state = f'double w[{2 * nb}];\nint at_w;\n'
    if not na:
        return CCode(numbers, state, _G_AT_REST, f'{_G}x = y + other;\n')
    state += f'double y[{2 * na}];\nint at_y;\n'
    return CCode(numbers, state, _G_AT_REST + _G_BACK_AT_REST, f'{_G}{_G_BACK}x = y;\n')


def delay_in_c(delay: Delay) -> CCode:
    """Write z^-d in C, as `DelayOperator` computes it."""
    if delay.total == 0.0:
        return CCode()
    between = delay.fraction > 0.0
    n = delay.samples + (2 if between else 1)
    state = f'double line[{n}];\nint at;\n'
    rest = '{\nint i;\ns->at = 0;\nfor (i = 0; i < n; i++)\n    s->line[i] = x;\n}\n'
    step = 's->line[s->at] = x;\ns->at = s->at + 1 < n ? s->at + 1 : 0;\n'
    now = '(1.0 - part) * s->line[s->at + 1 < n ? s->at + 1 : 0] + part * s->line[s->at]'
    step += f'x = {now if between else "s->line[s->at]"};\n'
    return CCode({'n': n, 'part': delay.fraction}, state, rest, step)
