# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The feed-forward of the header: the model goes where it is told, and limits are kept."""

from dataclasses import replace
import re

from c_compiler import Compiled, needs_compiler
from effect_table import VISIBLE
import numpy as np
from numpy.testing import assert_allclose
from paper_stage import FS, PAPER
import piezo_ident as pi
from piezo_ident.common.errors import PiezoIdentError
from piezo_ident.control.hysteresis_inverse import HysteresisInverse
from piezo_ident.control.linear_inverse import linear_inverse
from piezo_ident.model.stage_model import EffectSetting
from piezo_ident.operators.hysteresis import Hysteresis
import pytest

LAWS = {
    'plays': Hysteresis([0.1, 0.3, 0.6], [0.3, 0.1, 0.2], -0.1, 0.9),
    'wide': Hysteresis(
        *([0.1, 0.3, 0.6], [0.3, 0.1, 0.2], 0.1, 0.9),
        **{'p0': 0.1, 'curves': [[0.1], [0.05], [0.2]], 'bias': [0.1, 0.0, 0.2]},
    ),
    'falls': Hysteresis([0.005, 0.3], [1.0, 0.5], 0.5, -0.3, curves=[[-0.2], [-0.1]]),
    'lags': Hysteresis([0.1], [0.3], -0.1, 0.9, relaxations=[[1.0, 0.05, 0.0, 0.0]]),
}
MODELS = {
    'paper': PAPER,
    **{name: replace(PAPER, effects=(EffectSetting(name, VISIBLE[name]),)) for name in VISIBLE},
    **{name: replace(PAPER, hysteresis=h) for name, h in LAWS.items()},
    'retracts': replace(PAPER, scaling=replace(PAPER.scaling, Y=-75e-6, y0=80e-6)),
}
#: within which a stage is kept
LIMITS, SLEW = (1.0, 8.0), 4000.0
#: what is undone up to the jump of its play, as its channel begins, or as a line
COARSE = {'backlash': 0.02, 'cross_coupling': 0.02, 'falls': 2.0}


@pytest.fixture(scope='module')
def headers():
    made = {name: pi.export_c(model, name) for name, model in MODELS.items()}
    made['short'] = pi.export_c(PAPER, 'short', preview=60)
    made['kept'] = pi.export_c(PAPER, 'kept', limits=LIMITS, slew=SLEW)
    return made


@pytest.fixture(scope='module')
def compiled(tmp_path_factory, headers):
    return Compiled(tmp_path_factory.mktemp('headers'), headers)


def preview(header):
    return int(re.search(r'PREVIEW = (\d+)', header).group(1))


def wanted(n=4000, frequency=60.0, size=5e-6):
    """Return a sine around 30 um that starts and ends at rest."""
    t = np.arange(n) / FS
    envelope = np.minimum(1.0, np.minimum(t, t[::-1]) / 0.05)
    return 30e-6 - size * envelope * np.cos(2 * np.pi * frequency * t)


@needs_compiler
@pytest.mark.parametrize('name', [name for name in MODELS if name != 'input_feedthrough'])
def test_the_model_goes_where_it_is_told(name, compiled, headers):
    model, y, ahead = MODELS[name], wanted(), preview(headers[name])
    y = 80e-6 - y if name == 'retracts' else y
    told = np.append(y, np.full(ahead, y[-1]))
    channel = np.sin(np.arange(told.size) / 300.0)
    clipped, v = compiled.drive(name, told, channel)
    k = np.arange(told.size) - ahead
    now = {'other_axis': np.interp(k, k + ahead, channel)}
    reached = model.stream().process(v, k / FS, now)[ahead:]
    assert clipped == 0
    # 100 rms(wanted - reached) / (max wanted - min wanted)
    error = 100.0 * np.sqrt(np.mean((y - reached) ** 2)) / np.ptp(y)
    assert error < COARSE.get(name, 2e-3)


@needs_compiler
def test_a_shorter_preview_is_kept_and_costs_little(compiled, headers):
    assert preview(headers['short']) == 60 < preview(headers['paper'])
    assert 'samples 61 to' in headers['short'] and 'ahead' in headers['short']
    y = wanted(size=20e-6)
    _, v = compiled.drive('short', np.append(y, np.full(60, y[-1])))
    assert 100.0 * np.sqrt(np.mean((y - PAPER.simulate(v)[60:]) ** 2)) / np.ptp(y) < 0.05


@needs_compiler
@pytest.mark.parametrize('name', ['paper', *LAWS])
def test_without_effects_it_is_the_inverse_of_h_behind_that_of_g(name, compiled, headers):
    model, y, ahead = MODELS[name], wanted(size=20e-6), preview(headers[name])
    s = model.scaling
    _, v = compiled.drive(name, np.append(y, np.full(ahead, y[-1])))
    H = HysteresisInverse(model.hysteresis)
    H.reset(float(s.u(v[0])))
    Q = linear_inverse(model)
    w = Q(np.pad(s.x(y), (ahead, 0), mode='edge'))
    assert_allclose(v, s.v0 + s.V * H.process(w)[0], atol=1e-9)


@needs_compiler
@pytest.mark.parametrize('seed', range(20))
def test_limits_hold_whatever_is_wanted(seed, compiled):
    rng = np.random.default_rng(seed)
    y = 35e-6 + rng.choice([1e-6, 30e-6, 1e-3]) * rng.standard_normal(3000)
    y[rng.integers(0, y.size, 20)] = rng.choice([np.nan, np.inf, -np.inf, 1e300, -1e300], 20)
    clipped, v = compiled.drive('kept', y)
    assert clipped > 0
    assert LIMITS[0] <= v.min() and v.max() <= LIMITS[1]
    assert np.abs(np.diff(v)).max() <= SLEW / FS * (1 + 1e-9)


@needs_compiler
def test_it_goes_on_after_numbers_that_are_none(compiled, headers):
    y, ahead = wanted(), preview(headers['paper'])
    broken = y.copy()
    broken[500] = np.nan
    held = y.copy()
    held[500] = y[499]
    assert_allclose(compiled.drive('paper', broken)[1], compiled.drive('paper', held)[1])
    assert np.isfinite(compiled.drive('paper', broken)[1]).all() and ahead < 1000


def test_the_header_says_what_it_does_not_do(headers):
    assert 'input_feedthrough: the voltage in the reading' in headers['input_feedthrough']
    assert 'a clock that starts elsewhere' in headers['thermal_drift']
    assert 'a clock that' not in headers['paper']
    falls = replace(PAPER, hysteresis=Hysteresis([0.1], [0.1], -0.8, 2.0))
    header = pi.export_c(falls)
    assert 'There is no feed-forward' in header and 'its slope falls to' in header
    assert 'stage_step' in header and 'stage_feedforward_step' not in header


@pytest.mark.parametrize(
    ('options', 'what'),
    [
        ({'name': '2x'}, "'2x'"),
        ({'name': 'a b'}, "'a b'"),
        ({'limits': (1.0, 0.0)}, r'limits \(1\.0, 0\.0\)'),
        ({'limits': (0.0, np.inf)}, r'limits \(0\.0, inf\)'),
        ({'slew': 0.0}, r'slew 0\.0:'),
        ({'preview': 3}, 'preview of 3 samples .* 3 samples'),
    ],
)
def test_what_cannot_be_is_refused(options, what):
    with pytest.raises(PiezoIdentError, match=what):
        pi.export_c(PAPER, **options)
