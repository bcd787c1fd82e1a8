# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The header of shared modes predicts what Python does, to the last bit."""

import ctypes
from dataclasses import replace
import subprocess

from axes_stage import loop_stage
from c_compiler import COMPILER, needs_compiler, STRICT
import numpy as np
import piezo_ident as pi
from piezo_ident.model.modes.shared_modes import SharedModes
import pytest
from random_models import random_modes_model, random_shared_modes, random_voltages

NAMES = ('y_b', 'y', 'y_c')
CALLS = """
#include "stage.h"
void predict(const double *v, double *y, double *rest, long n)
{
    static stage_state s;
    long k;
    stage_reset(&s, v, rest);
    for (k = 0; k < n; k++)
        stage_step(&s, v + k * AXES, y + k * AXES);
}
"""


def compiled(folder, model):
    """Compile the header of a model, and return a function of voltages, shape (n, axes)."""
    axes = len(model.axes)
    (folder / 'stage.h').write_text(pi.export_c(model))
    (folder / 'calls.c').write_text(CALLS.replace('AXES', str(axes)))
    command = [COMPILER, *STRICT, '-shared', '-fPIC', 'calls.c', '-o', 'calls.so', '-lm']
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    call = ctypes.CDLL(str(folder / 'calls.so')).predict
    vector = np.ctypeslib.ndpointer(np.float64, flags='C')
    call.argtypes, call.restype = [vector, vector, vector, ctypes.c_long], None

    def predict(v):
        y, rest = np.empty_like(v), np.empty(axes)
        call(v, y, rest, len(v))
        return y, rest

    return predict


def renamed(model):
    """Name and order the axes so that the model file and the alphabet differ."""
    axes = list(model.axes.values())
    return pi.MultiAxisModel(dict(zip(NAMES, axes, strict=False)), model.modes)


def cases():
    """Return models of shared modes by name, with all signals, few and none."""
    rng = np.random.default_rng(5)
    made = {
        f'{axes} axes{", softens" * softens}': random_modes_model(rng, axes, softens=softens)
        for axes in (1, 2, 3)
        for softens in (False, True)
    }
    two = made['2 axes']
    linear = SharedModes.of(random_shared_modes(rng).linear)
    soft = random_shared_modes(rng)
    kept = slice(0, soft.levels)
    parts = {k: getattr(soft, k)[:, kept] for k in ('e', 'h')}
    parts |= {k: getattr(soft, k)[kept] for k in ('f', 'g', 'mu')}
    made['linear'] = pi.MultiAxisModel(two.axes, linear)
    made['softening alone'] = pi.MultiAxisModel(two.axes, replace(soft, **parts))
    made['a direct path'] = pi.MultiAxisModel(
        two.axes, replace(two.modes, h=rng.normal(size=two.modes.h.shape) * 1e-7)
    )
    made['creep'] = random_modes_model(rng, 3, creeps=True)
    made['a real loop'] = pi.MultiAxisModel(two.axes, replace(loop_stage(), v0=np.full(2, 4.0)))
    return {name: renamed(model) for name, model in made.items()}


CASES = cases()


@needs_compiler
@pytest.mark.parametrize('name', CASES)
def test_the_header_predicts_to_the_last_bit(name, tmp_path):
    model, rng = CASES[name], np.random.default_rng(3)
    v = np.ascontiguousarray(random_voltages(rng, model.modes, 4000))
    # a jump, and a rest in which the modes die away
    v[2000:] = v[2000]
    y, rest = compiled(tmp_path, model)(v)
    expected = model.simulate({f'v{a[1:]}': x for a, x in zip(model.axes, v.T, strict=True)})
    for column, axis in zip(y.T, model.axes, strict=True):
        np.testing.assert_array_equal(column, expected[axis])
    np.testing.assert_array_equal(rest, [expected[a][0] for a in model.axes])
    assert np.ptp(y, axis=0).min() > 0.0


def test_settings_of_a_feed_forward_are_refused():
    model = CASES['2 axes']
    assert 'no feed-forward' in pi.export_c(model, limits=None, slew=np.inf, preview=None)
    with pytest.raises(pi.ConfigError, match='preview'):
        pi.export_c(model, preview=20)
    with pytest.raises(pi.ConfigError, match="'Stage 1'"):
        pi.export_c(model, 'Stage 1')
