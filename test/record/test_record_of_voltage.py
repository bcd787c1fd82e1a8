# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A record of voltage alone serves a prediction and nothing else."""

import numpy as np
import piezo_ident as pi
from piezo_ident.record.record import Piece
import pytest


def test_what_needs_a_displacement_refuses_a_voltage_alone():
    model = pi.SimulatedStage.load('paper').model
    v = 5 - 5 * np.cos(np.arange(4000) / 100)
    record = pi.Record((Piece(v, np.full(v.size, np.nan), 20_000.0),), 'scan')
    for use in (
        lambda: pi.identify(record),
        lambda: pi.diagnose(model, record),
        lambda: pi.free_run(model, record),
    ):
        with pytest.raises(pi.DataError, match=r'scan.*no displacement'):
            use()
    assert np.isfinite(model.simulate(v)).all()
