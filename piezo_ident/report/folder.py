# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The report folder: the page, the pictures, the numbers and the model."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
import io
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING

from piezo_ident.common.errors import DataError
from piezo_ident.common.files import write_together
from piezo_ident.identification.results import Identification, Progress, silent
from piezo_ident.model.files import model_to_yaml
from piezo_ident.model.free_run import piece_runs, sines_of
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.record import Record
from piezo_ident.report.html import Shown
from piezo_ident.report.numbers import to_json
from piezo_ident.report.page import page

if TYPE_CHECKING:
    from piezo_ident.report.figures import Picture

__all__ = [
    'PAGE',
    'check_own',
    'check_report_folder',
    'put_in_place',
    'rendered',
    'write_report',
]

PAGE, NUMBERS, MODEL = 'report.html', 'identification.json', 'model.yaml'


def write_report(
    identification: Identification,
    records: Sequence[Record] | Record,
    folder: str | os.PathLike[str],
    *,
    progress: Progress = silent,
) -> Path:
    """
    Write a report.

    Every file is written under a temporary name first; the page is put in place last.

    Parameters
    ----------
    identification : Identification
    records : sequence of Record, or Record
        Those that were identified.
    folder : path
        Made when it does not exist.  Files of an earlier report there are replaced.
    progress : callable, optional
        Called with what is done and the share of it; may raise `Cancelled` as long as nothing is
        written.

    Returns
    -------
    Path
        The page, ``report.html``; beside it ``identification.json``, ``model.yaml`` and the
        pictures.

    Raises
    ------
    DataError
        When the folder cannot be written.
    """
    # matplotlib takes half a second to import, and most commands draw nothing
    from piezo_ident.report.figures import draw, NAMES

    records = [records] if isinstance(records, Record) else list(records)
    runs = piece_runs(identification.model, records, identification.memories)
    drawn = draw(identification, runs, lambda share: progress('drawing', 0.4 * share))
    shown = rendered(drawn.pictures, lambda share: progress('drawing', 0.4 + 0.5 * share))
    progress('writing', 0.9)
    html = page(identification, records, sines_of(runs), shown, drawn.left_out)
    numbers = json.dumps(
        to_json(identification, records, runs), indent=2, ensure_ascii=False, allow_nan=False
    )
    texts = {NUMBERS: numbers + '\n', PAGE: html}
    return put_in_place(folder, texts, identification.model, shown, NAMES)


def check_report_folder(folder: str | os.PathLike[str]) -> None:
    """
    Refuse a folder in which `write_report` would lay hands on what is of no earlier report.

    Raises
    ------
    DataError
    """
    from piezo_ident.report.figures import NAMES

    check_own(folder, (NUMBERS, PAGE), NAMES)


def rendered(pictures: Sequence[Picture], tick: Callable[[float], None]) -> list[Shown]:
    """
    Return pictures as PNG.

    Parameters
    ----------
    pictures : sequence of Picture
    tick : callable
        Called with the share done; may raise to stop it.
    """
    from piezo_ident.report.figures import DPI

    shown = []
    for i, picture in enumerate(pictures):
        tick(i / len(pictures))
        buffer = io.BytesIO()
        picture.figure.savefig(buffer, format='png', dpi=DPI)
        shown.append((picture.name, picture.title, picture.caption, buffer.getvalue()))
    return shown


def check_own(
    folder: str | os.PathLike[str], texts: Collection[str], names: Collection[str]
) -> None:
    """
    Refuse to replace or take away files of no earlier report, which is known by its numbers.

    Parameters
    ----------
    folder : path
        Need not exist.
    texts : collection of str
        File names of the page and of the numbers.
    names : collection of str
        As for `put_in_place`.

    Raises
    ------
    DataError
    """
    target = Path(folder)
    if any((target / name).exists() for name in texts if name != PAGE):
        return
    for name in (*texts, MODEL, *(f'{name}.png' for name in names)):
        if (target / name).exists():
            raise DataError(
                f'{target / name}: is there already, and of no earlier report; choose another '
                'folder'
            )


def put_in_place(
    folder: str | os.PathLike[str],
    texts: Mapping[str, str],
    model: StageModel,
    pictures: Sequence[Shown],
    names: Collection[str],
) -> Path:
    """
    Write the files of a report, all of them or none.

    Parameters
    ----------
    folder : path
        Made when it does not exist.
    texts : mapping of str to str
        By file name; one of them is the page, which is put in place last.
    model : StageModel
        Becomes ``model.yaml``.
    pictures : sequence of (name, title, caption, png)
    names : collection of str
        Names of pictures that a report of this kind may have; an earlier one's are taken away.

    Returns
    -------
    Path
        The page.

    Raises
    ------
    DataError
        When the folder cannot be written, or holds such files that are of no earlier report.
    """
    target = Path(folder)
    check_own(target, texts, names)
    # the numbers first: they tell that the files after them belong to a report
    # file names need not be Unicode
    files = {name: text.encode('utf-8', 'replace') for name, text in texts.items()}
    html = files.pop(PAGE)
    files |= {f'{name}.png': png for name, _, _, png in pictures}
    write_together(target, {**files, MODEL: model_to_yaml(model).encode(), PAGE: html})
    for name in set(names) - {name for name, *_ in pictures}:
        with suppress(OSError):
            (target / f'{name}.png').unlink()
    return target / PAGE
