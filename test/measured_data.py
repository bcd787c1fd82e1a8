# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Measured records, which are no part of the package; a test that needs one is skipped without."""

import os
from pathlib import Path

import piezo_ident as pi
from piezo_ident.record.record import Record
import pytest

#: where they are
DATA = Path(
    os.environ.get('PIEZO_IDENT_DATA', Path(__file__).resolve().parents[2] / 'shared/data')
)


def measured_record(name: str) -> Record:
    path = DATA / name
    if not path.is_file():
        pytest.skip(f'{path} is not there; set PIEZO_IDENT_DATA to the folder of measured records')
    return pi.read(path)
