# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The reference stage of Gu, Li, Zhu and Su (2016), doi:10.1109/TMECH.2015.2465868."""

from pathlib import Path

from piezo_ident.model.simulated_stage import SimulatedStage

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
