# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Results as one picture or a short table: in a file, in a notebook, at a prompt."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, TYPE_CHECKING

import numpy as np
from piezo_ident.common.errors import ConfigError
from piezo_ident.common.files import temporary_output
from piezo_ident.model.free_run import FreeRun, PieceRun
from piezo_ident.model.metrics import expected_error, FORMULA, worst_error
from piezo_ident.model.multi_axis import EachAxis, files_of
from piezo_ident.model.observer import HORIZON
from piezo_ident.record.record import Record
from piezo_ident.report.html import Shown, summary_html
from piezo_ident.report.table import length, number, plain_text, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from piezo_ident.control.inverse import Inverse
    from piezo_ident.diagnosis.results import Diagnosis
    from piezo_ident.identification.results import Identification
    from piezo_ident.model.front_door import ModelParameter
    from piezo_ident.model.stage_model import StageModel

    Result = Identification | Diagnosis | FreeRun | Inverse | Record

#: endings that a picture may have
ENDINGS = ('.png', '.pdf', '.svg')
#: dots an inch on a screen
DPI = 110


def plot(result: Result) -> Figure:
    """
    Draw the picture that tells most of a result.

    An identification is drawn as its hysteresis loop, measured and modelled, with the error.  A
    free run is its longest piece over time.  A diagnosis is the residual before and after.  An
    inverse is the voltage with the motion.  A record is voltage and displacement over time.

    Parameters
    ----------
    result : Identification, Diagnosis, FreeRun, Inverse or Record

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    NothingToDraw
        When the result holds no data.
    """
    # each import comes late, because the modules of a diagnosis take half a second
    from piezo_ident.control.inverse import Inverse
    from piezo_ident.report.figures.free_run import loops_figure, overview_figure, record_figure

    if isinstance(result, Record):
        return record_figure(result)
    if isinstance(result, FreeRun):
        i = int(np.argmax([piece.n for piece in result.record]))
        longest, y = result.record.pieces[i], result.pieces[i]
        half = result.half_widths[i] if result.half_widths else None
        return overview_figure(PieceRun(result.record.name, longest, y, y), half_width=half)
    if isinstance(result, Inverse):
        from piezo_ident.report.figures.drive import drive_figure

        return drive_figure(result)
    from piezo_ident.diagnosis.results import Diagnosis
    from piezo_ident.report.figures.diagnosis import worst_pieces
    from piezo_ident.report.figures.residual import residual_figure

    if isinstance(result, Diagnosis):
        return residual_figure(worst_pieces(result, 1)[0])
    return loops_figure(result.runs)


def save_plot(result: Result | EachAxis[Any], path: str | os.PathLike[str]) -> None:
    """
    Write the picture of `plot`.

    Parameters
    ----------
    result : Identification, Diagnosis, FreeRun, Inverse or Record, or EachAxis of them
    path : path
        Ending in .png, .pdf or .svg; an old file is replaced.  With several axes, each axis has
        its own file, with the name of the axis at the end.

    Raises
    ------
    ConfigError
        When the path has another ending.
    DataError
        When the file cannot be written.
    """
    target = Path(path)
    if target.suffix.lower() not in ENDINGS:
        raise ConfigError(f'{path}: a picture ends in {", ".join(ENDINGS)}')
    from piezo_ident.report.figures import style

    for axis, place in files_of(result, target).items():
        drawn = plot(result[axis] if isinstance(result, EachAxis) else result)
        with temporary_output(place, overwrite=True) as file:
            drawn.savefig(file, dpi=style.DPI)


def to_text(result: Result) -> str:
    """Write headline and table of a result as text, for a prompt."""
    return plain_text(_summary(result))


def to_html(result: Result) -> str:
    """Write headline, table and picture of a result as HTML, for a notebook."""
    from piezo_ident.report.figures.style import png

    headline, table = _summary(result)
    picture = Shown('result', table.title, '', png(plot(result), DPI))
    return summary_html(headline, table, picture)


def _value(p: ModelParameter) -> str:
    value = p.value if isinstance(p.value, str) else f'{p.value:.4g}'
    return f'{p.name} {value}' + f' {p.unit}' * (p.unit not in ('', '1', 'name'))


def _with_deviation(p: ModelParameter) -> str:
    if p.is_known is False:
        return f'not known by these data (± {number(p.std, 2)} {p.unit})'
    return f'{number(float(p.value), 4)} ± {number(p.std, 2)} {p.unit}'.rstrip()


def model_text(model: StageModel) -> str:
    """Describe a model as text: range, hysteresis, dynamics, delay, effects and known errors."""
    s, h, rate = model.scaling, model.hysteresis, model.sample_rate
    low, high = s.range
    lags = 0 if h.relaxations is None else len(h.relaxations)
    parts = [f'{h.thresholds.size} plays', *[f'{lags} lags along the path'] * (lags > 0)]
    parts += ['curves of their outputs'] * (h.curves is not None or h.bias is not None)
    rows = [('voltage', f'{low:g} .. {high:g} V'), ('stroke', length(abs(s.Y)))]
    rows += [('sampling rate', f'{rate:g} Hz'), ('hysteresis', ', '.join(parts))]
    rows += [('static gain', f'{length(abs(float(model.bode(0.0).gain[0])))}/V')]
    rows += [('order of G', f'na = {model.dynamics.a.size}, nb = {model.dynamics.b.size}')]
    rows += [
        ('mode', f'{number(mode.frequency, 4)} Hz, damping ratio {number(mode.damping)}')
        for mode in model.dynamics.modes(rate)
    ]
    delay = model.total_delay.total
    rows += [('delay', f'{delay:g} samples = {number(1e6 * delay / rate)} µs')]
    for effect in model.effects:
        own = [p for p in model.parameters if p.part == effect.name]
        rows.append((effect.name, ', '.join(map(_value, own))))
    rows += [(f'{p.part}, {p.name}', _with_deviation(p)) for p in model.quantities]
    error, worst = expected_error(model), worst_error(model)
    known = 'unknown' if error is None else f'{number(error)}, at worst {number(worst)}'
    rows += [('error', known + ' % of stroke' * (error is not None))]
    return plain_text([Table('Model', ('', ''), rows, FORMULA)])


def _summary(result: Result) -> tuple[str, Table]:
    if isinstance(result, Record):
        return _record(result)
    if isinstance(result, FreeRun):
        return _free_run(result)
    from piezo_ident.control.inverse import Inverse

    if isinstance(result, Inverse):
        return _drive(result)
    from piezo_ident.diagnosis.results import Diagnosis
    from piezo_ident.report import diagnosis, identification

    if isinstance(result, Diagnosis):
        return diagnosis.headline(result), diagnosis.brief_table(result)
    return identification.headline(result), identification.brief_table(result)


def _record(record: Record) -> tuple[str, Table]:
    rates = ', '.join(f'{rate:g}' for rate in dict.fromkeys(p.sample_rate for p in record))
    low, high = record.voltage_range
    channels = sorted({name for piece in record for name in piece.channels})
    rows = [('samples', str(record.n)), ('duration', f'{number(record.duration, 4)} s')]
    rows += [('sampling rate', f'{rates} Hz'), ('voltage', f'{low:.4g} .. {high:.4g} V')]
    rows += [('stroke', length(record.stroke) if record.is_measured else 'none, voltage alone')]
    rows += [('segments', ', '.join(record.labels))] if record.labels else []
    rows += [('channels', ', '.join(channels))] if channels else []
    rows += [('fault', str(fault)) for fault in record.faults]
    text = f'Record {record.name}' + (f', {len(record.pieces)} pieces' * (len(record.pieces) > 1))
    return f'{text}.', Table('Record', ('', ''), rows)


def _free_run(result: FreeRun) -> tuple[str, Table]:
    parts = [('whole record', result.errors)]
    late, rows = result.errors_after_start, []
    if late is not None and any(result.estimated):
        parts.append(('start forgotten', late))
    for name, e in parts:
        counts = f'NRMSE fit {number(e.fit, 4)} %, {e.n} samples'
        rows.append((name, f'{number(e.percent)} % of stroke, {counts}'))
        if e.mostly_offset:
            zero = ': as if the sensor were zeroed elsewhere' if e.only_offset else ''
            left = f'{number(e.percent_without_offset)} % after removing a mean of'
            rows.append(('', f'{left} {length(e.offset)}{zero}'))
    if (seen := result.errors_of_estimate) is not None:
        how = f'from displacement {HORIZON} samples before'
        rows.append(('estimate', f'{number(seen.percent)} % of stroke, {how}'))
    if result.interval is not None:
        half = np.concatenate(result.half_widths)
        half = half[np.isfinite(half)]
        mean = length(float(half.mean())) if half.size else 'not known'
        level, inside = (f'{100.0 * x:.3g} %' for x in (result.interval, result.inside))
        rows.append(('band', f'± {mean} in the mean at {level}; {inside} lie inside'))
    if late is None:
        rows.append(('start', 'no sample at which it is forgotten: drive a wider range'))
    rows += [('warning', warning) for warning in result.warnings]
    error = number((late or result.errors).percent)
    text = f'On {result.record.name} the model errs by {error} % of stroke'
    return f'{text} ({FORMULA}).', Table('Free run', ('', ''), rows)


def _drive(result: Inverse) -> tuple[str, Table]:
    rows = [('voltage', f'{result.v.min():.4g} .. {result.v.max():.4g} V')]
    lead = 1e3 * float(result.t[result.lead] - result.t[0])
    rows += [('begins', f'{lead:.4g} ms before the motion')] if lead else []
    rows += [('left by the inversion', f'{number(result.error)} % of stroke')]
    expected = 'unknown, the model holds no error on data it was not fitted to'
    if result.expected is not None and result.expected_rms is not None:
        rms = length(result.expected_rms)
        expected = (
            f'{number(result.expected)} % of stroke, {rms} rms without the mean, as the model '
            'errs elsewhere'
        )
        if result.error > result.expected:
            expected += '; what the inversion leaves comes on top'
    rows += [('expected', expected)]
    offset = 'unknown, the model has no creep'
    if result.expected_offset is not None:
        offset = f'{length(result.expected_offset)}, where the stage waits 1 s at the beginning'
    rows += [('expected mean', offset)]
    rows += [('warning', warning) for warning in result.warnings]
    rows += [('% of stroke', FORMULA)]
    text = f'A voltage of {result.v.size} samples moves {length(float(np.ptp(result.wanted)))}.'
    return text, Table('Drive', ('', ''), rows)
