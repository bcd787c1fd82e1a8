# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Assign blocks to kinds of motion, which are held out as a whole; collect errors by segment."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from piezo_ident.common.arrays import Array, Integers, Mask
from piezo_ident.diagnosis.criteria import MOVED_ZERO
from piezo_ident.model.initial_memory import fit_start
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.record import Piece
from piezo_ident.selection.judged import JudgedRun
from piezo_ident.selection.motion_kinds import description, interleaved, KINDS, kinds_of

#: largest number of kinds of motion that are held out in turn
GROUPS = 8
#: names of a kind that joins small kinds, of a part of a single kind, and of blocks whose command
#: moves alike
REST, PART, ALIKE = 'the rest', ', part ', 'motion that is alike'


def are_parts(labels: Sequence[str]) -> bool:
    """Return whether the names of kinds are not labels of the user."""
    return all(x in (REST, ALIKE) or PART in x for x in labels)


def stretches(record: str, piece: Piece, m: int = 1) -> list[tuple[str, int, int]]:
    """Return label, first row and end of the segments of a piece; each row is in a segment."""
    n = piece.n // m
    if not piece.segments:
        # without labels, parts of the time stand for kinds
        edges = np.linspace(0, n, GROUPS + 1).astype(int)
        names = [f'{record}{PART}{i + 1}' for i in range(GROUPS)]
        return [
            (name, a, b) for name, a, b in zip(names, edges[:-1], edges[1:], strict=True) if b > a
        ]
    found: list[tuple[str, int, int]] = []
    end = 0
    for s in piece.segments:
        start, stop = max(end, s.start // m), min(n, s.stop // m)
        if start > end:
            found.append(('ramp', end, start))
        if stop > start:
            found.append((s.label, start, stop))
            end = stop
    if end < n:
        found.append(('ramp', end, n))
    return found


def errors_of_segments(runs: Iterable[JudgedRun]) -> dict[str, Array]:
    """Collect the errors that count, of all runs together, by the label of their segment [m]."""
    found = dict[str, list[Array]]()
    for run in runs:
        for label, start, stop in stretches(run.record, run.piece):
            found.setdefault(label, []).append(run.error[start:stop][run.use[start:stop]])
    return {label: np.concatenate(parts) for label, parts in found.items()}


def unseen_runs(
    model: StageModel, parts: Iterable[tuple[str, Piece, Mask, float]]
) -> list[JudgedRun]:
    """Run a model as on unseen records, at the known or clearly moved zero of each."""
    runs = []
    for record, piece, use, zero in parts:
        y = model.predict_piece(piece, fit_start(model, piece, use)) + zero
        runs.append(JudgedRun(record, piece, y, use, np.zeros(y.size, dtype=bool)))
    moved = {}
    for name in {run.record for run in runs}:
        e = np.concatenate([run.error[run.use] for run in runs if run.record == name])
        is_clear = e.size and abs(e.mean()) > MOVED_ZERO * e.std()
        moved[name] = float(e.mean()) if is_clear else 0.0
    return [replace(run, predicted=run.predicted + moved[run.record]) for run in runs]


def excess(runs: Sequence[JudgedRun], held_out: Mapping[str, float]) -> dict[str, float]:
    """Compute by how much held-out squared errors exceed fitted ones, by segment [m^2]."""
    return {
        label: max(held_out[label] - float(e.var()), 0.0)
        for label, e in errors_of_segments(runs).items()
        if label in held_out
    }


def held_out_kinds(
    labels: Sequence[str], commands: Sequence[Array]
) -> tuple[Integers, tuple[str, ...]]:
    """
    Assign each block to a kind of motion, shape (blocks,), and name the kinds.

    `labels` holds the label of each block, and `commands` its rows.  A kind is a label, and the
    smallest kinds are joined.  Clusters by mean, size and speed of the command replace missing
    labels.  Parts of the time replace the clusters if these are too few.
    """
    size: Counter[str] = Counter()
    for label, u in zip(labels, commands, strict=True):
        size[label] += u.size
    large = [label for label, _ in size.most_common()]
    large = [label for label in large if label.partition(':')[0] not in ('idle', 'ramp')]
    names = large if len(large) < GROUPS else large[: GROUPS - 1]
    number = {label: i for i, label in enumerate(names)}
    rest = len(names)
    group = np.array([number.get(label, rest) for label in labels])
    if np.any(group == rest):
        names = [*names, REST]
    few = all(PART in name for name in names) and len(names) < GROUPS // 2
    if all(PART in name or name == REST for name in names) or len(names) == 1:
        found = _by_command(commands)
        if found is not None:
            return found
    if len(names) == 1 or few:
        # one kind, or few judged parts, would leave no data to predict from
        whole = ' and '.join(dict.fromkeys(name.partition(PART)[0] for name in names))
        group = np.arange(group.size) * GROUPS // group.size
        names = [f'{whole}{PART}{i + 1}' for i in range(int(group.max()) + 1)]
    return group, tuple(names)


def _by_command(commands: Sequence[Array]) -> tuple[Integers, tuple[str, ...]] | None:
    """Assign each block to a kind by its command, if the command has enough kinds."""
    kinds = kinds_of(np.array([description(u) for u in commands]))
    if kinds is None:
        return None
    # kinds at the edge of mean, size or speed would require extrapolation: they are interleaved
    sets = KINDS + interleaved(kinds.size)
    group = np.unique(np.where(kinds < 0, sets, kinds), return_inverse=True)[1]
    return group, (ALIKE,) * (int(group.max()) + 1)
