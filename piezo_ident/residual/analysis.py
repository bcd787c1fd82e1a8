# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""One result with everything that the pictures of a residual show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from piezo_ident.common.errors import DataError
from piezo_ident.residual.coherence import Coherence, coherence
from piezo_ident.residual.dependence import Curve, curves_of
from piezo_ident.residual.faults import find_faults
from piezo_ident.residual.lines import find_lines, Line, without_lines
from piezo_ident.residual.noise_floor import NoiseFloor, residual_noise_floor
from piezo_ident.residual.stretches import all_stretches, ResidualPart


@dataclass(frozen=True, eq=False)
class ResidualAnalysis:
    """Noise floor, lines, curves and coherence of the residual of some parts."""

    parts: tuple[ResidualPart, ...]
    floor: NoiseFloor
    lines: tuple[Line, ...]
    curves: tuple[Curve, ...]
    coherence: Coherence | None


def analyse(parts: Sequence[ResidualPart]) -> ResidualAnalysis:
    """
    Analyse the residual of a model without its outliers and clipped readings.

    DataError if there is no sound sample.
    """
    if not any(part.mask.any() for part in parts):
        raise DataError('no sample of the residual is sound; give a record with sound samples')
    faults = find_faults(parts)
    clean = [
        ResidualPart(p.record, p.piece, p.e, p.mask & ~bad)
        for p, bad in zip(parts, faults.bad, strict=True)
    ]
    stretches = all_stretches(clean)
    lines = find_lines(clean, stretches).lines
    # a line is no noise: a model may carry it
    quiet = [without_lines(part, lines) for part in clean]
    return ResidualAnalysis(
        parts=tuple(parts),
        floor=residual_noise_floor(quiet, stretches),
        lines=lines,
        curves=curves_of(quiet, stretches),
        coherence=coherence(clean),
    )
