# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What the jobs of the identifier say beside the numbers."""

from dataclasses import replace
import json

import numpy as np
from piezo_ident.excitation.program import parse_program
from piezo_ident.identification.results import Settings
from piezo_ident.live.capture import Capture
from piezo_ident.model.simulated_stage import SimulatedStage
from piezo_ident.nodes.identifier.jobs import identify_capture
from piezo_ident.record.blocks import Samples
from programs import identification_program
import pytest

STAGE = SimulatedStage.load('paper')


@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_a_displacement_that_has_changed_its_sign_is_told(sign):
    program = identification_program(steps=8, cycles=4, frequency=100, noise=0.5, slope=100)
    (piece,) = STAGE.play(parse_program(program).build(), np.random.default_rng(0))
    capture = Capture()
    for s in piece.segments:
        rows = slice(s.start, s.stop)
        for key, x in (('voltage', piece.v), ('displacement', sign * piece.y)):
            capture.add(key, Samples(piece.t[rows], x[rows], s.label, key), s.start)
    settings = Settings(thresholds=3, max_order=2, solver='swarm', swarm_size=4)
    settings = replace(settings, swarm_iterations=100)
    outcome = identify_capture(
        capture.snapshot(), settings, 'all', None, STAGE.model, lambda *_: None
    )
    told = [w for w in json.loads(outcome.report)['warnings'] if 'sign' in w]
    assert len(told) == (sign < 0.0)
    if told:
        assert (
            outcome.warnings and f'{1e6 * outcome.identification.model.scaling.Y:.4g}' in told[0]
        )
