# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""``export``: writes a header, or refuses in one line."""

from dataclasses import replace
import json
from zipfile import ZipFile

from command_line import refuse, succeed
from paper_stage import PAPER
import piezo_ident as pi
from piezo_ident.operators.hysteresis import Hysteresis
import pytest


@pytest.fixture
def model(tmp_path):
    PAPER.save(tmp_path / 'model.yaml')
    return tmp_path / 'model.yaml'


def test_a_header_is_written(capsys, tmp_path, model):
    out = tmp_path / 'My-Stage.h'
    said = succeed(capsys, 'export', model, '--format', 'c', '--out', out, '--limits', 0, 9)
    assert f'wrote {out} with my_stage_step, my_stage_feedforward_step' in said
    assert 'samples ahead, 15.2 ms; --preview N' in said
    header = out.read_text()
    assert 'The stage of model.yaml' in header and '#define MY_STAGE_HIGHEST 9.0' in header
    assert (
        header.splitlines()[3:]
        == pi.export_c(PAPER, 'my_stage', limits=(0.0, 9.0)).splitlines()[4:]
    )
    more = ['--overwrite', '--name', 'axis', '--slew', '5e3', '--json']
    result = json.loads(succeed(capsys, 'export', model, '--out', out, *more))
    assert result['functions'] == ['axis_step', 'axis_feedforward_step']
    assert result['preview'] == 304
    assert '#define AXIS_STEP 0.25' in out.read_text()


def test_an_fmu_is_written(capsys, tmp_path, model):
    out = tmp_path / 'stage.fmu'
    result = json.loads(succeed(capsys, 'export', model, '--out', out, '--json'))
    assert result['format'] == 'fmu' and result['functions'] == []
    with ZipFile(out) as archive:
        assert 'modelName="stage"' in archive.read('modelDescription.xml').decode()
        assert 'sources/stage.h' in archive.namelist()


def test_what_has_no_inverse_is_said(capsys, tmp_path, model):
    replace(PAPER, hysteresis=Hysteresis([0.1], [0.1], -0.8, 2.0)).save(model)
    assert 'no feed-forward' in succeed(capsys, 'export', model, '--out', tmp_path / 'stage.h')


@pytest.mark.parametrize(
    ('words', 'what'),
    [
        ([], '--out stage.h'),
        (['--out', 'stage.txt'], 'choose .h, .fmu'),
        (['--out', 'stage.fmu', '--format', 'c'], 'choose .h'),
        (['--out', 'stage.fmu', '--slew', '100'], 'has no feed-forward'),
        (['--out', 'stage.h', '--format', 'fortran'], 'fortran'),
        (['--out', '3.h'], '--name stage'),
        (['--out', 'stage.h', '--slew', '0'], 'no speed'),
        (['--out', 'stage.h', '--limits', '3', '1'], 'lower one first'),
        (['--out', 'none/stage.h'], 'there is no folder'),
    ],
)
def test_one_line_of_refusal(capsys, tmp_path, monkeypatch, model, words, what):
    monkeypatch.chdir(tmp_path)
    refuse(capsys, tmp_path, ['export', 'model.yaml', *words], what)
