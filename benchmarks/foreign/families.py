# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The families of cores of each set."""

from __future__ import annotations

from .cores import bouc_wen, coleman_hodgdon, uneven
from .more_cores import (
    dahl,
    hills,
    jiles_atherton,
    krasnoselskii_pokrovskii,
    skewed_bouc_wen,
    turning_curves,
)
from .sealed_cores import dragged_moments, gap_shares, loaded_sliders, random_bonds

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
    'dragged-moments': dragged_moments,
    'gap-shares': gap_shares,
    'loaded-sliders': loaded_sliders,
    'random-bonds': random_bonds,
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
    'final': ('dragged-moments', 'gap-shares', 'loaded-sliders', 'random-bonds'),
}
