# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The families of cores of each set."""

from __future__ import annotations

from .cores import bouc_wen, coleman_hodgdon, uneven

__all__ = ['LAWS', 'SETS']

LAWS = {'preisach': uneven, 'bouc-wen': bouc_wen, 'duhem': coleman_hodgdon}

#: how often each is dealt
SETS = {
    'tuning': ('preisach', 'preisach', 'bouc-wen', 'duhem'),
}
