# Copyright 2026 The piezo_ident authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Every effect: neutral values, streaming, files; and the signature of those built in first."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from piezo_ident.block import Block, SLOTS
from piezo_ident.dynamics import Delay, Dynamics
from piezo_ident.effects import catalogue, Effect, find_effect
from piezo_ident.errors import ModelError
from piezo_ident.hysteresis import HysteresisOperator
from piezo_ident.model import EffectSetting, StageModel
from piezo_ident.model_io import load_model, save_model
from piezo_ident.record import Piece, Record
from piezo_ident.simulation import load_stage
import pytest

FS = 20_000.0
ROOT = Path(__file__).resolve().parents[1]
PAPER = load_stage(ROOT / 'config/stage_paper.yaml').model
H = PAPER.hysteresis

#: a setting of each effect that can be seen
VISIBLE = {
    'creep': {'gain': [0.012, 0.02], 'time_constant': [0.1, 1.0]},
    'periodic_disturbance': {
        'frequency': 50.0,
        'harmonic': [1.0, 3.0],
        'amplitude': [1e-3, 3e-4],
        'phase': [0.4, 1.1],
    },
    'rate_dependent_hysteresis': {'gain': 1e-4, 'exponent': 1.0, 'cutoff': 1000.0},
    'thermal_drift': {'rate': 1e-3, 'amplitude': 0.01, 'time_constant': 0.5},
}


def signal(n: int = 4000, f: float = 40.0) -> np.ndarray:
    """Return a sine that grows from rest, in volts."""
    t = np.arange(n) / FS
    return 5 * (1 - np.cos(2 * np.pi * f * t)) * np.minimum(1.0, 0.3 + 4 * t)


def with_effects(*names: str, model: StageModel = PAPER) -> StageModel:
    return replace(model, effects=tuple(EffectSetting(n, VISIBLE[n]) for n in names))


def alone(name: str, values: dict, u: np.ndarray, fs: float = FS, t0: float = 0.0) -> np.ndarray:
    """Return what one effect makes of a normalised signal, starting at rest."""
    effect = find_effect(name)(fs, values, H)
    effect.reset(float(u[0]), float(u[0]))
    return effect.process(Block(t=t0 + np.arange(u.size) / fs, v=u, x=u)).x


# -- every effect ------------------------------------------------------------------------------


def test_what_is_tested_here_is_in_the_catalogue():
    assert set(VISIBLE) <= set(catalogue())


@pytest.mark.parametrize('name', sorted(catalogue()))
def test_effect_is_declared_in_full(name):
    effect = catalogue()[name]
    assert effect.name == name
    assert effect.slot in SLOTS
    assert any(not np.isnan(p.neutral) for p in effect.parameters)
    assert effect.__doc__
    assert 'Notes' in effect.__doc__
    for p in effect.parameters:
        assert p.unit
        assert p.description
        assert p.lower < p.upper
        assert np.isnan(p.neutral) or p.lower <= p.neutral <= p.upper


@pytest.mark.parametrize('name', sorted(VISIBLE))
def test_neutral_values_change_nothing(name):
    neutral = {p.name: p.neutral for p in catalogue()[name].parameters}
    values = {
        key: (np.full(np.shape(value), neutral[key]) if not np.isnan(neutral[key]) else value)
        for key, value in VISIBLE[name].items()
    }
    model = replace(PAPER, effects=(EffectSetting(name, values),))
    assert_array_equal(model.stream().process(signal()), PAPER.stream().process(signal()))
    # and the values of the other tests do change something
    seen = with_effects(name).stream().process(signal())
    assert np.abs(seen - PAPER.stream().process(signal())).max() > 1e-9


@settings(deadline=None, max_examples=30)
@given(
    cuts=st.lists(st.integers(0, 4000), max_size=8),
    names=st.permutations(sorted(VISIBLE)).flatmap(
        lambda order: st.integers(1, len(order)).map(lambda n: order[:n])
    ),
    t0=st.sampled_from([0.0, 3.7, 1e4]),
)
def test_result_does_not_depend_on_the_cutting(cuts, names, t0):
    model, v = with_effects(*names), signal()
    t = t0 + np.arange(v.size) / FS
    whole = model.stream().process(v, t)
    run, edges = model.stream(), [0, *sorted(cuts), v.size]
    parts = [run.process(v[a:b], t[a:b]) for a, b in pairwise(edges)]
    assert_array_equal(np.concatenate(parts), whole)


def test_saving_and_loading_changes_nothing(tmp_path):
    model = with_effects(*VISIBLE)
    save_model(model, tmp_path / 'model.yaml')
    again = load_model(tmp_path / 'model.yaml')
    assert [e.name for e in again.effects] == list(VISIBLE)
    assert_array_equal(again.stream().process(signal()), model.stream().process(signal()))


@pytest.mark.parametrize('name', sorted(VISIBLE))
def test_inputs_are_left_alone(name):
    u = signal() / 10
    before = u.copy()
    alone(name, VISIBLE[name], u)
    assert_array_equal(u, before)


@pytest.mark.parametrize('name', sorted(VISIBLE))
def test_rest_is_rest(name):
    # after a reset a constant command moves nothing but what time itself moves
    effect = find_effect(name)(FS, VISIBLE[name], H)
    rest = effect.reset(0.3, 0.3)
    x = effect.process(Block(t=np.zeros(200), v=np.full(200, 0.3), x=np.full(200, 0.3))).x
    assert_array_equal(x, np.full(200, x[0]))
    if name != 'periodic_disturbance':
        assert x[0] == pytest.approx(rest, abs=1e-15)


@pytest.mark.parametrize(
    ('name', 'change', 'says'),
    [
        ('creep', {'gain': [0.1]}, 'give one each'),
        ('periodic_disturbance', {'phase': [0.0]}, 'differ in length'),
        ('periodic_disturbance', {'frequency': -50.0}, 'leaves its bounds'),
        ('rate_dependent_hysteresis', {'gain': -1e-4}, 'leaves its bounds'),
        ('rate_dependent_hysteresis', {'gain': float('nan')}, 'leaves its bounds'),
        ('thermal_drift', {'time_constant': 0.0}, 'leaves its bounds'),
        ('thermal_drift', {'speed': 0.0}, 'unknown'),
        ('thermal_drift', {'rate': [0.0]}, 'must be one number'),
    ],
)
def test_wrong_parameters_are_refused(name, change, says):
    with pytest.raises(ModelError, match=says):
        find_effect(name)(FS, {**VISIBLE[name], **change}, H)


# -- creep -------------------------------------------------------------------------------------


def test_creep_of_one_element_a_decade_is_straight_in_the_logarithm_of_time():
    fs, gamma = 200.0, 0.012
    values = {'gain': [gamma] * 5, 'time_constant': [0.01, 0.1, 1.0, 10.0, 100.0]}
    u = np.concatenate([[0.0], np.ones(int(100 * fs))])
    y = alone('creep', values, u, fs)[1:]
    t = np.arange(1, y.size + 1) / fs
    at = np.geomspace(0.1, 30, 60)
    rise = np.interp(at, t, y)
    slope, offset = np.polyfit(np.log10(at), rise, 1)
    assert slope == pytest.approx(gamma, rel=0.03)
    # what bends is the ripple of the elements, a few per cent of the rise a decade
    assert np.abs(rise - slope * np.log10(at) - offset).max() < 0.06 * gamma


# -- rate dependence ---------------------------------------------------------------------------


def plainly(u, fs, gain, exponent, cutoff, memory=None):
    """Return H with growing thresholds, written as in the text book."""
    pole = np.exp(-2 * np.pi * cutoff / fs)
    f = H.initial_memory(u[0]) if memory is None else memory
    s, last, w = 0.0, u[0], []
    for x in u:
        s = pole * s + (1 - pole) * (x - last) * fs
        last = x
        r = H.thresholds + gain * abs(s) ** exponent
        f = np.maximum(x - r, np.minimum(x, f))
        w.append(H.p1 * x**3 + H.p2 * x + H.weights @ f)
    return np.array(w)


@pytest.mark.parametrize('values', [(1e-4, 1.0, 1000.0), (2e-3, 0.5, 200.0)])
def test_rate_dependence_is_its_equation(values):
    u = signal(1500) / 10
    got = alone(
        'rate_dependent_hysteresis',
        dict(zip(('gain', 'exponent', 'cutoff'), values, strict=True)),
        u,
    )
    assert_allclose(got, plainly(u, FS, *values), atol=1e-13)


def deviation(f: float, amplitude: float = 0.5) -> float:
    """Return by how much rate dependence changes H on a sine, in % of the stroke."""
    fs = FS * max(1.0, f / 100)
    n = round(2 * fs / f)
    u = amplitude * (1 - np.cos(2 * np.pi * f * np.arange(n) / fs))
    w = alone('rate_dependent_hysteresis', VISIBLE['rate_dependent_hysteresis'], u, fs)
    still = H(u)
    half = slice(n // 2, n)
    return 100 * np.sqrt(np.mean((w - still)[half] ** 2)) / np.ptp(still[half])


def test_rate_dependence_is_nothing_when_slow_and_grows_with_speed():
    at = {f: deviation(f) for f in (0.2, 1.0, 10.0, 50.0, 100.0, 120.0)}
    assert at[0.2] < 0.005
    assert at[1.0] < 0.02
    assert at[120.0] > 0.5
    assert np.all(np.diff(list(at.values())) > 0)


def test_rate_dependence_grows_with_amplitude_at_one_frequency():
    # linear dynamics would give one number
    assert deviation(100.0, 0.5) > 1.3 * deviation(100.0, 0.15)


def test_rate_dependence_stacks_with_other_effects_of_its_slot():
    class Square(Effect):
        """Add p0 v^2."""

        name = 'square'
        slot = 'hysteresis'
        parameters = ()

        def reset(self, v0, x0):
            return self.inner.reset(v0, x0) + 0.1 * x0**2

        def process(self, block):
            inner = self.inner.process(block)
            return inner.with_signal(inner.x + 0.1 * block.x**2)

    rate, values = (
        find_effect('rate_dependent_hysteresis'),
        VISIBLE['rate_dependent_hysteresis'],
    )
    # a stage that came from above: every play at the lower end of its band
    u, memory = signal() / 10, -H.thresholds

    def run(operator):
        operator.reset(u[0], u[0])
        return operator.process(Block(t=np.arange(u.size) / FS, v=u, x=u)).x

    one = rate(FS, values, H, Square(FS, {}, H, HysteresisOperator(H, memory)))
    two = Square(FS, {}, H, rate(FS, values, H, HysteresisOperator(H, memory)))
    assert_allclose(run(one), run(two), atol=1e-14)
    # the memory that was given is the one that both kinds of plays start from
    assert_allclose(run(one) - 0.1 * u**2, plainly(u, FS, *values.values(), memory), atol=1e-13)


# -- hum and drift -----------------------------------------------------------------------------


def test_hum_has_the_lines_and_phases_it_was_given():
    n = 20_000
    x = alone('periodic_disturbance', VISIBLE['periodic_disturbance'], np.zeros(n))
    spectrum = np.fft.rfft(x) / (n / 2)
    assert_array_equal(np.flatnonzero(np.abs(spectrum) > 1e-9), [50, 150])
    assert_allclose(np.abs(spectrum[[50, 150]]), [1e-3, 3e-4], rtol=1e-9)
    assert_allclose(np.angle(spectrum[[50, 150]]) + np.pi / 2, [0.4, 1.1], atol=1e-9)


def test_hum_in_metres_is_a_share_of_the_span():
    y = with_effects('periodic_disturbance').stream().process(np.zeros(20_000))
    assert np.abs(np.fft.rfft(y)[50]) / 10_000 == pytest.approx(1e-3 * 75e-6, rel=1e-6)


def test_drift_goes_on_through_a_gap():
    model = with_effects('thermal_drift')
    static = replace(model, dynamics=Dynamics.unit(), delay=Delay(0))
    zero = np.zeros(100)
    early, late = Piece(zero, zero, FS), Piece(zero, zero, FS, start_time=2.0)
    first, second = static.predict(Record((early, late))).pieces
    assert first[0] == 0.0

    def law(t):
        return 75e-6 * (1e-3 * t + 0.01 * (1 - np.exp(-t / 0.5)))

    assert_allclose(first, law(early.t), rtol=1e-9)
    assert_allclose(second, law(late.t), rtol=1e-9)


def test_drift_does_not_look_at_the_command():
    one = alone('thermal_drift', VISIBLE['thermal_drift'], np.zeros(100), t0=-1e-3)
    two = alone('thermal_drift', VISIBLE['thermal_drift'], np.full(100, 0.7), t0=-1e-3)
    assert_allclose(two - one, 0.7, atol=1e-15)
    # before the clock starts nothing has drifted
    assert_array_equal(one[:20], np.zeros(20))
