# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
What `bench_growth` measures of bags: writing, reading, converting and predicting them.

Each function takes a length [s] and a folder, in which `writing` has left a bag of that length,
and returns a time [s] and the number of samples.
"""

from __future__ import annotations

from collections.abc import Callable
import contextlib
import io
from pathlib import Path
import time

import numpy as np
from piezo_ident.cli import main as piezo_ident
from piezo_ident.model.simulated_stage import SimulatedStage
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.bags.read import read_bag
from piezo_ident.record.bags.write import write_bag
from piezo_ident.record.record import Piece, Record

RATE = 20_000.0
#: bytes that a second of voltage and displacement takes in a bag, and how much must stay free
BAG_BYTES, SPARE = 2 * 16 * RATE * 1.1, 4e9

Measure = tuple[float, float]


def paper() -> StageModel:
    """Return the paper's stage."""
    return SimulatedStage.load('paper').model


def sine(n: int, model: StageModel) -> Piece:
    """Return a record of a 50 Hz sine without its answer."""
    v = 5.0 + 5.0 * np.sin(2 * np.pi * 50.0 * np.arange(n) / RATE)
    return Piece(v, np.zeros(n), model.sample_rate)


def writing(size: float, folder: Path) -> Measure:
    """Write a record as a bag."""
    model = paper()

    def record(n: int) -> Record:
        piece = sine(n, model)
        return Record((Piece(piece.v, model.predict_piece(piece), RATE),), 'long')

    # what the next measures warm up on as well
    write_bag(record(20_000), folder / 'short', overwrite=True)
    long = record(round(size * RATE))
    start = time.perf_counter()
    write_bag(long, folder / f'bag_{size:g}', overwrite=True)
    return time.perf_counter() - start, long.n


def reading(size: float, folder: Path) -> Measure:
    """Read a bag into a record."""
    read_bag(folder / 'short')
    start = time.perf_counter()
    record = read_bag(folder / f'bag_{size:g}')
    return time.perf_counter() - start, record.n


def converting(size: float, folder: Path) -> Measure:
    """Measure ``piezo_ident convert BAG OUT.npz``."""
    return _command(size, folder, lambda bag, out: ['convert', bag, out])


def predicting(size: float, folder: Path) -> Measure:
    """Measure ``piezo_ident predict MODEL BAG --out OUT.npz``."""
    model = folder / 'paper.yaml'
    paper().save(model)
    return _command(size, folder, lambda bag, out: ['predict', str(model), bag, '--out', out])


def _command(size: float, folder: Path, arguments: Callable[[str, str], list[str]]) -> Measure:
    out = folder / 'out.npz'
    took = 0.0
    for bag in ('short', f'bag_{size:g}'):
        start = time.perf_counter()
        with contextlib.redirect_stdout(io.StringIO()) as output:
            status = piezo_ident([*arguments(str(folder / bag), str(out))])
        took = time.perf_counter() - start
        if status:
            raise RuntimeError(output.getvalue())
        out.unlink()
    return took, round(size * RATE)


#: by the name with which `bench_growth` measures them
BAG_MEASURES: dict[str, Callable[[float, Path], Measure]] = {
    'write': writing,
    'read': reading,
    'convert': converting,
    'predict_bag': predicting,
}
