# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Delay from steps or scan, G with the hysteresis undone, and which samples are used."""

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from paper_stage import STAGE as PAPER
from piezo_ident.common.errors import IdentificationError
from piezo_ident.excitation.program import parse_program
from piezo_ident.identification.prepare import excerpts_of, runs_of, scaling_of
from piezo_ident.identification.settings import Settings, silent
from piezo_ident.identification.step1_delay import first_step
from piezo_ident.identification.step2_dynamics import beside_law, second_step
from piezo_ident.identification.step3_hysteresis import factorise, fit_hysteresis
from piezo_ident.operators.dynamics import Delay, Dynamics
from piezo_ident.record.record import Piece, Record, Segment
from programs import identification_program
import pytest
from scipy import signal

pytestmark = pytest.mark.filterwarnings('error::RuntimeWarning')

PROGRAM = identification_program(steps=12, noise=1, slope=30)
COARSE = """
limits: [0, 100]
slew: 300
seed: 1
segments:
  - {signal: settle, bias: 50, amplitude: 4.8, cycles: 16, frequency: 20}
  - {signal: noise, bias: 50, amplitude: 4, cutoff: 3000, duration: 2}
  - {signal: triangle, slope: 160}
"""


def runs(*records):
    pieces = [p for r in records for p in r]
    return runs_of(records, 20_000.0, scaling_of(pieces))


def record(stage=PAPER, labels=('step', 'settle', 'noise', 'triangle')):
    made = stage.play(parse_program(PROGRAM).build(), np.random.default_rng(0))
    p = made.pieces[0]
    return Record((replace(p, segments=tuple(s for s in p.segments if s.kind in labels)),))


def with_delay(d):
    return replace(PAPER, model=replace(PAPER.model, delay=Delay(d)))


@pytest.mark.parametrize('d', [0, 1, 7])
def test_delay_from_steps_and_from_the_scan_agree(d):
    found = first_step(runs(record(with_delay(d))), Settings(), silent)
    assert (found.samples, found.source, found.agree) == (d, 'steps', True)


def test_delay_from_noise_alone_has_the_doubt_of_its_band():
    found = first_step(runs(record(labels=('noise', 'triangle'))), Settings(), silent)
    assert found.source == 'scan'
    # half a period of 3 kHz is 3.3 samples
    assert abs(found.samples - 3) <= found.std
    assert 2 < found.std < 4


def test_dynamics_are_found_with_the_hysteresis_undone():
    result, G = second_step(runs(record()), Delay(3), Settings(order=(10, 10)), silent)
    truth = PAPER.model.dynamics
    f = np.array([1.0, 50, 120, 500, 1500, 2500])
    error = G.response(f, 2e4) - truth.response(f, 2e4) / truth.gain
    assert np.abs(error).max() < 2e-3
    assert G.is_stable
    assert G.gain == pytest.approx(1.0, abs=1e-9)
    assert result.covariance.shape == (20, 20)
    assert set(result.methods) == {'least squares', 'instrumental variables', 'output error'}
    assert result.methods['output error'] <= min(result.methods.values()) * 1.05
    assert 3000 < result.band < 4500
    assert result.slope_measured == pytest.approx(result.slope_model, rel=0.02)


def test_dynamics_are_refined_where_they_do_not_suit_h():
    given, delay, r = runs(record()), Delay(3), PAPER.model.hysteresis.thresholds
    found, _ = second_step(given, delay, Settings(order=(10, 10)), silent)
    truth = PAPER.model.dynamics.normalised()
    H = fit_hysteresis(factorise(excerpts_of(given, 'triangle'), r, truth, delay), r).hysteresis
    # a tenth of it answers through a slower pole
    slow = np.array([-np.exp(-2 * np.pi * 300 / 2e4)])
    b = 0.9 * np.convolve(truth.b, [1.0, *slow]) + 0.1 * (1 + slow[0]) * np.pad(truth.b, (0, 1))
    bent = Dynamics(np.convolve([1.0, *truth.a], [1.0, *slow])[1:], b)
    assert beside_law(given, H, found, truth, delay) is None
    refined = beside_law(given, H, found, bent, delay)
    assert refined is not None
    f = np.array([50.0, 120, 500, 1500, 2500])
    before, after = (
        np.abs(G.response(f, 2e4) - truth.response(f, 2e4)) for G in (bent, refined[1])
    )
    assert after.max() < 0.1 * before.max()
    assert refined[0].covariance.shape == (22, 22)


def test_modes_that_ring_for_long_are_found_beside_a_coarse_converter():
    # at 50 kHz least squares see none of them below the steps of 9 bits
    fs, modes = 5e4, ((243.0, 0.012, 0.81), (679.0, 0.005, 0.1), (1551.0, 0.036, 0.09))
    sequence = parse_program(COARSE).build(sample_rate=fs)
    x = np.zeros(sequence.n)
    for f, zeta, share in modes:
        s = 2.0 * np.pi * f
        b, a, _ = signal.cont2discrete(
            ([share * s * s], [1.0, 2.0 * zeta * s, s * s]), 1.0 / fs, 'zoh'
        )
        x += signal.lfilter(np.ravel(b), a, sequence.v / 100.0)
    y = 1e-5 * np.round(x * 512) / 512
    piece = Piece(sequence.v, y, fs, segments=sequence.segments)
    given = runs_of([Record((piece,), 'coarse')], fs, scaling_of([piece]))
    _, G = second_step(given, Delay(0), Settings(), silent)
    for f, zeta, _ in modes:
        assert any(
            m.frequency == pytest.approx(f, rel=0.01) and m.damping == pytest.approx(zeta, rel=0.1)
            for m in G.modes(fs)
        ), G.modes(fs)


def test_short_and_silent_noise_are_refused():
    p = record().pieces[0]
    noise = p.find('noise')[0]
    cut = replace(
        p,
        segments=tuple(
            Segment(s.label, s.start, s.start + 1000) if s is noise else s for s in p.segments
        ),
    )
    with pytest.raises(IdentificationError, match='at least 2000'):
        second_step(runs(Record((cut,))), Delay(3), Settings(max_order=3), silent)
    v = p.v.copy()
    v[noise.start : noise.stop] = 5.0
    still = Record((Piece(v, p.y, p.sample_rate, 0.0, p.segments),))
    at = p.t[noise.start]
    with pytest.raises(IdentificationError, match=rf'voltage .* noise .*{at:.4g} s'):
        second_step(runs(still), Delay(3), Settings(max_order=3), silent)


def test_fitted_and_held_out_triangles_are_the_same_runs():
    slow = record()
    quick = Record(
        (
            Piece(
                np.tile([0.0, 5.0], 3000),
                np.zeros(6000),
                2e4,
                0.0,
                (Segment('triangle', 0, 6000),),
            ),
        )
    )
    made = runs(slow, quick)
    fit, held = excerpts_of(made, 'triangle'), excerpts_of(made, 'triangle', held=True)
    assert len(fit) == len(held) == 2
    assert not held[1].use.any()
    for one, two in zip(fit, held, strict=True):
        assert not np.any(one.use & two.use)
    assert_array_equal(fit[0].use | held[0].use, made[0].mask('triangle'))
    # an excerpt of nothing adds nothing
    G = Dynamics(np.array([-0.5]), np.array([0.5]))
    R, more = (factorise(part, np.array([0.2, 0.6]), G, Delay(3)) for part in (held[:1], held))
    assert_allclose((more.T @ more)[2:, 2:], (R.T @ R)[1:, 1:], rtol=1e-9)
