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

"""The report folder: the page, the pictures, the numbers and the model."""

from __future__ import annotations

from collections.abc import Sequence
import io
import json
import os
from pathlib import Path
import shutil
import tempfile

from piezo_ident.errors import DataError
from piezo_ident.model_io import save_model
from piezo_ident.record import Record
from piezo_ident.report.numbers import to_json
from piezo_ident.report.page import page
from piezo_ident.results import Identification, Progress, silent
from piezo_ident.validation import free_runs, sines_of

__all__ = ['write_report']


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
    from piezo_ident.plots import DPI, draw, NAMES

    records = [records] if isinstance(records, Record) else list(records)
    runs = free_runs(identification.model, records, identification.memories)
    drawn = draw(identification, runs, lambda share: progress('drawing', 0.4 * share))
    shown = []
    for i, picture in enumerate(drawn.pictures):
        progress('drawing', 0.4 + 0.5 * i / len(drawn.pictures))
        buffer = io.BytesIO()
        picture.figure.savefig(buffer, format='png', dpi=DPI)
        shown.append((picture.name, picture.title, picture.caption, buffer.getvalue()))
    progress('writing', 0.9)
    html = page(identification, records, sines_of(runs), shown, drawn.left_out)
    numbers = json.dumps(
        to_json(identification, records, runs), indent=2, ensure_ascii=False, allow_nan=False
    )
    target = Path(folder)
    try:
        target.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(dir=target, prefix='.report.', suffix='.tmp'))
        try:
            for name, _, _, png in shown:
                (work / f'{name}.png').write_bytes(png)
            (work / 'identification.json').write_text(numbers + '\n', encoding='utf-8')
            save_model(identification.model, work / 'model.yaml')
            (work / 'report.html').write_text(html, encoding='utf-8')
            for name in sorted(os.listdir(work), key=lambda name: name == 'report.html'):
                os.replace(work / name, target / name)
            for name in set(NAMES) - {name for name, *_ in shown}:
                (target / f'{name}.png').unlink(missing_ok=True)
        finally:
            shutil.rmtree(work, ignore_errors=True)
    except OSError as error:
        raise DataError(
            f'{folder}: the report cannot be written ({error.strerror or error}); choose a folder '
            'with room and the right to write'
        ) from None
    return target / 'report.html'
