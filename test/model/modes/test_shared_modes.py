# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Creep of shared modes is that of a chain, rests with the voltage, and is kept in the file."""

from dataclasses import replace

import numpy as np
from paper_stage import FS, with_mode
import piezo_ident as pi
from piezo_ident.common.errors import ModelError
from piezo_ident.model.axes_file import text_of
from piezo_ident.model.modes.modal import to_modal
from piezo_ident.model.modes.shared_modes import SharedModes
from piezo_ident.model.stage_model import EffectSetting
from piezo_ident.operators.dynamics import Delay
from piezo_ident.operators.hysteresis import Hysteresis
import pytest
from random_models import random_modes_model, random_shared_modes, random_voltages
from scipy.signal import tf2ss

GAIN, TIMES = np.array([0.02, 0.03]), np.array([0.01, 0.3])


def test_modes_of_one_axis_creep_as_its_chain():
    one = with_mode(900.0)
    crept = EffectSetting('creep', {'gain': GAIN.tolist(), 'time_constant': TIMES.tolist()})
    chain = replace(
        one, hysteresis=Hysteresis([], [], 0.0, 1.0), delay=Delay(0, 0.0), effects=(crept,)
    )
    G = chain.dynamics
    linear = to_modal(*tf2ss(np.pad(G.b, (0, G.a.size + 1 - G.b.size)), np.r_[1.0, G.a]))
    gain = chain.scaling.Y / chain.scaling.V
    modes = replace(
        SharedModes.of(replace(linear, c=gain * linear.c, d=gain * linear.d)),
        v0=np.array([5.0]),
        y0=chain.simulate([5.0]),
        creep=GAIN[None],
        taus=FS * TIMES,
    )
    # a start about which the modes hold is exactly at rest
    v = random_voltages(np.random.default_rng(0), modes, 20_000) + 5.0
    v += modes.v0 - v[0]
    v[10_000:] = v[10_000]
    y = chain.simulate(v[:, 0])
    assert modes.simulate(v)[:, 0] == pytest.approx(y, abs=1e-9 * np.ptp(y))


def test_a_voltage_at_rest_starts_no_creep_and_a_step_goes_on():
    modes = random_shared_modes(np.random.default_rng(1), creeps=True)
    still = modes.simulate(np.tile(modes.v0 + 1.0, (3000, 1)))
    assert np.abs(still - still[0]).max() < 1e-3 * np.abs(still[0] - modes.y0).max()
    linear = replace(SharedModes.of(modes.linear), creep=modes.creep, taus=modes.taus)
    step = np.zeros((40_000, 2))
    step[1:, 0] = 1.0
    y, plain = (x.simulate(step)[-1] for x in (linear, SharedModes.of(modes.linear)))
    assert y == pytest.approx((1.0 + modes.creep[0].sum()) * plain, rel=1e-4)


def test_a_file_keeps_creep_and_one_without_creep_is_of_the_earlier_schema(tmp_path):
    model = random_modes_model(np.random.default_rng(2), creeps=True)
    model.save(tmp_path / 'model.yaml')
    again = pi.load(tmp_path / 'model.yaml')
    v = random_voltages(np.random.default_rng(3), model.modes, 500)
    np.testing.assert_array_equal(again.modes.simulate(v), model.modes.simulate(v))
    text = (tmp_path / 'model.yaml').read_text(encoding='utf-8')
    assert 'schema_version: 4' in text and 'creep' in repr(model)
    (tmp_path / 'model.yaml').write_text(text.replace('taus: [', 'taus: [-'), encoding='utf-8')
    with pytest.raises(ModelError, match=r'model\.yaml: modes: .*taus'):
        pi.load(tmp_path / 'model.yaml')
    older = text_of(pi.MultiAxisModel(model.axes, random_shared_modes(np.random.default_rng(2))))
    assert 'schema_version: 3' in older and 'taus' not in older
    (tmp_path / 'model.yaml').write_text(older, encoding='utf-8')
    assert pi.load(tmp_path / 'model.yaml').modes.creep.shape == (2, 0)
