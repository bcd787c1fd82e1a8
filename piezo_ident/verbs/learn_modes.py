# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Add modes that axes share to an identification, and judge such modes in a diagnosis."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from piezo_ident.common.arrays import Array, Mask
from piezo_ident.common.errors import ModelError
from piezo_ident.diagnosis.criteria import SMALLEST_EFFECT
from piezo_ident.diagnosis.held_out import errors_of_segments
from piezo_ident.diagnosis.results import (
    Diagnosis,
    DiagnosisSettings,
    Errors,
    Residual,
    stroke_of,
    Unexplained,
)
from piezo_ident.diagnosis.shared_modes import (
    find_shared_modes,
    LEFT,
    Multisines,
    SharedModesFinding,
)
from piezo_ident.identification.errors import errors_of, key_of, noise_floor_of, Prediction
from piezo_ident.identification.prepare import fault_lines, prepare, Run
from piezo_ident.identification.results import Identification, rms_percent, SharedRuns
from piezo_ident.identification.settings import Progress
from piezo_ident.identification.warnings import warn_of_errors, warn_of_zeros, ZERO_MOVED
from piezo_ident.model.free_run import FreeRun, PieceRun
from piezo_ident.model.initial_memory import is_at_rest
from piezo_ident.model.metrics import percent
from piezo_ident.model.multi_axis import each_of, EachAxis, MultiAxisModel
from piezo_ident.model.scaling import Scaling
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.record import Piece, Record
from piezo_ident.residual.noise_floor import residual_noise_floor
from piezo_ident.residual.stretches import all_stretches, ResidualPart
from piezo_ident.selection.judged import JudgedRun
from piezo_ident.verbs.predict import free_run
from piezo_ident.verbs.promised_modes import judged_modes

#: entry of `identification` of a chain: `Multisines.digest` of records on which chains were kept
CHAINS_KEPT = 'chains_kept_on'
#: why chains are kept although modes err less on multisines
BUT = 'shared modes err less on multisines held out, but chains are kept:'


@dataclass(frozen=True, eq=False)
class AxesData:
    """Records of a stage, records for validation, and records of each chain by axis."""

    records: Sequence[Record]
    validation: Sequence[Record]
    of_chains: Mapping[str, Sequence[Record]]


def with_better_modes(
    chains: EachAxis[Identification], data: AxesData, progress: Progress
) -> EachAxis[Identification]:
    """
    Replace chains by shared modes if the modes err clearly less.

    `find_shared_modes` compares both on multisines held out.  On other motion of the records, the
    modes must not err more than the chains.
    """
    sines = Multisines.of(chains, data.records)
    if sines is None:
        return chains
    finding = find_shared_modes(chains.model, sines, data.records, progress, tests=True)
    notes: tuple[str, ...] = ()
    if finding is not None:
        try:
            taken = _with_modes(chains, finding, data)
        except ModelError as error:
            notes = (f'{BUT} {error}',)
        else:
            if not _err_elsewhere(taken, chains, finding.held_out):
                return taken
            notes = (f'{BUT} modes err more on the other motion of the records',)

    def kept(_: str, x: Identification) -> Identification:
        known = {**x.model.identification, CHAINS_KEPT: sines.digest}
        model = replace(x.model, identification=known)
        return replace(x, model=model, warnings=(*x.warnings, *notes))

    return chains.mapped(kept)


def chains_were_kept(model: MultiAxisModel, sines: Multisines) -> bool | None:
    """Return whether an identification kept chains on these multisines; None if it had none."""
    known = {x.identification.get(CHAINS_KEPT) for x in model.axes.values()}
    return known == {sines.digest} if known != {None} else None


def _with_modes(
    chains: EachAxis[Identification], finding: SharedModesFinding, data: AxesData
) -> EachAxis[Identification]:
    """Give each axis errors, warnings, promise and band of the modes."""
    model, order = replace(chains.model, modes=finding.modes), sorted(chains)
    fitted, unseen = (
        [each_of(free_run(model, record)) for record in records]
        for records in (data.records, data.validation)
    )

    def of_axis(axis: str, chain: Identification) -> Identification:
        held_out = {label: float(x[order.index(axis)]) for label, x in finding.held_out.items()}
        runs = [x[axis] for x in fitted], [x[axis] for x in unseen]
        return _of_modes(chain, *runs, finding, held_out, data.of_chains[axis])

    return EachAxis({a: of_axis(a, x) for a, x in chains.items()}, modes=finding.modes)


def _of_modes(
    chain: Identification,
    fitted: Sequence[FreeRun],
    unseen: Sequence[FreeRun],
    finding: SharedModesFinding,
    held_out: Mapping[str, float],
    of_chain: Sequence[Record],
) -> Identification:
    """Judge an axis by free runs of the modes over records, and over records for validation."""
    scaling, data = chain.model.scaling, prepare(of_chain)
    own = [p for run in fitted for p in _predictions(run, scaling)]
    others = [p for run in unseen for p in _predictions(run, scaling)]
    zeros = _moved_zeros(own, scaling)
    own = [replace(p, y_hat=p.y_hat + zeros.get(key_of(p.run), 0.0)) for p in own]
    masks = [_in_fit(p.run, finding.fitted) for p in own]
    rows = errors_of(own, [(mask, np.zeros_like(mask)) for mask in masks])
    tests = errors_of(others, [(np.zeros_like(p.judged),) * 2 for p in others])
    judged = [
        JudgedRun(p.run.record, p.run.piece, p.y_hat, _known(chain.model, p), ~mask)
        for p, mask in zip(own, masks, strict=True)
    ]
    model, promise = judged_modes(chain.model, judged, held_out, chain.stroke)
    floor, records = noise_floor_of(own), [run.record for run in (*fitted, *unseen)]
    runs = [PieceRun(p.run.record, p.run.piece, p.y_hat, p.y_hat) for p in (*own, *others)]
    law = finding.law + finding.modes.creep_told
    shared = SharedRuns(law, finding.errors, tuple(runs))
    result = replace(
        chain,
        model=model,
        errors=(*rows, *(replace(row, data='validation') for row in tests)),
        noise_floor=None if floor.rms is None else percent(floor.rms, chain.stroke),
        noise_source=floor.source,
        warnings=(
            *data.warnings,
            *fault_lines(records[len(fitted) :]),
            shared.told,
            *warn_of_zeros(zeros, scaling),
        ),
        not_identified=(),
        records=tuple(records),
        memories={},
        promise=promise,
        shared=shared,
    )
    return replace(result, warnings=(*result.warnings, *warn_of_errors(result, data.pieces)))


def _pieces(run: FreeRun) -> Iterator[tuple[Piece, Array, Mask]]:
    """Yield each piece, its prediction, and the samples that `score` rates."""
    late = run.late if run.errors_after_start is not None else (0,) * len(run.late)
    for piece, y_hat, start in zip(run.record, run.pieces, late, strict=True):
        yield piece, y_hat, piece.mask & (np.arange(piece.n) >= start)


def _predictions(run: FreeRun, scaling: Scaling) -> list[Prediction]:
    name, predictions = run.record.name, []
    for piece, y_hat, use in _pieces(run):
        u, x = scaling.u(piece.v), scaling.x(piece.y)
        whole = Run(u=u, x=x, use=use, record=name, piece=piece, known=use)
        predictions.append(Prediction(whole, y_hat, np.full(piece.n, np.nan), use))
    return predictions


def _known(model: StageModel, prediction: Prediction) -> Mask:
    """Mark the samples that a free run can know: all samples of a piece that begins at rest."""
    piece = prediction.run.piece
    return piece.mask if is_at_rest(model, piece) else prediction.judged


def _in_fit(run: Run, labels: Collection[str]) -> Mask:
    """Mark the segments of a fit; a piece without segments has the name of its record."""
    fitted = np.zeros(run.piece.n, dtype=bool)
    parts = [(s.label, slice(s.start, s.stop)) for s in run.piece.segments]
    for label, part in parts or [(run.record, slice(None))]:
        fitted[part] |= label in labels
    return fitted


def _moved_zeros(
    predictions: Sequence[Prediction], scaling: Scaling
) -> dict[tuple[str, float], float]:
    """Compute the distance of the zero of each run from the model's zero, if it moved [m]."""
    errors: dict[tuple[str, float], list[Array]] = {}
    for p in predictions:
        e = (p.run.piece.y - p.y_hat)[p.judged]
        errors.setdefault(key_of(p.run), []).append(e)
    means = {key: float(np.concatenate(e).mean()) for key, e in errors.items() if any(map(len, e))}
    return {key: zero for key, zero in means.items() if abs(zero) > ZERO_MOVED * abs(scaling.Y)}


def _err_elsewhere(
    taken: EachAxis[Identification], chains: EachAxis[Identification], sines: Collection[str]
) -> bool:
    """Return whether modes err more than chains on segments other than these multisines."""
    errors = []
    for axis, result in taken.items():
        ours = [
            row
            for row in result.errors
            if row.data == 'held out' and row.driven and (row.segment or row.record) not in sines
        ]
        places = {(row.record, row.segment) for row in ours}
        theirs = [
            row
            for row in chains[axis].errors
            if row.data != 'validation' and (row.record, row.segment) in places
        ]
        errors.append((rms_percent(ours), rms_percent(theirs)))
    modes, chain = np.sqrt(np.sum(np.square(errors), axis=0))
    # both are NaN if the records hold no other motion
    return bool(modes > chain)


def diagnosed_modes(
    model: MultiAxisModel, records: Sequence[Record], settings: DiagnosisSettings
) -> EachAxis[Diagnosis]:
    """Judge a model with shared modes as it is, without search or fit."""
    runs = [each_of(free_run(model, record)) for record in records]
    results = {a: _judged(x, [run[a] for run in runs], settings) for a, x in model.axes.items()}
    return EachAxis(results, modes=model.modes)


def _judged(model: StageModel, runs: Sequence[FreeRun], settings: DiagnosisSettings) -> Diagnosis:
    """Diagnose an axis by free runs of shared modes; the zero of each record is free."""
    residuals = []
    for run in runs:
        pieces = [*_pieces(run)]
        zero = float(np.concatenate([(piece.y - y)[use] for piece, y, use in pieces]).mean())
        for piece, y, use in pieces:
            e = piece.y - y - zero
            residuals.append(Residual(run.record.name, piece, e, e, e, use))
    stroke, joined = stroke_of(residuals), errors_of_segments(r.run for r in residuals)
    # each row is in a segment
    joined[''] = np.concatenate([*joined.values()])
    rms = {k: percent(np.sqrt(np.mean(e**2)), stroke) for k, e in joined.items() if e.size}
    errors = Errors(rms.pop(''), rms, {})
    parts = [ResidualPart(r.record, r.piece, r.after, r.sound) for r in residuals]
    floor = residual_noise_floor(parts, all_stretches(parts))
    noise = None if floor.rms is None else percent(floor.rms, stroke)
    left = float(np.sqrt(max(errors.overall**2 - (noise or 0.0) ** 2, 0.0)))
    return Diagnosis(
        verdict='none' if left < SMALLEST_EFFECT else 'unexplained',
        sentence=(
            f'The model has modes that the axes share, and errs by {errors.overall:.3g} % of '
            'stroke. Shared modes are judged as they are: nothing was searched beside them, and '
            'nothing was fitted again.'
        ),
        given=model,
        model=model,
        effects=(),
        group=None,
        unexplained=Unexplained(1.0, left, LEFT),
        candidates=(),
        before=errors,
        refit=errors,
        after=errors,
        noise_floor=noise,
        noise_source=floor.source,
        smallest_detectable=None,
        untestable=(),
        faults=tuple(fault for run in runs for fault in run.record.faults),
        residuals=tuple(residuals),
        records=tuple(run.record.name for run in runs),
        blocks=0,
        warnings=tuple(text for run in runs for text in run.warnings),
        settings=settings,
    )
