# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The report folder of a diagnosis: the page, the pictures, the numbers and the refined model."""

from __future__ import annotations

from collections.abc import Sequence
import os
from pathlib import Path

from piezo_ident.diagnosis.diagnosis_json import json_text
from piezo_ident.diagnosis.results import Diagnosis
from piezo_ident.identification.results import Progress, silent
from piezo_ident.report.diagnosis_page import diagnosis_page
from piezo_ident.report.diagnosis_tables import Unseen
from piezo_ident.report.folder import check_own, PAGE, put_in_place, rendered

__all__ = ['check_diagnosis_folder', 'write_diagnosis_report']

NUMBERS = 'diagnosis.json'


def write_diagnosis_report(
    diagnosis: Diagnosis,
    folder: str | os.PathLike[str],
    *,
    unseen: Sequence[Unseen] = (),
    progress: Progress = silent,
) -> Path:
    """
    Write the report of a diagnosis.

    Every file is written under a temporary name first; the page is put in place last.

    Parameters
    ----------
    diagnosis : Diagnosis
    folder : path
        Made when it does not exist.  Files of an earlier report there are replaced.
    unseen : sequence of Unseen, optional
        Errors on records that took no part in the diagnosis.
    progress : callable, optional
        Called with what is done and the share of it; may raise `Cancelled` as long as nothing is
        written.

    Returns
    -------
    Path
        The page, ``report.html``; beside it ``diagnosis.json``, ``model.yaml`` (the refined model)
        and the pictures.

    Raises
    ------
    DataError
        When the folder cannot be written.
    """
    # matplotlib takes half a second to import, and most commands draw nothing
    from piezo_ident.report.figures.diagnosis import DIAGNOSIS_NAMES, draw_diagnosis

    drawn = draw_diagnosis(diagnosis, lambda share: progress('drawing', 0.5 * share))
    shown = rendered(drawn.pictures, lambda share: progress('drawing', 0.5 + 0.4 * share))
    progress('writing', 0.9)
    texts = {
        NUMBERS: json_text(diagnosis) + '\n',
        PAGE: diagnosis_page(diagnosis, shown, drawn.left_out, unseen),
    }
    return put_in_place(folder, texts, diagnosis.model, shown, DIAGNOSIS_NAMES)


def check_diagnosis_folder(folder: str | os.PathLike[str]) -> None:
    """
    Refuse a folder in which this report would lay hands on what is of no earlier one.

    Raises
    ------
    DataError
    """
    from piezo_ident.report.figures.diagnosis import DIAGNOSIS_NAMES

    check_own(folder, (NUMBERS, PAGE), DIAGNOSIS_NAMES)
