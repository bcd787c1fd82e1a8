# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A quick part of the study of any record: short records, the best peer, and the inverse."""

import warnings

import any_record as study
import bouc_wen
import numpy as np
import pytest

SECONDS = 1.5


@pytest.fixture(scope='module')
def identified():
    """Return case and model of records that differ in kind and in law."""
    cases = (('preisach', 'noise, small'), ('duhem', 'triangles'))
    drawn = [study.draw(law, kind, 3, SECONDS) for law, kind in cases]
    return [(case, study.program(case.fit)) for case in drawn]


def test_no_peer_errs_clearly_less(identified):
    for case, model in identified:
        with warnings.catch_warnings():
            warnings.simplefilter('ignore', UserWarning)
            own = study.percent(model.simulate, case.judge)
            peers = [study.percent(peer(case.fit), case.judge) for peer in study.PEERS]
        assert own <= 1.05 * min(peers), case.kind


def test_H_rises_and_the_inverse_asks_for_no_jump(identified):
    for case, model in identified:
        assert study.drive_fault(model, np.random.default_rng(0)) == '', case.kind


def test_the_bouc_wen_spring_is_that_of_the_benchmark():
    u, y = bouc_wen.records(1)['multisine']
    # published: 50 N rms make 0.67 mm rms
    assert u.std() == pytest.approx(50.0, rel=0.01)
    assert y[bouc_wen.PERIOD :].std() == pytest.approx(6.7e-4, rel=0.05)
