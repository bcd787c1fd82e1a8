# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Effects that set in behind the identification, on a stage whose H is no sum of plays."""

from dataclasses import replace
from functools import cache
from itertools import groupby

from measured_data import measured_record
import numpy as np
from piezo_ident import DiagnosisSettings, Record, SimulatedStage
from piezo_ident.diagnosis import diagnose
from piezo_ident.identification.identify import identify
from piezo_ident.model.free_run import free_run
from piezo_ident.model.stage_model import EffectSetting
from piezo_ident.operators.hysteresis_law import HysteresisLaw
from piezo_ident.record.record import Piece, Segment
from piezo_ident.report.diagnosis import diagnosis_text
from piezo_ident.report.json_data import to_json
from programs import slow_model
import pytest
import truths

#: shows all that the programs of the truths move
RATE = 2500.0
PATH = DiagnosisSettings(
    effects=(
        'saturation',
        'backlash',
        'even_nonlinearity',
        'preload_loss',
        'noncongruent_minor_loops',
        'gain_drift',
    )
)


@cache
def stage():
    """Return the model of a stage whose loops change along the bias."""
    model = SimulatedStage.load('paper').model
    plays = model.hysteresis
    law = HysteresisLaw('preisach', plays.thresholds, (0.0, 1.0))
    coefficients = np.zeros(law.size)
    coefficients[: law.thresholds.size] = 0.5 * plays.weights
    more = slice(law.thresholds.size, law.densities)
    coefficients[more] = np.random.default_rng(0).uniform(0.0, 0.03, coefficients[more].size)
    coefficients[-3] = 0.7
    return replace(
        model,
        sample_rate=RATE,
        hysteresis=law.hysteresis(coefficients),
        dynamics=slow_model().dynamics,
    )


def record(real, kind='diagnosis', *, labelled=True, factor=1.0):
    """Return what a stage does in a program of the truths, with the noise of 2e-4 at 20 kHz."""
    _, v, labels = truths.program(kind, 2, RATE)
    v = v * stage().scaling.range[1] / v.max()
    y = factor * real.simulate(v)
    y = y + np.random.default_rng(len(kind)).normal(0.0, 1e-4 * np.ptp(y), y.size)
    segments = tuple(Segment(*label) for label in labels) if labelled else ()
    return Record((Piece(v, y, RATE, segments=segments),), kind)


def saturated(high=0.93):
    """Return the stage with an end that it now meets."""
    return replace(stage(), effects=(EffectSetting('saturation', {'high': high}),))


@pytest.mark.parametrize('labelled', [True, False])
def test_what_set_in_since_is_named_though_a_refit_does_as_much(labelled):
    changed, steps = saturated(), []
    known = record(changed, labelled=labelled)
    result = diagnose(stage(), known, PATH, progress=lambda *at: steps.append(at[0]))
    assert [step for step, _ in groupby(steps)] == ['residual', 'candidates', 'verdict']
    assert [e.name for e in result.effects] == ['saturation'], result.sentence
    unseen = record(changed, 'unseen')
    before, after = (free_run(m, unseen).errors.percent for m in (result.given, result.model))
    if labelled:
        assert result.effects[0].parameters['high'].value == pytest.approx(0.93, abs=0.01)
        assert 'saturation (slot: input), ' in ' '.join(diagnosis_text(result).split())
        assert after < 0.1 * before and after < 2.0 * result.after.overall
    else:
        assert not to_json(result)['set_in'] and after < 0.2 * before


def test_a_look_alike_that_was_not_tried_is_asked_for_beside_those_that_do_as_much():
    some = DiagnosisSettings(effects=('saturation', 'sensor_nonlinearity'))
    group = diagnose(stage(), record(saturated()), some).group
    assert group.names[0] == 'saturation' and group.names[-1] == 'backlash'
    assert group.separating_experiment.startswith('diagnose again with backlash among the')


def test_nothing_set_in_where_the_range_is_passed_twice():
    v = 5.0 - 5.0 * np.cos(2.0 * np.pi * 0.5 * np.arange(2 * RATE) / RATE)
    twice = Record.from_arrays(v, saturated().simulate(v), sample_rate=RATE)
    result = diagnose(stage(), twice, PATH)
    assert (result.smallest_detectable, result.effects) == (None, ()), result.sentence


@pytest.mark.parametrize(
    ('known', 'real', 'factor'),
    [(lambda: saturated(0.98), saturated, 1.0), (stage, stage, 1.02)],
    ids=['a known effect of the path that has changed', 'another gain'],
)
def test_what_is_no_new_effect_of_the_path(known, real, factor):
    result = diagnose(known(), record(real(), factor=factor), PATH)
    assert (result.verdict, result.effects) == ('refitted', ()), result.sentence
    is_gain = 'the gain is 1.02 times that of the model' in result.sentence.lower()
    assert is_gain == (factor == 1.02)


def test_noncongruent_loops_are_no_name():
    # the H of a material that is no sum of plays misses them, too
    values = {'threshold': (0.1, 0.3), 'slope': (0.06, 0.06), 'bend': (0.0, 0.0)}
    changed = replace(stage(), effects=(EffectSetting('noncongruent_minor_loops', values),))
    alone = DiagnosisSettings(effects=('noncongruent_minor_loops', 'gain_drift'))
    assert diagnose(stage(), record(changed), alone).effects == ()


def test_what_set_in_since_is_found_beside_hum():
    (piece,) = record(saturated()).pieces
    hum = 0.003 * np.ptp(piece.y) * np.sin(2.0 * np.pi * 50.0 * np.arange(piece.n) / RATE)
    few = DiagnosisSettings(effects=('periodic_disturbance', 'saturation', 'backlash'))
    result = diagnose(stage(), Record((replace(piece, y=piece.y + hum),), 'hum'), few)
    found = {e.name: e.share for e in result.effects}
    assert list(found) == ['periodic_disturbance', 'saturation'], result.sentence
    assert found['saturation'] > 0.8
    assert result.after.overall < 0.2 * result.before.overall


def test_the_verdict_on_a_measured_stage_is_one_for_all_parts_of_it():
    (piece,) = measured_record('piezo_1hz.csv').pieces
    piece = Piece(piece.v[::2], piece.y[::2], 0.5 * piece.sample_rate)
    third = piece.n // 3
    pairs = [Record((piece.cut(i * third, (i + 2) * third),), f'from {i}') for i in range(2)]
    model = identify(pairs[0]).model
    found = [diagnose(model, pair) for pair in pairs]
    # no effect of the stage is named, and refitted stands for a refit that is kept
    for one in found:
        assert {e.name for e in one.effects} <= {'periodic_disturbance'}
        if 'stays as given' not in str(one):
            assert one.verdict == 'refitted'
        else:
            assert one.verdict in ('none', 'unexplained', 'partly_explained')
