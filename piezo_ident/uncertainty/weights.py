# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Weigh the candidates of a diagnosis by their errors on kinds of motion that were held out.

A set s of effects leaves the mean square E_s on N kinds of motion held out.  A kind counts as one
observation of unknown size.  The weight of the set is

    w_s = p_s (E_s / T^n)^(-N/2) / sum of all,

pseudo Bayesian model averaging: Y. Yao, A. Vehtari, D. Simpson and A. Gelman, "Using stacking to
average Bayesian predictive distributions", Bayesian Analysis 13(3), 2018, doi:10.1214/17-BA1091.

T is `TAKES`: an effect that leaves more than this share has taken the error of another law.  n is
the number of effects; an effect that contains narrower effects counts twice.  ``none of these``,
n = 0, stands for a complete model, and for a cause outside of the catalogue.  Its prior is `NONE`.
A further effect is `FURTHER` times as likely as the first effect, and sets of one size are equally
likely.

Limits: the number of kinds bounds how well E_s is known, and only sets that the search fitted are
compared.  Effects with tests of their own, such as hum, have no weight.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from piezo_ident.diagnosis.criteria import TAKES
from piezo_ident.effects import find_effect

#: name of the last weight
NOTHING = 'none of these'
#: prior of none, and ratio of the priors of sets with one effect more (taste)
NONE, FURTHER = 0.5, 0.25
#: number of parts of a record that replace kinds of motion
PARTS = 5


def weights_of(errors: Mapping[tuple[str, ...], float], kinds: int) -> dict[str, float]:
    """
    Compute the weight of each set of effects and of none, the largest first; their sum is one.

    Parameters
    ----------
    errors : mapping of tuple of str to float
        Rms error that the best candidate of each set leaves; the empty set has no effect.
    kinds : int
        Number of kinds of motion that were held out; 0 if parts of the data replaced them.

    Examples
    --------
    >>> weights = weights_of({(): 1.0, ('creep',): 0.1, ('backlash',): 0.9}, 8)
    >>> {cause: round(weight, 3) for cause, weight in weights.items()}
    {'creep': 1.0, 'none of these': 0.0, 'backlash': 0.0}
    """
    sizes = [len(s) for s in errors if s]
    whole = sum(FURTHER**n for n in set(sizes)) or 1.0
    logs = {}
    for effects, error in errors.items():
        n, square = len(effects), max(error**2, np.finfo(float).tiny)
        prior = (1.0 - NONE) * FURTHER**n / whole / sizes.count(n) if n else NONE
        power = -0.5 * (kinds or PARTS)
        steps = n + sum(bool(find_effect(name).contains) for name in effects)
        logs['+'.join(effects) or NOTHING] = np.log(prior) + power * np.log(square / TAKES**steps)
    most = max(logs.values(), default=0.0)
    raw = {name: float(np.exp(x - most)) for name, x in logs.items()}
    total = sum(raw.values())
    return {k: x / total for k, x in sorted(raw.items(), key=lambda item: -item[1])}
