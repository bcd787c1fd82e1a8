# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Results as plain data for strict JSON."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from importlib import resources
import json
import math
import sys
from typing import Any, TYPE_CHECKING

import numpy as np
from piezo_ident import __version__
from piezo_ident.model import metrics
from piezo_ident.model.files import finite, plain
from piezo_ident.model.free_run import FreeRun, FreeRunErrors, PieceRun
from piezo_ident.model.multi_axis import EachAxis
from piezo_ident.model.sines import sines_of
from piezo_ident.operators.dynamics import Dynamics
from piezo_ident.record.record import Record
from piezo_ident.selection.judged import Promise

if TYPE_CHECKING:
    from piezo_ident.control.inverse import Inverse
    from piezo_ident.diagnosis.results import Diagnosis, Errors, FoundParameter
    from piezo_ident.identification.results import Identification, Steps
    from piezo_ident.identification.step1_delay import DelayResult
    from piezo_ident.identification.step2_dynamics import DynamicsResult

    One = Identification | Diagnosis | FreeRun | Inverse | Record
    Shown = One | EachAxis[Any]

VERSION = {'schema_version': 1, 'package_version': __version__}
#: a diagnosis has weights and promises since 2
DIAGNOSIS_VERSION = 2


def to_json(result: Shown, runs: Sequence[PieceRun] = ()) -> dict[str, Any]:
    """
    Convert a result to plain data, ready for strict JSON.

    Parameters
    ----------
    result : Identification, Diagnosis, FreeRun, Inverse or Record, or EachAxis of them
        For several axes the key ``axes`` holds the data of each axis.
    runs : sequence of PieceRun, optional
        For the steady-state errors of sines of an identification.

    Returns
    -------
    dict
        Numbers in SI units, errors in % of stroke, shares within 0 .. 1.  Unknown and infinite
        numbers are None, with these exceptions.  An infinite parameter of an effect is the text
        ``inf`` or ``-inf``.  An unknown share or rms of a diagnosis is 0.  The overall error of a
        diverged model is the largest float64.
    """
    if isinstance(result, EachAxis):
        return {**VERSION, 'axes': {axis: to_json(x) for axis, x in result.items()}}
    return dict(finite(plain({**VERSION, **_data(result, runs)})))


def _data(result: One, runs: Sequence[PieceRun]) -> dict[str, Any]:
    if isinstance(result, Record):
        return _record(result)
    if isinstance(result, FreeRun):
        return _free_run(result)
    from piezo_ident.control.inverse import Inverse

    if isinstance(result, Inverse):
        return _drive(result)
    from piezo_ident.diagnosis.results import Diagnosis

    return _diagnosis(result) if isinstance(result, Diagnosis) else _identified(result, runs)


def _record(record: Record) -> dict[str, Any]:
    return {
        'record': record.name,
        'pieces': len(record.pieces),
        'samples': record.n,
        'duration': record.duration,
        'sample_rates': list(dict.fromkeys(piece.sample_rate for piece in record)),
        'voltage_range': list(record.voltage_range),
        'stroke': record.stroke if record.is_measured else None,
        'labels': list(record.labels),
        'faults': [asdict(fault) for fault in record.faults],
    }


def _free_run(run: FreeRun) -> dict[str, Any]:
    late, estimate = run.errors_after_start, run.errors_of_estimate
    return {
        'record': run.record.name,
        'formula': metrics.FORMULA,
        'whole': _free_run_errors(run.errors),
        'start_forgotten': None if late is None else _free_run_errors(late),
        'estimate': None if estimate is None else _free_run_errors(estimate),
        'memory_estimated': list(run.estimated),
        'share_inside_band': None if run.interval is None else run.inside,
        'warnings': list(run.warnings),
    }


def _drive(result: Inverse) -> dict[str, Any]:
    return {
        'formula': metrics.FORMULA,
        'percent_of_stroke': result.error,
        'expected_percent_of_stroke': result.expected,
        'expected_rms': result.expected_rms,
        'expected_offset': result.expected_offset,
        'samples': result.v.size,
        'lead': result.lead,
        'clipped': int(result.clipped.sum()),
        'voltage_range': [result.v.min(), result.v.max()],
        'steepest': np.abs(np.diff(result.v) / np.diff(result.t)).max(initial=0.0),
        'warnings': list(result.warnings),
    }


def _free_run_errors(errors: FreeRunErrors) -> dict[str, Any]:
    return {
        'percent_of_stroke': errors.percent,
        'fit_percent': errors.fit,
        'n': errors.n,
        'offset': errors.offset,
        'percent_of_stroke_without_offset': errors.percent_without_offset,
    }


def json_text(result: Shown, runs: Sequence[PieceRun] = ()) -> str:
    """Write `to_json` as text on one line."""
    return json.dumps(to_json(result, runs), ensure_ascii=False, allow_nan=False)


def diagnosis_schema() -> dict[str, Any]:
    """Read the JSON Schema of a diagnosis, as plain data."""
    file = resources.files('piezo_ident').joinpath('schemas', 'diagnosis.schema.json')
    schema: dict[str, Any] = json.loads(file.read_text(encoding='utf-8'))
    return schema


def steps_to_json(steps: Steps, sample_rate: float, records: Sequence[Record]) -> dict[str, Any]:
    """
    Convert the result of single steps to plain data, under the keys of `to_json`.

    Parameters
    ----------
    steps : Steps
    sample_rate : float
        [Hz]
    records : sequence of Record
        For the faults in their data.
    """
    data = {**VERSION, 'sample_rate': sample_rate, 'data_faults': _faults(records)}
    if steps.delay is not None:
        data['delay'] = _delay(steps.delay, steps.delay.samples / sample_rate)
    if steps.dynamics is not None:
        data['dynamics'] = _dynamics(*steps.dynamics, sample_rate)
    return dict(finite(plain(data)))


def _identified(result: Identification, runs: Sequence[PieceRun]) -> dict[str, Any]:
    from piezo_ident.report.identification import headline

    model, fit, dynamics, shared = result.model, result.hysteresis, result.dynamics, result.shared
    h, m = model.hysteresis, model.hysteresis.thresholds.size
    std = fit.std if fit.std.size == m + 2 else np.full(m + 2, np.nan)
    records = [record.name for record in result.records]
    return {
        'verdict': headline(result),
        'method': model.identification.get('method'),
        'records': model.identification.get('records', records),
        'sample_rate': model.sample_rate,
        'stroke': result.stroke,
        'voltage_range': list(model.scaling.range),
        'errors': {
            'unit': '% of stroke',
            'formula': metrics.FORMULA,
            **{kind.replace(' ', '_'): result.error(kind) for kind in metrics.KINDS},
            'rows': [asdict(row) for row in result.errors],
        },
        'promise': _promise(result.promise),
        'shared_modes': shared and {'law': shared.law, 'errors_of_laws': dict(shared.errors)},
        'quantities': [asdict(p) | {'known': p.is_known} for p in model.quantities],
        'sines': [asdict(row) for row in sines_of(runs)],
        'noise_floor': {'percent_of_stroke': result.noise_floor, 'source': result.noise_source},
        'delay': _delay(result.delay, model.delay.total / model.sample_rate),
        'dynamics': {
            **_dynamics(dynamics, model.dynamics, model.sample_rate),
            'bias': model.scaling.v0 + model.scaling.V * dynamics.bias,
        },
        'hysteresis': {
            'thresholds': h.thresholds,
            'thresholds_volt': h.thresholds * model.scaling.V,
            'weights': h.weights,
            'weights_std': None if np.isnan(std).all() else std[:m],
            'p1': h.p1,
            'p1_std': std[m],
            'p2': h.p2,
            'p2_std': std[m + 1],
            'p0': h.p0,
            'law': fit.law,
            'errors_of_laws': {name: 100.0 * x for name, x in fit.errors_of_laws.items()},
            'solver': fit.solver,
            'polished': fit.polished,
            'loss': fit.loss,
            'swarm_loss': fit.swarm_loss,
            'optimum_loss': fit.optimum_loss,
            'samples': fit.n,
            'swarm_iterations': None if fit.swarm is None else fit.swarm.nit,
            'swarm_evaluations': None if fit.swarm is None else fit.swarm.nfev,
        },
        'warnings': list(result.warnings),
        'not_identified': [{'what': what, 'why': why} for what, why in result.not_identified],
        'data_faults': _faults(result.records),
        'settings': asdict(result.settings),
        'seed': result.settings.seed,
        'versions': model.identification.get('versions', {}),
    }


def _delay(delay: DelayResult, seconds: float) -> dict[str, Any]:
    return {
        'samples': delay.samples,
        'seconds': seconds,
        'std': delay.std,
        'source': delay.source,
        'from_steps': delay.step.samples if delay.step is not None else None,
        'from_scan': delay.scan,
        'agree': delay.agree,
    }


def _dynamics(dynamics: DynamicsResult, G: Dynamics, sample_rate: float) -> dict[str, Any]:
    na, nb = G.a.size, G.b.size
    sigma = np.sqrt(np.maximum(np.diag(dynamics.covariance), 0.0))
    known = sigma.size == na + nb
    return {
        'order': list(dynamics.order),
        'a': G.a,
        'b': G.b,
        'a_std': sigma[:na] if known else None,
        'b_std': sigma[na:] if known else None,
        'modes': [asdict(mode) for mode in G.modes(sample_rate, dynamics.covariance)],
        'methods': dynamics.methods,
        'slope_measured': dynamics.slope_measured,
        'slope_model': dynamics.slope_model,
        'band': dynamics.band,
    }


def _faults(records: Sequence[Record]) -> list[dict[str, Any]]:
    return [
        {'record': record.name, **asdict(fault)} for record in records for fault in record.faults
    ]


def _diagnosis(result: Diagnosis) -> dict[str, Any]:
    from piezo_ident.diagnosis.results import FORMULA

    group, left = result.group, result.unexplained
    return {
        'schema_version': DIAGNOSIS_VERSION,
        'verdict': result.verdict,
        'sentence': result.sentence,
        'effects': [
            {
                'name': effect.name,
                'slot': effect.slot,
                'share_of_explainable': _share(effect.share),
                'rms_percent_of_stroke': _size(effect.rms_percent),
                'parameters': {name: _parameter(p) for name, p in effect.parameters.items()},
            }
            for effect in result.effects
        ],
        'class': None if group is None else asdict(group),
        'gain': None if result.gain is None else asdict(result.gain),
        'model_changes': list(result.changes),
        'unexplained': {
            'share_of_explainable': _share(left.share),
            'rms_percent_of_stroke': _size(left.rms_percent),
            'description': left.description,
        },
        'candidates': [
            {'name': x.name, 'share_of_explainable': _share(x.share), 'why_not': x.why_not}
            for x in result.candidates
        ],
        'error': {
            'unit': '% of stroke',
            'formula': FORMULA,
            'before': _errors(result.before),
            'refit': _errors(result.refit),
            'after': _errors(result.after),
        },
        'promise': _promise(result.promise),
        'weights': dict(result.weights),
        'noise_floor': {'percent_of_stroke': result.noise_floor, 'source': result.noise_source},
        'smallest_detectable': {'percent_of_stroke': result.smallest_detectable},
        'hysteresis': {'law': result.law, 'errors_of_laws': dict(result.errors_of_laws)},
        'set_in': result.set_in,
        'held_out_kinds': list(result.kinds),
        'share_outside_range': result.outside,
        'untestable': [asdict(x) for x in result.untestable],
        'data_faults': [asdict(fault) for fault in result.faults],
        'records': list(result.records),
        'held_out_blocks': result.blocks,
        'warnings': list(result.warnings),
        'settings': asdict(result.settings),
        'seed': result.settings.seed,
    }


def _promise(promise: Promise | None) -> dict[str, Any] | None:
    if promise is None:
        return None
    return {'unit': '% of stroke', 'same_motion': promise.same, 'other_motion': promise.other}


def _share(value: float) -> float:
    # estimated from noisy sums, a share may come out a little below 0 or above 1
    return min(1.0, max(0.0, float(value))) if math.isfinite(value) else 0.0


def _size(value: float) -> float:
    return 0.0 if math.isnan(value) else min(max(0.0, float(value)), sys.float_info.max)


def _errors(errors: Errors) -> dict[str, Any]:
    return {
        'overall': sys.float_info.max if math.isnan(errors.overall) else _size(errors.overall),
        'by_segment': errors.by_segment,
        'by_frequency': {str(float(f)): x for f, x in errors.by_frequency.items()},
    }


def _parameter(parameter: FoundParameter) -> dict[str, Any]:
    return {'value': _value(plain(parameter.value)), 'unit': parameter.unit, 'std': parameter.std}


def _value(value: Any) -> Any:
    # an open range has an infinite end, and None would mean unknown
    if isinstance(value, list):
        return [_value(x) for x in value]
    if isinstance(value, float) and math.isinf(value):
        return 'inf' if value > 0.0 else '-inf'
    return value
