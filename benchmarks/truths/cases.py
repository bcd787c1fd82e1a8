# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The cases of the study, drawn by group and seed.

The stages of `sums` are sums of plays: each effect alone in three sizes, pairs, nothing, and
effects that are no candidates.  The stages of the other groups are of other families; every block
of 24 holds each kind in its share.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
import math

import numpy as np

from .families import SEALED
from .motion import POORER
from .table import EFFECTS, OUTSIDE

#: of the stages that are sums of plays, and the first of twenty seeds of those without an effect;
#: nobody looked at those of `sums` and `next-sums` before they were judged
SUM_SEEDS = {
    'sums': ((21, 22, 23), 41),
    'first-sums': ((1, 2, 3), 1),
    'next-sums': ((31, 32, 33), 71),
}
COLOURS = ('white', '1/f', '10-bit')
PAIRS = (
    ('creep', 'rate_dependent_hysteresis'),
    ('creep', 'periodic_disturbance'),
    ('creep', 'delay_change'),
    ('creep', 'saturation'),
    ('creep', 'changed_dynamics'),
    ('creep', 'cross_coupling'),
    ('creep', 'even_nonlinearity'),
    ('rate_dependent_hysteresis', 'periodic_disturbance'),
    ('rate_dependent_hysteresis', 'even_nonlinearity'),
    ('rate_dependent_hysteresis', 'cross_coupling'),
    ('even_nonlinearity', 'delay_change'),
    ('even_nonlinearity', 'periodic_disturbance'),
    ('saturation', 'periodic_disturbance'),
    ('saturation', 'changed_dynamics'),
    ('sensor_nonlinearity', 'creep'),
    ('sensor_nonlinearity', 'changed_dynamics'),
    ('noncongruent_minor_loops', 'creep'),
    ('input_feedthrough', 'creep'),
    ('preload_loss', 'periodic_disturbance'),
    ('cross_coupling', 'thermal_drift'),
)

#: of each set of other families: seed, cases, and its cores, as often as each is dealt.  `tuning`
#: and `known` may be looked at; nothing is tuned on the laws of `final` and `next`, and nobody
#: looked at the cases of `next`
SETS = {
    'next': (58300, 216, SEALED),
    'final': (41000, 216, SEALED),
    'known': (
        2800,
        216,
        (
            'hills',
            'hills',
            'kp-kernels',
            'jiles-atherton',
            'skewed-bouc-wen',
            'dahl',
            'turning-curves',
        ),
    ),
    'tuning': (15, 72, ('preisach', 'preisach', 'bouc-wen', 'duhem')),
}
#: how many cases a set has
CASES = {name: count for name, (_, count, _) in SETS.items()}
BLOCK = 24
#: of a block: nothing hidden, pairs, faults of the data; the rest has one effect
NOTHING, PAIRED, FAULTY = 6, 2, 2
FAULTS = ('stuck', 'repeated', 'jitter', 'outliers', 'clipping')
#: of those, which are common to effects that no record of some seconds tells from one another
SAME = (('thermal_drift', 'gain_drift'), ('amplifier_lag', 'delay_change'))


@dataclass(frozen=True)
class SumCase:
    """A sum of plays, what is hidden in it, and the candidates that are taken out."""

    kind: str
    effects: tuple[str, ...]
    size: float
    seed: int
    noise: str = 'white'
    without: tuple[str, ...] = ()

    @property
    def key(self) -> str:
        """Return a name for the file."""
        parts = [self.kind, '+'.join(self.effects), f'{self.size:g}', str(self.seed), self.noise]
        return ' '.join(parts)


def sum_cases(group: str = 'sums') -> Iterator[SumCase]:
    """Yield every case of a group of `SUM_SEEDS`, the telling ones first."""
    seeds, first = SUM_SEEDS[group]
    for k, seed in enumerate(seeds):
        for effect in EFFECTS:
            yield SumCase('one', (effect,), 0.3, seed)
        for number in range(first + k, first + 20, len(seeds)):
            for noise in COLOURS:
                yield SumCase('none', (), 0.0, number, noise)
        for effect in EFFECTS:
            yield SumCase('removed', (effect,), 0.3, seed, without=(effect,))
        for effect in OUTSIDE:
            yield SumCase('outside', (effect,), 0.3, seed)
        for size in (0.1, 1.0):
            for effect in EFFECTS:
                yield SumCase('one', (effect,), size, seed)
    for pair in PAIRS:
        yield SumCase('pair', pair, 0.3, seeds[0])


@dataclass(frozen=True)
class Case:
    """
    A stage of another family, what is hidden in it, and how it is measured.

    `group`: one of `SETS`; `kind`: {'none', 'one', 'pair', 'fault'}; `factors`: wanted size of
    each effect, in parts of the core's misfit; `fault`: one of `FAULTS`, or nothing; `poorer`:
    what the diagnosis record lacks, or nothing; `idle_channel`: whether another axis is recorded
    that does not couple.
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
    first, n, cores = SETS[group]
    rng = np.random.default_rng([4405, first])

    def dealt(items: list[str], count: int) -> list[str]:
        cards: list[str] = []
        while len(cards) < count:
            cards += [items[i] for i in rng.permutation(len(items))]
        return cards[:count]

    one = BLOCK - NOTHING - PAIRED - FAULTY
    kinds = ['none'] * NOTHING + ['pair'] * PAIRED + ['fault'] * FAULTY + ['one'] * one
    return {
        'kind': dealt(kinds, n),
        'core': dealt(list(cores), n),
        'way': dealt(['labelled', 'labelled', 'unlabelled'], n),
        'effect': dealt(list(EFFECTS), n),
        'fault': dealt(list(FAULTS), n),
        'size': dealt(['large', 'large', 'small'], n),
    }


def draw(group: str, number: int) -> Case:
    """
    Return a case.

    `group`: one of `SETS`; `number`: 0 .. ``CASES[group] - 1``.
    """
    decks = _decks(group)
    seed = 1000 * SETS[group][0] + number
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
