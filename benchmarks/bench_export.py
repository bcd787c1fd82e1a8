# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The exported C header beside Python: ns a sample of prediction and feed-forward.

    .venv-bench/bin/python benchmarks/bench_export.py [--quick]

The header is compiled by the C compiler of the system and called sample by sample from a loop in
C.  All works run in turns in one process.
"""

from __future__ import annotations

from collections.abc import Callable
import ctypes
from pathlib import Path
import shutil
import subprocess
import tempfile

import alone  # noqa: F401 - one thread of BLAS
import numpy as np
import piezo_ident as pi
from side_by_side import markdown, ratio, show, take_turns

RUNS = 9
LOOPS = """
#include "NAME.h"
#define LOOP(function, state, reset, step) \\
    void function(const double *x, double *out, long n) \\
    { \\
        static state s; \\
        long k; \\
        reset(&s, x[0]); \\
        for (k = 0; k < n; k++) \\
            out[k] = step(&s, x[k]); \\
    }
LOOP(predict_NAME, NAME_state, NAME_reset, NAME_step)
LOOP(drive_NAME, NAME_feedforward, NAME_feedforward_reset, NAME_feedforward_step)
#undef LOOP
"""
#: shipped stages by the names of their headers
STAGES = {'paper': 'paper', 'effects': 'paper, creep, rate dependence'}
VECTOR = np.ctypeslib.ndpointer(np.float64, flags='C')


def library(folder: Path, level: str) -> ctypes.CDLL:
    """Return the headers of all stages, compiled."""
    compiler = shutil.which('cc') or shutil.which('gcc') or shutil.which('clang')
    if compiler is None:
        raise RuntimeError('there is no C compiler (cc, gcc or clang) on the path')
    text = ''
    for name in STAGES:
        model = pi.SimulatedStage.load(name).model
        (folder / f'{name}.h').write_text(pi.export_c(model, name))
        text += LOOPS.replace('NAME', name)
    (folder / 'loops.c').write_text(text)
    out = folder / f'loops{level}.so'
    command = [compiler, '-std=c99', level, '-shared', '-fPIC', 'loops.c', '-o', str(out), '-lm']
    subprocess.run(command, cwd=folder, check=True)
    return ctypes.CDLL(str(out))


def caller(made: ctypes.CDLL, name: str, x: np.ndarray, out: np.ndarray) -> Callable:
    """Return a work that calls a loop over a whole record."""
    function = getattr(made, name)
    function.argtypes, function.restype = [VECTOR, VECTOR, ctypes.c_long], None
    return lambda _: function(x, out, x.size)


def sections(quick: bool = False) -> list[tuple[str, str]]:
    """Return titles and texts."""
    n, runs = (100_000, 3) if quick else (1_000_000, RUNS)
    v = 5.0 - 5.0 * np.cos(2 * np.pi * 50 * np.arange(n) / 20e3)
    rows, gaps = [], []
    with tempfile.TemporaryDirectory() as place:
        made = {level: library(Path(place), level) for level in ('-O2', '-O3')}
        for name, what in STAGES.items():
            model, out = pi.SimulatedStage.load(name).model, np.empty(n)
            y = model.simulate(v)
            works = {f'{what}: `model.simulate`': lambda _, m=model: m.simulate(v)}
            for level, loops in made.items():
                step = caller(loops, f'predict_{name}', v, out)
                works[f'{what}: `{name}_step`, `{level}`'] = step
            drive = caller(made['-O2'], f'drive_{name}', y[: n // 10].copy(), np.empty(n))
            works[f'{what}: `{name}_feedforward_step`, `-O2`'] = drive
            turns = take_turns(works, runs, warm=works)
            base = next(iter(turns.values()))
            for key, turn in turns.items():
                size = n // 10 if 'feedforward' in key else n
                share = ratio(turn.over(base) * n / size)
                rows.append([key, f'{1e9 * turn.median / size:.3g}', share])
            gaps.append(float(np.abs(out - y).max() / np.ptp(y)))
    table = markdown(('', 'ns a sample', 'times `model.simulate`'), rows)
    gap = f'Largest difference of the predictions: {max(gaps):.1e} of stroke.'
    return [('The exported C header', f'{table}\n\n{gap}')]


if __name__ == '__main__':
    show(sections)
