# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The effects: their laws in a line each, and how strong each must be for a wanted left-over."""

from __future__ import annotations

import math

import numpy as np

#: left-over sizes [% of stroke, rms] at which the gains below were found
STRENGTHS = (0.1, 0.3, 1.0)

#: of each effect its variants, of which the seed of a stage chooses one: its gain at each of
#: `STRENGTHS`, the median over stages, and the law
TABLE = """\
creep
    0.00176 0.00527 0.0176 : h (1 + c ln(1 + t/t0)) after every change, by its exact spectrum
    0.00109 0.00327 0.0109 : h (1 + c ((1 + t/t0)^0.12 - 1) / 0.12) after every change, likewise
thermal_drift
    0.00425 0.0127 0.0425 : diffusion: a (sqrt(t + t1) - sqrt(t1))
    0.0035 0.0105 0.0351 : air conditioning: a slow sine of 120 to 240 s
    0.00994 0.0298 0.0994 : warming up: a (1 - exp(-t/tau)), tau 6 to 40 s
periodic_disturbance
    0.0011 0.00331 0.011 : a clipped sine, tanh(2.5 sin), of 50.03 Hz
    0.00109 0.00328 0.0109 : a rounded triangle, asin(0.98 sin), of 59.96 Hz
rate_dependent_hysteresis
    0.114 0.355 1.34 : both edges of every play move out by r b s / (s + s0) / 2, s smoothed speed
    0.0704 0.252 0.997 : the lower edge of every play moves out by r b s / (s + s0)
    6.45e-05 0.000159 0.000522 : viscous plays: each state follows its band with a lag tau
amplifier_lag
    3.71e-05 8.02e-05 0.000218 : RC that grows with its voltage: tau (1 + 0.3 u) du/dt = v - u
    5.91e-05 0.000108 0.000278 : two equal lags
slew_limit
    318 266 201 : du/dt = S tanh((v - u) / (S 20 us))
    327 271 203 : du/dt = S tanh((v - u) / (S 40 us))
saturation
    0.0168 0.0499 0.203 : u / (1 + (u/us)^16)^(1/16)
    0.00778 0.0379 0.155 : slope falling to a tenth along a Gaussian knee
even_nonlinearity
    0.0643 0.193 0.643 : e |u - 0.45|^1.7
    0.0108 0.0323 0.108 : e cosh(3.5 (u - 0.5))
    0.0239 0.0718 0.239 : -e sin(pi u)
noncongruent_minor_loops
    0.0957 0.287 0.957 : Preisach operator with Everett function g(a - b) (1 + k (a + b - 1))
    0.143 0.43 1 : plays with envelopes F + k ((exp(2 F) - 1) / (exp(2) - 1) - F)
preload_loss
    0.037 0.111 0.37 : soft hinge, -k s ln(1 + exp((0.3 - u)/s)), s = 0.02
    0.054 0.162 0.54 : contact after Hertz, -k max(0.35 - u, 0)^1.5
changed_dynamics
    0.226 0.696 1.66 : mass added to the first mode of a continuous-time cascade
    0.136 0.407 1.36 : a part of the platform rides on a mode of its own, between 260 and 345 Hz
sensor_nonlinearity
    0.0581 0.174 0.581 : Wheatstone bridge, y (1 + e) / (1 + e y)
    0.568 1.07 2.48 : inverse tangent, atan(e (y - 0.35)) / e
backlash
    0.00392 0.0118 0.0392 : Dahl friction on y: dz/dy = (1 - z sgn dy) / 0.004
    0.0041 0.0123 0.041 : LuGre-like friction on y whose level falls with speed
input_feedthrough
    0.0735 0.221 0.735 : high-pass of v at 3 kHz and a resistive share, undelayed
    0.0314 0.0942 0.314 : high-pass of v at 1.5 kHz and a resistive share, undelayed
delay_change
    2.21e-05 6.64e-05 0.000221 : a further delay of any fraction of a sample, by windowed sinc
gain_drift
    0.00277 0.00848 0.0283 : y (1 + a(t)), a a sum of 16 lines with 1/f^2 power from 4 to 80 s
    0.00277 0.00811 0.027 : y (1 + a(t)), a a sum of 16 lines with 1/f power from 4 to 80 s
cross_coupling
    0.00735 0.0221 0.0735 : another axis's own Preisach hysteresis and resonance, times c
stick_jumps
    0.000989 0.00297 0.00989 : jumps of random size at random distances, which decay by jumps
floor_vibration
    0.00157 0.00471 0.0157 : 8 to 25 Hz noise in random bursts
input_ripple
    0.00208 0.00625 0.0208 : 37 Hz, of amplitude a (2u - 1)
asymmetric_relaxation
    0.00235 0.00704 0.0235 : logarithmic creep after falls only
memory_fade
    0.0382 0.113 0.479 : every play relaxes to the middle of its band at a rate
"""
LAWS: dict[str, list[tuple[str, tuple[float, ...]]]] = {}
for _line in TABLE.splitlines():
    _gains, _, _law = _line.partition(' : ')
    if _law:
        LAWS[list(LAWS)[-1]].append((_law, tuple(map(float, _gains.split()))))
    else:
        LAWS[_line] = []

#: outside the catalogue
OUTSIDE = tuple(
    'stick_jumps floor_vibration input_ripple asymmetric_relaxation memory_fade'.split()
)
EFFECTS = tuple(name for name in LAWS if name not in OUTSIDE)
VARIANTS = {name: len(forms) for name, forms in LAWS.items()}

#: what sets in after the identification; G would have swallowed the linear ones
LATER = (
    *'thermal_drift amplifier_lag changed_dynamics input_feedthrough'.split(),
    *('delay_change', 'gain_drift'),
)


#: what sets in behind the identification of a stage of another family: G would have swallowed it,
#: or H, as it follows the path
SETS_IN = (
    *LATER,
    *'backlash even_nonlinearity noncongruent_minor_loops preload_loss saturation'.split(),
    'sensor_nonlinearity',
)
#: the forms of the laws on stages of another family
FAMILY_VARIANTS = {**VARIANTS, 'rate_dependent_hysteresis': 2, 'noncongruent_minor_loops': 1}
#: the effects with one form more, for all sets but that of the tuning
FURTHER = (
    *'saturation amplifier_lag noncongruent_minor_loops preload_loss changed_dynamics'.split(),
    *'backlash gain_drift periodic_disturbance sensor_nonlinearity input_feedthrough'.split(),
)


def describe(effect: str) -> str:
    """Return the law of an effect, one line, its variants separated by semicolons."""
    return '; '.join(law for law, _ in LAWS[effect])


def gain_of(effect: str, variant: int, strength: float) -> float:
    """Return the law's parameter for a wanted left-over [% of stroke, rms]."""
    if strength <= 0:
        return math.inf if effect == 'slew_limit' else 0.0
    logs = np.log(LAWS[effect][variant][1])
    x, at = math.log(strength), np.log(STRENGTHS)
    # straight lines between the sizes, and on beyond them
    i = 0 if x < at[1] else 1
    slope = (logs[i + 1] - logs[i]) / (at[i + 1] - at[i])
    return float(math.exp(logs[i] + slope * (x - at[i])))
