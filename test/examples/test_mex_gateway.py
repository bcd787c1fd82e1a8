# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The gateway for MATLAB, against a stand-in for the functions of MATLAB that it calls."""

import ctypes
from pathlib import Path
import subprocess

from c_compiler import COMPILER, needs_compiler, STRICT
import numpy as np
from numpy.testing import assert_allclose
from paper_stage import PAPER
import piezo_ident as pi

GATEWAY = Path(__file__).resolve().parents[2] / 'examples' / 'stage_mex.c'
MEX = """
#include <stdbool.h>
#include <stddef.h>
typedef struct { double *data; size_t n; bool is_true; } mxArray;
enum { mxREAL };
static mxArray result;
static double room[10000];
static bool mxIsDouble(const mxArray *a) { return a->data != NULL; }
static bool mxIsComplex(const mxArray *a) { (void)a; return false; }
static bool mxIsLogicalScalarTrue(const mxArray *a) { return a->is_true; }
static size_t mxGetNumberOfElements(const mxArray *a) { return a->n; }
static double *mxGetDoubles(const mxArray *a) { return a->data; }
static mxArray *mxCreateDoubleMatrix(size_t m, size_t n, int kind)
{
    (void)kind;
    result.data = room;
    result.n = m * n;
    return &result;
}
static void mexErrMsgIdAndTxt(const char *id, const char *text) { (void)id; (void)text; }
"""
CALL = """
#include "stage_mex.c"
void call(double *in, double *out, long n, int drives)
{
    mxArray in_array = {in, (size_t)n, false}, flag = {NULL, 1, true}, *left[1];
    const mxArray *right[2] = {&in_array, &flag};
    long k;
    mexFunction(1, left, drives ? 2 : 1, right);
    for (k = 0; k < n; k++)
        out[k] = left[0]->data[k];
}
"""


@needs_compiler
def test_the_gateway_gives_the_numbers_of_python(tmp_path):
    (tmp_path / 'mex.h').write_text(MEX)
    (tmp_path / 'stage.h').write_text(pi.export_c(PAPER))
    (tmp_path / 'stage_mex.c').write_text(GATEWAY.read_text())
    (tmp_path / 'call.c').write_text(CALL)
    command = [COMPILER, *STRICT, '-shared', '-fPIC', 'call.c', '-o', 'call.so', '-lm']
    subprocess.run(command, cwd=tmp_path, check=True)
    call = ctypes.CDLL(str(tmp_path / 'call.so')).call
    vector = np.ctypeslib.ndpointer(np.float64)
    call.argtypes, call.restype = [vector, vector, ctypes.c_long, ctypes.c_int], None
    v = 5.0 - 4.0 * np.cos(np.arange(5000) / 300.0)
    y, back = np.empty(v.size), np.empty(v.size)
    call(v, y, v.size, 0)
    assert_allclose(y, PAPER.simulate(v), atol=1e-12 * np.ptp(y))
    call(y, back, v.size, 1)
    ahead = int(pi.export_c(PAPER).partition('STAGE_PREVIEW = ')[2].partition(',')[0])
    assert_allclose(back[2 * ahead :], v[ahead:-ahead], atol=1e-3)
