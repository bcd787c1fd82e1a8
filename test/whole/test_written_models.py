# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A model that can be written is taken by every verb and by its live twin, or refused by all."""

from dataclasses import replace

from command_line import refuse, succeed
from effect_table import VISIBLE
import numpy as np
from numpy.testing import assert_allclose
from paper_stage import FS, PAPER
import piezo_ident as pi
from piezo_ident.common.errors import ModelError
from piezo_ident.live.predictor import Predictor
from piezo_ident.model.stage_model import EffectSetting
from piezo_ident.operators.hysteresis_law import LAWS
from piezo_ident.record.blocks import Samples
import pytest
from random_models import falling_hysteresis, random_hysteresis, random_model, smooth_motion

#: effects that leave the motions within reach
EFFECTS = {**VISIBLE, 'saturation': {'high': 0.95}, 'slew_limit': {'limit': 2000.0}}
#: what the inversion may leave of a motion, % of stroke: less than a real stage errs by
LEFT = 1.0


def reread(model, path):
    """Return a model that was written and read."""
    model.save(path)
    return pi.load(path)


@pytest.mark.parametrize('name', sorted(VISIBLE))
def test_a_model_is_taken_by_every_verb(name, tmp_path):
    place = sorted(VISIBLE).index(name)
    for k, made in enumerate((random_hysteresis, falling_hysteresis)):
        law, rng = LAWS[(place + 2 * k) % len(LAWS)], np.random.default_rng([place, k])
        model = replace(random_model(rng, law, damped=0.02), hysteresis=made(rng, law))
        wanted = smooth_motion(rng, model, 1500)
        model = replace(model, effects=(EffectSetting(name, EFFECTS[name]),))
        model = reread(model, tmp_path / 'model.yaml')
        t = np.arange(wanted.size) / FS
        v, beside = 5.0 - 5.0 * np.cos(600.0 * t), {'other_axis': np.sin(300.0 * t)}
        y = model.simulate(v, channels=beside)
        drive = pi.invert(model, wanted, channels=beside)
        assert drive.error < LEFT, (law, drive.error)
        says = [x for x in drive.warnings if 'inverted as lines' in x]
        assert len(says) == k, drive.warnings
        live = pi.LiveInverse(model)
        assert np.isfinite(live.process(wanted).v).all()
        assert ('inverted as lines' in ' '.join(live.warnings)) == bool(k)
        assert 'stage_feedforward_step' in pi.export_c(model)
        pi.export_fmu(model, tmp_path / f'{k}.fmu')
        predictor = Predictor()
        if name == 'cross_coupling':
            with pytest.raises(ModelError, match=r"cross_coupling .* 'other_axis'"):
                predictor.set_model(model)
            continue
        predictor.set_model(model)
        blocks = [predictor.process(Samples(t[s], v[s])) for s in (slice(700), slice(700, None))]
        assert_allclose(np.concatenate([b.values for b in blocks]), y, rtol=0.0, atol=1e-17)


@pytest.mark.parametrize('law', LAWS)
def test_a_model_that_falls_is_refused_by_all_with_the_same_words(capsys, law, tmp_path):
    rng = np.random.default_rng(LAWS.index(law))
    h = random_hysteresis(rng, law)
    falls = replace(PAPER, hysteresis=replace(h, p2=h.p2 - h.lowest_slope() - 3.0))
    path, scan, header = (tmp_path / name for name in ('model.yaml', 'scan.csv', 'stage.h'))
    falls = reread(falls, path)
    wanted = np.full(100, 20e-6)
    with pytest.raises(ModelError, match=r'slope .* -\d\S* at \d\S* V') as refused:
        pi.invert(falls, wanted)
    with pytest.raises(ModelError) as live:
        pi.LiveInverse(falls)
    assert str(live.value) == str(refused.value)
    # the files are told apart: not the motion is at fault
    np.savetxt(scan, np.c_[np.arange(100) / FS, wanted], delimiter=',', header='t,y', comments='')
    line = refuse(capsys, tmp_path, ['invert', path, scan])
    assert f'{path}: {refused.value}' in line and scan.name not in line
    said = succeed(capsys, 'export', path, '--out', header)
    assert f'{path}: ' in said and str(refused.value) in said
    assert 'stage_feedforward_step' not in header.read_text()
    assert np.isfinite(falls.simulate([0.0, 5.0, 2.0])).all()


def test_a_model_that_falls_within_a_narrow_play_does_not_jump_at_rest():
    h = falling_hysteresis(np.random.default_rng(1), 'preisach')
    model = replace(PAPER, hysteresis=h)
    k = np.arange(3000)
    soft = 0.5 - 0.5 * np.cos(np.pi * np.clip((k - 300) / 600.0, 0.0, 1.0))
    low, high = (model.stream().reset(v) for v in (2.0, 6.0))
    drive = pi.invert(model, low + (high - low) * soft)
    assert drive.error < LEFT
    # what is left of G at rest must not make the voltage turn by the width of the play
    rest = drive.v[drive.lead + 1200 :]
    assert np.abs(np.diff(rest)).max() < 0.1 * h.thresholds[0] * model.scaling.V
