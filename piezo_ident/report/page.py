# Copyright 2026 The piezo_ident authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The report as one HTML page: nothing is loaded from elsewhere, everything foreign is escaped."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape

from piezo_ident.record import Record
from piezo_ident.report.numbers import verdict
from piezo_ident.report.tables import (
    dynamics_tables,
    error_tables,
    facts,
    fault_table,
    hysteresis_tables,
    origin_tables,
    Table,
)
from piezo_ident.results import Identification
from piezo_ident.validation import SineError

__all__ = ['Shown', 'page']

#: name, title, caption and PNG of a picture
Shown = tuple[str, str, str, bytes]

#: size on the screen of a pixel of a picture: the letters of both then have one size
SHOWN = 0.72

STYLE = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, -apple-system, 'Segoe UI', 'DejaVu Sans', sans-serif;
  color: #1a1a1a; background: #fff; max-width: 60rem; margin: 0 auto; padding: 1.5rem; }
h1 { font-size: 1.5rem; margin: 0 0 .2rem; }
h2 { font-size: 1.2rem; margin: 2.2rem 0 .6rem; border-bottom: 1px solid #ccc; }
h3 { font-size: 1rem; margin: 1.4rem 0 .4rem; }
.source { color: #555; margin: 0 0 1rem; overflow-wrap: anywhere; }
.verdict { font-size: 1.15rem; border-left: 4px solid #0072B2; padding: .4rem .9rem;
  background: #f1f6fa; margin: 0 0 1rem; }
.warnings, .missing { border-left: 4px solid #D55E00; background: #fdf3ec;
  padding: .5rem .9rem; margin: 1rem 0; }
.missing { border-color: #7a7a7a; background: #f5f5f5; }
.warnings h2, .missing h2 { border: 0; margin: 0 0 .2rem; font-size: 1rem; }
.warnings ul, .missing ul { margin: 0; padding-left: 1.2rem; }
dl.facts { display: grid; grid-template-columns: repeat(auto-fill, minmax(13rem, 1fr));
  gap: .5rem 1.2rem; margin: 1rem 0; }
dl.facts div { border-top: 1px solid #ccc; padding-top: .25rem; }
dt { color: #555; font-size: .85rem; } dd { margin: 0; font-weight: 600; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .9rem; font-variant-numeric: tabular-nums; }
th, td { padding: .2rem .7rem; text-align: right; border-bottom: 1px solid #e4e4e4;
  white-space: nowrap; }
th:first-child, td:first-child { text-align: left; padding-left: 0; }
td.text, th.text { text-align: left; white-space: normal; overflow-wrap: anywhere; }
thead th { border-bottom: 1.5px solid #333; font-weight: 600; vertical-align: bottom; }
.note, figcaption, footer { color: #555; font-size: .85rem; }
.note { margin: .4rem 0 0; max-width: 50rem; }
figure { margin: 1.2rem 0; break-inside: avoid; }
figure img { max-width: 100%; height: auto; display: block; }
figcaption b { color: #1a1a1a; }
footer { margin-top: 2.5rem; border-top: 1px solid #ccc; padding-top: .5rem; }
@media print { body { font-size: 10.5pt; max-width: none; padding: 0; }
  h2, h3 { break-after: avoid; } tr, .verdict, .warnings, .missing { break-inside: avoid; }
  thead { display: table-header-group; } .wide { overflow: visible; } }
"""


def _is_number(cell: str) -> bool:
    return not cell or (cell[0] in '0123456789-–∞' and len(cell) < 16)


def _table(table: Table) -> str:
    # a column is set as text when any of its cells is
    text = [
        i > 0 and not all(_is_number(row[i]) for row in table.rows) for i in range(len(table.head))
    ]

    def row(cells: Sequence[str], tag: str) -> str:
        return ''.join(
            f'<{tag} class="text">{escape(cell)}</{tag}>'
            if is_text
            else f'<{tag}>{escape(cell)}</{tag}>'
            for cell, is_text in zip(cells, text, strict=True)
        )

    body = ''.join(f'<tr>{row(cells, "td")}</tr>\n' for cells in table.rows)
    note = f'<p class="note">{escape(table.note)}</p>\n' if table.note else ''
    return (
        f'<h3>{escape(table.title)}</h3>\n<div class="wide"><table>\n'
        f'<thead><tr>{row(table.head, "th")}</tr></thead>\n<tbody>\n{body}</tbody>\n'
        f'</table></div>\n{note}'
    )


def _figure(shown: Shown) -> str:
    name, title, caption, png = shown
    data = base64.b64encode(png).decode('ascii')
    # the width in pixels stands at bytes 16 to 19 of every PNG
    width = round(SHOWN * int.from_bytes(png[16:20], 'big'))
    return (
        f'<figure id="{escape(name)}"><img src="data:image/png;base64,{data}" '
        f'width="{width}" alt="{escape(title)}">\n'
        f'<figcaption><b>{escape(title)}.</b> {escape(caption)}</figcaption></figure>\n'
    )


def _list(kind: str, title: str, items: Sequence[str]) -> str:
    if not items:
        return ''
    body = ''.join(f'<li>{escape(item)}</li>\n' for item in items)
    return f'<section class="{kind}"><h2>{escape(title)}</h2>\n<ul>\n{body}</ul></section>\n'


def page(
    identification: Identification,
    records: Sequence[Record],
    sines: Sequence[SineError],
    pictures: Sequence[Shown],
    left_out: Sequence[tuple[str, str]],
) -> str:
    """
    Return the HTML of a report.

    Parameters
    ----------
    identification : Identification
    records : sequence of Record
    sines : sequence of SineError
    pictures : sequence of (name, title, caption, png)
    left_out : sequence of (title, reason)
        Pictures that the data do not allow.
    """
    by_name: Mapping[str, Shown] = {shown[0]: shown for shown in pictures}

    def some(*names: str) -> str:
        return ''.join(_figure(shown) for name, shown in by_name.items() if name.startswith(names))

    names = ', '.join(f'{record.name} ({record.duration:.4g} s)' for record in records)
    cards = ''.join(
        f'<div><dt>{escape(what)}</dt><dd>{escape(said)}</dd></div>\n'
        for what, said in facts(identification)
    )
    faults = fault_table(records)
    # a fault is told in its own table; a second time would hide the other warnings
    told = {f'{record.name}: {fault}' for record in records for fault in record.faults}
    warnings = [said for said in identification.warnings if said not in told]
    if faults is not None:
        warnings.append(f'the data had {len(faults.rows)} kinds of faults, see below')
    parts = [
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<title>Identification of a piezo stage</title>\n'
        f'<style>{STYLE}</style></head><body>\n'
        '<h1>Identification of a piezo stage</h1>\n'
        f'<p class="source">{escape(names)}</p>\n'
        f'<p class="verdict">{escape(verdict(identification))}</p>\n',
        _list('warnings', 'Warnings', warnings),
        _list(
            'missing',
            'Not identified',
            [f'{what}: {why}' for what, why in identification.not_identified],
        ),
        f'<dl class="facts">\n{cards}</dl>\n',
        '<h2>How well the model predicts</h2>\n',
        *(_table(table) for table in error_tables(identification, sines)),
        some('sines', 'loops', 'segments', 'overview'),
        '<h2>Delay and dynamics</h2>\n',
        some('delay', 'response', 'orders'),
        *(_table(table) for table in dynamics_tables(identification)),
        '<h2>Hysteresis</h2>\n',
        some('weights'),
        *(_table(table) for table in hysteresis_tables(identification)),
        '<h2>Origin</h2>\n',
        _table(faults) if faults is not None else '',
        *(_table(table) for table in origin_tables(identification)),
        _list(
            'missing',
            'Pictures that these data do not allow',
            [f'{title}: {reason}' for title, reason in left_out],
        ),
        '<footer>Method: Gu, Li, Zhu and Su, IEEE/ASME Trans. Mechatronics 21(3), 2016, '
        'doi:10.1109/TMECH.2015.2465868. Every error is of a free run, never of one-step '
        'prediction. Beside this page: model.yaml, identification.json and the pictures.'
        '</footer>\n</body></html>\n',
    ]
    return ''.join(parts)
