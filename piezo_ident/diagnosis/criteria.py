# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The constants that decide a verdict, and where each comes from.

Physics: it follows from how stages, sensors and the candidates' laws behave.
Statistics: it follows from a test or from how well a quantity can be estimated.
Taste: another choice would be defensible.

Shares and ratios are of mean squares beyond the noise, sizes are rms in % of stroke.
"""

from __future__ import annotations

# -- physics -------------------------------------------------------------------------------------

#: size below which nothing is named: real laws differ from textbook ones by about as much
SMALLEST_EFFECT = 0.05
#: share of what G missed when it was identified, times the fast motion now over that of then, that
#: a change of G must exceed: what it missed was partly small loops, which no G holds
IN_PROPORTION = 0.5
#: times the rest that the mean error of a record is, where the zero of the sensor has moved
MOVED_ZERO = 3.0

# -- statistics ----------------------------------------------------------------------------------

#: passes over the voltage range that held-out data need: a branch passed once has no second half
PASSES = 3.0
#: ratio of a gain to the largest gain on circular-shift surrogates that makes it significant:
#: their largest is exceeded by chance in 1 of 17 cases, the factor allows for the many candidates
BEYOND_CHANCE = 1.5
#: standard errors over held-out blocks from which a difference is one (95 % of a normal variable)
STANDARD_ERRORS = 2.0
#: factor of an effect where it alone acts, as fitted to all data: 1 is exact
SHOWS = (0.4, 3.0)
#: share of a candidate's columns outside the span of the base below which it is not testable:
#: its amplitude is then known a hundred times less well
SWALLOWED = 1e-4
#: share of the noise that counts as left: its mean square is known to about as much
NOISE_SHARE = 0.1

# -- taste ---------------------------------------------------------------------------------------

#: share that an effect, or a wider H, may leave: it takes most
TAKES = 0.4
#: times the least that candidates leave which are alike: the one with fewest parameters is taken
ALIKE = 1.3
#: times what the best leaves, of candidates that are not separated from it
RIVALS = 1.6
#: share of what there was to explain that may be left by what explains it
LITTLE = 0.1
#: most names of a class
CLASS_SIZE = 3
