# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""An identification for people: its headline, its tables, a page and a summary."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
import math

import numpy as np
from piezo_ident import __version__
from piezo_ident.identification.results import ErrorRow, Identification
from piezo_ident.identification.warnings import LAW_WORDS
from piezo_ident.model.metrics import FORMULA, KINDS, percent
from piezo_ident.model.multi_axis import EachAxis
from piezo_ident.model.sines import SineError
from piezo_ident.report.html import Box, named, Page, page_text, pairs, Section, Shown
from piezo_ident.report.table import (
    FAULTS,
    length,
    listed,
    number,
    origin_tables,
    plain_text,
    Table,
    table,
)

#: how a headline begins, by the kind of data that it is about
ABOUT = {
    'validation': 'On {records}, recorded for validation',
    'held out': 'On data held out of the fit',
    'selection': 'On the parts of steps, noise and triangle that were held out from the fit (the '
    'only motion to test it)',
    'fitted': 'Nothing was held out; on the fitted data',
}
#: static gain that the paper leaves in G: its printed coefficients give G(1) = 0.6411
PAPER_GAIN = 0.6411
FOOTER = (
    'Method: Gu, Li, Zhu and Su, IEEE/ASME Trans. Mechatronics 21(3), 2016, '
    'doi:10.1109/TMECH.2015.2465868. Every error is of a free run, never of one-step '
    'prediction. The folder of this page also holds model.yaml, identification.json and the '
    'pictures.'
)


def headline(result: Identification) -> str:
    """
    Tell the error of the model, and of its hysteresis alone, in one sentence.

    The two errors are over the same samples, see `Identification.headline`.
    """
    errors = result.headline
    text = ABOUT[errors.data].format(records=', '.join(errors.records))
    text += f', the model errs by {number(errors.percent)} % of stroke'
    if not result.model.is_static and math.isfinite(errors.static_percent):
        text += f', its hysteresis alone by {number(errors.static_percent)} %'
    return f'{text} ({FORMULA}).'


def facts(result: Identification) -> list[tuple[str, str]]:
    """List the main numbers, for a place beside the headline."""
    model, delay, floor = result.model, result.delay, result.noise_floor
    # slow poles are removed after the search for the order
    na, nb = model.dynamics.a.size, model.dynamics.b.size
    low, high = model.scaling.range
    samples = f'{delay.samples} ± {number(delay.std, 2)} samples'
    if delay.source == 'given':
        samples = f'{delay.samples} samples (given)'
    is_validated = result.headline.data == 'validation'
    texts = {
        'stroke': length(result.stroke),
        'voltage': f'{low:g} .. {high:g} V',
        'direction': 'retracts with rising voltage' if model.scaling.Y < 0.0 else '',
        'sampling rate': f'{model.sample_rate:g} Hz',
        'delay': f'{samples} = {1e6 * model.delay.total / model.sample_rate:.4g} µs',
        'dynamics': f'na = {na}, nb = {nb}' if na else 'G = 1',
        'hysteresis': _law(result),
        'error holds': _stands_for(result),
        'another record': result.promise.told if result.promise and not is_validated else '',
        'sensor noise': 'unknown' if floor is None else f'{number(floor)} % of stroke rms',
        'effects': ', '.join(effect.name for effect in model.effects),
    }
    if result.shared is not None:
        texts |= {'delay': '', 'dynamics': f'shared modes, {result.shared.law}', 'hysteresis': ''}
    missing = dict(result.not_identified)
    return [
        (what, 'not identified' if what in missing else text)
        for what, text in texts.items()
        if text
    ]


def _law(result: Identification) -> str:
    h, words = result.model.hysteresis, LAW_WORDS.get(result.hysteresis.law)
    if words is None:
        return f'{h.thresholds.size} thresholds, p1, p2'
    return f'not a sum of plays: {h.thresholds.size} thresholds and {words}'


def _stands_for(result: Identification) -> str:
    """Describe the motions for which the error of the headline holds."""
    data = result.headline.data
    rows = [row for row in result.errors if row.data == data and row.driven]
    labels = dict.fromkeys(row.segment for row in rows if row.segment)
    if data == 'fitted' or not rows:
        return ''
    if not labels:
        return 'for similar motion: other parts of these records were fitted'
    return f'for motion of these kinds: {listed(labels)}'


def error_table(result: Identification) -> Table:
    """List the errors by record, segment and kind of data."""
    rows = sorted(result.errors, key=lambda row: (KINDS.index(row.data), not row.driven))
    cells = [
        (
            *(row.record, row.segment or 'whole', row.data),
            *(number(row.percent), number(row.static_percent), _fit(row), str(row.n)),
        )
        for row in rows
    ]
    source = '' if result.noise_floor is None else 'from '
    return Table(
        'Errors in % of stroke',
        ('record', 'segment', 'data', 'model', 'hysteresis alone', 'NRMSE fit / %', 'samples'),
        cells,
        f'{FORMULA}, with the stroke of the whole record. NRMSE fit: '
        '100 (1 - |y - y_hat| / |y - mean y|) over the samples of a row in motion. "validation": '
        'a record beside the fit. "held out": samples for this error alone. "selection": samples '
        'that chose between models. '
        f'Sensor noise: {source}{result.noise_source}.',
    )


def _fit(row: ErrorRow) -> str:
    # at rest the displacement is only noise, and a good model looks like a bad one
    if row.segment.partition(':')[0] == 'idle' or not math.isfinite(row.fit):
        return '–'
    # adding zero turns a negative zero into a plain one
    return f'{round(row.fit, 2) + 0.0:.2f}'


def sine_tables(rows: Sequence[SineError]) -> list[Table]:
    """List the steady-state errors in the layout of the paper's Table I; empty without sines."""
    errors = [
        ('model with dynamics', *(number(row.percent) for row in rows)),
        ('hysteresis alone', *(number(row.static_percent) for row in rows)),
    ]
    return table(
        'Errors of sines in steady state, % of stroke',
        ('frequency / Hz', *(f'{row.frequency:g}' for row in rows)),
        errors if rows else [],
        f'{FORMULA}, without the first second and at least one period; the stroke is counted '
        'there, too. Layout of Table I of the paper.',
    )


def dynamics_tables(result: Identification) -> list[Table]:
    """List delay, coefficients and modes of G, and the methods that were compared."""
    model, dynamics, delay = result.model, result.dynamics, result.delay
    G = model.dynamics
    na, nb = G.a.size, G.b.size
    std = '–' if delay.source == 'given' else number(delay.std, 2)
    rows = [('used', str(delay.samples), std, delay.source)]
    if delay.step is not None:
        samples = '–' if delay.step.samples is None else str(delay.step.samples)
        source = f'average of {delay.step.repeats}' if delay.step.repeats else 'no steps'
        rows.append(('steps', samples, number(delay.step.std, 2), source))
    if delay.scan is not None:
        source = 'noise segment' if delay.step is None else 'the same steps'
        rows.append(('scan of the ARX loss', str(delay.scan), '–', source))
    tables = [Table('Delay', ('', 'd / samples', '± / samples', 'from'), rows)]
    if not na:
        return tables
    sigma = np.sqrt(np.maximum(np.diag(dynamics.covariance), 0.0))
    if sigma.size != na + nb:
        sigma = np.full(na + nb, math.nan)
    a = [(number(x, 6), number(e, 2)) for x, e in zip(G.a, sigma[:na], strict=True)]
    b = [
        (number(x, 6), number(e, 2), number(PAPER_GAIN * x, 4))
        for x, e in zip(G.b, sigma[na:], strict=True)
    ]
    a += [('', '')] * (nb - na)
    b += [('', '', '')] * (na - nb)
    tables.append(
        Table(
            'Coefficients of G',
            ('i', 'a_i', '±', 'b_i', '±', f'{PAPER_GAIN} b_i'),
            [(str(i), *left, *right) for i, (left, right) in enumerate(zip(a, b, strict=True), 1)],
            'y(k) = - sum a_i y(k-i) + sum b_j w(k-d-j+1), normalised so that G(1) = 1. The paper '
            f'leaves a static gain of {PAPER_GAIN} in G; the last column is b in its split.',
        )
    )
    modes = [
        (
            *(number(mode.frequency, 4), number(mode.frequency_std, 2)),
            *(number(mode.damping), number(mode.damping_std, 2)),
        )
        for mode in G.modes(model.sample_rate, dynamics.covariance)
    ]
    note = (
        'A mode with an uncertainty of its own size only helps the other modes to fit. The data '
        f'show G up to {number(dynamics.known_to, 4)} Hz; higher frequencies are extrapolated.'
    )
    tables += table('Modes of G', ('frequency / Hz', '± / Hz', 'damping ratio', '±'), modes, note)
    methods = [
        (name, number(error) if math.isfinite(error) else 'unstable')
        for name, error in dynamics.methods.items()
    ]
    note = f'At the order ({dynamics.order[0]}, {dynamics.order[1]}).'
    if math.isfinite(dynamics.slope_measured):
        note += (
            f' Small-signal gain of the noise {number(dynamics.slope_measured)}, of H at its bias '
            f'{number(dynamics.slope_model)} (normalised).'
        )
    head = ('method', 'free-run error / % of rms')
    return [*tables, *table('Methods compared on held-out noise', head, methods, note)]


def hysteresis_tables(result: Identification) -> list[Table]:
    """List the weights of H, the losses of their solvers, and the laws of H that were compared."""
    model, fit = result.model, result.hysteresis
    h, s, m = model.hysteresis, model.scaling, model.hysteresis.thresholds.size
    std = fit.std if fit.std.size == m + 2 else np.full(m + 2, math.nan)
    rows = [
        (
            *(f'q_{i}', number(s.V * r, 4), number(r, 4), number(q, 4)),
            'on its bound' if q == 0.0 else number(e, 2),
            number(q / PAPER_GAIN, 4),
        )
        for i, (r, q, e) in enumerate(zip(h.thresholds, h.weights, std[:m], strict=True), 1)
    ]
    for name, value, e in (('p1', h.p1, std[m]), ('p2', h.p2, std[m + 1])):
        rows.append((name, '', '', number(value, 4), number(e, 2), number(value / PAPER_GAIN, 4)))
    if h.p0 != 0.0:
        rows.append(('p0', '', '', number(h.p0, 4), '', number(h.p0 / PAPER_GAIN, 4)))
    laws = [
        (f'{name}, chosen' if name == fit.law else name, number(100.0 * error, 3))
        for name, error in fit.errors_of_laws.items()
    ]
    compared = table(
        'Laws of H compared',
        ('law', 'error of parts / % of stroke'),
        laws,
        'Geometric mean over parts of the data, each predicted from the other parts. A wider law '
        'than plays must err by a quarter less.'
        + ' The weights above are then those at the lowest voltage.'
        * (fit.law != 'plays'),
    )
    solvers = [('bounded least squares (optimum)', number(fit.optimum_loss, 5), '', '')]
    if fit.swarm_loss is not None and fit.swarm is not None:
        excess = fit.swarm_loss / fit.optimum_loss - 1.0 if fit.optimum_loss > 0.0 else 0.0
        name = 'particle swarm, then polished' if fit.polished else 'particle swarm'
        effort = f'{fit.swarm.nit} iterations, {fit.swarm.nfev} evaluations'
        above = f'{number(100.0 * excess, 2)} %'
        solvers.insert(0, (name, number(fit.swarm_loss, 5), above, effort))
    return [
        Table(
            'Weights of H',
            ('', 'r / V', 'r', 'weight', '±', f'weight / {PAPER_GAIN}'),
            rows,
            'Normalised, for white residuals. The play at r = 0 is v itself; p2 holds its weight. '
            f'H carries the static gain; in the last column G carries {PAPER_GAIN}, as printed.',
        ),
        Table(
            'Solver of the weights',
            ('', 'sum of squares', 'above optimum', 'effort'),
            solvers,
            f'Normalised, over {fit.n} samples; rms '
            f'{number(percent(fit.rms, result.stroke / abs(s.Y)))} % of stroke.',
        ),
        *compared,
    ]


def identification_page(
    result: Identification,
    sines: Sequence[SineError] = (),
    pictures: Sequence[Shown] = (),
    left_out: Sequence[tuple[str, str]] = (),
) -> Page:
    """Make the page; `left_out` holds titles of missing pictures, with reasons."""
    faults = [
        (record.name, fault.name, str(fault.count), fault.where, fault.action)
        for record in result.records
        for fault in record.faults
    ]
    # a table lists the faults; the same faults among the warnings would hide other warnings
    listed_below = {
        f'{record.name}: {fault}' for record in result.records for fault in record.faults
    }
    warnings = [text for text in result.warnings if text not in listed_below]
    count = sum(not fault.is_note for record in result.records for fault in record.faults)
    if count:
        warnings.append(f'the data had {count} kinds of faults, see below')
    origin, of = result.model.identification, ' of the chain' if result.shared else ''
    settings = {'method': origin.get('method', '–'), **asdict(result.settings)}
    versions = {'piezo_ident': __version__, **dict(origin.get('versions', {}))}
    return Page(
        title='Identification of a piezo stage',
        source=', '.join(f'{r.name} ({r.duration:.4g} s)' for r in result.records),
        headline=headline(result),
        facts=facts(result),
        before=(
            Box('warnings', 'Warnings', warnings),
            Box('missing', 'Not identified', pairs(result.not_identified)),
        ),
        sections=(
            Section(
                'How well the model predicts',
                [
                    error_table(result),
                    *sine_tables(sines),
                    *named(pictures, 'sines', 'loops', 'segments', 'overview'),
                ],
                brief=True,
            ),
            Section(
                f'Delay and dynamics{of}',
                [*named(pictures, 'delay', 'response', 'orders'), *dynamics_tables(result)],
            ),
            Section(f'Hysteresis{of}', hysteresis_tables(result)),
            Section(
                'Origin',
                [
                    *table('Faults in the data', ('record', *FAULTS), faults),
                    *origin_tables(settings, 'chosen from the data', versions),
                ],
            ),
        ),
        after=(Box('missing', 'Pictures that these data do not allow', pairs(left_out)),),
        footer=FOOTER,
    )


def identification_text(result: Identification | EachAxis[Identification]) -> str:
    """Write headline, facts, errors and warnings for a terminal."""
    if isinstance(result, EachAxis):
        return result.told(identification_text)
    return page_text(identification_page(result), result.warnings)


def brief_table(result: Identification) -> Table:
    """List facts, errors and warnings for a notebook."""
    rows = [(kind, number(result.error(kind))) for kind in KINDS]
    errors = [(f'error, {kind}', f'{x} % of stroke') for kind, x in rows if x != '–']
    warnings = [('warning', warning) for warning in result.warnings]
    return Table('Model', ('', ''), [*facts(result), *errors, *warnings])


def table_one(rows: Sequence[SineError]) -> str:
    """Write the errors of sines as a table for a terminal, one column a frequency."""
    tables = sine_tables(rows)
    return plain_text(tables or ['no sine segment is long enough for its steady state'])
