# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The result of an identification as plain data, and as one sentence."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from piezo_ident import __version__
from piezo_ident.identification.results import (
    DelayResult,
    DynamicsResult,
    ErrorRow,
    Identification,
    Steps,
)
from piezo_ident.model.files import plain
from piezo_ident.model.free_run import PieceRun, sines_of
from piezo_ident.model.metrics import FORMULA
from piezo_ident.operators.dynamics import Dynamics
from piezo_ident.record.record import Record

__all__ = [
    'JSON_VERSION',
    'KINDS',
    'Mode',
    'length',
    'modes',
    'moves',
    'number',
    'share',
    'steps_to_json',
    'to_json',
    'verdict',
]

JSON_VERSION = 1
#: what is compared, in the order in which it is shown
KINDS = ('validation', 'held out', 'selection', 'fitted')


@dataclass(frozen=True)
class Mode:
    """
    A pole of G, or a pair of them, in continuous time.

    Attributes
    ----------
    frequency, frequency_std : float
        Natural frequency, or corner frequency of a real pole [Hz].
    damping, damping_std : float
        Damping ratio; 1 for a real pole.
    oscillates : bool
        Whether it is a pair.
    """

    frequency: float
    frequency_std: float
    damping: float
    damping_std: float
    oscillates: bool


def modes(dynamics: Dynamics, sample_rate: float, covariance: NDArray[np.float64]) -> list[Mode]:
    """
    Return the poles of G as modes, with the uncertainty that follows from that of a_1 .. a_na.

    Parameters
    ----------
    dynamics : Dynamics
    sample_rate : float
        [Hz]
    covariance : ndarray
        Of (a, b); the block of a is used.

    Notes
    -----
    To first order, a change of a_i moves a pole p by ``-p^(na-i) / A'(p)``.  Poles at zero and on
    the negative real axis are no modes of a sampled motion and are left out.
    """
    a = np.concatenate([[1.0], dynamics.a])
    na = dynamics.a.size
    slope = np.polyder(a) if na else np.zeros(1)
    block = covariance[:na, :na] if covariance.shape[0] >= na else np.full((na, na), np.nan)
    found = []
    for pole in dynamics.poles:
        if pole.imag < 0.0 or (pole.imag == 0.0 and pole.real <= 0.0):
            continue
        s = np.log(pole)
        ds = -(pole ** np.arange(na - 1, -1, -1)) / np.polyval(slope, pole) / pole
        size = abs(s)
        d_size = np.real(np.conj(s) * ds) / size
        d_damping = -ds.real / size + s.real * d_size / size**2
        std = [math.sqrt(max(float(d @ block @ d), 0.0)) for d in (d_size, d_damping)]
        rate = sample_rate / (2.0 * math.pi)
        real = pole.imag == 0.0
        found.append(
            Mode(rate * size, rate * std[0], -s.real / size, 0.0 if real else std[1], not real)
        )
    return sorted(found, key=lambda mode: mode.frequency)


def number(value: float | None, digits: int = 3) -> str:
    """Return a number for people: `digits` significant ones, a dash where there is none."""
    if value is None or math.isnan(value):
        return '–'
    if math.isinf(value):
        return '∞' if value > 0 else '-∞'
    if value != 0.0 and not 1e-4 <= abs(value) < 1e6:
        return f'{value:.{digits - 1}e}'
    places = digits if value == 0.0 else digits - 1 - math.floor(math.log10(abs(value)))
    return f'{value:.{max(0, places)}f}' if value else '0'


def share(percent: float) -> str:
    """Return a percentage for people, to two decimals."""
    # adding zero turns a negative zero into a plain one
    return f'{round(percent, 2) + 0.0:.2f}' if math.isfinite(percent) else number(percent)


def length(metres: float) -> str:
    """Return a length in the unit in which it is read best."""
    for limit, factor, unit in ((1e-3, 1e3, 'mm'), (1e-6, 1e6, 'µm'), (0.0, 1e9, 'nm')):
        if abs(metres) >= limit:
            return f'{number(metres * factor, 4)} {unit}'
    return f'{number(metres * 1e9, 4)} nm'


def fit_share(row: ErrorRow) -> str:
    """Return the NRMSE fit of a row, a dash where the stage rests."""
    # there is nothing but noise to explain, and a good model looks like a bad one
    rests = row.segment.partition(':')[0] == 'idle' or math.isinf(row.fit)
    return share(math.nan if rests else row.fit)


def verdict(identification: Identification) -> str:
    """Return what was found, in one sentence."""
    headline = identification.headline
    # rest and ramps flatter: they are no test of a model
    said = {
        'validation': f'On {", ".join(headline.records)}, recorded for validation',
        'held out': 'On data it did not fit',
        'selection': 'On the parts of steps, noise and triangle that were kept from the fit (no '
        'other motion was there to test it)',
        'fitted': 'Nothing was held out; on the data it was fitted to',
    }[headline.data]
    said += f', the model errs by {number(headline.percent)} % of stroke'
    if not identification.model.is_static and math.isfinite(headline.static_percent):
        said += f', its hysteresis alone by {number(headline.static_percent)} %'
    return f'{said} ({FORMULA}).'


def moves(label: str) -> bool:
    """Return whether a segment drives the stage to test it, rather than rests or moves over."""
    return label.partition(':')[0] not in ('idle', 'ramp')


def to_json(
    identification: Identification,
    records: Sequence[Record] = (),
    runs: Iterable[PieceRun] = (),
) -> dict[str, Any]:
    """
    Return the result as plain data, ready for strict JSON.

    Parameters
    ----------
    identification : Identification
    records : sequence of Record, optional
        For the faults that were met in the data.
    runs : iterable of PieceRun, optional
        For the steady-state errors of sines.

    Returns
    -------
    dict
        Numbers in SI units, errors in % of stroke; what is unknown or infinite is None.
    """
    model, fit, dynamics = identification.model, identification.hysteresis, identification.dynamics
    h, G, delay = model.hysteresis, model.dynamics, identification.delay
    m = h.thresholds.size
    swarm = identification.swarm
    data = {
        'schema_version': JSON_VERSION,
        'package_version': __version__,
        'verdict': verdict(identification),
        'method': model.identification.get('method'),
        'records': model.identification.get('records', [record.name for record in records]),
        'sample_rate': model.sample_rate,
        'stroke': identification.stroke,
        'voltage_range': list(model.scaling.range),
        'errors': {
            'unit': '% of stroke',
            'formula': FORMULA,
            **{kind.replace(' ', '_'): identification.error(kind) for kind in KINDS},
            'rows': [asdict(row) for row in identification.errors],
        },
        'sines': [asdict(row) for row in sines_of(list(runs))],
        'noise_floor': {
            'percent_of_stroke': identification.noise_floor,
            'source': identification.noise_source,
        },
        'delay': _delay(delay, model.delay.total / model.sample_rate),
        'dynamics': {
            **_dynamics(dynamics, G, model.sample_rate),
            'bias': model.scaling.v0 + model.scaling.V * dynamics.bias,
        },
        'hysteresis': {
            'thresholds': h.thresholds,
            'thresholds_volt': h.thresholds * model.scaling.V,
            'weights': h.weights,
            'weights_std': fit.std[:m] if fit.std.size == m + 2 else None,
            'p1': h.p1,
            'p1_std': fit.std[m] if fit.std.size == m + 2 else None,
            'p2': h.p2,
            'p2_std': fit.std[m + 1] if fit.std.size == m + 2 else None,
            'solver': fit.solver,
            'polished': fit.polished,
            'loss': fit.loss,
            'swarm_loss': fit.swarm_loss,
            'optimum_loss': fit.optimum_loss,
            'samples': fit.n,
            'swarm_iterations': swarm.nit if swarm is not None else None,
            'swarm_evaluations': swarm.nfev if swarm is not None else None,
        },
        'warnings': list(identification.warnings),
        'not_identified': [
            {'what': what, 'why': why} for what, why in identification.not_identified
        ],
        'data_faults': _faults(list(records)),
        'settings': asdict(identification.settings),
        'seed': identification.settings.seed,
        'versions': model.identification.get('versions', {}),
    }
    result: dict[str, Any] = _strict(plain(data))
    return result


def steps_to_json(
    steps: Steps, sample_rate: float, records: Sequence[Record] = ()
) -> dict[str, Any]:
    """
    Return what single steps have found, under the keys of `to_json`.

    Parameters
    ----------
    steps : Steps
    sample_rate : float
        [Hz]
    records : sequence of Record, optional
        For the faults that were met in the data.
    """
    data: dict[str, Any] = {
        'schema_version': JSON_VERSION,
        'package_version': __version__,
        'sample_rate': sample_rate,
        'data_faults': _faults(records),
    }
    if steps.delay is not None:
        data['delay'] = _delay(steps.delay, steps.delay.samples / sample_rate)
    if steps.dynamics is not None:
        data['dynamics'] = _dynamics(*steps.dynamics, sample_rate)
    result: dict[str, Any] = _strict(plain(data))
    return result


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
        'modes': [asdict(mode) for mode in modes(G, sample_rate, dynamics.covariance)],
        'methods': dynamics.methods,
        'slope_measured': dynamics.slope_measured,
        'slope_model': dynamics.slope_model,
        'band': dynamics.band,
    }


def _faults(records: Sequence[Record]) -> list[dict[str, Any]]:
    return [
        {'record': record.name, **asdict(fault)} for record in records for fault in record.faults
    ]


def _strict(value: Any) -> Any:
    """Return plain data with None for every number that JSON does not know."""
    if isinstance(value, dict):
        return {key: _strict(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_strict(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
