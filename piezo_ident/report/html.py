# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Results as HTML: a page loads nothing from elsewhere, and all foreign text is escaped."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import TYPE_CHECKING

from piezo_ident.report.table import plain_text, Table

if TYPE_CHECKING:
    import jinja2

#: pixels of the page for one of a picture: letters of picture and page then have one size
PIXEL = 0.72
#: smallest width of a picture on a narrow screen, as a share of its width; then the page scrolls
LEAST = 0.65


@dataclass(frozen=True)
class Shown:
    """A picture as PNG, with its file name (without ending), title and caption."""

    name: str
    title: str
    caption: str
    png: bytes = field(repr=False)

    @property
    def data(self) -> str:
        """The picture in base 64."""
        return base64.b64encode(self.png).decode('ascii')

    @property
    def width(self) -> int:
        """Width on the screen; bytes 16 to 19 of a PNG hold its width in pixels."""
        return round(PIXEL * int.from_bytes(self.png[16:20], 'big'))

    @property
    def least_width(self) -> int:
        """Smallest width on the screen at which the letters can be read."""
        return round(LEAST * self.width)


@dataclass(frozen=True)
class Box:
    """A list in a box, of kind 'warnings' or 'missing'; left out without items."""

    kind: str
    title: str
    items: Sequence[str]


@dataclass(frozen=True)
class FileLink:
    """Link to another file: its address relative to the page, and a description."""

    href: str
    text: str


@dataclass(frozen=True)
class Step:
    """A suggestion: its reason, and the command that follows it."""

    reason: str
    command: str


@dataclass(frozen=True)
class Section:
    """Parts below a heading; None is left out.  Only `brief` sections are shown on a terminal."""

    title: str
    parts: Sequence[Table | Shown | Step | FileLink | str | None]
    brief: bool = False


@dataclass(frozen=True)
class Page:
    """A whole page, all plain text; the boxes stand above the facts and after the sections."""

    title: str
    source: str
    headline: str
    facts: Sequence[tuple[str, str]]
    before: Sequence[Box]
    sections: Sequence[Section]
    after: Sequence[Box]
    footer: str
    next_steps: Sequence[Step] = ()


def page_text(page: Page, warnings: Iterable[str]) -> str:
    """Write headline, facts, brief sections, boxes and warnings of a page for a terminal."""
    brief = [part for section in page.sections if section.brief for part in section.parts]
    boxes = [box for box in page.before if box.kind != 'warnings']
    return plain_text(
        [
            page.headline,
            Table('', ('', ''), page.facts),
            *(part for part in brief if isinstance(part, (str, Table))),
            *(f'{box.title.lower()}: {item}' for box in boxes for item in box.items),
            *(f'warning: {warning}' for warning in warnings),
        ]
    )


def named(pictures: Sequence[Shown], *names: str) -> list[Shown]:
    """Choose the pictures whose names begin with one of `names`."""
    return [picture for picture in pictures if picture.name.startswith(names)]


def pairs(items: Iterable[tuple[str, str]]) -> list[str]:
    """Join names and reasons to the items of a box."""
    return [f'{name}: {reason}' for name, reason in items]


@cache
def _environment() -> jinja2.Environment:
    # the import takes a tenth of a second, and few commands make a page
    import jinja2

    return jinja2.Environment(
        loader=jinja2.PackageLoader('piezo_ident.report', 'templates'),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )


def page_html(page: Page) -> str:
    """Write a page as one HTML file."""
    return _environment().get_template('page.html').render(page=page)


def summary_html(headline: str, table: Table, picture: Shown) -> str:
    """Write a sentence, a table and a picture as HTML for a notebook."""
    template = _environment().get_template('summary.html')
    return template.render(headline=headline, table=table, picture=picture)
