# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The reference stage of Gu, Li, Zhu and Su (2016), doi:10.1109/TMECH.2015.2465868."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from piezo_ident.model.simulated_stage import SimulatedStage
from piezo_ident.model.stage_model import StageModel
from piezo_ident.operators.dynamics import Dynamics

CONFIG = Path(__file__).resolve().parents[1] / 'config'
STAGE = SimulatedStage.load(CONFIG / 'stage_paper.yaml')
PAPER = STAGE.model
FS = 20_000.0

A = [-1.5157, 0.3685, 0.5132, 0.02363, -0.09831, -0.2931, 0.0842, 0.2921, -0.2582, 0.05803]
B = [
    0.02146,
    0.02553,
    0.01495,
    -0.001324,
    0.001639,
    0.01780,
    0.02112,
    0.01059,
    0.001185,
    -0.001171,
]


def with_mode(frequency: float) -> StageModel:
    """Return the stage with a G of one mode, damped by 1 %."""
    poles = np.exp(2 * np.pi * frequency / FS * np.array([-0.01 + 1j, -0.01 - 1j]))
    G = Dynamics(np.real(np.poly(poles))[1:], np.ones(1)).normalised()
    return replace(PAPER, dynamics=G)
