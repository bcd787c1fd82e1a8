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
    # each process compiles again, and says how to change that
    assert done.stderr.count('\n') == 1 and 'set NUMBA_CACHE_DIR' in done.stderr


def test_what_compiles_says_so_once(tmp_path):
    code = (
        'import numpy as np; from piezo_ident.operators.kernels import held\n'
        'from piezo_ident.common.kernel import alive; alive(1.0); held(1.0, 0.0, 2.0)'
    )
    said = [
        subprocess.run(
            [sys.executable, '-c', code],
            env={**os.environ, 'NUMBA_CACHE_DIR': str(tmp_path)},
            capture_output=True,
            text=True,
            check=True,
        ).stderr
        for _ in range(2)
    ]
    assert said[0].startswith('compiling ') and 'common.kernel.alive' in said[0]
    assert str(tmp_path) in said[0] and said[0].count('\n') == 1
    assert said[1] == ''
