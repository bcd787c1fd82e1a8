# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Identify a stage of several axes from a capture; the job is independent of ROS."""

from __future__ import annotations

from dataclasses import asdict
import json
from math import isfinite
from pathlib import Path

from piezo_ident.axes.from_records import AxesIdentification, identify_axes
from piezo_ident.axes.model_text import axes_model_to_text
from piezo_ident.common.files import write_text
from piezo_ident.common.process import Tick
from piezo_ident.live.capture import Snapshot
from piezo_ident.nodes.identifier.jobs import IdentificationOutcome

#: name of the file that ~/save writes
MODEL_FILE = 'axes_model.yaml'


def identify_axes_capture(snapshot: Snapshot, tick: Tick) -> IdentificationOutcome:
    """
    Make a record of a capture, and identify the stage of several axes in it.

    Parameters
    ----------
    snapshot : Snapshot
    tick : callable
    """
    tick('record', 0.0)
    found = identify_axes([snapshot.record('capture')], progress=tick)
    tick('report', 0.98)
    periods, name, warnings = found.periods, found.explanation.name, found.warnings
    error, linear = f'{found.error:.3g}', f'{found.linear_error:.3g}'
    size = f'{len(periods.inputs)} inputs, {len(periods.outputs)} outputs'
    return IdentificationOutcome(
        f'{size}: {error} % of the rms of y in free run on what was held out, a linear model '
        f'{linear} %; what that lacks: {name}',
        f'{error} %, linear {linear} %: {name}',
        {'error_percent': error, 'linear_percent': linear, 'effect': name},
        json.dumps(_report(found, warnings)),
        len(warnings),
        model=axes_model_to_text(found.model),
    )


def _report(found: AxesIdentification, warnings: tuple[str, ...]) -> dict[str, object]:
    return {
        'several_axes': {
            'inputs': [*found.periods.inputs],
            'outputs': [*found.periods.outputs],
            'sample_rate': found.periods.records[0].rate,
            'order': found.model.model.linear.order,
            'effect': found.explanation.name,
            'error_formula': '100 rms(y - yhat) / rms(y), free run, realisations held out',
            'candidates': [
                {
                    'name': c.name,
                    'error_percent': _known(c.error),
                    'by_group': {group: _known(s.pooled) for group, s in c.scores.items()},
                }
                for c in found.explanation.candidates
            ],
            'axes': [asdict(x) for x in found.axis_errors],
            'paths': [asdict(x) for x in found.paths],
            'periodicity': [str(p) for p in found.periodicity],
            'warnings': [*warnings],
        }
    }


def _known(error: float) -> float | None:
    """Return an error, or None if a model diverges: JSON cannot hold infinity."""
    return error if isfinite(error) else None


def save_axes(model: str, folder: str, tick: Tick) -> str:
    """Write the model of several axes into a folder."""
    tick('saving', 0.0)
    path = Path(folder, MODEL_FILE)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, model)
    return str(path)
