# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The cases of the study, dealt by seed: every block of 24 holds each kind in its share."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
import math

import numpy as np
from truths.table import EFFECTS

from .families import SETS
from .motion import POORER

#: how many cases a set has
CASES = {'tuning': 72, 'known': 216, 'final': 216}
BLOCK = 24
#: of a block: nothing hidden, pairs, faults of the data; the rest has one effect
NOTHING, PAIRS, FAULTY = 6, 2, 2
FAULTS = ('stuck', 'repeated', 'jitter', 'outliers', 'clipping')
#: of those, which are common to effects that no record of some seconds tells from one another
SAME = (('thermal_drift', 'gain_drift'), ('amplifier_lag', 'delay_change'))
SEEDS = {'tuning': 15, 'known': 2800, 'final': 41000}


@dataclass(frozen=True)
class Case:
    """
    One stage, what is hidden in it, and how it is measured.

    Attributes
    ----------
    group : {'tuning', 'known', 'final'}
    number : int
    core : str
    kind : {'none', 'one', 'pair', 'fault'}
    effects : tuple of str
    factors : tuple of float
        Wanted size of each effect, in parts of the core's misfit.
    fault : str
        One of `FAULTS`, or nothing.
    labelled : bool
    poorer : str
        What the diagnosis record lacks, or nothing.
    idle_channel : bool
        Whether another axis is recorded that does not couple.
    seed : int
    """

    group: str
    number: int
    core: str
    kind: str
    effects: tuple[str, ...]
    factors: tuple[float, ...]
    fault: str
    labelled: bool
    poorer: str
    idle_channel: bool
    seed: int

    @property
    def key(self) -> str:
        """Return a name for people and files."""
        hidden = '+'.join(self.effects) or self.fault or 'nothing'
        way = 'labelled' if self.labelled else 'unlabelled'
        return f'{self.group}-{self.number:03d} {self.core} {hidden} {way}'


@cache
def _decks(group: str) -> dict[str, list[str]]:
    """Return the dealt kinds, cores, effects, faults and ways of a set."""
    rng = np.random.default_rng([4405, SEEDS[group]])
    blocks = CASES[group] // BLOCK

    def dealt(items: list[str], count: int) -> list[str]:
        cards: list[str] = []
        while len(cards) < count:
            cards += [items[i] for i in rng.permutation(len(items))]
        return cards[:count]

    one = BLOCK - NOTHING - PAIRS - FAULTY
    kinds = ['none'] * NOTHING + ['pair'] * PAIRS + ['fault'] * FAULTY + ['one'] * one
    n = blocks * BLOCK
    return {
        'kind': dealt(kinds, n),
        'core': dealt(list(SETS[group]), n),
        'way': dealt(['labelled', 'labelled', 'unlabelled'], n),
        'effect': dealt(list(EFFECTS), n),
        'fault': dealt(list(FAULTS), n),
        'size': dealt(['large', 'large', 'small'], n),
    }


def draw(group: str, number: int) -> Case:
    """
    Return a case.

    Parameters
    ----------
    group : {'tuning', 'known', 'final'}
    number : int
        0 .. ``CASES[group] - 1``.
    """
    decks = _decks(group)
    seed = 1000 * SEEDS[group] + number
    rng = np.random.default_rng([90210, seed])
    kind = decks['kind'][number]
    before = decks['kind'][:number]
    effects: tuple[str, ...] = ()
    if kind == 'one':
        effects = (decks['effect'][before.count('one')],)
    elif kind == 'pair':
        while len(effects) != 2 or effects in SAME or effects[::-1] in SAME:
            effects = tuple(str(x) for x in rng.choice(EFFECTS, 2, replace=False))
    factors = tuple(
        # two thirds above the misfit of the core, evenly in their logarithm
        math.exp(rng.uniform(math.log(1.05), math.log(3.0)))
        if decks['size'][(number + i) % len(decks['size'])] == 'large'
        else rng.uniform(0.3, 0.9)
        for i in range(len(effects))
    )
    return Case(
        group=group,
        number=number,
        core=decks['core'][number],
        kind=kind,
        effects=effects,
        factors=factors,
        fault=decks['fault'][before.count('fault')] if kind == 'fault' else '',
        labelled=decks['way'][number] == 'labelled',
        poorer=str(rng.choice(POORER)) if rng.random() < 0.2 else '',
        idle_channel='cross_coupling' not in effects and rng.random() < 0.15,
        seed=seed,
    )
