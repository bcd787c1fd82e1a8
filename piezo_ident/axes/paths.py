# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
What each input moves of each output, and by how much a model errs there.

An error pooled over all axes hides that of a small axis, and wholly that of a coupling: one of 1 %
may be missed altogether where the pooled error is 2 %.  All axes move at once, but each by random
phases of its own.  So the part of an error that follows one input stands out line by line, from
records that no fit has seen, and what varies around a line says how well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from piezo_ident.axes.frequency_response import excited_lines, neighbours
from piezo_ident.axes.loop_model import LoopModel
from piezo_ident.axes.periodic import PeriodicRecord
from piezo_ident.common.errors import DataError

#: neighbours on either side of a line, at least; degree of the polynomial
HALF_WIDTH, DEGREE = 4, 2
#: equations for each unknown of a line, at least
EQUATIONS = 1.5
#: standard deviations that a path, or an error, must stand out by
SURE = 3.0
#: a model that errs by more than this part of what a path moves does not tell the path
WRONG = 0.5


@dataclass(frozen=True)
class AxisError:
    """Free-run error of one output on records held out, in % of its rms and of its stroke."""

    output: str
    of_motion: float
    of_stroke: float

    def __str__(self) -> str:
        return f'{self.output}: {self.of_motion:.3g} % of rms, {self.of_stroke:.3g} % of stroke'


@dataclass(frozen=True)
class Path:
    """
    What one input moves of one output, about the same for all amplitudes.

    Attributes
    ----------
    input, output : str
    size : float
        rms of what the input moves, in % of the rms of the output; 0 where nothing shows.
    error : float
        rms of what the model errs by there, in % of the same; 0 where it is not seen to err.
    doubt : float
        Below so many % of the same nothing shows in these records.
    """

    input: str
    output: str
    size: float
    error: float
    doubt: float

    @property
    def seen(self) -> bool:
        """Whether the input is seen to move the output."""
        return self.size > self.doubt

    @property
    def most(self) -> float:
        """What the input may move at most, in % of the rms of the output."""
        return float(np.hypot(self.size, self.doubt))

    @property
    def wrong(self) -> bool:
        """Whether the model is seen not to tell what the input moves."""
        return self.error > max(self.doubt, WRONG * self.size)

    def __str__(self) -> str:
        if self.seen:
            share = max(self.error, self.doubt) / self.size
            most = '' if self.error > self.doubt else 'at most '
            return (
                f'{self.input} moves {self.output} by {self.size:.2g} % of its motion; the model '
                f'errs by {most}{100 * share:.0f} % of that'
            )
        return (
            f'{self.input} is not seen to move {self.output}, by less than {self.most:.2g} % of '
            'its motion'
        )


def axis_errors(
    model: LoopModel, records: Sequence[PeriodicRecord], outputs: Sequence[str]
) -> tuple[AxisError, ...]:
    """Judge every output alone on records held out, quadratic mean over the records."""
    errors = np.array([np.nanmean(model.error(r) ** 2, axis=0) for r in records])
    powers, strokes = (np.array([f(r.y[-1], axis=0) for r in records]) for f in (np.var, np.ptp))
    shares = 100 * np.sqrt(np.mean(errors / powers, axis=0))
    of_stroke = 100 * np.sqrt(np.mean(errors / strokes**2, axis=0))
    return tuple(
        AxisError(*x) for x in zip(outputs, shares.tolist(), of_stroke.tolist(), strict=True)
    )


def paths_of(
    model: LoopModel,
    records: Sequence[PeriodicRecord],
    inputs: Sequence[str],
    outputs: Sequence[str],
) -> tuple[Path, ...]:
    """
    Return every path from an input to an output of another axis, as records held out show it.

    Parameters
    ----------
    records : sequence of PeriodicRecord
        Each counts alike, whatever its amplitude.
    inputs, outputs : sequence of str
        What they are called: ``v_b`` is the input of the output ``y_b``.
    """
    lines = excited_lines(records)
    own = [[i for i, name in enumerate(inputs) if name[1:] == o[1:]] for o in outputs]
    rows = []
    for record in records:
        answer = model.simulate(record.u[-1])
        # what was lost is taken for what the model says
        error = np.nan_to_num(record.error(answer))
        alone = np.column_stack([_answer(model, record, part)[:, o] for o, part in enumerate(own)])
        signals = np.hstack([record.u[-1], error, answer + error - alone])
        signals /= np.sqrt(np.mean(record.u**2))
        rows.append(np.fft.rfft(signals, axis=0)[lines])
    u, answers = np.split(np.array(rows), [len(inputs)], axis=2)
    power = np.mean(np.abs(u) ** 2, axis=0)
    whole = np.mean([np.var(r.y[-1], axis=0) / np.mean(r.u**2) for r in records], axis=0)
    # of lines to the mean of squares over samples
    share = 2 * 1e4 / whole / records[0].u.shape[1] ** 2
    g, variance, width = _response(u, answers, lines)
    paths = []
    for i, name in enumerate(inputs):
        for o, output in enumerate(outputs):
            if i in own[o]:
                continue
            # what the model misses, and what is there beside its own answer to the other inputs
            columns = [o, o + len(outputs)]
            noise = variance[:, columns, i] * power[:, i, None]
            squares = np.sum(np.abs(g[:, columns, i]) ** 2 * power[:, i, None] - noise, axis=0)
            # lines that share neighbours err alike
            doubt = SURE * np.sqrt(width * np.sum(noise**2, axis=0)).max()
            error, size = np.sqrt(np.maximum(squares, 0) * share[o]).tolist()
            paths.append(Path(name, output, size, error, float(np.sqrt(doubt * share[o]))))
    return tuple(paths)


def _answer(
    model: LoopModel, record: PeriodicRecord, inputs: Sequence[int]
) -> NDArray[np.float64]:
    """Return what a model answers to some of the inputs."""
    u = np.zeros_like(record.u[-1])
    u[:, inputs] = record.u[-1][:, inputs]
    return model.simulate(u)


def _response(
    u: NDArray[np.complex128], y: NDArray[np.complex128], lines: NDArray[np.intp]
) -> tuple[NDArray[np.complex128], NDArray[np.float64], int]:
    """
    Return the response at each line, shape (k, outputs, inputs), and its variance.

    The last number is that of the lines which each is fitted to.
    """
    count, _, inputs = u.shape
    unknown = inputs * (DEGREE + 1)
    half_width = max(HALF_WIDTH, int(np.ceil((EQUATIONS * unknown / count - 1) / 2)))
    if 2 * half_width + 1 > len(lines):
        raise DataError(
            f'{len(lines)} lines do not tell what each of {inputs} inputs moves; play a multisine '
            'of more lines'
        )
    g = np.zeros((len(lines), y.shape[2], inputs), complex)
    variance = np.zeros(g.shape)
    for i in range(len(lines)):
        columns, near = neighbours(u, lines, i, half_width, DEGREE)
        right = y[:, near].reshape(-1, y.shape[2])
        solution = np.linalg.lstsq(columns, right, rcond=None)[0]
        left = np.sum(np.abs(right - columns @ solution) ** 2, axis=0)
        left /= len(columns) - unknown
        spread = np.real(np.diag(np.linalg.pinv(columns.conj().T @ columns)))[:inputs]
        g[i], variance[i] = solution[:inputs].T, left[:, None] * spread
    return g, variance, 2 * half_width + 1
