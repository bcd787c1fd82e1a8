# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The constants that decide a verdict, and where each comes from.

Physics: it follows from how stages, sensors and the candidates' laws behave.
Statistics: it follows from a test or from how well a quantity can be estimated.
Taste: another choice would be defensible; these were chosen on the study of simulated stages
(``docs/diagnosis_study.md``), for few wrong names.

Shares are of the explainable mean square (what the refitted base model leaves beyond the noise),
sizes are rms in % of stroke.
"""

from __future__ import annotations

# -- physics -------------------------------------------------------------------------------------

#: size below which no effect is named: real laws differ from textbook ones by about as much
SMALLEST_EFFECT = 0.05
#: size of a difference that means nothing: no weights of H describe a stage to better than that
INDISTINCT = 0.01
#: gain [% of stroke, rms] of a refit of H that is a finding: ten plays describe a smooth
#: hysteresis to about 0.15
REFIT_FINDING = 0.2
#: the same of a retuned G, where it is so many times what G missed when it was identified
CHANGE_FINDING, CLEAR_CHANGE = 0.1, 4.0
#: share of what plays leave and a wider H does not, below which no effect is named: the wider H
#: misses about as much of a hysteresis that is not of its kind
OF_MISFIT = 0.15
#: share from which a law fits; real effects deviate from their law by a little
LAW_FITS = 0.99
#: ratio of what is left by which a law that fits rules out a simpler one that fits, too: further
#: parameters make up for deviations of the form
FORM_RATIO = 4.0
#: range of the amplitude that an effect which is either on or off gets in a fit; 1 is exact
ON_AMPLITUDE = (0.2, 3.0)
#: expected size of a weight of H, normalised: the prior that keeps collinear plays small
WEIGHT_SPREAD = 0.1
#: the same of the other coefficients of H
WIDE_SPREAD = 1.0
#: what creeps on from before a record costs a fit as much as an error of so much of it, and the
#: share of the rms error of held-out blocks that may be left with it
EARLIER_COST, EARLIER_LEAVES = 0.003, 0.5
#: share of the model's voltage range that data must cover for a refitted H to hold in all of it
COVERED = 0.95
#: share of the voltage range below which the command is at rest but for noise
TREMBLES = 0.01

# -- statistics ----------------------------------------------------------------------------------

#: passes over the voltage range that held-out data need: a branch passed once has no second half
PASSES = 3.0
#: ratio of a gain to the largest gain on circular-shift surrogates that makes it significant, and
#: the number of surrogates: their largest is exceeded by chance in 1 of 17 cases, the factor
#: allows for the many candidates
BEYOND_CHANCE, SURROGATES = 1.5, 16
#: standard errors over held-out blocks from which a difference is one (95 % of a normal variable)
STANDARD_ERRORS = 2.0
#: share of a candidate's columns outside the span of the base below which it is not testable:
#: its amplitude is then known a hundred times less well
SWALLOWED = 1e-4
#: factor of an effect where it alone acts, as fitted to all data: 1 is exact
SHOWS = (0.4, 3.0)
#: share of the variance beyond which the displacement does not follow the voltage
UNRELATED = 0.99
#: correlation with the model below which no change of the stage can be the cause
AGAINST = -0.9
#: share to which the rms of the noise is known
NOISE_KNOWN = 0.1

# -- taste ---------------------------------------------------------------------------------------

#: share that an effect, or several, must explain to be named, and to be added at all
NAMED, ADDED = 0.92, 0.5
#: share that effects must explain together, but for those that show where they alone act: a
#: hysteresis that does not fit leaves a residual of which any effect explains a part
TOGETHER = 0.8
#: ratio of a gain to that of any other candidate from which an effect need not explain so much
STANDS_OUT = 2.0
#: share of what a refit of H takes that an effect beside the H as given must take, and the same
#: of noncongruent loops alone: of 33 refits of labelled simulated stages with nothing hidden those
#: took at most 0.76, and other effects 0.62
SET_IN, NONCONGRUENT = 0.75, 0.85
#: ratio to what H missed at the identification that noncongruent loops alone must exceed: no law
#: of H holds quite those of the material
BEYOND_MATERIAL = 3.0
#: share of what an effect leaves beside the H as given that a refit of H must take to be used,
#: where no kinds of motion are held out: of 24 such simulated stages H stays for twelve, of which
#: five then err less on other motion and five more, none more than as given; with a refit two did
BENT_H = 0.75
#: rms of the noise under which a retuned G is held to the given one where no kinds of motion are
#: held out, share of the range: of 15 such refits of simulated stages the one that bent a mode
#: (error on other motion 0.27 to 0.44 % of stroke) errs by 0.28, and three gain less; with 0.04
#: three gain nothing
NOISE_OF_G = 0.01
#: share of what a refit of H leaves that a gain which wanders must take for the gain of that refit
#: to be no change of H: of 14 refits of simulated stages whose H had changed it took at most 0.08
WANDERING = 0.2
#: share of what earlier effects left that a further one must explain
FURTHER = 0.6
#: least gain of an effect, share
LEAST_GAIN = 0.10
#: a wider law of H must leave less than this of the rms on held-out kinds of excitation
WIDER = 0.9
#: share of its gain that an effect, or a refit of H, may cost at kinds of excitation where the
#: error grows
HARM = 0.1
#: the same of a refit of H to labelled records, each kind predicted from the others: of 107 such
#: refits of simulated stages five of the seven that cost more failed on another record
HARM_OF_REFIT = 0.055
#: rms that a refit to records without labels may leave of a typical block (the geometric mean),
#: over that of the given model
TYPICAL_LEFT = 0.93
#: a rival that leaves less than this times what the best leaves is not separated from it
AHEAD = 1.6
#: a rival with more parameters must leave less than this times what a law that fits leaves
RICHER_AHEAD = 0.95
#: an effect with fewer parameters goes first if it leaves at most this times what the best leaves
SIMPLER = 1.3
#: share from which a drift is not separated from creep beside a wide H: of simulated stages that
#: drift it took 0.73 to 0.95 where creep took more, and of those that creep at most 0.55
DRIFTS = 0.7
#: most names of a class
CLASS_SIZE = 3
#: a change of the dynamics that exceeds what the model missed of fast motion less than so many
#: times has to fit its law
NEWS = 2.0
#: share of what G missed when it was identified, times the fast motion now over that of then, that
#: a change must exceed: of simulated stages six names of changes that were none were below, and so
#: were three changes of 46
IN_PROPORTION = 0.5
#: share from which a linear change is a finding of its own, not a side effect on G
LINEAR = 0.5
#: share of what a linear change leaves that a bent G and another effect must not exceed
BENT = 0.25
#: share that a first candidate must gain to be fitted jointly, and the most candidates of a round
WORTH_FIT, JOINT_FITS = 0.05, 4
#: share of the gain of the best after a few iterations below which a fit is not brought to its end
WORTH_END = 0.5
#: a step that gains less ends a fit: share of the mean square of the noise, or of that of the
#: smallest effect if it is less
OF_LEAST = 0.01
#: trials of a candidate that a joint fit starts from, its iterations, and how many candidates of a
#: round are fitted to the end
STARTS, FIRST, FINAL = 2, 3, 2
#: ratio to what was left before up to which the trial beside a sum of plays is a start: of 97 such
#: starts on simulated stages ten that clearly won left less, and one left more
PLAIN_START = 1.6
#: ratio to what the last of those leaves up to which another one is fitted to the end, too
LEVEL = 1.05
#: passes with fresh columns at the end, at most, and the gain that makes another worth it
POLISHING, POLISH = 6, 0.02
#: retuning of G that is worth a warning: samples of delay, or a share of the fast motion
TUNED = 0.05
#: mean error of a record, in units of the rms of the rest, from which a sensor's zero has moved
MOVED_ZERO = 3.0
#: gain in rms from which a refit of H alone is kept
WORTH_REFIT = 0.05
#: the same where no kinds of motion are held out, of a refit alone, and with effects: of 81 such
#: refits of simulated stages six gained less, of which three erred more on other motion, and of
#: the models with effects one, which erred more by a third
WORTH_UNLABELLED = 0.15, 0.3
#: share of the mean square within blocks, their means aside, that a refit of H alone must take:
#: of simulated stages whose loops move on, by up to 3 % of stroke, the four refits that failed on
#: another record took 0.07 to 0.29, and 84 of 89 that held took more
OF_SHAPE = 0.3
