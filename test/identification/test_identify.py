# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The whole of it: known truth back, measured records, awkward records, cancelling, repeating."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
import re

from measured_data import measured_record
import numpy as np
from numpy.testing import assert_array_equal
from piezo_ident.common.errors import Cancelled, DataError, IdentificationError, PiezoIdentError
from piezo_ident.excitation.program import parse_program, Program
from piezo_ident.identification import free_run_fit, step1_delay, three_steps
from piezo_ident.identification.identify import identify
from piezo_ident.identification.refusals import refuse_undriven
from piezo_ident.identification.results import Steps
from piezo_ident.identification.settings import Settings
from piezo_ident.identification.step1_delay import delay_from_steps
from piezo_ident.identification.three_steps import FITTED
from piezo_ident.identification.warnings import warnings_of
from piezo_ident.model.files import load, model_from_dict, model_to_dict
from piezo_ident.model.free_run import free_run
from piezo_ident.model.scaling import Scaling
from piezo_ident.model.simulated_stage import Sensor, SimulatedStage
from piezo_ident.model.stage_model import EffectSetting
from piezo_ident.operators.dynamics import Dynamics, filter_arx
from piezo_ident.record.record import Piece, Record, Segment
from programs import identification_program
import pytest

pytestmark = pytest.mark.filterwarnings('error::RuntimeWarning')

ROOT = Path(__file__).resolve().parents[2]
PAPER = SimulatedStage.load(ROOT / 'config/stage_paper.yaml')
DENSE = SimulatedStage.load(ROOT / 'config/stage_dense.yaml')
FULL = Program.load(ROOT / 'config/program_identification.yaml')
SHORT = identification_program(slew=80, steps=8, cycles=8, noise=0.8, slope=40)
#: the search over orders has tests of its own
QUICK = Settings(order=(10, 10), thresholds=10)
FREQUENCIES = (1, 10, 50, 80, 100, 120)


def short(stage=PAPER, **settings) -> Record:
    return kept(**settings) if stage is PAPER else played(stage, **settings)


@cache
def kept(**settings) -> Record:
    return played(PAPER, **settings)


@cache
def quick():
    """Return what is identified from the short record."""
    return identify(short(), QUICK)


@cache
def swarmed(**more):
    """Return what a short swarm makes of the short record."""
    return identify(short(), replace(QUICK, solver='swarm', swarm_iterations=300, **more))


def played(stage, noise=None, seed=1, text=SHORT) -> Record:
    if noise is not None:
        stage = replace(stage, sensor=replace(stage.sensor, noise_rms=noise * 75e-6))
    return stage.play(parse_program(text).build(), np.random.default_rng(seed), 'short')


def sine_errors(truth, model) -> list[float]:
    """Return steady-state errors under v = 5 + 5 sin(2 pi f t), % of stroke (Table I)."""
    errors, fs = [], 20_000
    for f in FREQUENCIES:
        soft = 5 * (1 - np.cos(np.pi * np.arange(fs // 2) / (fs // 2))) / 2
        drop = fs * max(1, np.ceil(1 / f))
        t = np.arange(int(drop + fs * max(1 / f, 0.2))) / fs
        # the amplitude grows over the part that is dropped
        v = np.concatenate([soft, 5 + 5 * np.sin(2 * np.pi * f * t) * np.minimum(1, 4 * t)])
        last = slice(soft.size + int(drop), None)
        y, y_hat = (m.stream().process(v)[last] for m in (truth, model))
        errors.append(100 * float(np.sqrt(np.mean((y - y_hat) ** 2)) / np.ptp(y)))
    return errors


def loop_error(truth, model) -> float:
    """Return the error over minor loops, % of their stroke."""
    v = Program.load(ROOT / 'config/program_minor_loops.yaml').build().v
    y, y_hat = (m.stream().process(v) for m in (truth, model))
    return 100 * float(np.sqrt(np.mean((y - y_hat) ** 2)) / np.ptp(y))


@pytest.fixture(scope='module')
def paper():
    record = PAPER.play(FULL.build(), np.random.default_rng(1), 'paper')
    return record, identify(record)


# -- known truth -------------------------------------------------------------------------------


def test_paper_stage_is_found(paper):
    _, result = paper
    assert result.delay.samples == 3
    assert result.delay.source == 'steps'
    assert result.delay.agree
    assert result.model.dynamics.is_stable
    assert result.model.dynamics.gain == pytest.approx(1.0, abs=1e-9)
    assert result.warnings == ()
    assert result.not_identified == ()
    errors = sine_errors(PAPER.model, result.model)
    assert max(errors) <= 0.02
    assert loop_error(PAPER.model, result.model) <= 0.02
    # the noise of the sensor and of its converter, 1.5 nm and 2.3 nm / sqrt(12)
    assert result.noise_floor == pytest.approx(100 * 1.64e-9 / result.stroke, rel=0.1)
    assert result.error('selection') == pytest.approx(result.noise_floor, rel=0.1)


def test_paper_stage_is_found_by_one_fit(monkeypatch):
    # its H hardly rises behind the end of the range, its densities are lines, and no window of the
    # search, of 0.2 s, sees all of its range
    for name in ('MOST', 'WINDOWED'):
        monkeypatch.setattr(free_run_fit, name, 12_000)
    model = identify(short(), Settings(10, 'joint', order=(10, 10), delay=3)).model
    assert max(sine_errors(PAPER.model, model)) <= 0.02
    assert loop_error(PAPER.model, model) <= 0.02


def test_steps_that_slow_noise_has_shifted_are_not_followed(monkeypatch):
    def late(pieces):
        return replace(delay_from_steps(pieces), samples=7)

    monkeypatch.setattr(step1_delay, 'delay_from_steps', late)
    result = identify(short(noise=2e-5), QUICK)
    assert (result.delay.step.samples, result.delay.scan) == (7, 3)
    assert (result.delay.samples, result.delay.source) == (3, 'scan')
    said = 'steps say a delay of 7 samples, the ARX fit says 3; the fit was followed'
    assert said in result.warnings
    assert max(sine_errors(PAPER.model, result.model)) < 0.1


def test_the_swarm_gives_what_it_found_and_polishing_is_stated():
    optimum, found, polished = quick(), swarmed(), swarmed(polish=True)
    fit = found.hysteresis
    assert (fit.solver, fit.polished) == ('swarm', False)
    assert fit.loss == fit.swarm_loss > fit.optimum_loss == optimum.hysteresis.loss
    assert fit.swarm.nfev > 0
    h = found.model.hysteresis
    assert_array_equal([*h.weights, h.p1, h.p2], fit.swarm.x)
    assert found.model.identification['losses']['swarm'] == fit.swarm_loss
    assert polished.hysteresis.polished
    assert polished.hysteresis.swarm_loss == fit.swarm_loss
    assert polished.hysteresis.loss == fit.optimum_loss
    assert_array_equal(polished.model.hysteresis.weights, optimum.model.hysteresis.weights)


def test_a_record_for_validation_is_what_the_headline_is_about():
    other = short(seed=2)
    result = identify(short(), QUICK, validation=replace(other, name='other'))
    assert (result.headline.data, result.headline.records) == ('validation', ('other',))
    assert result.headline.percent < result.headline.static_percent
    assert [record.name for record in result.records] == ['short', 'other']
    p = other.pieces[0]
    slow = Record((Piece(p.v, p.y, 2 * p.sample_rate),), 'slow')
    with pytest.raises(IdentificationError, match='slow'):
        identify(short(), QUICK, validation=slow)


def test_small_signal_gain_is_the_slope_of_h(paper):
    dynamics = paper[1].dynamics
    assert dynamics.slope_measured == pytest.approx(dynamics.slope_model, rel=0.01)
    assert dynamics.bias == pytest.approx(0.5, abs=0.01)


def test_inputs_stay_and_the_seed_repeats_bit_for_bit():
    piece = short().pieces[0]
    v, y, one = piece.v.copy(), piece.y.copy(), swarmed()
    two = identify([short()], replace(QUICK, solver='swarm', swarm_iterations=300))
    assert_array_equal(piece.v, v)
    assert_array_equal(piece.y, y)
    assert model_to_dict(one.model) == model_to_dict(two.model)
    assert one.hysteresis.swarm_loss == two.hysteresis.swarm_loss
    assert one.errors == two.errors
    assert swarmed(seed=1).hysteresis.swarm_loss != one.hysteresis.swarm_loss


def test_model_keeps_its_story_in_the_file(paper, tmp_path):
    _, result = paper
    result.model.save(tmp_path / 'model.yaml')
    again = load(tmp_path / 'model.yaml')
    assert model_to_dict(again) == model_to_dict(result.model)
    story = again.identification
    assert story['records'] == ['paper']
    assert story['seed'] == 0
    assert len(story['uncertainties']['weights']) == 9
    assert len(story['uncertainties']['a']) == again.dynamics.a.size
    assert len(story['uncertainties']['b']) == again.dynamics.b.size


@pytest.mark.parametrize(('seed', 'noise'), [(1, 1e-5), (2, 1e-4), (3, 5e-4)])
def test_seeds_and_noise(seed, noise):
    result = identify(short(noise=noise, seed=seed), Settings(thresholds=10, seed=seed))
    assert result.delay.samples == 3
    assert result.model.dynamics.is_stable
    errors = sine_errors(PAPER.model, result.model)
    assert max(errors) <= max(0.02, 200 * noise)


def test_dense_truth_that_no_ten_thresholds_can_hit():
    program = identification_program(slew=80, steps=8, cycles=12, noise=2)
    record = DENSE.play(parse_program(program).build(), np.random.default_rng(1), 'dense')
    ten = identify(record, Settings(thresholds=10))
    more = identify(record, Settings(order=ten.dynamics.order))
    for result, limit in ((ten, 0.25), (more, 0.05)):
        errors = sine_errors(DENSE.model, result.model), loop_error(DENSE.model, result.model)
        assert max(*errors[0], errors[1]) <= limit


def test_retracting_stage():
    s = PAPER.model.scaling
    model = replace(PAPER.model, scaling=Scaling(s.v0, s.V, 5e-5, -s.Y, s.range))
    stage = SimulatedStage(model, PAPER.sensor)
    result = identify(short(stage), QUICK)
    assert result.model.scaling.Y < 0
    assert np.all(result.model.hysteresis.weights >= 0)
    assert max(sine_errors(model, result.model)) <= 0.02


def drifting(u):
    """Return a loop of Bouc and Wen, swept before, whose small loops do not close."""
    before = np.abs(np.linspace(-2.0, 2.0, 2001) % 2.0 - 1.0)
    u = np.concatenate([1.0 - before, u])
    z, out = 0.0, np.zeros(u.size)
    for k, du in enumerate(np.diff(u), 1):
        z += 4.0 * (du - 0.6 * abs(du) * z - 0.4 * du * abs(z))
        out[k] = z
    return (u - 0.06 * out)[before.size :]


def test_a_level_that_drifts_under_small_motion_shows_the_law():
    program, model = parse_program(SHORT).build(), PAPER.model
    w = drifting(program.v / 10.0)
    x = filter_arx(model.dynamics.a, model.dynamics.b, model.delay.apply(w))
    y = 75e-6 * (x + 2e-5 * np.random.default_rng(1).standard_normal(x.size))
    record = Record((Piece(program.v, y, 20_000.0, segments=program.segments),), 'drifting')
    found = identify(record, Settings(order=(10, 10)))
    assert found.hysteresis.law == 'duhem'
    error = free_run(found.model, record).errors.percent
    # the law that triangles alone tell leaves 1.7 % of stroke
    assert error < 0.2
    plays = identify(record, QUICK)
    assert free_run(plays.model, record).errors.percent > 1.0
    # what is only judged, as rests and ramps, has no say in it
    kinds = [s for s in program.segments if s.kind in FITTED]
    assert found.hysteresis.n < sum(s.n for s in kinds)


def test_records_of_one_name_have_a_zero_and_a_stroke_each():
    t = np.arange(6000) / 1000.0
    v = 5.0 - 5.0 * np.cos(2.0 * np.pi * t) * np.exp(-t / 6.0)
    y = replace(PAPER.model, sample_rate=1000.0, dynamics=Dynamics.unit()).simulate(v)
    y = y + 2e-9 * np.random.default_rng(1).standard_normal(y.size)
    one, two = (Record.from_arrays(v, x, sample_rate=1000.0) for x in (y, y + 300e-6))
    result = identify([one, two], Settings(thresholds=8), validation=two)
    assert {row.record for row in result.errors} == {'record', 'record (2)', 'record (3)'}
    # a zero that has moved is no motion, and no error of what is judged
    assert abs(result.stroke / np.ptp(y) - 1.0) < 0.01
    assert all(row.percent < 0.5 for row in result.errors if row.data == 'held out')


def test_unlabelled_parts_of_a_labelled_record_are_judged_and_a_wider_validation_is_told():
    (piece,) = short().pieces
    kept = tuple(s for s in piece.segments if s.kind in ('step', 'noise', 'triangle'))
    half = Record((replace(piece, segments=kept),), 'in part')
    model = quick().model
    wide = replace(model, scaling=replace(model.scaling, V=2.0 * model.scaling.V))
    t = np.arange(20_000) / 20_000.0
    v = 9.0 - 9.0 * np.cos(4.0 * np.pi * t)
    beyond = Record.from_arrays(v, wide.simulate(v), sample_rate=20_000.0, name='wide')
    result = identify(half, QUICK, validation=beyond)
    rows = [row for row in result.errors if row.record == 'in part']
    assert sum(row.n for row in rows) == piece.n
    assert [row.data for row in rows if not row.segment] == ['held out']
    assert any('wide' in w and 'extrapolation' in w for w in result.warnings)


def test_a_start_in_mid_range_is_told_by_what_comes_before_the_triangle():
    (piece,) = short().pieces
    first = next(s for s in piece.segments if s.kind == 'step').start
    cut = identify(Record((piece.cut(first, piece.n),), 'from the steps on'), QUICK)
    assert max(row.percent for row in cut.errors) < 0.05


def test_delay_and_orders_may_be_given():
    result = identify(short(), Settings(delay=3, order=(7, 6)))
    assert result.delay.source == 'given'
    assert result.dynamics.order == (7, 6)
    assert result.model.dynamics.a.size == 7
    assert result.hysteresis.swarm is None


# -- stopping ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ('step', 'count', 'labelled'),
    [
        *((step, 10, True) for step in ('delay', 'dynamics', 'hysteresis')),
        ('hysteresis', None, True),
        *((step, 10, False) for step in ('delay', 'dynamics', 'hysteresis')),
    ],
)
def test_every_step_can_be_cancelled(step, count, labelled):
    record = short()
    if not labelled:
        p = record.pieces[0]
        record = Record((Piece(p.v[-22_000::8], p.y[-22_000::8], p.sample_rate / 8),))
    seen: list[tuple[str, float]] = []

    def progress(name, share):
        seen.append((name, share))
        if name == step:
            raise Cancelled('on request')

    with pytest.raises(Cancelled, match='on request'):
        identify(record, replace(QUICK, thresholds=count), progress=progress)
    assert seen[-1][0] == step


def test_swarm_can_be_cancelled_while_it_flies():
    def progress(name, share):
        if name == 'hysteresis' and share > 0.3:
            raise Cancelled('in flight')

    with pytest.raises(Cancelled, match='in flight'):
        identify(short(), replace(QUICK, solver='swarm'), progress=progress)


def test_progress_rises_to_one_in_every_step():
    seen: dict[str, list[float]] = {}
    identify(
        short(),
        replace(QUICK, thresholds=None),
        progress=lambda name, share: seen.setdefault(name, []).append(share),
    )
    assert list(seen) == ['delay', 'dynamics', 'hysteresis']
    for shares in seen.values():
        assert np.all(np.diff(shares) >= -1e-12)
        assert shares[0] == 0.0
        assert shares[-1] == 1.0


# -- what a lab really hands over --------------------------------------------------------------


def test_measured_one_hertz_record():
    result = identify(measured_record('piezo_1hz.csv'), Settings(hold_out=1.5))
    (held,) = [row for row in result.errors if row.data == 'held out']
    modes = result.model.dynamics.modes(result.model.sample_rate)
    assert held.n == 7500
    assert held.percent <= 0.17
    assert result.model.hysteresis.lowest_slope() > 0.0
    readme = (Path(__file__).parents[2] / 'README.md').read_text(encoding='utf-8')
    (piece,) = measured_record('piezo_1hz.csv').pieces
    v, y = piece.v[-held.n :], piece.y[-held.n :]
    line = 100.0 * np.std(y - np.polynomial.Polynomial.fit(v, y, 1)(v)) / np.ptp(piece.y)
    said = re.findall(r'errs by ([\d.]+) %', readme)
    assert said == [f'{held.percent:.2f}', f'{line:.1f}']
    # a free G takes the rest
    assert result.delay.samples <= 1
    assert any(abs(mode.frequency / 972 - 1) <= 0.05 for mode in modes)
    assert result.warnings


def test_in_the_end_an_unlabelled_record_is_fitted_whole():
    record = measured_record('piezo_1hz.csv')
    (piece,) = record.pieces
    # it stands still until then
    start, n = (round(t * piece.sample_rate) for t in (3.0, 6.0))
    few = Settings(max_order=5, thresholds=10)
    result = identify(Record((piece.cut(start, n),), 'three seconds'), few)
    assert re.search(r'three seconds .* 25 %', result.warnings[0])
    e = (piece.y - result.model.simulate(piece.v))[n:]
    unseen = 100.0 * float(np.sqrt(np.mean(e**2)) / np.ptp(piece.y))
    assert unseen <= 0.16
    assert unseen < 1.2 * result.headline.percent


def test_measured_closed_loop_is_refused_whole_and_by_its_ramps_alone():
    record = measured_record('afm_hold.csv')
    with pytest.raises(IdentificationError, match=r'afm_hold.*: from \S+ to \S+ s .*its stroke'):
        identify(record)
    for piece in (record.pieces[1], record.pieces[3]):
        with pytest.raises(IdentificationError, match=r'ramp: from \S+ to \S+ s .*its travel'):
            identify(Record((piece,), 'ramp'))


def test_measured_open_loop_is_identified_with_a_warning():
    result = identify(measured_record('afm_open_loop.csv'), Settings(thresholds=10, max_order=5))
    assert result.warnings
    assert result.model.dynamics.is_stable
    assert result.model.hysteresis.lowest_slope() > 0.0
    assert result.error('fitted') < 2.0


def test_the_solver_joint_fits_labelled_motion_together():
    record = decimated(short(), 40)
    joint = Settings(thresholds=4, order=(1, 1), solver='joint')
    result = identify(record, joint)
    assert result.model.identification['method'] == 'joint free-run fit'
    bare = identify(relabelled(record), replace(joint, solver='least_squares'))
    v = record.pieces[0].v
    assert_array_equal(result.model.simulate(v), bare.model.simulate(v))
    assert any(row.segment.startswith('triangle') for row in result.errors)
    assert 'joint' in result.warnings[0] and 'noise and triangle' in bare.warnings[0]
    with pytest.raises(IdentificationError, match=r'hysteresis: .* joint'):
        identify(record, joint, steps=Steps())


# -- awkward records ---------------------------------------------------------------------------


def part(*kinds: str, record: Record | None = None) -> Record:
    """Return the record cut down to the segments of some kinds, side by side."""
    piece = (record or short()).pieces[0]
    cuts = [s for s in piece.segments if s.kind in kinds]
    first, last = cuts[0].start, cuts[-1].stop
    return Record((piece.cut(first, last),), '+'.join(kinds))


def relabelled(record: Record, *keep: str) -> Record:
    """Return the record with only some kinds of its labels."""
    pieces = tuple(
        replace(p, segments=tuple(s for s in p.segments if s.kind in keep)) for p in record
    )
    return Record(pieces, record.name)


def changed(change: Callable[[np.ndarray, np.ndarray], tuple], base: Record | None = None):
    p = (base or short()).pieces[0]
    v, y = change(p.v, p.y)
    return Record((Piece(v, y, p.sample_rate, 0.0, p.segments),), 'changed')


def decimated(record: Record, by: int) -> Record:
    p = record.pieces[0]
    segments = tuple(
        Segment(s.label, -(-s.start // by), -(-s.stop // by))
        for s in p.segments
        if -(-s.stop // by) > -(-s.start // by)
    )
    return Record((Piece(p.v[::by], p.y[::by], p.sample_rate / by, 0.0, segments),), 'slow')


def stub(record: Record, n: int) -> Record:
    """Return the record with segments of n samples."""
    p = record.pieces[0]
    segments = tuple(Segment(s.label, s.start, min(s.stop, s.start + n)) for s in p.segments)
    return Record((replace(p, segments=segments),), 'stub')


def two_records(order: int) -> list[Record]:
    p = short().pieces[0]
    cut = next(s for s in p.segments if s.kind == 'triangle').start
    one, two = Record((p.cut(0, cut),), 'noise'), Record((p.cut(cut, p.n),), 'triangle')
    return [one, two][:: order or 1]


TALL = SHORT.replace(
    '{signal: triangle, slope: 40}', '{signal: triangle, slope: 40, peaks: [3, 6]}'
)
FAST = SHORT.replace(
    '{signal: triangle, slope: 40}',
    '{signal: triangle, slope: 400, peaks: [' + ', '.join(['10'] * 40) + ']}',
)


def ramp_for_noise(rise):
    """Return what puts a ramp of some volts in the place of the noise."""

    def change(v, y):
        s = next(s for s in short().pieces[0].segments if s.kind == 'noise')
        v, y = v.copy(), y.copy()
        v[s.start : s.stop] = np.linspace(5, 5 + rise, s.n)
        y[s.start : s.stop] = y[s.start] + 5e-6 * np.linspace(0, rise, s.n)
        return v, y

    return change


AWKWARD: dict[str, Callable[[], Record | list[Record]]] = {
    'only triangle': lambda: part('triangle', record=decimated(short(), 4)),
    'only noise': lambda: part('noise', record=decimated(short(), 4)),
    'only steps': lambda: part('step', record=decimated(short(), 4)),
    'noise without triangle': lambda: part('idle', 'step', 'settle', 'noise'),
    'unlabelled': lambda: relabelled(decimated(short(), 8)),
    'strange labels': lambda: relabelled(decimated(short(), 10), 'idle', 'ramp'),
    'noise and triangle without steps': lambda: relabelled(short(), 'noise', 'triangle'),
    **{f'segments of {n}': lambda n=n: stub(short(), n) for n in (1, 30, 2500)},
    'constant displacement': lambda: changed(lambda v, y: (v, np.full(y.size, 1e-3))),
    'constant voltage': lambda: changed(lambda v, y: (np.full(v.size, 5.0), y)),
    'displacement of rounding only': lambda: changed(
        lambda v, y: (v, 1e-3 * (1 + 2.3e-16 * (np.arange(y.size) % 2)))
    ),
    'displacement of noise only': lambda: changed(
        lambda v, y: (v, 1e-9 * np.random.default_rng(0).standard_normal(y.size))
    ),
    'displacement is the voltage': lambda: changed(lambda v, y: (v, 7.5e-6 * v)),
    'saturated at both ends': lambda: changed(lambda v, y: (v, np.clip(y, 20e-6, 45e-6))),
    'starts at 5 V': lambda: Record((short().pieces[0].cut(20_000, short().n),), 'late'),
    'triangle far above the noise': lambda: short(text=SHORT.replace('bias: 5', 'bias: 0.6')),
    'triangle of many fast cycles': lambda: short(text=FAST),
    'one kilohertz': lambda: decimated(short(), 20),
    'fifty hertz': lambda: decimated(short(), 400),
    'silent noise': lambda: changed(ramp_for_noise(0.0)),
    'noise that is a ramp': lambda: changed(ramp_for_noise(0.2)),
    'the same twice': lambda: [short(), short(seed=2)],
    'two rates': lambda: [short(), decimated(short(), 4)],
    'a single sample': lambda: Record((Piece([1.0], [1e-6], 1e3),)),
    'two samples': lambda: Record((Piece([1.0, 2.0], [1e-6, 2e-6], 1e3),)),
    'hundred samples': lambda: Record(
        (Piece(np.linspace(0, 1, 100), np.linspace(0, 1e-6, 100), 1e3),)
    ),
    'one jump': lambda: Record(
        (Piece(np.arange(2000) // 1000, 1e-6 * (np.arange(2000) // 1000), 1e3),)
    ),
    'noise unlabelled': lambda: relabelled(decimated(part('noise'), 4)),
}


#: those without labels that count are fitted as a whole: few plays for all but one
FEW_PLAYS = ('only', 'noise unlabelled', 'unlabelled', 'strange labels')


@pytest.mark.parametrize('case', AWKWARD)
def test_awkward_records_give_a_result_or_a_reason(case):
    records, count = AWKWARD[case](), 10 if case.startswith(FEW_PLAYS) else None
    try:
        result = identify(records, Settings(thresholds=count, max_order=4))
    except PiezoIdentError as error:
        assert isinstance(error, IdentificationError)
        assert len(str(error)) > 20
        assert '\n' not in str(error)
        return
    assert result.model.dynamics.is_stable
    # at the stops of a sensor H may fall, and `invert` then refuses it
    assert result.model.hysteresis.lowest_slope() > 0.0 or case == 'saturated at both ends'
    # a result is told of, and is no nonsense: it can be written, and does not explode
    model_from_dict(model_to_dict(result.model))
    low, high = result.model.scaling.range
    sweep = np.concatenate([np.linspace(low, high, 2000), np.linspace(high, low, 2000)])
    y = result.model.stream().process(sweep)
    assert np.all(np.isfinite(y))
    assert np.ptp(y) < 3 * result.stroke
    assert all(np.isfinite(row.percent) for row in result.errors)
    assert result.hysteresis.law == 'plays' or 'thresholds' not in str(result.warnings)


@pytest.mark.parametrize(
    ('by_v', 'by_y', 'offset'), [(1.0, 1e-5 / 71e-6, 1e-3), (1e-3, 1e-3, 0.0), (1e3, 1e3, 0.0)]
)
def test_neither_scale_nor_offset_matters(by_v, by_y, offset):
    one = quick()
    two = identify(changed(lambda v, y: (by_v * v, offset + by_y * y)), QUICK)
    assert two.delay.samples == one.delay.samples == 3
    assert two.error('selection') == pytest.approx(one.error('selection'), rel=1e-3)
    weights = one.hysteresis.hysteresis.weights
    assert two.hysteresis.hysteresis.weights == pytest.approx(weights, abs=1e-6)
    v = np.concatenate([np.linspace(0, 10, 3000), np.linspace(10, 0, 3000)])
    y = (two.model.stream().process(by_v * v) - offset) / by_y
    assert np.abs(y - one.model.stream().process(v)).max() < 1e-6 * 71e-6


def test_noise_of_a_tenth_hides_the_delay_and_leaves_the_hysteresis():
    with pytest.raises(IdentificationError, match='delay'):
        identify(short(noise=0.1), Settings(max_order=4))
    result = identify(short(noise=0.1), Settings(max_order=4, delay=3))
    assert any('noise' in w for w in result.warnings)
    errors = sine_errors(PAPER.model, result.model)
    assert max(errors) < 10.0


def test_segments_in_two_records_are_as_good_as_in_one():
    for order in (1, -1):
        result = identify(two_records(order), QUICK)
        assert result.delay.samples == 3
        assert max(sine_errors(PAPER.model, result.model)) <= 0.02


def test_triangle_that_does_not_cover_the_range_warns():
    result = identify(short(text=TALL.replace('step, bias: 5', 'step, bias: 9')), QUICK)
    assert any(re.search(r'triangle .* 6 V', w) for w in result.warnings)
    assert result.model.scaling.range == pytest.approx((0.0, 6.0), abs=0.01)
    wide = free_run(result.model, PAPER.ideal.play(FULL.build()))
    assert wide.warnings


def test_a_band_is_too_narrow_for_a_g_and_not_for_none(paper):
    record, result = paper
    # a jump has little power, and tells the response far beyond the rest
    jump = replace(result, dynamics=replace(result.dynamics, band=1.0))
    narrow = replace(jump, dynamics=replace(jump.dynamics, response=None))
    unit = replace(narrow, model=replace(narrow.model, dynamics=Dynamics.unit()))
    for one, is_said in ((narrow, True), (jump, False), (unit, False)):
        said = warnings_of(one, [record], list(record))
        assert any('up to 1 Hz' in x for x in said) == is_said


def test_no_record_and_settings_of_another_type_are_refused():
    with pytest.raises(IdentificationError, match=r'^identify: no record was given'):
        identify([])
    with pytest.raises(DataError, match=r'settings: .*dict; .*Settings\('):
        identify(short(), {'thresholds': 4})


def test_faults_of_a_file_become_warnings():
    dac = PAPER.sensor
    stage = SimulatedStage(
        PAPER.model, Sensor(dac.noise_rms, dac.dac, replace(dac.adc, high=6e-5))
    )
    result = identify(short(stage), QUICK)
    assert any('clipping' in w for w in result.warnings)


def test_creep_does_not_become_dynamics():
    """Slow poles that stand for creep halved G at 80 Hz before slow motion was filtered out."""
    setting = EffectSetting('creep', {'gain': [0.012] * 3, 'time_constant': [0.1, 1.0, 10.0]})
    crept = replace(PAPER, model=replace(PAPER.model, effects=(setting,)))
    record = crept.play(FULL.build(), np.random.default_rng(1), 'crept')
    G = identify(record, QUICK).model.dynamics
    f = np.array([10.0, 80.0, 300.0])
    true = np.abs(PAPER.model.dynamics.normalised().response(f, 20_000.0))
    np.testing.assert_allclose(np.abs(G.response(f, 20_000.0)), true, rtol=0.01)


@pytest.mark.parametrize('quantum', [0.0, 1e-3])
@pytest.mark.parametrize('drift', ['line', 'exponential', 'with the voltage'])
def test_a_voltage_that_only_carries_its_noise_is_refused(quantum, drift, n=2000):
    rng, t = np.random.default_rng(1), np.linspace(0.0, 1.0, n)
    v = 5.0 + 1e-3 * rng.standard_normal(n)
    if quantum:
        v = quantum * np.round(v / quantum)
    y = t
    if drift == 'exponential':
        y = 1.0 - np.exp(-5.0 * t)
    elif drift == 'with the voltage':
        v = v + 2e-3 * t
    y = 1e-6 * y + 1e-9 * rng.standard_normal(n)
    with pytest.raises(IdentificationError, match=r'resting: .* V\. .* \S+ % of stroke .* \S+ %'):
        identify(Record((Piece(v, y, 5000.0),), 'resting'), Settings(max_order=4))


def test_small_noise_at_a_bias_drives_the_stage():
    piece = short(noise=1e-4).pieces[0]
    (noise,) = piece.find('noise')
    refuse_undriven([Record((piece.cut(noise.start, noise.stop),), 'noise')])


@pytest.mark.parametrize(('delay', 'used', 'missing'), [(5, 5, []), (None, 0, ['delay'])])
def test_a_g_that_goes_takes_no_given_delay_along(monkeypatch, delay, used, missing):
    second = three_steps.second_step

    def wrong(*args):
        # a lag of 0.25 s, as no stage here has
        return second(*args)[0], Dynamics([-0.9998], [2e-4])

    monkeypatch.setattr(three_steps, 'second_step', wrong)
    settings = replace(QUICK, delay=delay, order=(2, 2))
    result = identify(short(), settings)
    assert result.model.dynamics.is_static
    assert result.model.delay.total == result.delay.samples == used
    assert list(dict(result.not_identified)) == [*missing, 'dynamics']
    assert all(re.search(r'\d times .* noise', why) for _, why in result.not_identified)


@pytest.mark.parametrize('hold_out', [1e-4, 1e-3])
def test_a_hold_out_of_no_sample_is_one_line(hold_out):
    v = 5.0 - 5.0 * np.cos(np.linspace(0.0, 8.0 * np.pi, 2000))
    record = Record((Piece(v, 1e-6 * v, 1000.0),), 'brief')
    with pytest.raises(IdentificationError, match='--hold-out') as caught:
        identify(record, Settings(hold_out=hold_out))
    assert '\n' not in str(caught.value)


def test_a_singular_fit_is_an_error_of_ours(monkeypatch):
    def first_step(*args):
        raise np.linalg.LinAlgError('Singular matrix')

    monkeypatch.setattr('piezo_ident.identification.three_steps.first_step', first_step)
    with pytest.raises(IdentificationError, match=r'Singular matrix.* triangle'):
        identify(short(), QUICK)
