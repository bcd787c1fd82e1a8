# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The families of cores of each set."""

from __future__ import annotations

from .collective_cores import (
    frustrated_dipoles,
    loaded_contacts,
    moving_preisach,
    rugged_walls,
    turning_friction,
)
from .cores import bouc_wen, coleman_hodgdon, uneven
from .more_cores import (
    dahl,
    hills,
    jiles_atherton,
    krasnoselskii_pokrovskii,
    skewed_bouc_wen,
    turning_curves,
)
from .unseen_cores import (
    back_stresses,
    growing_domains,
    phase_fractions,
    rotating_grains,
    tetragonal_grains,
)

__all__ = ['LAWS', 'SETS']

LAWS = {
    'preisach': uneven,
    'bouc-wen': bouc_wen,
    'duhem': coleman_hodgdon,
    'hills': hills,
    'kp-kernels': krasnoselskii_pokrovskii,
    'jiles-atherton': jiles_atherton,
    'skewed-bouc-wen': skewed_bouc_wen,
    'dahl': dahl,
    'turning-curves': turning_curves,
    'moving-preisach': moving_preisach,
    'loaded-contacts': loaded_contacts,
    'turning-friction': turning_friction,
    'rugged-walls': rugged_walls,
    'frustrated-dipoles': frustrated_dipoles,
    'back-stresses': back_stresses,
    'growing-domains': growing_domains,
    'phase-fractions': phase_fractions,
    'rotating-grains': rotating_grains,
    'tetragonal-grains': tetragonal_grains,
}

#: how often each is dealt; the laws of 'final' are for judging alone, all others may be looked at
SETS = {
    'tuning': ('preisach', 'preisach', 'bouc-wen', 'duhem'),
    'known': (
        'hills',
        'hills',
        'kp-kernels',
        'jiles-atherton',
        'skewed-bouc-wen',
        'dahl',
        'turning-curves',
    ),
    'past': (
        'moving-preisach',
        'loaded-contacts',
        'turning-friction',
        'rugged-walls',
        'frustrated-dipoles',
    ),
    'final': (
        'back-stresses',
        'growing-domains',
        'phase-fractions',
        'rotating-grains',
        'tetragonal-grains',
    ),
}
