# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Free run of the whole model beside python-control's simulation of its linear part alone.

    .venv-bench/bin/python benchmarks/bench_peers_control.py [--quick]
"""

from __future__ import annotations

from collections.abc import Callable
import warnings

import alone  # noqa: F401 - one thread of BLAS
import numpy as np
from piezo_ident.model.simulated_stage import SimulatedStage
from piezo_ident.operators.dynamics import filter_arx
from piezo_ident.record.record import Piece
from scipy.signal import lfilter
from side_by_side import markdown, ratio, seconds, show, take_turns

RATE = 20_000.0


def sections(quick: bool = False) -> list[tuple[str, str]]:
    """Return titles and texts."""
    import control

    warnings.filterwarnings('ignore', module='control')
    runs, n = (2, 20_000) if quick else (5, 200_000)
    model = SimulatedStage.load('paper').model
    v = 5.0 + 5.0 * np.sin(2 * np.pi * 50.0 * np.arange(n) / RATE)
    piece, w = Piece(v, np.zeros(n), RATE), model.hysteresis(model.scaling.u(v))
    G, d = model.dynamics, model.delay.samples
    a, b = np.concatenate([[1.0], G.a]), np.concatenate([np.zeros(d), G.b])
    # powers of z, highest first, and as many of them above as below
    size = max(a.size, b.size)
    numerator, denominator = (np.pad(x, (0, size - x.size)) for x in (b, a))
    transfer = control.tf(numerator, denominator, 1.0 / RATE)
    space = control.ss(transfer)
    t = np.arange(n) / RATE
    works: dict[str, Callable[[int], np.ndarray]] = {
        'piezo_ident: whole model': lambda k: model.predict_piece(piece),
        'python-control: `forced_response`, transfer function': lambda k: (
            control.forced_response(transfer, t, w).outputs
        ),
        'python-control: `forced_response`, state space': lambda k: (
            control.forced_response(space, t, w).outputs
        ),
        'scipy: `lfilter`': lambda k: lfilter(b, a, w),
    }
    base = next(iter(works))
    turns = take_turns(works, runs, warm=works)
    # both from zero, so that they can be compared
    expected = filter_arx(G.a, b, w, at_rest=False)
    rows = []
    for name, turn in turns.items():
        result = turn.results[-1]
        gap = float(np.abs(result - expected).max() / np.ptp(expected))
        rows.append(
            [
                name,
                seconds(turn.median),
                f'{1e9 * turn.median / n:.1f} ns',
                ratio(turn.over(turns[base])),
                '' if name == base else f'{gap:.0e}',
            ]
        )
    heads = ('prediction', 'median time', 'a sample', f'over `{base}`', 'differs by, of stroke')
    text = f"""\
A 50 Hz sine of {n:,} samples through `stage_paper`, {runs} paired turns. Ours scales, goes through
{model.hysteresis.thresholds.size} plays and the cubic, G of order ({G.a.size}, {G.b.size}) and the
delay, and scales back. The others get w, the output of H, and simulate G and the delay alone.

{markdown(heads, rows)}

python-control steps through the state space in Python; it is made for design. `lfilter` runs the
same recursion in C."""
    return [('Free run of the whole model, and the linear part alone', text)]


if __name__ == '__main__':
    show(sections)
