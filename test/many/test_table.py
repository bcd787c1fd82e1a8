# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The table of many records."""

import csv
import io
from pathlib import Path
import re

from piezo_ident.many.table import COLUMNS, columns_of, csv_text, Row
import pytest

ROWS = [
    Row('a', {'stroke': 7e-5, 'q1': 0.5, 'r1': 0.1, 'creep.share': 0.9, 'warnings': ''}),
    Row('b', {'stroke': 7.5e-5, 'q2': 0.25, 'r2': 0.2}),
    Row('c', reason='no displacement'),
]


def test_columns_keep_their_order_and_numbers_are_read_back_exactly():
    known = ['record', 'status', 'reason', 'stroke']
    assert columns_of(ROWS) == [*known, 'r1', 'q1', 'r2', 'q2', 'creep.share', 'warnings']
    lines = list(csv.DictReader(io.StringIO(csv_text(ROWS))))
    assert float(lines[0]['stroke']) == 7e-5
    assert lines[2]['status'] == 'failed' and lines[2]['stroke'] == ''


@pytest.mark.parametrize('name', ['=cmd|x', '+1', '-1', '@a', '\ta'])
def test_a_name_is_no_formula_of_a_spreadsheet(name):
    (line,) = csv.DictReader(io.StringIO(csv_text([Row(name, {'stroke': -1.0})])))
    assert line['record'] == f"'{name}"
    assert float(line['stroke']) == -1.0


def test_every_column_is_in_the_documentation():
    page = Path(__file__).resolve().parents[2] / 'docs/many_records.md'
    text = page.read_text(encoding='utf-8')
    rows = re.findall(r'^\| (`\w+`(?:, `\w+`)*) \| (.*?) \|', text, re.MULTILINE)
    units = {name.strip('`'): unit.strip() for names, unit in rows for name in names.split(', ')}
    assert units == COLUMNS
