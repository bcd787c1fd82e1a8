# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Write the report of a result: a folder with the page, pictures, numbers and the model."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
import json
import os
from pathlib import Path
from typing import Any, TYPE_CHECKING

from piezo_ident.common.errors import DataError, expect
from piezo_ident.common.files import write_together
from piezo_ident.diagnosis.results import Diagnosis
from piezo_ident.identification.results import Identification
from piezo_ident.identification.settings import Progress, silent
from piezo_ident.model.files import model_to_yaml
from piezo_ident.model.multi_axis import EachAxis
from piezo_ident.model.sines import sines_of
from piezo_ident.report.advice import next_steps, Prompt
from piezo_ident.report.diagnosis import diagnosis_page
from piezo_ident.report.html import Page, page_html, Shown
from piezo_ident.report.identification import identification_page
from piezo_ident.report.json_data import to_json

if TYPE_CHECKING:
    from piezo_ident.report.figures.style import Drawn

PAGE, MODEL = 'report.html', 'model.yaml'
#: the numbers, by which an earlier report is known
NUMBERS: Mapping[type, str] = {Identification: 'identification.json', Diagnosis: 'diagnosis.json'}
#: all pictures that a report may have; a new report replaces or deletes all of them
PICTURES: Mapping[type, tuple[str, ...]] = {
    Identification: (
        *('sines', 'loops', 'segments', 'delay', 'response', 'orders'),
        *(f'overview_{i}' for i in range(1, 5)),
    ),
    Diagnosis: (
        *('errors', 'signature', 'spectrum', 'coherence'),
        *(f'residual_{i}' for i in range(1, 5)),
    ),
}

Result = Identification | Diagnosis
Results = Result | EachAxis[Identification] | EachAxis[Diagnosis]


def write_report(
    result: Results,
    folder: str | os.PathLike[str],
    *,
    progress: Progress = silent,
    prompt: Prompt | None = None,
) -> Path:
    """
    Write the report of an identification or a diagnosis.

    Parameters
    ----------
    result : Identification or Diagnosis, or EachAxis of them
    folder : path
        Made if it does not exist.  The files of an earlier report in it are replaced, all
        together; other files stay.
    progress : callable, optional
        Called with the name of the step and its share done; may raise `Cancelled` before the
        writing.
    prompt : Prompt, optional
        Names of the files in the commands that the page suggests.

    Returns
    -------
    Path
        The page, ``report.html``; beside it the pictures, ``model.yaml`` (of a diagnosis the
        refined model) and ``identification.json`` or ``diagnosis.json``.  With several axes, each
        axis has a folder with its report, beside ``model.yaml`` of the stage; the result is the
        page of the first axis.

    Raises
    ------
    DataError
        When the folder cannot be written, or holds files of these names from another source.

    Examples
    --------
    >>> import numpy as np
    >>> import piezo_ident as pi
    >>> v = 5.0 - 5.0 * np.cos(2.0 * np.pi * np.arange(4000) / 1000.0)
    >>> record = pi.Record.from_arrays(v, 1e-6 * v, sample_rate=1000.0)
    >>> page = pi.write_report(pi.identify(record, pi.Settings(thresholds=4)), 'report')
    >>> page.name, len(list(page.parent.glob('*.png'))) > 1
    ('report.html', True)
    """
    if isinstance(result, EachAxis):
        return _of_axes(result, Path(folder), progress, prompt)
    expect(result, (Identification, Diagnosis), 'write_report', 'give a result')
    kind = type(result)
    data, content, pictures = _content(result, progress)
    progress('writing', 0.9)
    target = Path(folder)
    named = prompt or Prompt(model=str(target / MODEL))
    page = page_html(replace(content, next_steps=next_steps(result, named)))
    check_report_folder(target, kind)
    numbers = json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False) + '\n'
    texts = {NUMBERS[kind]: numbers, MODEL: model_to_yaml(result.model)}
    # file names need not be Unicode
    files = {name: text.encode('utf-8', 'replace') for name, text in texts.items()}
    files |= {f'{picture.name}.png': picture.png for picture in pictures}
    write_together(target, {**files, PAGE: page.encode('utf-8', 'replace')})
    for name in set(PICTURES[kind]) - {picture.name for picture in pictures}:
        with suppress(OSError):
            (target / f'{name}.png').unlink()
    return target / PAGE


def _of_axes(
    result: EachAxis[Identification] | EachAxis[Diagnosis],
    folder: Path,
    progress: Progress,
    prompt: Prompt | None,
) -> Path:
    """Write the report of each axis into a folder of its own, and the model beside them."""
    pages = []
    for axis, x in result.items():
        (folder / axis).mkdir(parents=True, exist_ok=True)
        pages.append(write_report(x, folder / axis, progress=progress, prompt=prompt))
    result.model.save(folder / MODEL)
    return pages[0]


def _content(result: Result, progress: Progress) -> tuple[dict[str, Any], Page, list[Shown]]:
    """Make numbers, page and pictures of a result."""

    def tick(share: float) -> None:
        progress('drawing', 0.45 * share)

    # matplotlib takes half a second to import, and most commands draw nothing
    if isinstance(result, Diagnosis):
        from piezo_ident.report.figures.diagnosis import draw_diagnosis

        drawn = draw_diagnosis(result, tick)
        pictures = _rendered(drawn, progress)
        return to_json(result), diagnosis_page(result, pictures, drawn.left_out), pictures
    from piezo_ident.report.figures.identification import draw_identification

    runs = result.runs
    drawn = draw_identification(result, runs, tick)
    pictures = _rendered(drawn, progress)
    page = identification_page(result, sines_of(runs), pictures, drawn.left_out)
    return to_json(result, runs), page, pictures


def _rendered(drawn: Drawn, progress: Progress) -> list[Shown]:
    from piezo_ident.report.figures.style import png

    pictures = []
    for i, picture in enumerate(drawn.pictures):
        progress('drawing', 0.45 + 0.45 * i / len(drawn.pictures))
        pictures.append(Shown(picture.name, picture.title, picture.caption, png(picture.figure)))
    return pictures


def check_report_folder(folder: str | os.PathLike[str], kind: type) -> None:
    """
    Refuse a folder in which `write_report` would replace a file from another source.

    `kind` is the class of the result; the refusal is a DataError.
    """
    target = Path(folder)
    if (target / NUMBERS[kind]).exists():
        return
    # beside the reports of axes lies the model of their stage
    names = [PAGE] if any(target.glob(f'y*/{NUMBERS[kind]}')) else [PAGE, MODEL]
    for name in (*names, *(f'{name}.png' for name in PICTURES[kind])):
        if (target / name).exists():
            raise DataError(
                f'{target / name}: exists and is of no earlier report; choose another folder'
            )
