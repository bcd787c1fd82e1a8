# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What an identification or a diagnosis found, for people and for programs."""

from piezo_ident.report.diagnosis_folder import check_diagnosis_folder, write_diagnosis_report
from piezo_ident.report.diagnosis_tables import changes, Unseen
from piezo_ident.report.diagnosis_text import diagnosis_summary
from piezo_ident.report.folder import check_report_folder, write_report
from piezo_ident.report.numbers import steps_to_json, to_json, verdict
from piezo_ident.report.text import error_table_for_sines, table_one, text_summary

__all__ = [
    'Unseen',
    'changes',
    'check_diagnosis_folder',
    'check_report_folder',
    'diagnosis_summary',
    'error_table_for_sines',
    'steps_to_json',
    'table_one',
    'text_summary',
    'to_json',
    'verdict',
    'write_diagnosis_report',
    'write_report',
]
