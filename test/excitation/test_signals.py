# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Signals and programs: what they promise, and what would prove it wrong."""

from dataclasses import replace
from itertools import pairwise

from hypothesis import assume, given, settings
from hypothesis import strategies as st
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from piezo_ident.common.errors import ConfigError
from piezo_ident.excitation import signals as ex
from piezo_ident.excitation.catalogue import SIGNALS
from piezo_ident.excitation.program import parse_program, Program
from piezo_ident.excitation.scaled import program_to_yaml, scaled
from piezo_ident.operators.play import play_columns
from piezo_ident.record.record import KINDS
import pytest
import yaml

FS = 20_000.0
CONFIG = (
    'identification',
    'identification_loops',
    'validation',
    'minor_loops',
    'survey',
    'diagnosis',
    'holds',
)


def program(*segments: dict, **head) -> Program:
    return parse_program(yaml.safe_dump({'limits': [0, 10], **head, 'segments': list(segments)}))


def part(segment: dict) -> np.ndarray:
    """Return the voltage of a signal without the ramps around it."""
    s = program(segment).build(FS)
    (x,) = (x for x in s.segments if x.kind != 'ramp')
    return s.v[x.start : x.stop]


def band_power(x, fs, low, high):
    spectrum = np.abs(np.fft.rfft(x - x.mean())) ** 2
    f = np.fft.rfftfreq(x.size, 1 / fs)
    return spectrum[(f >= low) & (f < high)].sum()


def test_paper_triangle_is_equation_7_and_the_default_one_covers_its_range():
    v = ex.triangle(ex.PAPER_PEAKS, 0.0, ex.PAPER_SLOPE, FS)
    assert v.size == 6 * FS
    peaks = v[1:-1][(v[1:-1] > v[:-2]) & (v[1:-1] > v[2:])]
    assert peaks.tolist() == [3.0, 6.0, 9.0]
    assert_allclose(np.abs(np.diff(v)) * FS, 6.0, rtol=1e-9)
    assert_allclose(v[[0, 10_000, 20_000]], [0.0, 3.0, 0.0], atol=1e-12)
    for limits in ([0, 10], [-10, 10], [-2, 7.7]):
        s = program({'signal': 'triangle'}, limits=limits, rest=limits[0]).build(FS)
        assert (s.v.min(), s.v.max()) == tuple(limits)
        v = s.v[: s.segments[0].stop]
        peaks = v[1:-1][(v[1:-1] > v[:-2]) & (v[1:-1] > v[2:])]
        assert_allclose(np.diff(peaks), (limits[1] - limits[0]) / 3)


@settings(deadline=None)
@given(levels=st.lists(st.floats(-10, 10), min_size=2, max_size=6), slope=st.floats(1.0, 1000.0))
def test_corners_are_met_exactly(levels, slope):
    assume(np.abs(np.diff(levels)).sum() / slope > 1e-3)
    v = ex.corners(levels, slope, 1000.0)
    assert set(levels[:-1]) <= set(v.tolist())
    assert v.min() >= min(levels)
    assert v.max() <= max(levels)


@pytest.mark.parametrize('cutoff', [500.0, 3000.0])
def test_noise_spectrum_is_flat_and_ends(cutoff):
    v = ex.noise(5.0, 0.4, cutoff, 5.0, FS, np.random.default_rng(3))
    total = band_power(v, FS, 0, FS)
    # 1.2 times the cut-off is where the roll-off ends; what is left comes from the fades
    assert band_power(v, FS, 1.25 * cutoff, FS) < 1e-4 * total
    tenths = [band_power(v, FS, k * cutoff / 10, (k + 1) * cutoff / 10) for k in range(10)]
    assert max(tenths) < 1.35 * min(tenths)


@pytest.mark.parametrize(('crest', 'reached'), [(2.0, 2.1), (2.5, 2.6), (3.0, 3.1)])
def test_noise_peaks_are_limited_and_its_size_is_exact(crest, reached):
    v = ex.noise(5.0, 0.4, 3000.0, 5.0, FS, np.random.default_rng(1), crest=crest)
    assert np.abs(v - 5.0).max() / (v - 5.0).std() < reached
    assert_allclose(np.abs(v - 5.0).max(), 0.4, rtol=1e-12)
    assert abs(v.mean() - 5.0) < 1e-3
    assert v[0] == 5.0
    assert abs(v[-1] - 5.0) < 1e-3


def test_seed_reproduces_and_matters():
    def noise(seed):
        return ex.noise(0.0, 1.0, 1000.0, 0.5, FS, np.random.default_rng(seed))

    assert_array_equal(noise(1), noise(1))
    assert not np.array_equal(noise(1), noise(2))
    one, two = Program.load('identification'), Program.load('identification')
    assert_array_equal(one.build().v, two.build().v)
    other = one.build(rng=np.random.default_rng(99))
    assert not np.array_equal(one.build().v, other.v)


def test_multisine_has_odd_lines_only_and_leaves_some_out():
    rng = np.random.default_rng(5)
    lines = ex.odd_lines(1, 199, rng)
    v = ex.multisine(5.0, 4.5, lines, 1.0, 3, FS, rng)
    assert v.size == 3 * FS
    assert_allclose(v[:20_000], v[20_000:40_000], atol=1e-12)
    assert_allclose(np.abs(v - 5.0).max(), 4.5, rtol=1e-12)
    spectrum = np.abs(np.fft.rfft(v[:20_000] - 5.0))
    excited = np.flatnonzero(spectrum > 1e-6 * spectrum.max())
    assert_array_equal(excited, lines)
    assert np.all(excited % 2 == 1)
    assert_allclose(spectrum[excited], spectrum[excited].mean(), rtol=1e-9)
    assert np.all(ex.odd_lines(2, 99, rng) % 2 == 1)
    # one of every four odd lines detects odd nonlinearity
    for start in range(1, 193, 8):
        group = {start, start + 2, start + 4, start + 6}
        assert len(group & set(lines.tolist())) == 3


@settings(deadline=None)
@given(f=st.floats(0.5, 400.0), periods=st.integers(1, 12))
def test_sine_has_whole_periods(f, periods):
    v = ex.sine(5.0, 5.0, f, periods, FS)
    assert abs(v.size * f / FS - periods) <= 0.5 * f / FS + 1e-9
    # the next sample would be the first again, within the rounding to a sample
    after = 5.0 + 5.0 * np.sin(2 * np.pi * f * v.size / FS)
    assert abs(after - v[0]) <= 5.0 * 2 * np.pi * f * 0.5 / FS + 1e-9


@settings(deadline=None)
@given(
    a=st.floats(-10, 10),
    b=st.floats(-10, 10),
    slew=st.floats(0.5, 500.0),
    fs=st.floats(100.0, 50_000.0),
)
def test_ramp_is_soft_and_keeps_its_slew(a, b, slew, fs):
    v = np.append(ex.ramp(a, b, slew, fs), b)
    speed = np.diff(v) * fs
    assert np.abs(speed).max() <= slew * (1 + 1e-9) + 1e-9
    assert v[0] == a
    assert np.all(speed * np.sign(b - a) >= -1e-9 * fs)
    if v.size > 100:
        assert abs(speed[0]) < 0.01 * slew
        assert abs(speed[-1]) < 0.01 * slew


def test_settling_sweep_starts_full_and_dies_out_evenly():
    v = ex.settling_sweep(5.0, 0.5, 20, 20.0, FS) - 5.0
    assert v.size == FS
    cycles = np.abs(v.reshape(20, -1)).max(axis=1)
    assert cycles[0] == pytest.approx(0.5, rel=1e-3)
    assert cycles[-1] < 0.5 / 15
    assert np.all(np.diff(cycles) < 0)
    assert np.abs(np.diff(cycles)).max() < 0.5 / 15


def test_noise_after_the_sweep_does_not_ratchet_the_plays():
    s = Program.load('identification').build()
    noise = next(x for x in s.segments if x.kind == 'noise')
    # thresholds wider than twice the noise stand still; without the sweep they wander
    memory = play_columns(s.v / 10, [0.1, 0.2, 0.5])[:, noise.start : noise.stop]
    assert np.ptp(memory, axis=1).max() == 0.0


def test_steps_go_up_and_down_stairs_hold_and_a_decaying_triangle_shrinks_to_its_bias():
    v = part({'signal': 'step', 'bias': 5, 'size': 1, 'hold': 0.1, 'count': 10})
    jumps = np.diff(v)
    assert_array_equal(np.unique(v), [4.5, 5.5])
    assert (np.sum(jumps > 0), np.sum(jumps < 0)) == (5, 5)
    assert np.diff(np.flatnonzero(jumps)).tolist() == [2000] * 9
    assert ex.staircase([0, 2, 1], [0.1, 0.2, 0.3], 10.0).tolist() == [0, 2, 2, 1, 1, 1]
    v = part({'signal': 'decaying_triangle', 'bias': 5, 'amplitude': 5, 'cycles': 5, 'slope': 20})
    turns = v[1:-1][(np.sign(np.diff(v))[1:] != np.sign(np.diff(v))[:-1])]
    assert_allclose(turns, [10, 0, 9, 1, 8, 2, 7, 3, 6, 4], atol=1e-9)


def signal(name: str, **options: object) -> st.SearchStrategy:
    drawn = {k: x if isinstance(x, st.SearchStrategy) else st.just(x) for k, x in options.items()}
    return st.fixed_dictionaries({'signal': st.just(name), **drawn})


volt = st.floats(-0.5, 10.5)
size, few, short = st.floats(0.1, 5), st.integers(1, 5), st.floats(0.01, 0.1)
ONE_SIGNAL = st.one_of(
    signal('idle', duration=short),
    signal('hold', level=volt, duration=short),
    signal('step', bias=volt, size=size, hold=0.01, count=few),
    signal(
        'noise',
        bias=volt,
        amplitude=size,
        cutoff=st.floats(100, 500),
        duration=st.floats(0.05, 0.2),
    ),
    signal(
        'sine',
        bias=volt,
        amplitude=size,
        frequency=st.sampled_from([10, 50]),
        periods=few,
        phase=st.floats(-3, 3),
    ),
    signal('staircase', levels=st.lists(volt, min_size=1, max_size=4), hold=0.02),
    signal(
        'minor_loops',
        biases=st.lists(volt, min_size=1, max_size=3),
        amplitude=st.floats(0.1, 1),
        cycles=2,
        slope=100,
    ),
    signal('decaying_triangle', bias=volt, amplitude=size, cycles=few, slope=100),
    signal('settle', bias=volt, amplitude=st.floats(0.1, 1), cycles=few),
    signal('triangle', slope=100),
    signal(
        'multisine',
        bias=volt,
        amplitude=size,
        lowest=10,
        highest=90,
        period=0.1,
        periods=2,
        realisations=st.integers(1, 2),
    ),
)


@settings(deadline=None, max_examples=150)
@given(items=st.lists(ONE_SIGNAL, min_size=1, max_size=5), rest=st.floats(0, 10))
def test_every_program_keeps_its_promises_or_is_refused(items, rest):
    try:
        s = program(*items, rest=rest, slew=50, seed=4).build(2000)
    except ConfigError as error:
        assert 'outside the limits 0 .. 10 V' in str(error)
        assert 'segment' in str(error)
        return
    assert np.all((s.v >= 0.0) & (s.v <= 10.0))
    # the segments cover every sample, in order
    assert [x.start for x in s.segments] == [0, *[x.stop for x in s.segments[:-1]]]
    assert s.segments[-1].stop == s.n
    labels = [x.label for x in s.segments]
    assert all(a != b for a, b in pairwise(labels))
    assert {x.kind for x in s.segments} <= set(KINDS)
    for x in s.segments:
        if x.kind == 'ramp':
            speed = np.diff(s.v[max(0, x.start - 1) : x.stop + 1])[1:] * 2000
            assert np.abs(speed).max(initial=0.0) <= 50 * (1 + 1e-6)
    if s.segments[-1].kind == 'ramp':
        assert s.v[-1] == rest
    assert not s.v.flags.writeable


@pytest.mark.parametrize('name', CONFIG)
def test_programs_that_come_along_and_over_another_range(name):
    program = Program.load(name)
    s = program.build()
    assert s.sample_rate == FS
    assert np.all((s.v >= 0.0) & (s.v <= 10.0))
    assert s.v[0] == s.v[-1] == 0.0
    assert s.n == sum(x.n for x in s.segments)
    rows = s.describe().splitlines()
    assert [round(float(row.split()[0]) * s.sample_rate) for row in rows] == [
        segment.start for segment in s.segments
    ]
    # any rate will do
    rate = 10_000 if name.startswith('identification') else 5000
    assert program.build(rate).duration == pytest.approx(s.duration, rel=1e-2)
    # the same motion over another range; a level may be in a label
    other = scaled(program, (-20.0, 120.0), FS).build()
    assert [x.n for x in other.segments] == [x.n for x in s.segments]
    assert [x.kind for x in other.segments] == [x.kind for x in s.segments]
    assert_allclose(other.v, -20.0 + 14.0 * s.v, atol=1e-6)
    # what a slow rate cannot carry is left out
    slow = scaled(program, (0.0, 100.0), 500.0).build()
    assert slow.duration == pytest.approx(s.duration, rel=0.1)
    assert (slow.v.min(), slow.v.max()) == pytest.approx((0.0, 10.0 * s.v.max()), rel=0.02)


def test_identification_program_has_what_the_three_steps_need():
    s = Program.load('identification').build()
    assert 14 < s.duration < 18
    kinds = [x.kind for x in s.segments if x.kind not in ('ramp', 'idle')]
    assert kinds == ['step', 'settle', 'noise', 'triangle']
    part = {x.kind: s.v[x.start : x.stop] for x in s.segments}
    assert np.count_nonzero(np.diff(part['step'])) >= 10
    assert np.ptp(part['settle']) > np.ptp(part['noise'])
    assert (part['triangle'].min(), part['triangle'].max()) == (0.0, 10.0)


def test_the_program_with_loops_is_identification_with_motion_of_all_sizes_behind_it():
    plain, loops = (Program.load(f'identification{x}') for x in ('', '_loops'))
    assert loops.entries[: len(plain.entries) - 1] == plain.entries[:-1]
    s = loops.build()
    part = {x.label: s.v[x.start : x.stop] for x in s.segments}
    for label in ('triangle:loops', 'multisine:slow', 'multisine:fast'):
        assert np.ptp(part[label]) > 7.0
    assert s.duration < 23


def test_validation_program_is_the_papers_six_sines():
    s = Program.load('validation').build()
    sines = [x for x in s.segments if x.kind == 'sine']
    assert [x.label for x in sines] == [f'sine:{f}Hz' for f in (1, 10, 50, 80, 100, 120)]
    for x, f in zip(sines, (1, 10, 50, 80, 100, 120), strict=True):
        k = np.arange(x.n)
        assert_allclose(s.v[x.start : x.stop], 5 + 5 * np.sin(2 * np.pi * f * k / FS), atol=1e-9)
        assert (x.n * f) % FS == 0


def test_neighbours_never_share_a_label():
    s = program({'signal': 'triangle'}, {'signal': 'triangle'}).build(1000)
    assert [x.label for x in s.segments] == ['triangle', 'triangle:2']
    hold = {'signal': 'hold', 'level': 4, 'duration': 0.1}
    s = program(hold, hold, hold).build(1000)
    assert [x.label for x in s.segments] == ['ramp', 'hold:4V', 'hold:4V-2', 'hold:4V', 'ramp']
    s = program({**hold, 'name': 'warm'}, hold).build(1000)
    assert [x.label for x in s.segments][1:3] == ['hold:warm', 'hold:4V']


def test_the_labels_of_a_reference_name_its_own_unit():
    loops = {'signal': 'minor_loops', 'biases': [3, 5], 'amplitude': 1, 'cycles': 1}
    asked = program({'signal': 'hold', 'level': 4, 'duration': 0.1}, loops)
    for unit in ('V', 'um'):
        labels = {x.label for x in replace(asked, unit=unit).build(1000).segments}
        kinds = {f'hold:4{unit}', f'triangle:minor-3{unit}', f'triangle:minor-5{unit}'}
        assert labels == {'ramp', *kinds}


def test_numbers_that_yaml_reads_as_text_are_numbers():
    text = 'limits: [0, 1e1]\nsegments:\n - {signal: hold, level: 5e0, duration: 2e-1}\n'
    assert parse_program(text).build(1e3).v.max() == 5.0


def test_limits_of_the_caller_only_narrow():
    p = program({'signal': 'hold', 'level': 8, 'duration': 0.1})
    assert p.build(1000, limits=(-5, 9)).v.max() == 8.0
    with pytest.raises(ConfigError, match=r'segment 1 \(hold\).*outside the limits 0 .. 7 V'):
        p.build(1000, limits=(-5, 7))
    with pytest.raises(ConfigError, match=r'rest .* 0 V .* 1 .. 9 V'):
        p.build(1000, limits=(1, 9))
    # a signal that follows the range follows the narrower one
    assert program({'signal': 'triangle'}).build(1000, limits=(0, 6)).v.max() == 6.0


def test_a_signal_with_voltages_of_its_own_is_not_scaled():
    p = program({'signal': 'triangle', 'preset': 'paper'})
    with pytest.raises(ConfigError, match=r'preset: paper .*peaks.*base.*slope'):
        scaled(p, (0.0, 100.0), FS)
    # its own limits, and another rate
    other = parse_program(program_to_yaml(scaled(p, p.limits, FS / 2)))
    np.testing.assert_array_equal(other.build().v, p.build(FS / 2).v)


HEAD = 'limits: [0, 10]\nsegments: [{signal: idle, duration: 1}]\n'
SINE = 'sine, bias: 5, amplitude: 5, frequency: 10'
NOISE = 'noise, bias: 5, amplitude: 1, cutoff: 600, duration: 1'
MULTISINE = 'multisine, bias: 5, amplitude: 1, lowest: 1, highest: 600, period: 1, periods: 1'


@pytest.mark.parametrize(
    ('text', 'says'),
    [
        ('', 'mapping'),
        ('[1, 2', 'not valid YAML'),
        ('segments: [{signal: idle, duration: 1}]', 'limits .* V'),
        ('limits: [0, 10]', ': segments '),
        ('limits: [0, 10]\nsegments: []', ': segments '),
        ('limits: [0, 10]\nsegments: [3]', r'segment 1 \(None\): signal .*idle, '),
        (HEAD.replace('[0, 10]', '[10, 0]'), r'limits .*\[10\.0, 0\.0\]'),
        (HEAD.replace('[0, 10]', '5'), r'limits .*\[5\.0\]'),
        (HEAD.replace('[0, 10]', '[0, .inf]'), 'limits: inf .* V'),
        (HEAD + 'rest: 11', 'rest = 11'),
        (HEAD + 'seed: -1', 'seed = -1 '),
        (HEAD + 'slew: 0', 'slew: 0 V/s'),
        (HEAD + 'speed: 3', 'speed; .*limits, '),
        *(
            (f'limits: [0, 10]\nsegments: [{{signal: {segment}}}]', says)
            for segment, says in (
                ('chirp', r'segment 1 \(chirp\): signal .*idle, '),
                ('[1]', r'segment 1 .*: signal .*idle, '),
                ('idle', r'1 \(idle\): duration .* s$'),
                ('idle, duration: -1', 'duration: -1 s '),
                ('idle, duration: true', 'duration: True .* s$'),
                ('idle, duration: abc', "duration: 'abc' .* s$"),
                ('idle, duration: .nan', 'duration: nan .* s$'),
                ('idle, duration: [1]', r'duration: \[1\] .* s$'),
                ('idle, duration: 1e9', r'1e\+09 s .* samples'),
                ('idle, duration: 1e-9', '1e-09 s .* sample'),
                ('idle, length: 1', 'length; .*duration'),
                ('idle, duration: 1, name: a b', "name 'a b'"),
                (SINE, 'periods or duration'),
                (f'{SINE}, periods: 1.5', r'periods: 1\.5 '),
                (f'{SINE}, periods: 2, duration: 1', 'periods or duration'),
                ('triangle, preset: own', "preset: 'own' .*range, paper"),
                ('triangle, peaks: []', 'peaks: '),
                ('triangle, peaks: [3, 11]', 'reaches 0 .. 11 V'),
                ('triangle, preset: paper, slope: 60', 'preset: paper .* slope'),
                ('staircase, levels: [1, 2], hold: [1, 1, 1]', '2 levels and 3 holds'),
                (NOISE, r'600 Hz .*\(500 Hz\)'),
                (MULTISINE, r'highest = 600 Hz .*\(500 Hz\)'),
            )
        ),
    ],
)
def test_what_cannot_be_followed_is_refused_in_one_line(text, says):
    with pytest.raises(ConfigError, match=says) as caught:
        parse_program(text, 'lab.yaml').build(1000)
    assert str(caught.value).startswith('lab.yaml: ')
    assert '\n' not in str(caught.value)


def test_rate_is_needed_from_somewhere():
    p = program({'signal': 'idle', 'duration': 1})
    with pytest.raises(ConfigError, match='sample_rate'):
        p.build()
    with pytest.raises(ConfigError, match='sample_rate'):
        p.build(float('nan'))
    assert program({'signal': 'idle', 'duration': 1}, sample_rate=100).build().n == 100


def test_every_signal_says_its_kind():
    assert {s.kind for s in SIGNALS.values()} <= set(KINDS)
