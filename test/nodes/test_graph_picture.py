# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0


"""The picture of the graph shows all nodes and topics that are declared."""

import importlib.util
from pathlib import Path
import re

from piezo_ident.nodes.interfaces import TOPICS
from piezo_ident.nodes.parameters import NODES

IMAGES = Path(__file__).resolve().parents[2] / 'docs/images'


def texts(svg: str) -> list[str]:
    return [t.strip() for t in re.findall(r'<text[^>]*>([^<]*)</text>', svg)]


def test_the_picture_shows_what_is_declared(tmp_path):
    shown = texts((IMAGES / 'graph.svg').read_text(encoding='utf-8'))
    wanted = {t.name for t in TOPICS if not t.name.startswith(('~', '/'))} | set(NODES)
    assert wanted <= set(shown), 'run: python docs/images/draw_graph.py docs/images/graph.svg'
    spec = importlib.util.spec_from_file_location('draw_graph', IMAGES / 'draw_graph.py')
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    script.draw().savefig(tmp_path / 'new.svg')
    assert 'svg' in (tmp_path / 'new.svg').read_text(encoding='utf-8')
    assert set(script.SPOTS) == wanted - set(NODES) | {'model'}
    for page in ('README.md', 'docs/graph.md'):
        text = (IMAGES.parents[2] / page).read_text(encoding='utf-8')
        assert 'images/graph.svg' in text
