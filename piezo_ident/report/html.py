# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The parts of a page: nothing is loaded from elsewhere, everything foreign is escaped."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape

from piezo_ident.report.tables import Table

__all__ = ['Shown', 'cards', 'document', 'figures', 'listed', 'table']

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


def table(content: Table) -> str:
    """Return a table; a column is set as text when any of its cells is."""
    text = [
        i > 0 and not all(_is_number(row[i]) for row in content.rows)
        for i in range(len(content.head))
    ]

    def row(cells: Sequence[str], tag: str) -> str:
        return ''.join(
            f'<{tag} class="text">{escape(cell)}</{tag}>'
            if is_text
            else f'<{tag}>{escape(cell)}</{tag}>'
            for cell, is_text in zip(cells, text, strict=True)
        )

    body = ''.join(f'<tr>{row(cells, "td")}</tr>\n' for cells in content.rows)
    note = f'<p class="note">{escape(content.note)}</p>\n' if content.note else ''
    return (
        f'<h3>{escape(content.title)}</h3>\n<div class="wide"><table>\n'
        f'<thead><tr>{row(content.head, "th")}</tr></thead>\n<tbody>\n{body}</tbody>\n'
        f'</table></div>\n{note}'
    )


def figures(pictures: Sequence[Shown], *names: str) -> str:
    """Return the pictures whose names start with one of those given."""
    return ''.join(_figure(shown) for shown in pictures if shown[0].startswith(names))


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


def listed(kind: str, title: str, items: Sequence[str]) -> str:
    """Return a box of a kind ('warnings' or 'missing') with a list; empty without items."""
    if not items:
        return ''
    body = ''.join(f'<li>{escape(item)}</li>\n' for item in items)
    return f'<section class="{kind}"><h2>{escape(title)}</h2>\n<ul>\n{body}</ul></section>\n'


def cards(facts: Sequence[tuple[str, str]]) -> str:
    """Return a few numbers side by side, each below its name."""
    body = ''.join(
        f'<div><dt>{escape(what)}</dt><dd>{escape(said)}</dd></div>\n' for what, said in facts
    )
    return f'<dl class="facts">\n{body}</dl>\n'


def document(title: str, source: str, verdict: str, body: Sequence[str], footer: str) -> str:
    """
    Return a whole page.

    Parameters
    ----------
    title, source, verdict : str
        What stands on top: plain text.
    body : sequence of str
        HTML.
    footer : str
        Plain text.
    """
    return ''.join(
        [
            '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            f'<title>{escape(title)}</title>\n<style>{STYLE}</style></head><body>\n'
            f'<h1>{escape(title)}</h1>\n<p class="source">{escape(source)}</p>\n'
            f'<p class="verdict">{escape(verdict)}</p>\n',
            *body,
            f'<footer>{escape(footer)}</footer>\n</body></html>\n',
        ]
    )
