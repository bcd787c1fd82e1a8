# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A diagnosis as plain data and as strict JSON, and the schema that says what is in it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from importlib import resources
import json
import math
import sys
from typing import Any

from piezo_ident import __version__
from piezo_ident.diagnosis.results import Diagnosis, Errors, FORMULA, FoundParameter
from piezo_ident.model.files import plain

__all__ = ['JSON_VERSION', 'diagnosis_schema', 'json_text', 'to_json']

JSON_VERSION = 1


def diagnosis_schema() -> dict[str, Any]:
    """Return the JSON Schema of what `to_json` gives, as plain data."""
    file = resources.files('piezo_ident').joinpath('schemas', 'diagnosis.schema.json')
    schema: dict[str, Any] = json.loads(file.read_text(encoding='utf-8'))
    return schema


def to_json(diagnosis: Diagnosis) -> dict[str, Any]:
    """
    Return a diagnosis as plain data, ready for strict JSON.

    JSON knows neither infinity nor NaN.  The value of a parameter that is infinite, as the end of
    a range that is not there, becomes the text ``inf`` or ``-inf``, so that it stays apart from an
    unknown one; every other number that is not finite becomes None.  An overall error that is not
    finite, of a model that diverged, becomes the largest number there is.

    Parameters
    ----------
    diagnosis : Diagnosis

    Returns
    -------
    dict
        Valid against `diagnosis_schema`; shares within 0 .. 1, errors in % of stroke, parameters
        in the units of the normalised chain.
    """
    group, left = diagnosis.group, diagnosis.unexplained
    data = {
        'schema_version': JSON_VERSION,
        'package_version': __version__,
        'verdict': diagnosis.verdict,
        'sentence': diagnosis.sentence,
        'effects': [
            {
                'name': effect.name,
                'slot': effect.slot,
                'share_of_explainable': _share(effect.share),
                'rms_percent_of_stroke': _size(effect.rms_percent),
                'parameters': {
                    name: _parameter(found) for name, found in effect.parameters.items()
                },
            }
            for effect in diagnosis.effects
        ],
        'class': None
        if group is None
        else {
            'names': list(group.names),
            'separating_experiment': group.separating_experiment,
        },
        'unexplained': {
            'share_of_explainable': _share(left.share),
            'rms_percent_of_stroke': _size(left.rms_percent),
            'description': left.description,
        },
        'candidates': [
            {
                'name': candidate.name,
                'share_of_explainable': _share(candidate.share),
                'why_not': candidate.why_not,
            }
            for candidate in diagnosis.candidates
        ],
        'error': {
            'unit': '% of stroke',
            'formula': FORMULA,
            'before': _errors(diagnosis.before),
            'refit': _errors(diagnosis.refit),
            'after': _errors(diagnosis.after),
        },
        'noise_floor': {
            'percent_of_stroke': _known(diagnosis.noise_floor),
            'source': diagnosis.noise_source,
        },
        'smallest_detectable': {'percent_of_stroke': _known(diagnosis.smallest_detectable)},
        'untestable': [{'name': x.name, 'needs': x.needs} for x in diagnosis.untestable],
        'data_faults': [
            {'name': x.name, 'where': x.where, 'count': int(x.count), 'action': x.action}
            for x in diagnosis.faults
        ],
        'records': list(diagnosis.records),
        'held_out_blocks': diagnosis.blocks,
        'warnings': list(diagnosis.warnings),
        'settings': asdict(diagnosis.settings),
        'seed': diagnosis.settings.seed,
    }
    result: dict[str, Any] = plain(data)
    return result


def json_text(diagnosis: Diagnosis, *, indent: int | None = 2) -> str:
    """
    Return `to_json` as text.

    Parameters
    ----------
    diagnosis : Diagnosis
    indent : int, optional
        None puts everything on one line.
    """
    return json.dumps(to_json(diagnosis), indent=indent, ensure_ascii=False, allow_nan=False)


def _known(value: float | None) -> float | None:
    return float(value) if value is not None and math.isfinite(value) else None


def _share(value: float) -> float:
    # estimated from noisy sums, a share may come out a little below 0 or above 1
    return min(1.0, max(0.0, float(value))) if math.isfinite(value) else 0.0


def _size(value: float) -> float:
    if math.isnan(value):
        return 0.0
    return min(max(0.0, float(value)), sys.float_info.max)


def _errors(errors: Errors) -> dict[str, Any]:
    return {
        'overall': sys.float_info.max if math.isnan(errors.overall) else _size(errors.overall),
        'by_segment': _each(errors.by_segment),
        # one way to write a frequency, whoever made the table
        'by_frequency': _each({str(float(f)): x for f, x in errors.by_frequency.items()}),
    }


def _each(table: Mapping[str, float]) -> dict[str, float | None]:
    return {name: _known(value) for name, value in table.items()}


def _parameter(found: FoundParameter) -> dict[str, Any]:
    return {'value': _value(plain(found.value)), 'unit': found.unit, 'std': _std(plain(found.std))}


def _value(value: Any) -> Any:
    if isinstance(value, list):
        return [_value(x) for x in value]
    if isinstance(value, float) and math.isinf(value):
        return 'inf' if value > 0.0 else '-inf'
    return None if isinstance(value, float) and math.isnan(value) else value


def _std(std: Any) -> Any:
    if isinstance(std, list):
        return [_known(x) for x in std]
    return _known(std)
