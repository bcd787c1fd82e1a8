# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A stage with a core of another family, light modes, a fractional delay, and hidden effects."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
import math
import zlib

import numpy as np
from scipy.linalg import expm
from scipy.signal import lfilter
from truths import laws
from truths.linear import delayed, relaxation
from truths.table import LATER

from . import forms
from .cores import Array, Core, core_of, Rng, WIDTHS
from .families import LAWS
from .speed import spent_on_speed

#: what sets in behind the identification: G would have swallowed it, or H, as it follows the path
SETS_IN = (
    *LATER,
    'backlash',
    'even_nonlinearity',
    'noncongruent_minor_loops',
    'preload_loss',
    'saturation',
    'sensor_nonlinearity',
)

#: forms of each effect's law
VARIANTS = {
    'thermal_drift': 3,
    'even_nonlinearity': 3,
    'delay_change': 1,
    'cross_coupling': 1,
    'noncongruent_minor_loops': 1,
}
#: what a stage has gone through before a record [s] after its last move, at rest
RESTED = 0.4
#: speed of the moves before a record [spans/s]
MOVES = 3.0


@dataclass(frozen=True)
class Linear:
    """
    Modes side by side, a sensor's pole, a delay.

    Attributes
    ----------
    modes : tuple of (frequency [Hz], damping ratio, share)
        The shares add up to 1; neighbours of one sign have an antiresonance between them.
    pole : float
        Corner of the sensor [Hz].
    delay : float
        [s], of any fraction of a sample.
    """

    modes: tuple[tuple[float, float, float], ...]
    pole: float
    delay: float

    def __call__(self, h: Array, rate: float, later: float = 0.0) -> Array:
        """Return the answer to h held between samples, from rest at h[0]."""
        x = h - h[0]
        total = np.zeros(h.size)
        for frequency, zeta, share in self.modes:
            w = 2 * math.pi * frequency
            whole = np.zeros((3, 3))
            whole[0, 1], whole[1, 0], whole[1, 1], whole[1, 2] = w, -w, -2 * zeta * w, w
            held = expm(whole / rate)
            a1, a2 = -float(np.trace(held[:2, :2])), float(np.linalg.det(held[:2, :2]))
            # the first two samples of the answer to a pulse
            first = float(held[0, 2])
            second = float(held[0, :2] @ held[:2, 2])
            total += share * lfilter([0.0, first, second + a1 * first], [1.0, a1, a2], x)
        pole = math.exp(-2 * math.pi * self.pole / rate)
        y = lfilter([1.0 - pole], [1.0, -pole], total)
        return np.asarray(delayed(y, self.delay + later, rate) + h[0])


@dataclass(frozen=True, eq=False)
class Stage:
    """
    A stage that is measured.

    Attributes
    ----------
    core : Core
    linear : Linear
    rate : float
        [Hz]
    limits : tuple of float
        [V]
    stroke : float
        [m], negative where the sensor looks the other way.
    offset : float
        Reading at the lowest voltage [m].
    noise : {'white', '1/f', '10-bit', '12-bit'}
    noise_rms : float
        Share of the stroke.
    gains, variants : mapping of str to number
        Parameter and form of the law of every effect.
    seed : int
    """

    core: Core
    linear: Linear
    rate: float
    limits: tuple[float, float]
    stroke: float
    offset: float
    noise: str
    noise_rms: float
    gains: Mapping[str, float] = field(default_factory=dict)
    variants: Mapping[str, int] = field(default_factory=dict)
    seed: int = 0

    def before(self, start: float, name: str) -> Array:
        """Return what u did before a record: full sweeps, some turns, and rest at its start."""
        rng = self._draw('before', name)
        levels = [0.0, 1.0, 0.0]
        if start > 0.02:
            levels += [rng.uniform(0.7, 1.0), rng.uniform(0.0, 0.3), rng.uniform(0.4, 0.8)]
        parts = [np.zeros(2)]
        for a, b in zip(levels, [*levels[1:], start], strict=True):
            n = max(1, round(abs(b - a) / MOVES * self.rate))
            parts.append(a + (b - a) * 0.5 * (1 - np.cos(np.pi * np.arange(1, n + 1) / n)))
        parts.append(np.full(round(RESTED * self.rate), start))
        return np.concatenate(parts)

    def respond(
        self,
        v: Array,
        name: str,
        gains: Mapping[str, float] | None = None,
        other: Array | None = None,
        *,
        clean: bool = False,
    ) -> Array:
        """
        Return the displacement [m], shape (n,).

        Parameters
        ----------
        v : ndarray, shape (n,)
            Command held between samples [V].
        name : {'identification', 'diagnosis', 'unseen'}
            Of the record: its own noise, phases and past.  What is in `SETS_IN` sets in behind
            the identification.
        gains : mapping, optional
            Instead of the stage's own.
        other : ndarray, shape (n,), optional
            Voltage of another axis [V].
        clean : bool
            Without the sensor's noise, in parts of the stroke and without offset.
        """
        gains = dict(self.gains if gains is None else gains)
        if name == 'identification':
            gains = {k: x for k, x in gains.items() if k not in SETS_IN}
        low, high = self.limits
        u = (v - low) / (high - low)
        before = self.before(float(u[0]), name)
        y = self._displacement(np.concatenate([before, u]), before.size, name, gains, other)
        if clean:
            return y
        y = self.read(y, name)
        return np.asarray(self.offset + self.stroke * y)

    def read(self, y: Array, name: str) -> Array:
        """Return a displacement with the sensor's noise, in parts of the stroke."""
        white = self._draw('noise', name).standard_normal(y.size)
        if self.noise == '1/f':
            spectrum = np.fft.rfft(white)
            spectrum[0] = 0.0
            spectrum[1:] /= np.sqrt(np.arange(1, spectrum.size))
            white = np.fft.irfft(spectrum, y.size)
            white /= white.std()
        y = y + self.noise_rms * white
        if self.noise.endswith('-bit'):
            # a converter's range is wider than the stroke
            steps = 2 ** int(self.noise[:2]) / 1.2
            y = np.rint(y * steps) / steps
        return np.asarray(y)

    def _draw(self, what: str, name: str) -> Rng:
        return np.random.default_rng([zlib.crc32(f'{what} {name}'.encode()), self.seed])

    def _displacement(
        self, u: Array, start: int, name: str, gains: Mapping[str, float], other: Array | None
    ) -> Array:
        rate, kind = self.rate, self.variants
        drive = u
        if 'slew_limit' in kind:
            slew = gains.get('slew_limit', math.inf)
            drive = laws.current_limited(drive, slew, kind['slew_limit'], rate)
        if 'saturation' in gains:
            drive = forms.limited(drive, gains['saturation'], kind['saturation'])
        if 'amplifier_lag' in gains:
            drive = forms.lagging(drive, gains['amplifier_lag'], kind['amplifier_lag'], rate)
        field_ = drive
        if 'rate_dependent_hysteresis' in gains:
            amount, form = gains['rate_dependent_hysteresis'], kind['rate_dependent_hysteresis']
            field_ = drive - spent_on_speed(drive, amount, form, rate)
        h = self.core(field_)
        if 'noncongruent_minor_loops' in gains:
            amount = gains['noncongruent_minor_loops']
            # loops are wider the higher the voltage, or the further the stage is out
            place = drive if kind['noncongruent_minor_loops'] == 0 else h
            h = h + amount * (2.0 * place - 1.0) * (h - drive)
        if 'even_nonlinearity' in gains:
            amount, form = gains['even_nonlinearity'], kind['even_nonlinearity']
            h = h + laws.bent(drive, amount, form)
        if 'creep' in gains:
            law = ('log', 'power')[kind['creep']]
            h = relaxation(h, law, gains['creep'], rate=rate)
        if 'preload_loss' in gains:
            h = h + forms.hinge(drive, gains['preload_loss'], kind['preload_loss'])
        y = self._motion(h, gains)
        if 'backlash' in gains:
            y = y + forms.friction(y, gains['backlash'], kind['backlash'], rate)
        y, u = y[start:], u[start:]
        t = np.arange(y.size) / rate
        if 'gain_drift' in gains:
            rng = self._draw('gain_drift', name)
            y = y * (1.0 + forms.wander(t, gains['gain_drift'], kind['gain_drift'], rng))
        if 'cross_coupling' in gains and other is not None:
            y = y + gains['cross_coupling'] * self._other(other)
        for effect, law_of in (('thermal_drift', laws.drift), ('periodic_disturbance', forms.hum)):
            if effect in gains:
                rng = self._draw(effect, name)
                y = y + law_of(t, gains[effect], kind[effect], rng)
        if 'sensor_nonlinearity' in gains:
            y = forms.bent(y, gains['sensor_nonlinearity'], kind['sensor_nonlinearity'])
        if 'input_feedthrough' in gains:
            amount, form = gains['input_feedthrough'], kind['input_feedthrough']
            y = y + forms.fed(u, amount, form, rate)
        return np.asarray(y)

    def _motion(self, h: Array, gains: Mapping[str, float]) -> Array:
        linear, later = self.linear, gains.get('delay_change', 0.0)
        amount = gains.get('changed_dynamics', 0.0)
        if amount:
            (frequency, zeta, share), *others = linear.modes
            if self.variants['changed_dynamics'] == 0:
                # the same dashpot on more mass
                ratio = 1.0 / (1.0 + amount)
                modes = ((frequency * ratio, zeta * ratio, share), *others)
            elif self.variants['changed_dynamics'] == 2:
                # a stiffer or lighter platform: every mode moves up
                modes = tuple((f * (1.0 + 0.5 * amount), z, k) for f, z, k in linear.modes)
            else:
                # a part of the platform rides on a mode of its own
                modes = ((frequency, zeta, share - amount), (0.7 * frequency, 0.02, amount))
                modes = (*modes, *others)
            linear = Linear(modes, linear.pole, linear.delay)
        return linear(h, self.rate, later)

    def _other(self, v: Array) -> Array:
        low, high = self.limits
        u = v / (high - low)
        moved = 0.85 * u + 0.15 * u**2
        rng = self._draw('other', '')
        return Linear(((rng.uniform(150.0, 400.0), 0.03, 1.0),), 2500.0, 0.0)(moved, self.rate)


def make_linear(rng: Rng, rate: float, highest: float = 1500.0) -> Linear:
    """Draw two or three light modes, a sensor's pole and a delay of 0 to 6 samples."""
    top = 0.38 * rate
    first = math.exp(rng.uniform(math.log(200.0), math.log(min(highest, top / 1.7))))
    places, frequency = [first], first
    for _ in range(int(rng.integers(1, 3))):
        frequency *= rng.uniform(1.6, 2.8)
        if frequency < top:
            places.append(frequency)
    # the lowest mode carries most; a higher one of its sign makes an antiresonance
    shares = rng.uniform(0.03, 0.2, len(places)) * rng.choice([1.0, 1.0, -1.0], len(places))
    shares[0] = 1.0 - shares[1:].sum()
    zetas = np.exp(rng.uniform(math.log(0.005), math.log(0.05), len(places)))
    modes = tuple(zip(map(float, places), map(float, zetas), map(float, shares), strict=True))
    pole = rng.uniform(0.15, 0.4) * rate
    return Linear(modes, pole, rng.uniform(0.0, 6.0) / rate)


def make_core(name: str, rng: Rng) -> Core:
    """Draw a core of a family until its slopes are those of a piezo."""
    width = rng.uniform(*WIDTHS)
    for _ in range(200):
        core = core_of(name, LAWS[name](rng), width)
        if core is not None:
            return core
        width = rng.uniform(*WIDTHS)
    raise ValueError(f'no core of {name} has the slopes of a piezo')


def _form(effect: str, rng: Rng, further: bool) -> int:
    known = VARIANTS.get(effect, 2)
    if not further or effect not in forms.FURTHER:
        return int(rng.integers(known))
    return min(int(rng.integers(known + 2)), forms.FURTHER[effect])


def make_stage(
    core: str, seed: int, effects: tuple[str, ...] = (), further: bool = False
) -> Stage:
    """
    Draw a stage; the gains of its effects are still to be found.

    Parameters
    ----------
    core : str
        One of `families.LAWS`.
    seed : int
    effects : tuple of str
        Of which the forms are drawn.
    further : bool
        Also draw from `forms.FURTHER`, which counts twice.
    """
    rng = np.random.default_rng([8812, seed])
    rate = float(rng.choice([10_000.0, 20_000.0, 20_000.0, 50_000.0]))
    limits = ((0.0, 10.0), (0.0, 100.0), (-20.0, 130.0))[int(rng.integers(3))]
    stroke = math.exp(rng.uniform(math.log(5e-6), math.log(200e-6)))
    sign = -1.0 if rng.random() < 0.2 else 1.0
    noise = str(rng.choice(['white', 'white', '1/f', '1/f', '10-bit', '12-bit']))
    return Stage(
        core=make_core(core, rng),
        # a change of a high mode shows in nothing that a stage is driven with
        linear=make_linear(rng, rate, 600.0 if 'changed_dynamics' in effects else 1500.0),
        rate=rate,
        limits=limits,
        stroke=sign * stroke,
        offset=stroke * rng.uniform(-0.3, 0.3),
        noise=noise,
        noise_rms=math.exp(rng.uniform(math.log(2e-5), math.log(2e-4))),
        variants={n: _form(n, rng, further) for n in effects},
        seed=seed,
    )
