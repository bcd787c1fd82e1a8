# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The pages of the studies hold the words of their scripts, and the numbers of their cases."""

import ast
import csv
from pathlib import Path
import re

import any_record
import numpy as np
import piezo_ident as pi
from piezo_ident.cli.main import main
from piezo_ident.diagnosis import criteria
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


def draw_of(name):
    """Return the row of a draw of diagnoses."""
    hiding, empty, growth = [], [], []
    for row in cases_of(name):
        words, end = set(row['case'].split()), row['outcome'].split(':')[0]
        growth.append(float(row['unseen after']) / float(row['unseen before']))
        if end != 'small' and not words & set(study.NO_CANDIDATES):
            (empty if words & {'none', 'nothing'} else hiding).append(end)
    found = f'{hiding.count("named") + hiding.count("class")} of {len(hiding)}'
    false = f'{hiding.count("false")} | {empty.count("false")} of {len(empty)}'
    return f'[{len(growth)} stages]({name}.csv) | {found} | {false} | {max(growth):.2f} |'


def test_pages_quote_what_is_made_elsewhere():
    noise = re.search(r'Sensor noise at rest, ([\d.]+) %', page_of('benchmarks'))
    score = re.search(r'Brier score (0[.]\d+), of the base rate (0[.]\d+)', page_of('coverage'))
    white, pink = (
        [int(r['held %']) for r in cases_of('coverage') if r['stage and record'] == kind]
        for kind in ('on white unlabelled', 'on 1/f unlabelled')
    )
    programs = [pi.Program.load(x) for x in ('identification', 'diagnosis', 'survey')]
    steep = [f'{20e3 * np.abs(np.diff(x.build(20e3).v)).max():.0f} V/s' for x in programs]
    quotes = f"""
../README: from {programs[0].build(20e3).duration:.1f} s of its data
../README: noise at rest is {noise[1]} %
bands: in {min(white)} to {max(white)} % of the draws of white noise
bands: in {min(pink)} to {max(pink)} % of 1/f noise
diagnosis: {draw_of('diagnosis_study_foreign_2')}
diagnosis: {draw_of('diagnosis_study_foreign_3')}
diagnosis: {draw_of('diagnosis_study_2')}
diagnosis: {draw_of('diagnosis_study_3')}
diagnosis: is {criteria.BEYOND_CHANCE} times the largest on circularly shifted residuals
diagnosis: within {criteria.ALIKE} times of it
diagnosis: less than {criteria.RIVALS} times as much
diagnosis: {pi.DiagnosisSettings().most_samples:,} samples
driver: `identification` need {steep[0]}, of `diagnosis` {steep[1]}, of `survey` {steep[2]};
driver: At {2e-3 * programs[0].entries[3].options['cutoff']:g} kHz or less
limits: Brier score is {score[1]}, that of the base rate {score[2]} (
method: ranks {pi.Settings().max_order ** 2} orders
"""
    for page, quote in (line.split(': ', 1) for line in quotes.strip().splitlines()):
        assert quote in page_of(page), page


def test_pages_show_what_commands_print(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    rows = ''.join(f'{k / 1e3},{k},{1.25 * k}\n' for k in range(11))
    Path('scan.csv').write_text(f'time_s,voltage,position_um\n{rows}')
    Path('log.csv').write_text('Drive (V),Sensor (um)\n0,0\n1,1\n')
    for name in ('scan', 'log'):
        main(['convert', f'{name}.csv', f'{name}.npz'])
        assert flat(capsys.readouterr().err) in page_of('files')
