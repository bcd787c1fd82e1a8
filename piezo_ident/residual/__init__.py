# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What is left when a model has said what it knows: floor, lines, dependence and faults."""

from piezo_ident.residual.analysis import analyse, ResidualAnalysis
from piezo_ident.residual.dependence import Curve
from piezo_ident.residual.faults import FaultSearch, find_faults
from piezo_ident.residual.floor import noise_floor, NoiseFloor
from piezo_ident.residual.lines import find_lines, Line, LineSearch
from piezo_ident.residual.stretches import ResidualPart, Stretch, stretches_of
from piezo_ident.residual.tables import FrequencyRow, RecordRow, SegmentRow
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
    'RecordRow',
    'ResidualAnalysis',
    'ResidualPart',
    'SegmentRow',
    'Stretch',
    'Whiteness',
    'analyse',
    'find_faults',
    'find_lines',
    'noise_floor',
    'stretches_of',
]
