# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Weigh the candidates of a diagnosis by their errors on kinds of motion that were held out.

A set s of n changes leaves the mean square E_sk on kind k of N.  A kind counts as one observation
of unknown size: with the prior 1 / sigma of the size its likelihood is E_sk^(-1/2).  Thus a kind
on which sets err alike does not tell them apart.  The weight of s is the mean over a of

    p_s prod_k E_sk^(-N a_k / 2) / sum of all,    a uniform on a_k >= 0, sum of a_k = 1,

pseudo Bayesian model averaging with the Bayesian bootstrap: Y. Yao et al., "Using stacking to
average Bayesian predictive distributions", Bayesian Analysis 13(3), 2018, doi:10.1214/17-BA1091.
E_sk contains the square of `SMALLEST_EFFECT`, as laws differ from stages by about as much.

The search takes the best of many sets.  All sets of n of the M known changes therefore share the
prior of n: p_s = p(n) / C(M, n), as J. Scott and J. Berger, Annals of Statistics 38(5), 2010,
doi:10.1214/10-AOS792.  An effect that contains narrower effects counts as two changes.  A refitted
H and a retuned G are changes without a name.  They belong to ``none of these``, as does a complete
model, n = 0.  A further change is `FURTHER` times as likely as the first.

Limits: only fitted sets have a weight; small effects, and effects with own tests, are not fitted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import math

import numpy as np
from piezo_ident.diagnosis.criteria import SMALLEST_EFFECT
from piezo_ident.diagnosis.results import UNNAMED
from piezo_ident.effects import catalogue, find_effect
from scipy.special import softmax

#: name of the last weight
NOTHING = 'none of these'
#: prior of no change, and ratio of the priors of n + 1 and of n changes (taste)
NONE, FURTHER = 0.5, 0.25
#: draws of the bootstrap: the standard error of a weight is 0.016 at most
DRAWS = 1000


def weights_of(errors: Mapping[tuple[str, ...], Sequence[float]]) -> dict[str, float]:
    """
    Compute the weight of each set of effects and of none, the largest first; their sum is one.

    Parameters
    ----------
    errors : mapping of tuple of str to sequence of float
        Errors of one or more sets, as `Diagnosis.errors_of_sets`, % of stroke.

    Examples
    --------
    >>> weights = weights_of({(): [1.0] * 8, ('creep',): [0.1] * 8, ('backlash',): [0.9] * 8})
    >>> [(cause, round(weight, 1)) for cause, weight in weights.items()]
    [('creep', 1.0), ('none of these', 0.0), ('backlash', 0.0)]
    """
    names = ['+'.join(x for x in s if x not in UNNAMED) or NOTHING for s in errors]
    squares = np.array(list(errors.values())) ** 2 + SMALLEST_EFFECT**2
    kinds = squares.shape[1]
    draws = np.random.default_rng(0).dirichlet(np.ones(kinds), DRAWS)
    powers = -0.5 * kinds * draws @ np.log(squares).T + np.log([_prior(s) for s in errors])
    weights = dict.fromkeys(names, 0.0)
    for name, w in zip(names, softmax(powers, axis=1).mean(axis=0), strict=True):
        weights[name] += float(w)
    # rounding must not leave a weight above one
    total = sum(weights.values())
    return {k: w / total for k, w in sorted(weights.items(), key=lambda item: -item[1])}


def _prior(changes: tuple[str, ...]) -> float:
    """Compute the prior of one set of changes."""
    n = sum(2 if x not in UNNAMED and find_effect(x).contains else 1 for x in changes)
    some = (1.0 - NONE) * (1.0 - FURTHER) * FURTHER ** (n - 1)
    return some / math.comb(len(catalogue()) + len(UNNAMED), n) if n else NONE
