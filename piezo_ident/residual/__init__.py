# Copyright 2026 The piezo_ident authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

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
