# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Constants that decide a verdict, with the source of each.

Physics: the constant follows from the behaviour of stages, of sensors and of the candidates' laws.
Statistics: the constant follows from a test, or from the accuracy of an estimate.
Taste: another choice would be defensible.

Shares and ratios compare mean squares less the noise.  Sizes are rms in % of stroke.
"""

from __future__ import annotations

# -- physics -------------------------------------------------------------------------------------

#: smallest size of an effect that is named: real laws differ from textbook laws by about as much
SMALLEST_EFFECT = 0.05
#: a change of G must exceed the error of G at its identification.  The error grows by this share
#: of the growth of the fast motion: the rest of the error was small loops, not G
IN_PROPORTION = 0.5
#: the zero of the sensor has moved if the mean error of a record is so many times its other error
MOVED_ZERO = 3.0

# -- statistics ----------------------------------------------------------------------------------

#: passes over the voltage range that held-out data need: a branch passed once has no second half
PASSES = 3.0
#: a significant gain exceeds the largest gain on circular-shift surrogates by this factor.  Chance
#: exceeds the largest gain in 1 of 17 cases, and the factor allows for many candidates
BEYOND_CHANCE = 1.5
#: a difference is significant from so many standard errors over held-out blocks (95 % of a normal
#: variable)
STANDARD_ERRORS = 2.0
#: accepted range of kappa: size of an effect where it alone acts, over its size in all data
SHOWS = (0.4, 3.0)
#: a testable candidate has a larger share of its columns outside the span of the base.  At this
#: share its amplitude is known a hundred times less accurately
SWALLOWED = 1e-4
#: share of the mean square of the noise that is always added to the error: the noise is known to
#: about this share
NOISE_SHARE = 0.1

# -- taste ---------------------------------------------------------------------------------------

#: an effect, or a wider H, explains most of an error if it leaves at most this share
TAKES = 0.4
#: candidates with errors up to this factor times the smallest error are equal, and the candidate
#: with the fewest parameters is taken
ALIKE = 1.3
#: candidates with errors up to this factor times the best error are not separated from the best
RIVALS = 1.6
#: an explanation may leave this share of the error to explain
LITTLE = 0.1
#: largest number of names of a class
CLASS_SIZE = 3
