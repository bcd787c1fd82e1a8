# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The line search: hum is found to a fraction of a bin, drive and noise are not taken for it."""

from functools import cache

import numpy as np
from numpy.testing import assert_allclose
from piezo_ident.record.record import Piece
from piezo_ident.residual.line_spectrum import Series, series_of, Spectrum
from piezo_ident.residual.lines import _log_chance, find_lines, without_lines
from piezo_ident.residual.stretches import all_stretches, ResidualPart
import pytest
from residual_data import misfit, part_of, pink, RATE, STROKE, T, V, Y_HAT
from residual_stages import drives, foreign
from scipy.optimize import minimize_scalar
from scipy.signal import lfilter
from scipy.stats import gamma

DRIVES = drives()


def search(*parts: ResidualPart):
    return find_lines(parts, all_stretches(parts))


def noise(rng: np.random.Generator) -> np.ndarray:
    return 2e-9 * rng.standard_normal(V.size)


def test_hum_of_a_ten_thousandth_of_the_stroke_beside_a_drive_of_50_hz():
    rng = np.random.default_rng(0)
    amplitude = 1e-4 * STROKE
    hum = amplitude * np.sin(2 * np.pi * 50.03 * T + 0.7)
    part = part_of(noise(rng) + misfit(V) + hum)
    (line,) = search(part).lines
    # one bin of the whole record is 0.1 Hz
    assert line.frequency == pytest.approx(50.03, abs=0.002)
    assert line.amplitude == pytest.approx(amplitude, rel=0.03)
    ((_, _, phase),) = line.records
    assert phase == pytest.approx(0.7, abs=0.1)
    rest = without_lines(part, [line]).e - part.e + hum
    assert np.std(rest) < 0.15 * np.std(hum)


@pytest.mark.parametrize('orders', [(2, 3, 4, 5, 6), (7, 8, 9)])
def test_harmonics_are_grouped(orders):
    rng = np.random.default_rng(1)
    sizes = {1: 8e-9, orders[0]: 4e-9, **dict.fromkeys(orders[1:], 5e-9)}
    wave = sum(a * np.sin(2 * np.pi * k * 49.9 * T) for k, a in sizes.items())
    (line,) = search(part_of(noise(rng) + wave)).lines
    assert line.frequency == pytest.approx(49.9, abs=0.003)
    assert tuple(order for order, _ in line.harmonics) == orders
    assert line.harmonics[1][1].amplitude == pytest.approx(5e-9, rel=0.05)


def test_two_records_share_the_frequency_each_with_its_phase():
    rng = np.random.default_rng(2)
    parts = [
        part_of(noise(rng) + 2e-9 * np.sin(2 * np.pi * 83.3 * T + phase), record=name)
        for name, phase in (('a', 0.3), ('b', 2.0))
    ]
    (line,) = search(*parts).lines
    assert line.frequency == pytest.approx(83.3, abs=0.005)
    assert [phase for _, _, phase in line.records] == pytest.approx([0.3, 2.0], abs=0.2)


def test_a_record_driven_at_50_hz_cannot_tell_hum():
    rng = np.random.default_rng(3)
    t = np.arange(8000) / RATE
    v = 5 + 5 * np.sin(2 * np.pi * 50 * t)
    e = 2e-9 * rng.standard_normal(t.size) + 1e-7 * np.sin(2 * np.pi * 50 * t + 1) + misfit(v)
    part = ResidualPart('r', Piece(v, 7e-6 * v + e, RATE), e)
    found = search(part)
    assert found.lines == ()
    assert found.searched


@pytest.mark.parametrize('colour', ['white', 'pink', 'misfit'])
def test_no_false_lines(colour):
    rng = np.random.default_rng(4)
    # 0 to 1 in 800 were seen in longer runs
    for i in range(8):
        e = 2e-9 * pink(V.size, rng) if colour == 'pink' else noise(rng)
        if colour == 'misfit':
            e = e + misfit(V)
        assert search(part_of(e, labelled=i % 2 == 0)).lines == ()


@cache
def stage_of(drive: str) -> tuple[np.ndarray, np.ndarray]:
    return foreign(DRIVES[drive], np.random.default_rng(6))


def of_stage(drive: str, hum: float) -> ResidualPart:
    v = DRIVES[drive]
    y, y_hat = stage_of(drive)
    t = np.arange(v.size) / RATE
    y = y + hum * np.tanh(2.5 * np.sin(2 * np.pi * 50.03 * t + 1))
    return ResidualPart('r', Piece(v, STROKE * y, RATE), STROKE * (y - y_hat))


@pytest.mark.parametrize('drive', DRIVES)
def test_a_misfit_of_the_hysteresis_makes_no_line(drive):
    assert search(of_stage(drive, 0.0)).lines == ()


@pytest.mark.parametrize(
    ('drive', 'size'),
    # the steps, never at rest for long, excite 50 Hz themselves
    [*((name, 5e-4) for name in ('sines', 'triangle', 'multisine')), ('steps', 2.5e-3)],
)
def test_clipped_hum_beside_a_misfit_of_a_per_cent(drive, size):
    line, *_ = search(of_stage(drive, size)).lines
    assert line.frequency == pytest.approx(50.03, abs=0.05)
    # the first harmonic of that wave
    assert line.amplitude == pytest.approx(1.18 * size * STROKE, rel=0.1)


def test_a_sweep_of_one_frequency_is_drive_not_hum():
    rng = np.random.default_rng(5)
    t = np.arange(6000) / RATE
    v = 5 + np.minimum(t, 3 - t) * np.sin(2 * np.pi * 20 * t)
    e = 2e-9 * rng.standard_normal(t.size) + 5e-8 * (v - 5) + 1e-8 * (v - 5) ** 2
    assert search(ResidualPart('r', Piece(v, 7e-6 * v + e, RATE), e)).lines == ()


def test_no_noise_at_all_makes_no_lines_and_too_little_is_not_searched():
    assert search(part_of(misfit(V))).lines == ()
    assert search(part_of(np.zeros(V.size))).lines == ()
    part = ResidualPart('r', Piece(V[:300], Y_HAT[:300], RATE, 0.0), np.ones(300))
    found = search(part)
    assert found.lines == ()
    assert not found.searched
    assert search(part_of(np.zeros(V.size))).searched


def test_a_mode_that_rings_at_every_step_is_no_line():
    rng = np.random.default_rng(9)
    kicks = np.zeros(V.size)
    kicks[::2000] = 1e-7 * (1.0 + 0.1 * rng.standard_normal(kicks[::2000].size))
    pole = np.exp((-0.01 + 1j) * 2 * np.pi * 256.0 / RATE)
    ring = lfilter([1.0], [1.0, -2 * pole.real, abs(pole) ** 2], pole.imag * kicks)
    hum = 2e-8 * np.sin(2 * np.pi * 50.03 * T)
    (line,) = search(part_of(noise(rng) + ring + hum)).lines
    assert line.frequency == pytest.approx(50.03, abs=0.002)


def test_a_sine_in_one_half_of_a_rest_is_no_line():
    hum, rest = 1.2e-9 * np.sin(2 * np.pi * 50.03 * T), np.zeros(V.size)
    for wave, count in ((0.5 * hum, 1), (hum * (T > 0.5 * T[-1]), 0)):
        e = noise(np.random.default_rng(2)) + wave
        part = ResidualPart('r', Piece(rest, 0.1 * Y_HAT + e, RATE), e)
        assert len(search(part).lines) == count


def test_two_rests_far_apart_agree_on_one_frequency():
    rng, hertz = np.random.default_rng(10), 50.087
    v = np.zeros(130_000)
    # a motion of many periods, too loud to tell where the phase is
    moving = slice(10_000, 120_000)
    n = np.arange(110_000)
    v[moving] = 5.0 - 5.0 * np.cos(2e-4 * n * (1.0 + 1e-5 * n))
    t = np.arange(v.size) / RATE
    e = 1e-10 * rng.standard_normal(t.size) + 3e-8 * np.sin(2 * np.pi * hertz * t + 1.0)
    e[moving] += 3e-8 * rng.standard_normal(n.size)
    line, *_ = search(ResidualPart('r', Piece(v, 7e-6 * v + e, RATE), e)).lines
    assert line.frequency == pytest.approx(hertz, abs=0.002)


@pytest.mark.parametrize('records', [1, 3])
def test_the_chance_of_a_score_is_that_of_exponential_variables(records):
    total = np.array([0.5, 5.0, 50.0, 499.0, 501.0, 600.0])
    assert_allclose(_log_chance(total, records), -gamma.logsf(total, records), rtol=1e-4)


def transform(s: Series, hertz: np.ndarray) -> np.ndarray:
    """Return the windowed transform at any frequencies [Hz], sample by sample."""
    t = s.t + np.arange(s.x.size) / s.rate
    return np.exp(-2j * np.pi * np.outer(hertz, t)) @ (s.window * s.x)


@pytest.mark.parametrize('n', [4000, 400], ids=['whole', 'tenth'])
@pytest.mark.parametrize('offset', [0, 987_654], ids=['at_zero', 'later'])
def test_the_transform_between_points_of_the_grid(n, offset):
    rng = np.random.default_rng(12)
    # a slow drift far stronger than the line
    x = np.sin(2 * np.pi * 50.03 * np.arange(n) / RATE) + 1e4 * np.linspace(-1, 1, n) ** 2
    x += 0.1 * rng.standard_normal(n)
    # the grid counts whole samples, the stretch begins between two
    s = Series('r', (offset + 0.4) / RATE, x, np.hanning(n), 0.0, offset, 1, RATE)
    size = 10_000
    f = np.arange(4000) * RATE / size
    near = np.arange(220, 280)
    hertz = rng.uniform(f[near[0]], f[near[-1]], 200)
    found = Spectrum.of(s, f, size).between(f, near)(hertz)
    # a part of the search is sampled the more finely
    largest = 0.25 * n
    assert found == pytest.approx(transform(s, hertz), abs=(2e-5 if n == 4000 else 1e-8) * largest)


def test_the_frequency_is_that_of_the_largest_gain_at_the_full_rate():
    rng = np.random.default_rng(13)
    n, apart = 4000, 60.0123
    parts = []
    for start in (0.0, apart):
        t = start + np.arange(n) / RATE
        e = 1e-9 * rng.standard_normal(n) + 1e-8 * np.sin(2 * np.pi * 50.03 * t + 1.0)
        parts.append(ResidualPart('r', Piece(np.zeros(n), e, RATE, start), e))
    (line,) = search(*parts).lines
    series, *_ = series_of(parts, all_stretches(parts))
    assert len(series) == 2
    noise = [Spectrum.of(s, np.array([50.0]), 10_000).noise[0] for s in series]

    def gain(hertz: float | np.ndarray) -> np.ndarray:
        # equal windows know equally much
        seen = [transform(s, np.atleast_1d(hertz)) for s in series]
        return np.abs(seen[0] / noise[0] + seen[1] / noise[1]) ** 2

    grid = np.arange(49.9, 50.1, 1e-3)
    top = grid[np.argmax(gain(grid))]
    best = minimize_scalar(lambda f: -gain(f)[0], (top - 1e-3, top, top + 1e-3), tol=1e-10)
    assert best.x == pytest.approx(50.03, abs=0.001)
    # the resolution is 1 / 62 s
    assert line.frequency == pytest.approx(best.x, abs=1e-5)
