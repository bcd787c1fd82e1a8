# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The documentation site builds without a warning, and holds every public name."""

from pathlib import Path
import re

import piezo_ident as pi
import pytest

build_main = pytest.importorskip('sphinx.cmd.build').build_main

DOCS = Path(__file__).resolve().parents[2] / 'docs'


@pytest.mark.filterwarnings('ignore')
def test_the_site_builds_without_a_warning(tmp_path, capsys):
    places = [str(DOCS), str(tmp_path / 'site')]
    assert build_main(['-q', '-W', '--keep-going', *places]) == 0, capsys.readouterr().err
    # the cases of the studies, which the pages link
    loaded = {path.name for path in (tmp_path / 'site').rglob('*.csv')}
    assert loaded == {path.name for path in DOCS.glob('*.csv')}
    # what a browser would ask other machines for as it opens a page
    page = (tmp_path / 'site' / 'index.html').read_text(encoding='utf-8')
    assert not re.findall(r'(?:src|<link[^>]* href)="(?:https?:)?//[^"]*', page)


def test_the_reference_holds_every_public_name():
    page = (DOCS / 'api.md').read_text(encoding='utf-8')
    named = re.findall(r'^\.\. auto\w+:: piezo_ident\.(\w+)$', page, re.MULTILINE)
    assert sorted(named) == sorted(set(pi.__all__) - {'__version__'})
