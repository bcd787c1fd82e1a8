# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The report of one record of many, as files that can be sent from where the work was done."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
import tempfile

from piezo_ident.diagnosis.results import Diagnosis
from piezo_ident.identification.results import Identification
from piezo_ident.record.record import Record
from piezo_ident.report.diagnosis_folder import write_diagnosis_report
from piezo_ident.report.folder import write_report

__all__ = ['diagnosis_files', 'identification_files']


def identification_files(found: Identification, record: Record) -> Mapping[str, bytes]:
    """Return the files of `piezo_ident.report.write_report`, by name."""
    with tempfile.TemporaryDirectory(prefix='piezo_ident.') as folder:
        write_report(found, record, folder)
        return _files(folder)


def diagnosis_files(found: Diagnosis) -> Mapping[str, bytes]:
    """Return the files of `piezo_ident.report.write_diagnosis_report`, by name."""
    with tempfile.TemporaryDirectory(prefix='piezo_ident.') as folder:
        write_diagnosis_report(found, folder)
        return _files(folder)


def _files(folder: str) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(Path(folder).iterdir())}
