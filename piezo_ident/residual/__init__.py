# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What a model leaves: noise floor, lines, dependence and faults of the data."""

from piezo_ident.residual.analysis import (
    analyse,
    FrequencyRow,
    ResidualAnalysis,
    SegmentRow,
)
from piezo_ident.residual.dependence import Curve
from piezo_ident.residual.faults import FaultSearch, find_faults
from piezo_ident.residual.lines import find_lines, Line, LineSearch
from piezo_ident.residual.noise_floor import NoiseFloor, residual_noise_floor
from piezo_ident.residual.stretches import ResidualPart, Stretch, stretches_of
from piezo_ident.residual.whiteness import Coherence, CrossCorrelation, Whiteness

__all__ = [
    'Coherence',
    'CrossCorrelation',
    'Curve',
    'FaultSearch',
    'FrequencyRow',
    'Line',
    'LineSearch',
    'NoiseFloor',
    'ResidualAnalysis',
    'ResidualPart',
    'SegmentRow',
    'Stretch',
    'Whiteness',
    'analyse',
    'find_faults',
    'find_lines',
    'residual_noise_floor',
    'stretches_of',
]
