# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Noise floor, lines, dependence and faults of the data in the residual of a model."""

from piezo_ident.residual.analysis import analyse, Curve, ResidualAnalysis
from piezo_ident.residual.beyond_drive import channel_tests, ChannelTest, without_channels
from piezo_ident.residual.faults import find_faults
from piezo_ident.residual.lines import find_lines, LineSearch, without_lines
from piezo_ident.residual.noise_floor import NoiseFloor, residual_noise_floor
from piezo_ident.residual.stretches import all_stretches, ResidualPart

__all__ = [
    'ChannelTest',
    'Curve',
    'LineSearch',
    'NoiseFloor',
    'ResidualAnalysis',
    'ResidualPart',
    'all_stretches',
    'analyse',
    'channel_tests',
    'find_faults',
    'find_lines',
    'residual_noise_floor',
    'without_channels',
    'without_lines',
]
