# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The pages of the studies hold the words of their scripts, and the numbers of their cases."""

import ast
import csv
from pathlib import Path
import re

import any_record
import numpy as np
import pytest
import study_diagnosis as study
import study_tracking

ROOT = Path(__file__).resolve().parents[2]

#: script of each page; `study_diagnosis` writes two
SCRIPTS = {
    'any_record': 'any_record',
    'benchmarks': 'run_all',
    'bouc_wen': 'bouc_wen',
    'coverage': 'study_coverage',
    'identification_study': 'study_identification',
    'live': 'bench_live',
    'mirror': 'study_mirror',
    'stays_right': 'stays_right',
    'table_one': 'table_one',
    'tracking': 'study_tracking',
    'xy_study': 'xy_scanner',
}


def flat(text):
    return ' '.join(text.split())


def page_of(name):
    return flat((ROOT / f'docs/{name}.md').read_text(encoding='utf-8'))


def cases_of(name):
    with (ROOT / f'docs/{name}.csv').open(encoding='utf-8', newline='') as file:
        return list(csv.DictReader(file))


def sentences(script):
    """Return the long texts of a script that end as sentences do, cut where numbers come in."""
    tree = ast.parse((ROOT / f'benchmarks/{script}.py').read_text(encoding='utf-8'))
    docstrings = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Module | ast.FunctionDef | ast.ClassDef)
        and isinstance(node.body[0], ast.Expr)
    }
    texts = (
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant)
        and isinstance(node.value, str)
        and id(node) not in docstrings
        and '. ' in flat(node.value)
    )
    parts = (flat(part) for text in texts for part in re.split(r'\{[^{}]*\}|\n\n|\n\|', text))
    return [part for part in parts if len(part) >= 60]


@pytest.mark.parametrize('name', SCRIPTS)
def test_a_page_has_the_words_of_its_script(name):
    page = page_of(name)
    stale = [sentence for sentence in sentences(SCRIPTS[name]) if sentence not in page]
    assert stale == []


@pytest.mark.parametrize(
    ('name', 'sums'), [('diagnosis_study', True), ('diagnosis_study_foreign', False)]
)
def test_a_page_of_diagnoses_has_the_words_of_its_set(name, sums):
    page = page_of(name)
    for text in (*study.PURPOSES[sums], study.SUMS if sums else study.FAMILIES):
        assert [part for part in re.split(r'\{\w+\}', flat(text)) if part not in page] == []


def test_scripts_have_words():
    assert sum(len(sentences(script)) for script in SCRIPTS.values()) > 40


def test_the_page_of_any_record_counts_its_cases():
    rows = cases_of('any_record')
    ratios = np.array([float(row['identify']) / float(row['best peer']) for row in rows])
    said = re.search(
        r'Of (\d+) cases (\d+) err .* median is ([\d.]+) times, the worst ([\d.]+)\.',
        page_of('any_record'),
    )
    cases, good, median, worst = map(float, said.groups())
    assert (cases, good) == (len(rows), np.sum(ratios <= 1.05))
    # three digits of the errors are kept
    assert median == pytest.approx(np.median(ratios), abs=0.01)
    assert worst == pytest.approx(ratios.max(), rel=0.01)
    for law in any_record.LAWS:
        errors = [
            [float(r['identify']), float(r['best peer'])] for r in rows if r['hysteresis'] == law
        ]
        line = ' | '.join([law, *(f'{x:.3g}' for x in np.median(errors, axis=0))])
        assert f'| {line} |' in page_of('any_record')


def test_the_page_of_tracking_has_the_medians_of_its_cases():
    page, rows = page_of('tracking'), cases_of('tracking')
    for stage in dict.fromkeys(row['stage'] for row in rows):
        own = [row for row in rows if row['stage'] == stage]
        medians = [
            np.median([float(r[head].split()[0]) for r in own]) for head in study_tracking.HEADS
        ]
        line = ' | '.join(
            [stage, own[0]['found'], own[0]['error of the model'], *(f'{x:.2g}' for x in medians)]
        )
        assert f'| {line} |' in page
