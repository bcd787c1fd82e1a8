# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Headers that were exported, compiled by the C compiler of the system and called from Python."""

import ctypes
from pathlib import Path
import shutil
import subprocess

import numpy as np
import pytest

COMPILER = next(filter(None, map(shutil.which, ('cc', 'gcc', 'clang'))), None)
needs_compiler = pytest.mark.skipif(
    COMPILER is None, reason='no C compiler (cc, gcc or clang) on the path'
)
STRICT = ['-std=c99', '-O2', '-Wall', '-Wextra', '-Wshadow', '-pedantic', '-Werror']

#: calls of one header: a whole record for prediction and feed-forward
CALLS = """
double predict_NAME(const double *v, const double *c, double *y, long n)
{
    static NAME_state s;
    double rest = NAME_reset(&s, v[0]);
    long k;
    for (k = 0; k < n; k++) {
        s.channel[0] = c[k];
        y[k] = NAME_step(&s, v[k]);
    }
    return rest;
}
"""
DRIVE = """
double drive_NAME(const double *y, const double *c, double *v, long n)
{
    static NAME_feedforward f;
    long k;
    v[0] = NAME_feedforward_reset(&f, y[0]);
    for (k = 0; k < n; k++) {
        f.channel[0] = c[k];
        v[k] = NAME_feedforward_step(&f, y[k]);
    }
    return (double)f.clipped;
}
"""

_VECTOR = np.ctypeslib.ndpointer(np.float64, flags='C')


class Compiled:
    """Headers as one library, by their names."""

    def __init__(self, folder: Path, headers: dict[str, str]) -> None:
        text = ''
        for name, header in headers.items():
            (folder / f'{name}.h').write_text(header)
            calls = CALLS + (DRIVE if f'{name}_feedforward_step' in header else '')
            text += f'#include "{name}.h"\n{calls.replace("NAME", name)}'
        (folder / 'calls.c').write_text(text)
        command = [COMPILER, *STRICT, '-shared', '-fPIC', 'calls.c', '-o', 'calls.so', '-lm']
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        self._library = ctypes.CDLL(str(folder / 'calls.so'))

    def _call(self, what, x, channel):
        function = getattr(self._library, what)
        function.argtypes = [_VECTOR, _VECTOR, _VECTOR, ctypes.c_long]
        function.restype = ctypes.c_double
        out = np.empty(x.size)
        c = np.zeros(x.size) if channel is None else channel
        first = function(np.ascontiguousarray(x), c, out, x.size)
        return first, out

    def predict(self, name, v, channel=None):
        """Return the displacement at rest under the first sample, and that of all [m]."""
        return self._call(f'predict_{name}', v, channel)

    def drive(self, name, y, channel=None):
        """Return how many samples were clipped, and the voltage [V]."""
        return self._call(f'drive_{name}', y, channel)
