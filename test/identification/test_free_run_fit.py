# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""One record without labels: what it excites is found, what it does not is named."""

from dataclasses import replace
import re

import numpy as np
from paper_stage import PAPER
from piezo_ident.common.errors import ConfigError, IdentificationError
from piezo_ident.excitation.program import parse_program
from piezo_ident.fitting.stretch import Stretch
from piezo_ident.identification import free_run_fit
from piezo_ident.identification.free_run_fit import _fitted_parts, _thinned, _windows, MOST_RUNS
from piezo_ident.identification.identify import identify
from piezo_ident.identification.prepare import runs_of
from piezo_ident.identification.settings import Settings
from piezo_ident.model.free_run import free_run
from piezo_ident.model.scaling import Scaling
from piezo_ident.model.simulated_stage import SimulatedStage
from piezo_ident.operators.dynamics import Delay, Dynamics
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.record.record import Piece, Record
from piezo_ident.report.identification import facts
import pytest

pytestmark = pytest.mark.filterwarnings('error::RuntimeWarning')

FS = 5000.0
# a lightly damped mode at 700 Hz, as a small stage at 5 kHz has it
POLE = np.exp(2 * np.pi * 700 / FS * (-0.03 + 1j * np.sqrt(1 - 0.03**2)))
#: saves the choice of numbers where it is not what is asked
FEW = Settings(thresholds=10, order=(2, 2))
G = Dynamics(np.real(np.poly([POLE, np.conj(POLE)]))[1:], [0.3, 0.3]).normalised()
STAGE = replace(PAPER, sample_rate=FS, dynamics=G, delay=Delay(2))


def record_of(v, noise=1e-5, memory=None, name='record', zero=0.0, seed=0):
    v = np.asarray(v, dtype=float)
    y = STAGE.stream(memory).process(v) + zero
    y = y + noise * 75e-6 * np.random.default_rng(seed).standard_normal(v.size)
    return Record((Piece(v, y, FS),), name)


def sine(seconds, f=2.0, phase=0.0):
    return 5 - 5 * np.cos(2 * np.pi * f * np.arange(int(seconds * FS)) / FS + phase)


def has_the_mode(model):
    return any(abs(mode.frequency / 700 - 1) < 0.03 for mode in model.dynamics.modes(FS))


def missed(model, v):
    """Return the error under a voltage as a share of the stroke."""
    y = STAGE.simulate(v)
    return np.std(model.simulate(v) - y) / np.ptp(y)


def test_steps_and_a_sine_give_delay_mode_and_hysteresis():
    steps = np.repeat([0.0, 2, 0, 4, 0, 6, 0], 600)
    result = identify(record_of(np.concatenate([steps, sine(1.0)])))
    assert result.delay.samples == 2
    assert result.not_identified == ()
    assert has_the_mode(result.model)
    assert result.model.dynamics.is_stable
    assert result.model.dynamics.gain == pytest.approx(1.0, abs=1e-9)
    assert missed(result.model, sine(2.0, 3.0)) < 1e-3


def test_a_slow_record_is_predicted_at_other_slow_motion():
    result = identify(record_of(sine(1.0)), Settings(thresholds=10))
    unseen = sine(2.0, 1.0)
    y = STAGE.simulate(unseen)
    assert np.std(result.model.simulate(unseen) - y) < 2e-3 * np.ptp(y)


def test_memory_of_a_start_in_the_middle_is_found():
    rng = np.random.default_rng(4)
    r = STAGE.hysteresis.thresholds
    truth = 0.5 - np.cumsum(np.diff(np.concatenate([[0.0], r])) * rng.uniform(0, 1, r.size))
    record = record_of(sine(1.0, phase=np.pi / 2), memory=truth)
    result = identify(record, FEW)
    (piece,) = record.pieces
    [start] = result.memories.values()
    left = piece.y - result.model.predict_piece(piece, start)
    without = piece.y - result.model.predict_piece(piece)
    early = slice(0, 1000)
    assert np.std(left[early]) < 0.2 * np.std(without[early])
    u0, thresholds = 0.5, result.model.hysteresis.thresholds
    assert np.all(start <= u0 + 1e-3)
    assert np.all(start >= u0 - thresholds - 1e-3)


def test_a_given_delay_is_taken_and_too_little_is_refused():
    assert identify(record_of(sine(0.5)), replace(FEW, delay=4)).delay.samples == 4
    flat = record_of(np.concatenate([np.zeros(1000), sine(0.2)]))
    with pytest.raises(IdentificationError, match='--hold-out'):
        identify(flat, Settings(hold_out=0.21))


def test_steps_alone_do_not_identify_hysteresis():
    stage = SimulatedStage.load('paper')
    text = 'limits: [0, 10]\nsegments:\n  - {signal: step, bias: 5, size: 4, hold: 0.05, count: 4}'
    played = stage.play(parse_program(text).build(20000.0), np.random.default_rng(1))
    steps = played.find('step')[0]
    record = Record((Piece(steps.v, steps.y, steps.sample_rate),), 'steps')
    missing = dict(identify(record, Settings(max_order=4, thresholds=10)).not_identified)
    assert 'triangle' in missing['hysteresis']


def test_several_records_are_all_fitted_each_with_its_own_zero():
    one = record_of(sine(1.0), name='one')
    two = record_of(0.8 * sine(1.0, f=5.0), name='two', zero=4e-6, seed=1)
    result = identify([one, two], FEW)
    # the zero that moved is no error of the model
    of = {row.record: row for row in result.errors if row.data == 'fitted'}
    assert set(of) == {'one', 'two'}
    assert max(row.percent for row in result.errors) < 0.5
    assert any(re.match(r'one: .*zero .* um ', said) for said in result.warnings)
    # the model has the zero of the last record, where the sensor was last
    later = record_of(sine(1.0, f=3.0), name='later', zero=4e-6, seed=2)
    assert abs(free_run(result.model, later).errors.offset) < 0.1e-6


def plain_runs(*voltages):
    """Return runs of 1 kHz whose displacement is the voltage, named 0, 1 and so on."""
    records = [
        Record.from_arrays(v, 1e-6 * v, sample_rate=1000.0, name=str(i))
        for i, v in enumerate(voltages)
    ]
    return runs_of(records, 1000.0, Scaling(0.0, 10.0, 0.0, 1e-5, (0.0, 10.0)))


@pytest.mark.parametrize('sizes', [(1.0, 0.5), (0.5, 1.0)])
def test_fitted_runs_keep_the_order_of_recording(sizes):
    # the model takes the zero of the last run, whichever is the widest
    runs = plain_runs(*(size * sine(0.4) for size in sizes))
    chosen, masks = _fitted_parts(runs, Settings())
    assert [run.record for run in chosen] == ['0', '1']
    assert [mask.size for mask in masks] == [2000, 2000]


def test_a_wide_run_that_is_too_short_does_not_stop_the_others():
    tiny = sine(0.018, f=1.0 / 0.018)
    chosen, _ = _fitted_parts(plain_runs(tiny, *[0.9 * sine(0.4)] * 2), Settings())
    assert [run.record for run in chosen] == ['1', '2']
    with pytest.raises(IdentificationError, match='0: holding out'):
        _fitted_parts(plain_runs(tiny, tiny), Settings())
    # only runs that are fitted count among the most
    many = plain_runs(*[tiny] * MOST_RUNS, 0.9 * sine(0.4))
    assert [run.record for run in _fitted_parts(many, Settings())[0]] == [str(MOST_RUNS)]


def test_a_long_record_with_a_short_fitted_part_has_a_window():
    # 0.2 s of 6 s at 20 kHz are fitted
    u = sine(24.0, f=1.0) / 10.0
    use = np.arange(u.size) < 4000
    stretch = Stretch(u, u, use, np.arange(u.size) * 50 // u.size, 20_000.0)
    (window,) = _windows([stretch])
    assert window.use.sum() == 4000


def test_thinned_rows_show_all_of_a_periodic_motion(monkeypatch):
    # a quarter of the rows, from a motion whose period is four pieces
    monkeypatch.setattr(free_run_fit, 'MOST_ROWS', 10_000)
    u = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(40_000) / 800)
    (kept,) = _thinned([Stretch(u, u, u >= 0.0, np.zeros(u.size, dtype=int), 20_000.0)])
    phases = np.bincount(np.flatnonzero(kept.use) % 800 // 200, minlength=4)
    assert abs(kept.use.sum() - 10_000) < 1000
    assert phases.min() > 0.8 * phases.mean()


def test_a_multisine_does_not_only_jump():
    t = np.arange(int(3.0 * FS)) / FS
    rng = np.random.default_rng(3)
    tones = [
        np.sin(2.0 * np.pi * f * t + rng.uniform(0.0, 6.3)) for f in np.arange(40.0, 1200.0, 9)
    ]
    v = np.sum(tones, axis=0)
    v = 5.0 + 4.5 * v / np.abs(v).max()
    result = identify(Record((Piece(v, STAGE.simulate(v), FS),), 'multisine'), FEW)
    assert result.not_identified == ()
    assert has_the_mode(result.model)
    # the frequency response is measured without a segment called noise
    measured = result.dynamics.response
    assert 600 < measured.frequency[np.argmax(np.abs(measured.response))] < 800


def test_the_only_chirp_is_not_held_out():
    t = np.arange(int(1.0 * FS)) / FS
    drive = (
        0.3 * np.sin(2.0 * np.pi * (20.0 * t + 590.0 * t**2)) * np.minimum(1.0, 20.0 * (1.0 - t))
    )
    v = np.concatenate([sine(1.0), drive])
    # the chirp swings a little below 0 V
    with pytest.warns(UserWarning, match='extrapolation'):
        y = STAGE.simulate(v)
    result = identify(Record((Piece(v, y, FS),), 'ends in a chirp'), FEW)
    assert has_the_mode(result.model)
    assert 'held out' in result.warnings[0]


def test_what_chooses_lies_within_what_is_fitted():
    # the last quarter alone goes beyond 6 V
    steps = np.repeat([0.0, 2, 0, 3, 0, 4, 0], 600)
    v = np.concatenate([steps, 0.6 * sine(1.0), sine(0.5), 0.5 * sine(0.5)])
    rng = np.random.default_rng(0)
    y = STAGE.simulate(v) + 2e-8 * rng.standard_normal(v.size)
    result = identify(Record((Piece(v, y, FS),), 'grows'), Settings(max_order=4, thresholds=10))
    assert result.not_identified == ()
    assert has_the_mode(result.model)
    assert missed(result.model, sine(2.0, 3.0)) < 2e-3


def slow_record(delay, n=800):
    """Return a sine of 1 Hz and varying size at 200 Hz through plays and a pure delay."""
    t = np.arange(n) / 200.0
    v = 1.8 - 1.75 * np.cos(2 * np.pi * t) * (0.55 + 0.45 * np.cos(2 * np.pi * t / 8))
    H = Hysteresis(np.arange(1, 8) / 8.0, np.full(7, 0.12), 0.1, 1.0)
    y = Delay(delay).apply(H((v - v.min()) / np.ptp(v)))
    y = y + 1e-3 * np.random.default_rng(0).standard_normal(n)
    return Record.from_arrays(v, 1e-5 * y, sample_rate=200, name='slow')


@pytest.mark.parametrize('delay', [0, 7])
def test_a_given_delay_is_used_and_labelled_even_where_another_errs_less(delay):
    result = identify(slow_record(3), Settings(delay=delay, thresholds=6, max_order=4))
    assert (result.delay.samples, result.delay.source) == (delay, 'given')
    assert result.model.delay.total == delay
    assert 'delay' not in dict(result.not_identified)
    assert result.model.identification['delay_source'] == 'given'
    # nobody measured how far off it is
    assert result.model.identification['uncertainties']['delay'] is None
    assert dict(facts(result))['delay'].startswith(f'{delay} samples (given)')


def test_a_delay_of_most_of_the_record_and_a_swarm_without_labels_are_refused():
    with pytest.raises(IdentificationError, match='--delay'):
        identify(slow_record(3), Settings(delay=500))
    with pytest.raises(ConfigError, match='label'):
        identify(slow_record(3), Settings(solver='swarm'))


def test_slow_motion_of_many_sizes_tells_a_long_delay():
    result = identify(slow_record(3))
    assert (result.delay.samples, result.delay.source) == (3, 'free run')
    assert result.model.delay.total == 3
    assert list(dict(result.not_identified)) == ['dynamics']
