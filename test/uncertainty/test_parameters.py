# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Quantities of an identified model, with the deviations of all parameters together."""

from dataclasses import replace
import functools

import numpy as np
from paper_stage import STAGE
from piezo_ident import report
from piezo_ident.excitation.program import parse_program
from piezo_ident.fitting.jackknife import deviations, SHARE
from piezo_ident.identification.identify import identify_and_judge
from piezo_ident.identification.results import Settings
from piezo_ident.model.files import model_from_dict, model_to_dict
from piezo_ident.model.front_door import ModelParameter
from piezo_ident.operators.dynamics import Dynamics
from piezo_ident.operators.play import play_columns
from piezo_ident.record.record import Record
from piezo_ident.uncertainty import parameters
from piezo_ident.uncertainty.parameters import (
    BLOCKS,
    linearised,
    quantities_of,
    with_deviations,
)
import pytest

SHARES = ('25%', '50%', '100%')
PROGRAM = """
limits: [0, 10]
rest: 0
slew: 200
segments:
  - {signal: idle, duration: 0.1}
  - {signal: step, bias: 5, size: 1, hold: 0.03, count: 6}
  - {signal: noise, bias: 5, amplitude: 0.4, cutoff: 3000, duration: 0.5}
  - {signal: triangle, slope: 60}
"""


@functools.cache
def identified():
    record = STAGE.play(parse_program(PROGRAM))
    return identify_and_judge(record, Settings(order=(10, 10), thresholds=10))


@functools.cache
def deviating():
    return with_deviations(*identified())


def test_replicates_of_a_mean_give_its_deviation():
    x = np.random.default_rng(1).standard_normal((40, 3))
    whole = x.mean(axis=0)
    without = (40 * whole - x) / 39
    found = deviations(whole + SHARE * (without - whole), whole)
    np.testing.assert_allclose(found, x.std(axis=0, ddof=1) / np.sqrt(40))
    assert np.isinf(deviations(x[:1], whole)).all()


def test_the_deviations_are_about_as_large_as_the_errors():
    result = deviating()
    rows = result.model.quantities
    truth = quantities_of(STAGE.model, result)
    assert [p.name for p in truth] == [p.name for p in rows]
    off = {p.name: abs(p.value - q.value) / p.std for p, q in zip(rows, truth, strict=True)}
    loops = [x for name, x in off.items() if 'loop width' in name]
    assert len(loops) == 3 and np.sqrt(np.mean(np.square(loops))) < 2.0
    gains = [x for name, x in off.items() if name.startswith('gain at')]
    assert len(gains) == 10 and np.median(gains) < 4.0
    names = ' '.join(p.name for p in rows)
    for name in ('static gain', 'loop width at 25%', 'gain at', 'phase at', 'damping of mode 1'):
        assert name in names


def test_the_triangle_moves_h_alone_and_the_noise_moves_both():
    fitted = linearised(*identified())
    whole, stages = fitted.stage, list(fitted.replicates())
    G = [np.abs(x.dynamics.a - whole.dynamics.a).max() for x in stages]
    H = [np.abs(x.coefficients - whole.coefficients).max() for x in stages]
    assert max(G[:BLOCKS]) < 1e-3 * min(G[BLOCKS:])
    assert min(H) > 0.0


def test_an_order_that_does_as_well_adds_its_difference():
    result, judged = identified()
    quiet = deviating().model.quantities
    G = result.model.dynamics
    other = Dynamics(G.a * 0.999 ** np.arange(1, G.a.size + 1), G.b).normalised()
    beside = replace(result.dynamics, others=(other, Dynamics.unit()))
    rows = with_deviations(replace(result, dynamics=beside), judged).model.quantities
    for one, row in zip(quiet, rows, strict=True):
        assert row.value == one.value
        if row.part == 'H':
            assert row.std == one.std
        elif 'mode' in row.name:
            # G = 1 has none
            assert np.isinf(row.std)
        else:
            at = float(row.name.split()[2])
            off = [x.response(np.array([at]), result.model.sample_rate)[0] for x in (G, other)]
            if row.name.startswith('gain'):
                both = [abs(abs(x) - row.value) for x in (off[1], 1.0)]
                assert row.std == pytest.approx(
                    np.hypot(one.std, np.sqrt(np.mean(np.square([*both, 0.0])))), rel=1e-4
                )
            else:
                assert row.std > one.std


def test_deviations_are_in_the_parameters_the_file_the_json_and_the_summary():
    result = deviating()
    model = model_from_dict(model_to_dict(result.model))
    assert (
        model.quantities == result.model.quantities == result.parameters[-len(model.quantities) :]
    )
    assert model.quantities[0].name in model.summary()
    told = report.to_json(result)['quantities']
    assert told[0]['std'] == model.quantities[0].std and told[0]['known']
    own = [p for p in model.parameters if p.part == 'G' and p.name.startswith('a_')]
    assert all(p.std > 0.0 for p in own)


def test_a_parameter_that_the_data_do_not_know_says_so():
    values = [ModelParameter('G', 'x', 1.0, '', std) for std in (0.5, 2.0, float('inf'), None)]
    assert [p.is_known for p in values] == [True, False, False, None]
    row = {'part': 'G', 'name': 'gain at 9 kHz', 'value': 1.0, 'unit': '', 'std': float('inf')}
    model = replace(STAGE.model, identification={'quantities': [row]})
    assert 'not known' in model.summary()
    broken = replace(STAGE.model, identification={'quantities': [{'part': 'G'}, 3]})
    assert broken.quantities == ()


def test_a_loop_narrower_than_every_play_is_not_identified():
    sizes = np.repeat([10.0, 7.0, 4.0, 9.0], 1000)
    v = 0.5 * sizes * (1.0 - np.cos(2.0 * np.pi * np.arange(4000) / 1000.0))
    plays = play_columns(v / 10.0, np.array([0.25, 0.5]), np.zeros(2))
    y = 7e-5 * (0.06 * v + np.array([0.25, 0.15]) @ plays)
    y += 7e-9 * np.random.default_rng(0).standard_normal(v.size)
    record = Record.from_arrays(v, y, sample_rate=1000)
    result = with_deviations(*identify_and_judge(record, Settings(thresholds=4, delay=0)))
    rows = {p.name: p for p in result.model.quantities}
    narrow, *wider = (rows[f'loop width at {share} of the range'] for share in SHARES)
    assert narrow.value == 0.0 and np.isinf(narrow.std)
    assert all(row.is_known for row in wider)
    reasons = dict(result.not_identified)
    assert '--thresholds' in reasons[narrow.name]
    assert (
        f'{narrow.name}: {reasons[narrow.name]}' in result.model.identification['not_identified']
    )
    assert not any(row.name in reasons for row in wider)
    assert not any('loop' in what for what, _ in deviating().not_identified)
    # more of the same motion would not help
    prompt = report.Prompt('model.yaml', '', {'record': 'record.npz'})
    assert not any('loop' in step.reason for step in report.next_steps(result, prompt))


def test_a_share_of_creep_at_its_bound_is_no_closed_loop(monkeypatch):
    own, share = parameters._quantities, ModelParameter('creep', 'gain at 1 s', 0.0, '')
    monkeypatch.setattr(parameters, '_quantities', lambda *given: [*own(*given), share])
    result = with_deviations(*identified())
    assert result.model.quantities[-1].std == 0.0
    assert result.not_identified == deviating().not_identified


def test_what_no_linear_fit_describes_keeps_the_deviations_of_its_steps():
    result, judged = identified()
    assert linearised(replace(result, memories={('r', 0.0): None}), judged) is None
    swarm = replace(result, hysteresis=replace(result.hysteresis, solver='swarm'))
    assert with_deviations(swarm, judged) is swarm


def test_more_noise_makes_larger_deviations(factor=3.0):
    sensor = replace(STAGE.sensor, noise_rms=factor * 10 * STAGE.sensor.noise_rms)
    record = replace(STAGE, sensor=sensor).play(parse_program(PROGRAM))
    noisy = with_deviations(*identify_and_judge(record, Settings(order=(10, 10), thresholds=10)))
    ratios = [
        a.std / b.std
        for a, b in zip(noisy.model.quantities, deviating().model.quantities, strict=False)
        if a.name == b.name and np.isfinite(a.std)
    ]
    assert np.median(ratios) > factor
