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
