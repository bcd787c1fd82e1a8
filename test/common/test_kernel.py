# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Kernels import wherever the package is installed."""

import os
from pathlib import Path
import shutil
import subprocess
import sys

PACKAGE = Path(__file__).resolve().parents[2] / 'piezo_ident'


def test_a_read_only_installation_without_a_home_imports(tmp_path):
    copy = tmp_path / 'piezo_ident'
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns('__pycache__'))
    # root may write anywhere: a file in the place of a folder stops it too
    for folder in {path.parent for path in copy.rglob('*.py')}:
        (folder / '__pycache__').write_text('')
    nowhere = {'HOME': '/dev/null', 'XDG_CACHE_HOME': '/dev/null/cache'}
    script = 'from piezo_ident.common.kernel import alive; print(alive(1e-300), alive(2.0))'
    done = subprocess.run(
        [sys.executable, '-c', f'import piezo_ident.operators.play; {script}'],
        cwd=tmp_path,
        env={**os.environ, **nowhere, 'PYTHONPATH': str(tmp_path)},
        capture_output=True,
        text=True,
    )
    assert done.stdout.split() == ['0.0', '2.0'], done.stderr
