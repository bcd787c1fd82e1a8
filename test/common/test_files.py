# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Outputs appear whole or not at all, with the rights of the old one; YAML is read safely."""

import os
from pathlib import Path
import stat

from piezo_ident.common.errors import ConfigError, DataError
from piezo_ident.common.files import (
    load_yaml,
    parse_yaml,
    temporary_output,
    write_text,
    write_together,
    YAML_SIZE,
)
import pytest


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


@pytest.fixture(params=[0o022, 0o077, 0o002])
def umask(request):
    old = os.umask(request.param)
    yield request.param
    os.umask(old)


def by_context(path: Path, text: str) -> None:
    with temporary_output(path, overwrite=True) as file:
        file.write_text(text)


def together(path: Path, text: str) -> None:
    write_together(path.parent, {path.name: text.encode()})


@pytest.fixture(params=[write_text, by_context, together])
def write(request):
    return request.param


def test_a_new_output_has_the_rights_of_the_umask(tmp_path, umask, write):
    write(tmp_path / 'out', 'new')
    assert mode(tmp_path / 'out') == 0o666 & ~umask


@pytest.mark.parametrize('rights', [0o600, 0o664, 0o440])
def test_a_replaced_output_keeps_its_rights(tmp_path, write, rights):
    path = tmp_path / 'out'
    path.write_text('old')
    path.chmod(rights)
    write(path, 'new')
    assert (path.read_text(), mode(path)) == ('new', rights)


def test_a_link_is_followed(tmp_path, write):
    (tmp_path / 'data').mkdir()
    target, link = tmp_path / 'data' / 'real', tmp_path / 'link'
    target.write_text('old')
    link.symlink_to('data/real')
    write(link, 'new')
    assert link.is_symlink() and target.read_text() == 'new'
    assert os.listdir(tmp_path / 'data') == ['real']


@pytest.mark.parametrize('failing', ['fsync', 'replace'])
@pytest.mark.parametrize('old', [None, 'old'])
def test_a_full_disk_leaves_the_old_and_nothing_else(tmp_path, monkeypatch, write, failing, old):
    def full(*arguments):
        raise OSError(28, 'No space left on device')

    path = tmp_path / 'out'
    if old:
        path.write_text(old)
    monkeypatch.setattr(os, failing, full)
    with pytest.raises(DataError, match=f'{tmp_path}.*No space left on device'):
        write(path, 'new')
    assert [p.read_text() for p in tmp_path.iterdir()] == ([old] if old else [])


def test_an_interrupt_leaves_nothing(tmp_path, monkeypatch):
    def interrupted(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, 'fsync', interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_text(tmp_path / 'out', 'new')
    assert os.listdir(tmp_path) == []


def test_what_is_there_is_not_replaced_unasked(tmp_path):
    (tmp_path / 'out').write_text('old')
    with pytest.raises(DataError, match='out: '), temporary_output(tmp_path / 'out'):
        pass
    (tmp_path / 'mine').mkdir()
    (tmp_path / 'mine' / 'thesis').write_text('')
    with pytest.raises(DataError, match='mine'):
        write_text(tmp_path / 'mine', 'new')
    with pytest.raises(DataError, match='no folder/out: '):
        write_text(tmp_path / 'no folder' / 'out', 'new')


ALIASES = 'a0: &a0 [1, 1]\n' + ''.join(
    f'a{i}: &a{i} [*a{i - 1}, *a{i - 1}]\n' for i in range(1, 40)
)
MERGES = 'a0: &a0 {x: 1}\n' + ''.join(
    f'a{i}: &a{i} {{<<: [*a{i - 1}, *a{i - 1}]}}\n' for i in range(1, 40)
)


@pytest.mark.parametrize(
    'text',
    [
        '',
        '[1, 2]',
        'a: [',
        'a: !!python/object/apply:os.system [x]',
        'a: !!python/name:os.system',
        'a: &a [*a]',
        ALIASES,
        MERGES,
        'a: ' + '[' * 100_000,
        'a: ' + 'x' * YAML_SIZE,
    ],
    ids=range(10),
)
def test_what_is_no_small_mapping_is_refused(text):
    with pytest.raises(ConfigError, match=r'^model\.yaml: ') as caught:
        parse_yaml(text, 'model.yaml')
    assert len(str(caught.value)) < 200


def test_aliases_are_read():
    assert parse_yaml('a: &a [1, 2]\nb: *a', 'x') == {'a': [1, 2], 'b': [1, 2]}


def test_unreadable_files_are_named(tmp_path):
    (tmp_path / 'loop').symlink_to('loop')
    (tmp_path / 'lost').symlink_to('nowhere')
    (tmp_path / 'binary').write_bytes(b'\xff\xfe\x80')
    (tmp_path / 'folder').mkdir()
    os.mkfifo(tmp_path / 'pipe')
    for name in ('loop', 'lost', 'binary', 'folder', 'pipe', 'nothing'):
        with pytest.raises(ConfigError, match=name):
            load_yaml(tmp_path / name)
