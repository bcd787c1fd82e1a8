# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""MATLAB files are read in this process; test_hostile_files of the commands has the child."""

import io

from piezo_ident.record.tables import arrays, mat_read
import pytest


@pytest.fixture(autouse=True)
def _no_child(monkeypatch):
    def read_variables(path, wanted, needed):
        sent, asked = io.BytesIO(), '*' if needed is None else ','.join(needed)
        try:
            mat_read._send(mat_read._read(str(path), wanted, asked), sent)
        except Exception as error:  # noqa: BLE001
            raise ValueError(' '.join(str(error).split())) from None
        sent.seek(0)
        return mat_read._received(sent)

    monkeypatch.setattr(arrays, 'read_variables', read_variables)
