# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Results for people and for programs: a folder with a page, a summary, a picture, JSON.

Examples
--------
>>> import numpy as np
>>> import piezo_ident as pi
>>> v = 5.0 - 5.0 * np.cos(2.0 * np.pi * np.arange(4000) / 1000.0)
>>> record = pi.Record.from_arrays(v, 1e-6 * v, sample_rate=1000.0)
>>> result = pi.identify(record, pi.Settings(thresholds=4))
>>> pi.report.to_json(result)['sample_rate']
1000.0
>>> pi.report.save_plot(result, 'loop.png')
"""

from piezo_ident.report.diagnosis import diagnosis_text
from piezo_ident.report.folder import check_report_folder, write_report
from piezo_ident.report.identification import headline, identification_text, table_one
from piezo_ident.report.next_steps import next_steps, Prompt, Step
from piezo_ident.report.picture import model_text, plot, save_plot, to_html, to_text
from piezo_ident.report.refined import validated
from piezo_ident.report.table import length
from piezo_ident.report.to_json import json_text, steps_to_json, to_json

__all__ = [
    'Prompt',
    'Step',
    'check_report_folder',
    'diagnosis_text',
    'headline',
    'identification_text',
    'json_text',
    'length',
    'model_text',
    'next_steps',
    'plot',
    'save_plot',
    'steps_to_json',
    'table_one',
    'to_html',
    'to_json',
    'to_text',
    'validated',
    'write_report',
]
