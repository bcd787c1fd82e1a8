# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
How the modes of a stage change with the amplitude: frequency and damping, group by group.

One modal model is refined on the response of each group, so a mode keeps its place and can be
followed from amplitude to amplitude.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.arrays import Array
from piezo_ident.fitting.modes.frequency_response import excited_lines, frequency_response
from piezo_ident.fitting.modes.linear_fit import refined
from piezo_ident.fitting.modes.periods import groups, PeriodicRecord
from piezo_ident.model.modes.modal import Modal

#: modes nearer than this part of their frequency trade places from fit to fit: neither is followed
APART = 0.02
#: unless the peak of the other is below this part of its own
FAINT = 0.1
#: most modes that are followed, and steps of the fit to each group
COUNT, STEPS = 6, 8


@dataclass(frozen=True, eq=False)
class AmplitudeDependence:
    """
    Modes by group.

    `voltage`: rms of the voltages; `frequency`, `damping`: in Hz, and as a ratio.
    """

    groups: tuple[str, ...]
    voltage: Array
    frequency: Array
    damping: Array


def amplitude_dependence(start: Modal, records: Sequence[PeriodicRecord]) -> AmplitudeDependence:
    """
    Follow the strongest modes of a model that stand alone through the groups of records.

    `start`: A model of any of the groups.
    """
    parts = groups(records)
    rate = records[0].rate
    highest = float(excited_lines(records).max()) * rate / len(records[0].mean_u)
    places = _strongest(start, rate, highest)
    frequency, damping = [], []
    for part in parts.values():
        model = refined(start, frequency_response(part), iterations=STEPS)
        s = _poles(model, rate)[places]
        frequency.append(np.abs(s) / (2 * np.pi))
        damping.append(-s.real / np.abs(s))
    return AmplitudeDependence(
        tuple(parts),
        np.array([np.sqrt(np.mean([np.mean(r.u**2) for r in part])) for part in parts.values()]),
        np.array(frequency),
        np.array(damping),
    )


def _poles(model: Modal, rate: float) -> NDArray[np.complex128]:
    """Return s of each block, in 1/s."""
    return np.asarray(np.log(model.blocks[:, 0, 0] + 1j * model.blocks[:, 0, 1]) * rate)


def _strongest(model: Modal, rate: float, highest: float) -> NDArray[np.intp]:
    """Return the blocks of the modes with the largest peaks in the driven band, by frequency."""
    s = _poles(model, rate)
    size = np.linalg.norm(model.b.reshape(len(s), -1), axis=1) * np.sqrt(
        (model.c**2).sum(axis=0).reshape(-1, 2).sum(axis=1)
    )
    peak = np.where(model.oscillates, size / np.abs(s.real), 0)
    near = np.abs(s.imag[:, None] - s.imag) < APART * s.imag[:, None]
    np.fill_diagonal(near, False)
    alone = ~(near & (peak > FAINT * peak[:, None])).any(axis=1)
    # beyond the lines a mode stands for all that is there
    peak = np.where(alone & (np.abs(s.imag) < 2 * np.pi * highest), peak, 0)
    chosen = np.argsort(-peak)[: min(COUNT, int((peak > 0).sum()))]
    return np.asarray(chosen[np.argsort(s.imag[chosen])])
