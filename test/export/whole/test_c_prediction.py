# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The header predicts what Python does, to 1e-12 of stroke: every effect, law of H and G."""

from dataclasses import replace
from itertools import pairwise
import shutil
import subprocess

from c_compiler import Compiled, needs_compiler
from effect_table import VISIBLE
import numpy as np
from paper_stage import PAPER
import piezo_ident as pi
from piezo_ident import effects
from piezo_ident.effects import find_effect
from piezo_ident.model.stage_model import EffectSetting
from piezo_ident.operators.dynamics import Delay, Dynamics
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.operators.hysteresis_law import LAWS
import pytest
from random_models import random_model

#: largest difference, as a share of stroke
CLOSE = 1e-12


def random_drive(rng, n=6000):
    """Return a voltage with turns at random places, jumps, rests and noise, within 0 .. 10 V."""
    ends = rng.uniform(0.0, 10.0, n // 100)
    ways = [np.linspace(a, b, rng.integers(1, 300)) for a, b in pairwise(ends)]
    v = np.concatenate([*ways, np.repeat(rng.uniform(0.0, 10.0, 5), 200)])[:n]
    return np.clip(v + 0.02 * rng.standard_normal(v.size), 0.0, 10.0)


def random_voltage_model(rng, law, effects=()):
    """Return a random model whose delay may be whole, and whose voltage has an origin."""
    model = random_model(rng, law, tuple(effects), damped=0.05)
    delay = Delay(int(rng.integers(2, 20)), float(rng.choice([0.0, rng.uniform()])))
    return replace(model, scaling=replace(model.scaling, v0=0.3), delay=delay)


def random_effect(rng, name):
    """Return an effect with each number of a visible one times 0.5 to 1.5, within its bounds."""
    values = {}
    for p in find_effect(name).parameters:
        value = VISIBLE[name].get(p.name, p.default)
        if p.kind == 'number' and value is not None and (p.name in VISIBLE[name] or not p.vector):
            value = p.clip(np.asarray(value) * rng.uniform(0.5, 1.5, np.shape(value)))
        if value is not None and (p.name in VISIBLE[name] or not p.vector):
            values[p.name] = value
    if name == 'gain_drift':
        values['time'] = np.sort(values['time'])
    if name == 'rate_dependent_hysteresis':
        values |= {'exponent': rng.choice([1.0, 0.6]), 'levelling': rng.choice([0.0, 0.01])}
        values |= {'lead': 1e-5, 'lead_stretch': 1e-4}
    if name == 'saturation':
        values |= dict([('knee', 0.0), ('low', -np.inf), ('high', np.inf)][: rng.integers(0, 3)])
    return EffectSetting(name, values)


def refined_dynamics(rng):
    """Return a G of orders 18 and 13 with lightly damped modes, as a refit may have it."""

    def modes(w, damping):
        poles = np.exp(w * (-damping + 1j))
        return np.real(np.poly([*poles, *poles.conj()]))

    w = np.sort(np.concatenate([rng.uniform(0.1, 0.6, 4), rng.uniform(0.6, 3.0, 5)]))
    beside = rng.choice(w, 6, replace=False) * rng.uniform(1.0, 1.1, 6)
    zeros = modes(beside, 10.0 ** rng.uniform(-2.3, -1.0, 6))
    return Dynamics(modes(w, 10.0 ** rng.uniform(-2.3, -1.0, 9))[1:], zeros).normalised()


def models(seed=11):
    """Return models by name: each effect by itself, all of them, and each law of H."""
    rng = np.random.default_rng(seed)
    made = {}
    for name in sorted(VISIBLE):
        for law in ('plays', 'square'):
            made[f'{name}_{law}'] = random_voltage_model(rng, law, [random_effect(rng, name)])
    for law in LAWS:
        made[f'h_{law}'] = random_voltage_model(rng, law)
        every = [random_effect(rng, name) for name in rng.permutation(sorted(VISIBLE))]
        made[f'all_{law}'] = random_voltage_model(rng, law, every)
    # rates that double, and one that does not
    lags = np.column_stack([[1.0, 2.0, 4.0, 9.0], rng.uniform(0, 0.03, (4, 3))])
    made['h_lags'] = replace(
        PAPER, hysteresis=Hysteresis([0.1, 0.4], [0.3, 0.1], -0.1, 0.9, relaxations=lags)
    )
    for k in range(4):
        refined = ('creep', 'rate_dependent_hysteresis') if k % 2 else ()
        model = random_voltage_model(rng, LAWS[k % 2], [random_effect(rng, x) for x in refined])
        made[f'refined_{k}'] = replace(model, dynamics=refined_dynamics(rng))
    none = Hysteresis([], [], 0.1, 1.0, p0=0.05)
    made['h_none'] = replace(PAPER, hysteresis=none, dynamics=Dynamics.unit(), delay=Delay(0))
    made['paper'] = PAPER
    return made


MODELS = models()


@pytest.fixture(scope='module')
def compiled(tmp_path_factory):
    headers = {name: pi.export_c(model, name, feedforward=False) for name, model in MODELS.items()}
    return Compiled(tmp_path_factory.mktemp('headers'), headers)


def test_an_effect_that_is_not_written_in_c_is_refused_by_its_name(monkeypatch):
    class Odd(effects.Effect):
        name, slot, parameters = 'odd', 'output', ()

        def process(self, block):
            return block

    monkeypatch.setattr(effects, 'catalogue', lambda: {'odd': Odd})
    with pytest.raises(pi.ModelError, match=r'effect odd: .*\bC\b'):
        pi.export_c(replace(PAPER, effects=(EffectSetting('odd', {}),)))


def test_names_from_a_file_cannot_leave_the_comment():
    name = '*/ int evil; /*\n*'
    values = {**VISIBLE['cross_coupling'], 'channel': name}
    model = replace(PAPER, effects=(EffectSetting('cross_coupling', values),))
    header = pi.export_c(model, title='**// evil\n */')
    head, _, rest = header.partition('#ifndef STAGE_H')
    assert head.count('*/') == 1 and 'evil' in head and 'evil' not in rest


@needs_compiler
def test_c_plus_plus_takes_it_too(tmp_path):
    compiler = shutil.which('c++')
    if compiler is None:
        pytest.skip('no C++ compiler (c++) on the path')
    effects = [EffectSetting(name, VISIBLE[name]) for name in VISIBLE]
    (tmp_path / 'stage.h').write_text(pi.export_c(replace(PAPER, effects=tuple(effects))))
    (tmp_path / 'a.cpp').write_text('#include "stage.h"\n')
    command = [compiler, '-std=c++11', '-Wall', '-Wextra', '-Werror', '-fsyntax-only', 'a.cpp']
    subprocess.run(command, cwd=tmp_path, check=True)


@needs_compiler
@pytest.mark.parametrize('name', MODELS)
def test_prediction_is_that_of_python(name, compiled):
    rng = np.random.default_rng(sum(map(ord, name)))
    model, v = MODELS[name], random_drive(rng)
    channel = np.cumsum(rng.standard_normal(v.size)) / 20.0
    rest, y = compiled.predict(name, v, channel)
    expected = model.simulate(v, channels={'other_axis': channel})
    stroke = np.ptp(expected)
    assert np.abs(y - expected).max() < CLOSE * stroke
    assert abs(rest - model.stream().reset(v[0])) < CLOSE * stroke
