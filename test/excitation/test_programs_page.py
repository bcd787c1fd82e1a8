# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The page of the programs knows every key of the head and of every signal."""

from pathlib import Path

from piezo_ident.excitation.catalogue import Option, REQUIRED, SIGNALS
from piezo_ident.excitation.program import _HEAD, Program
import pytest

ROOT = Path(__file__).resolve().parents[2]
LINES = (ROOT / 'docs/programs.md').read_text(encoding='utf-8').splitlines()


def cells(name: str, columns: int) -> list[str]:
    """Return the cells of the row that begins with a name, in the table of so many columns."""
    rows = [[c.strip() for c in line.strip('|').split('|')] for line in LINES if line[:1] == '|']
    (row,) = [row for row in rows if row[0] == f'`{name}`' and len(row) == columns]
    return row


def written(key: str, option: Option) -> str:
    """Return how the table of the signals writes a key, its unit and its default."""
    text = f'`{key}`' + (f' {option.unit}' if option.unit not in ('', '1') else '')
    text += ' (list)' if option.many else ''
    text += f' ({" or ".join(option.choices)})' if option.choices else ''
    if option.default is REQUIRED:
        return text
    if option.default is None:
        return f'{text} [-]'
    return f'{text} [{option.default if option.choices else format(option.default, "g")}]'


@pytest.mark.parametrize('name', SIGNALS)
def test_every_signal_stands_on_the_page_with_all_its_keys(name):
    signal = SIGNALS[name]
    _, kind, keys, use = cells(name, 4)
    assert kind == f'`{signal.kind}`'
    assert keys == ', '.join(written(key, option) for key, option in signal.options.items())
    assert use


@pytest.mark.parametrize('key', _HEAD)
def test_every_key_of_the_head_stands_on_the_page(key):
    option = _HEAD[key]
    _, unit, default, meaning = cells(key, 4)
    assert unit == option.unit.replace('1', '')
    if option.default is REQUIRED:
        assert default == 'must be given'
    else:
        assert default == ('-' if option.default is None else f'{option.default:g}')
    assert meaning


def test_what_the_page_says_of_the_shipped_programs():
    text = '\n'.join(LINES)
    for name in ('identification', 'diagnosis', 'holds', 'validation', 'survey'):
        program = Program.load(ROOT / f'config/program_{name}.yaml')
        assert f'`program_{name}.yaml`' in text or f'`config/program_{name}.yaml`' in text
        assert program.limits == (0.0, 10.0)
