# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The tables of the report, as plain text cells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
import math

import numpy as np
from piezo_ident import __version__
from piezo_ident.identification.results import Identification
from piezo_ident.model.free_run import SineError
from piezo_ident.model.metrics import FORMULA
from piezo_ident.record.record import Record
from piezo_ident.report.numbers import fit_share, KINDS, length, modes, moves, number

__all__ = [
    'PAPER_GAIN',
    'Table',
    'dynamics_tables',
    'error_tables',
    'facts',
    'fault_table',
    'hysteresis_tables',
    'origin_tables',
]

#: static gain that the paper leaves in G: its printed coefficients give G(1) = 0.6411
PAPER_GAIN = 0.6411


@dataclass(frozen=True)
class Table:
    """
    A table for people.

    Attributes
    ----------
    title : str
    head : tuple of str
    rows : tuple of tuple of str
    note : str
    """

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ''


def facts(identification: Identification) -> list[tuple[str, str]]:
    """Return the few numbers that stand beside the verdict."""
    model, delay = identification.model, identification.delay
    na, nb = identification.dynamics.order
    low, high = model.scaling.range
    floor = identification.noise_floor
    lag = 1e6 * model.delay.total / model.sample_rate
    found = {
        'stroke': length(identification.stroke),
        'voltage': f'{low:g} .. {high:g} V',
        'sampling rate': f'{model.sample_rate:g} Hz',
        'delay': f'{delay.samples} ± {number(delay.std, 2)} samples = {lag:.4g} µs',
        'dynamics': f'na = {na}, nb = {nb}' if na else 'G = 1',
        'hysteresis': f'{model.hysteresis.thresholds.size} thresholds, p1, p2',
        'sensor noise': 'unknown' if floor is None else f'{number(floor)} % of stroke rms',
        'effects': ', '.join(effect.name for effect in model.effects),
    }
    for what, _ in identification.not_identified:
        if what in found:
            found[what] = 'not identified'
    return [(what, said) for what, said in found.items() if said]


def error_tables(identification: Identification, sines: Sequence[SineError]) -> list[Table]:
    """Return the errors by segment, and in the layout of the paper's Table I."""
    order = {kind: i for i, kind in enumerate(KINDS)}
    rows = sorted(
        identification.errors,
        key=lambda row: (order.get(row.data, len(order)), not moves(row.segment)),
    )
    source = identification.noise_source
    if identification.noise_floor is not None:
        source = f'from {source}'
    tables = [
        Table(
            'Errors',
            (
                'record',
                'segment',
                'data',
                'model / %',
                'hysteresis alone / %',
                'NRMSE fit / %',
                'samples',
            ),
            tuple(
                (
                    row.record,
                    row.segment or 'whole',
                    row.data,
                    number(row.percent),
                    number(row.static_percent),
                    fit_share(row),
                    str(row.n),
                )
                for row in rows
            ),
            f'Errors in % of stroke: {FORMULA}, with the stroke of the whole record. NRMSE fit: '
            '100 (1 - |y - y_hat| / |y - mean y|) over the samples of the row; it says nothing '
            'where the stage rests. "held out": neither fitted nor looked at before; '
            '"selection": not fitted, but chose between models. '
            f'Sensor noise: {source}.',
        )
    ]
    if sines:
        tables.append(
            Table(
                'Errors of sines in steady state',
                ('frequency / Hz', *(f'{row.frequency:g}' for row in sines)),
                (
                    ('model with dynamics', *(number(row.percent) for row in sines)),
                    ('hysteresis alone', *(number(row.static_percent) for row in sines)),
                ),
                'In % of stroke: 100 rms(y - y_hat) / (max y - min y), free run; the first second '
                'and at least one period are dropped, and the stroke is that of what is left. '
                'Layout of Table I of the paper.',
            )
        )
    return tables


def dynamics_tables(identification: Identification) -> list[Table]:
    """Return delay, coefficients, modes and the methods that were compared."""
    model, dynamics, delay = (
        identification.model,
        identification.dynamics,
        identification.delay,
    )
    G = model.dynamics
    na, nb = G.a.size, G.b.size
    rows = [('used', str(delay.samples), number(delay.std, 2), delay.source)]
    if delay.step is not None:
        found = '–' if delay.step.samples is None else str(delay.step.samples)
        said = f'average of {delay.step.repeats}' if delay.step.repeats else 'no steps'
        rows.append(('steps', found, number(delay.step.std, 2), said))
    if delay.scan is not None:
        scanned = 'noise segment' if delay.step is None else 'the same steps'
        rows.append(('scan of the ARX loss', str(delay.scan), '–', scanned))
    tables = [Table('Delay', ('', 'd / samples', '± / samples', 'from'), tuple(rows))]
    if not na:
        return tables
    sigma = np.sqrt(np.maximum(np.diag(dynamics.covariance), 0.0))
    if sigma.size != na + nb:
        sigma = np.full(na + nb, math.nan)
    empty = ('', '')
    cells = []
    for i in range(max(na, nb)):
        a = (number(G.a[i], 6), number(sigma[i], 2)) if i < na else empty
        b = (number(G.b[i], 6), number(sigma[na + i], 2)) if i < nb else empty
        split = number(PAPER_GAIN * G.b[i], 4) if i < nb else ''
        cells.append((str(i + 1), *a, *b, split))
    tables.append(
        Table(
            'Coefficients of G',
            ('i', 'a_i', '±', 'b_i', '±', f'{PAPER_GAIN} b_i'),
            tuple(cells),
            'y(k) = - sum a_i y(k-i) + sum b_j w(k-d-j+1), normalised so that G(1) = 1. The paper '
            f'leaves a static gain of {PAPER_GAIN} in G; the last column is b in its split.',
        )
    )
    poles = modes(G, model.sample_rate, dynamics.covariance)
    if poles:
        tables.append(
            Table(
                'Poles of G as modes',
                ('', 'frequency / Hz', '± / Hz', 'damping ratio', '±'),
                tuple(
                    (
                        'resonance' if mode.oscillates else 'real pole',
                        number(mode.frequency, 4),
                        number(mode.frequency_std, 2),
                        number(mode.damping) if mode.oscillates else '–',
                        number(mode.damping_std, 2) if mode.oscillates else '–',
                    )
                    for mode in poles
                ),
                'Real: corner frequency. A mode whose uncertainty is as large as itself only '
                f'helps the others to fit. The input has power up to {number(dynamics.band, 4)} '
                'Hz; what lies above is an extrapolation.',
            )
        )
    if dynamics.methods:
        tables.append(
            Table(
                'Methods compared on held-out noise',
                ('method', 'free-run error / % of rms'),
                tuple(
                    (name, number(error) if math.isfinite(error) else 'unstable')
                    for name, error in dynamics.methods.items()
                ),
                f'At the order ({dynamics.order[0]}, {dynamics.order[1]}). Small-signal gain of '
                f'the noise {number(dynamics.slope_measured)}, of H at its bias '
                f'{number(dynamics.slope_model)} (normalised).',
            )
        )
    return tables


def hysteresis_tables(identification: Identification) -> list[Table]:
    """Return the weights, the scaling and how the solver fared."""
    model, fit = identification.model, identification.hysteresis
    h, s = model.hysteresis, model.scaling
    m = h.thresholds.size
    std = fit.std if fit.std.size == m + 2 else np.full(m + 2, math.nan)
    rows = [
        (
            f'q_{i + 1}',
            number(s.V * r, 4),
            number(r, 4),
            number(q, 4),
            'on its bound' if q == 0.0 else number(e, 2),
            number(q / PAPER_GAIN, 4),
        )
        for i, (r, q, e) in enumerate(zip(h.thresholds, h.weights, std[:m], strict=True))
    ]
    for name, value, e in (('p1', h.p1, std[m]), ('p2', h.p2, std[m + 1])):
        rows.append((name, '', '', number(value, 4), number(e, 2), number(value / PAPER_GAIN, 4)))
    tables = [
        Table(
            'Weights of H',
            ('', 'r / V', 'r', 'weight', '±', f'weight / {PAPER_GAIN}'),
            tuple(rows),
            'Normalised, for white residuals. The play at r = 0 is v itself, so p2 holds its '
            'weight too. H carries the static gain here; the last column is in the split of the '
            f'paper, where G(1) = {PAPER_GAIN}.',
        ),
        Table(
            'Scaling',
            ('', 'zero', 'span'),
            (
                ('voltage u = (v - v0) / V', f'{s.v0:.6g} V', f'{s.V:.6g} V'),
                ('displacement (y - y0) / Y', f'{1e6 * s.y0:.6g} µm', f'{1e6 * s.Y:.6g} µm'),
            ),
            'A negative Y belongs to a stage that retracts as the voltage rises.',
        ),
    ]
    swarm = fit.swarm
    solved = [('bounded least squares (optimum)', number(fit.optimum_loss, 5), '', '')]
    if fit.swarm_loss is not None and swarm is not None:
        excess = fit.swarm_loss / fit.optimum_loss - 1.0 if fit.optimum_loss > 0.0 else 0.0
        solved.insert(
            0,
            (
                'particle swarm, then polished' if fit.polished else 'particle swarm',
                number(fit.swarm_loss, 5),
                f'{number(100.0 * excess, 2)} %',
                f'{swarm.nit} iterations, {swarm.nfev} evaluations',
            ),
        )
    tables.append(
        Table(
            'Solver of the weights',
            ('', 'sum of squares', 'above optimum', 'effort'),
            tuple(solved),
            f'Normalised, over {fit.n} samples; rms {number(100.0 * fit.rms)} % of stroke.',
        )
    )
    return tables


def origin_tables(identification: Identification) -> list[Table]:
    """Return settings and versions."""
    story = identification.model.identification
    versions = {'piezo_ident': __version__, **dict(story.get('versions', {}))}
    settings = asdict(identification.settings)
    return [
        Table(
            'Settings',
            ('setting', 'value'),
            (
                ('method', str(story.get('method', '–'))),
                *((name, _value(value)) for name, value in settings.items()),
            ),
        ),
        Table(
            'Versions',
            ('software', 'version'),
            tuple((str(name), str(version)) for name, version in versions.items()),
        ),
    ]


def _value(value: object) -> str:
    if value is None:
        return 'chosen from the data'
    if isinstance(value, bool):
        return 'yes' if value else 'no'
    return str(value)


def fault_table(records: Sequence[Record]) -> Table | None:
    """Return what was wrong with the data, None when nothing was."""
    rows = tuple(
        (record.name, fault.name, str(fault.count), fault.where, fault.action)
        for record in records
        for fault in record.faults
    )
    if not rows:
        return None
    return Table('Faults in the data', ('record', 'fault', 'count', 'where', 'action'), rows)
