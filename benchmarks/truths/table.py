# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Names of the effects, and their laws in a line each."""

from __future__ import annotations

__all__ = ['EFFECTS', 'LATER', 'LAWS', 'OUTSIDE', 'VARIANTS', 'describe']

#: law of each effect, one entry a variant; which one a stage takes is drawn from its seed
LAWS: dict[str, tuple[str, ...]] = {
    'creep': (
        'h (1 + c ln(1 + t/t0)) after every change, as its exact continuous relaxation spectrum',
        'h (1 + c ((1 + t/t0)^0.12 - 1) / 0.12) after every change, likewise',
    ),
    'thermal_drift': (
        'diffusion: a (sqrt(t + t1) - sqrt(t1))',
        'air conditioning: a slow sine of 120 to 240 s',
        'warming up: a (1 - exp(-t/tau)), tau 6 to 40 s',
    ),
    'periodic_disturbance': (
        'a clipped sine, tanh(2.5 sin), of 50.03 Hz',
        'a rounded triangle, asin(0.98 sin), of 59.96 Hz',
    ),
    'rate_dependent_hysteresis': (
        'both edges of every play move out by r b s / (s + s0) / 2, s smoothed speed',
        'the lower edge of every play moves out by r b s / (s + s0)',
        'viscous plays: each state follows its band with a lag tau',
    ),
    'amplifier_lag': (
        'RC whose capacitance grows with its voltage: tau (1 + 0.3 u) du/dt = v - u',
        'two equal lags',
    ),
    'slew_limit': (
        'du/dt = S tanh((v - u) / (S 20 us))',
        'du/dt = S tanh((v - u) / (S 40 us))',
    ),
    'saturation': (
        'u / (1 + (u/us)^16)^(1/16)',
        'slope falling to a tenth along a Gaussian knee',
    ),
    'even_nonlinearity': (
        'e |u - 0.45|^1.7',
        'e cosh(3.5 (u - 0.5))',
        '-e sin(pi u)',
    ),
    'noncongruent_minor_loops': (
        'Preisach operator with Everett function g(a - b) (1 + k (a + b - 1))',
        'plays with envelopes F + k ((exp(2 F) - 1) / (exp(2) - 1) - F)',
    ),
    'preload_loss': (
        'soft hinge, -k s ln(1 + exp((0.3 - u)/s)), s = 0.02',
        'contact after Hertz, -k max(0.35 - u, 0)^1.5',
    ),
    'changed_dynamics': (
        'mass added to the first mode of a continuous-time cascade',
        'a part of the platform rides on a mode of its own, between 260 and 345 Hz',
    ),
    'sensor_nonlinearity': (
        'Wheatstone bridge, y (1 + e) / (1 + e y)',
        'inverse tangent, atan(e (y - 0.35)) / e',
    ),
    'backlash': (
        'Dahl friction on y: dz/dy = (1 - z sgn dy) / 0.004',
        'LuGre-like friction on y whose level falls with speed',
    ),
    'input_feedthrough': (
        'high-pass of v at 3 kHz and a resistive share, undelayed',
        'high-pass of v at 1.5 kHz and a resistive share, undelayed',
    ),
    'delay_change': ('a further delay of any fraction of a sample, by windowed sinc',),
    'gain_drift': (
        'y (1 + a(t)), a a sum of 16 lines with 1/f^2 power from 4 to 80 s',
        'y (1 + a(t)), a a sum of 16 lines with 1/f power from 4 to 80 s',
    ),
    'cross_coupling': ("another axis's own Preisach hysteresis and resonance, times c",),
    'stick_jumps': ('jumps of random size at random distances travelled, which decay by jumps',),
    'floor_vibration': ('8 to 25 Hz noise in random bursts',),
    'input_ripple': ('37 Hz, of amplitude a (2u - 1)',),
    'asymmetric_relaxation': ('logarithmic creep after falls only',),
    'memory_fade': ('every play relaxes to the middle of its band at a rate',),
}

#: outside the catalogue
OUTSIDE = (
    'stick_jumps',
    'floor_vibration',
    'input_ripple',
    'asymmetric_relaxation',
    'memory_fade',
)
EFFECTS = tuple(name for name in LAWS if name not in OUTSIDE)
VARIANTS = {name: len(forms) for name, forms in LAWS.items()}

#: what sets in after the identification; G would have swallowed the linear ones
LATER = (
    'thermal_drift',
    'amplifier_lag',
    'changed_dynamics',
    'input_feedthrough',
    'delay_change',
    'gain_drift',
)


def describe(effect: str) -> str:
    """Return the law of an effect, one line, its variants separated by semicolons."""
    return '; '.join(LAWS[effect])
