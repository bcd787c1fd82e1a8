# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A small stage with records and a model, which tests of the command line only read."""

from pathlib import Path

from piezo_ident.cli import main
from programs import SLOW_PROGRAM
import pytest

# a stage with one slow mode at 2 kHz, so that an identification takes a moment only
STAGE = """\
schema_version: 1
sample_rate: 2000.0
input: {v0: 0.0, V: 10.0, range: [0.0, 10.0]}
output: {y0: 0.0, Y: 75.0e-6}
delay: {samples: 2}
hysteresis: {thresholds: [0.2, 0.4, 0.6], weights: [0.3, 0.2, 0.1], p1: -0.2, p2: 0.9}
dynamics: {a: [-1.2, 0.5], b: [0.2, 0.1]}
sensor: {noise_rms: 1.0e-9}
seed: 7
"""
SINE = """\
limits: [0, 10]
segments:
  - {signal: sine, bias: 5, amplitude: 5, frequency: 5, duration: 2}
"""


@pytest.fixture(autouse=True)
def _blank(blank_pictures):
    """Render no picture of a report: what renders them has tests of its own."""


@pytest.fixture(scope='session')
def made(tmp_path_factory) -> Path:
    """Return a folder with a stage, its record, a record of a sine and the model."""
    folder = tmp_path_factory.mktemp('made')
    (folder / 'stage.yaml').write_text(STAGE)
    (folder / 'program.yaml').write_text(SLOW_PROGRAM)
    (folder / 'sine.yaml').write_text(SINE)
    for program, out in (('program.yaml', 'record.npz'), ('sine.yaml', 'sine.csv')):
        files = ['--config', folder / 'stage.yaml', '--program', folder / program, folder / out]
        assert main(['simulate', *map(str, files)]) == 0
    argv = [
        'identify',
        folder / 'record.npz',
        '--model',
        folder / 'model.yaml',
        '--order',
        '2,2',
        '--thresholds',
        '5',
    ]
    assert main([str(a) for a in argv]) == 0
    return folder
