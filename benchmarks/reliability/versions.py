# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0
"""
The same data, other versions: how far the numbers differ on Python 3.10 to 3.13, NumPy and SciPy.

    .venv/bin/python benchmarks/reliability/versions.py             makes environments, minutes
    .venv/bin/python benchmarks/reliability/versions.py PYTHON...   compares these with the first

Every interpreter identifies the same measured samples; the first one made them.  Parameters are
compared relative to the largest of their kind, predictions relative to the stroke.
"""

from __future__ import annotations

import os

os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import argparse
import json
from pathlib import Path
import platform
import shutil
import subprocess
import sys
import tempfile

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / 'benchmarks'))
import numpy as np

#: Python, and what pip is to install: both ends of what setup.py allows, and Jazzy's
ENVIRONMENTS = {
    '3.10 oldest': ('3.10', ['numpy==1.26.0', 'scipy==1.11.1', 'numba==0.58.1']),
    '3.10 newest': ('3.10', ['numpy', 'scipy', 'numba']),
    '3.11 oldest': ('3.11', ['numpy==1.26.0', 'scipy==1.11.1', 'numba==0.58.1']),
    '3.11 newest': ('3.11', ['numpy', 'scipy', 'numba']),
    '3.12 Jazzy': ('3.12', ['-c', str(ROOT / 'constraints-jazzy.txt'), 'numpy', 'scipy', 'numba']),
    '3.13 newest': ('3.13', ['numpy', 'scipy', 'numba']),
}
COMMON = ['PyYAML>=6,<7', 'matplotlib>=3.6,<4', 'rosbags>=0.11,<0.12', 'tqdm>=4.60,<5']
SOLVERS = ('least_squares', 'swarm')


def make_data(path: Path, *, quick: bool) -> None:
    """Write the record that all identify, and the voltage that all predict."""
    if quick:
        from piezo_ident.record.io import write_record
        from reliability import untrusted

        programme = untrusted.PROGRAMME.replace('CUTOFF', '500')
        write_record(untrusted.measured(programme), path / 'identification.npz')
        write_record(untrusted.measured(untrusted.CHECK), path / 'validation.npz')
        return
    from piezo_ident.excitation.program import Program
    from piezo_ident.model.simulated_stage import SimulatedStage
    from piezo_ident.record.io import write_record

    stage = SimulatedStage.load('stage_paper')
    for name in ('identification', 'validation'):
        sequence = Program.load(name).build(stage.model.sample_rate)
        record = stage.play(sequence, np.random.default_rng(1))
        write_record(record, path / f'{name}.npz')


def measure(path: Path) -> None:
    """Print what this interpreter makes of the data, as JSON."""
    import numba
    from piezo_ident.identification.identify import identify
    from piezo_ident.identification.results import Settings
    from piezo_ident.model.files import model_to_dict
    from piezo_ident.model.free_run import free_run
    from piezo_ident.record.io import read_record
    import scipy

    record = read_record(path / 'identification.npz')
    check = read_record(path / 'validation.npz')
    found = {}
    for solver in SOLVERS:
        model = identify(record, Settings(thresholds=10, solver=solver)).model
        data = model_to_dict(model)
        found[solver] = {
            'delay': [data['delay']['samples'] + data['delay']['fraction']],
            'thresholds': data['hysteresis']['thresholds'],
            'weights': data['hysteresis']['weights'],
            'p': [data['hysteresis']['p1'], data['hysteresis']['p2']],
            'a': data['dynamics']['a'],
            'b': data['dynamics']['b'],
            'prediction': free_run(model, check).predicted[::97].tolist(),
        }
    print(
        json.dumps(
            {
                'python': platform.python_version(),
                'numpy': np.__version__,
                'scipy': scipy.__version__,
                'numba': numba.__version__,
                'found': found,
            }
        )
    )


def difference(one: dict[str, list[float]], other: dict[str, list[float]]) -> dict[str, float]:
    """Return the largest relative differences of parameters and of the prediction."""
    found = {'prediction': _relative(one, other), 'H': 0.0, 'G': 0.0, 'delay': 0.0}
    for key, x in one.items():
        if key == 'prediction' or not x:
            continue
        part = 'G' if key in 'ab' else 'delay' if key == 'delay' else 'H'
        scale = max(map(abs, x)) or 1.0
        worst = float('inf')
        if len(x) == len(other[key]):
            worst = max(abs(a - b) for a, b in zip(x, other[key], strict=True)) / scale
        found[part] = max(found[part], worst)
    return found


def _relative(one: dict[str, list[float]], other: dict[str, list[float]]) -> float:
    a, b = np.array(one['prediction']), np.array(other['prediction'])
    return float(np.abs(a - b).max() / np.ptp(a))


def environments(folder: Path) -> dict[str, str]:
    """Make the environments whose Python is here, and return their interpreters."""
    found = {}
    for name, (version, wanted) in ENVIRONMENTS.items():
        python = shutil.which(f'python{version}')
        place = folder / name.replace(' ', '-')
        if python is None or subprocess.run([python, '-V'], capture_output=True).returncode:
            print(f'{name}: python{version} is not here')
            continue
        if not (place / 'done').exists():
            subprocess.run([python, '-m', 'venv', '--clear', str(place)], check=True)
            pip = [str(place / 'bin' / 'pip'), 'install', '-q', *wanted, *COMMON]
            if subprocess.run(pip).returncode:
                print(f'{name}: cannot be installed')
                continue
            (place / 'done').touch()
        found[name] = str(place / 'bin' / 'python')
    return found


def main() -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('pythons', nargs='*', help='interpreters with what piezo_ident needs')
    parser.add_argument('--work', type=Path, default=Path('.venv-versions'), help='environments')
    parser.add_argument('--quick', action='store_true', help='a small stage; writes no rows')
    parser.add_argument('--measure', type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.measure:
        measure(args.measure)
        return 0
    from reliability.rows import write_rows

    pythons = {p: p for p in args.pythons} or environments(args.work)
    results = []
    with tempfile.TemporaryDirectory() as folder:
        make_data(Path(folder), quick=args.quick)
        for name, python in pythons.items():
            done = subprocess.run(
                [python, __file__, '--measure', folder],
                env={**os.environ, 'PYTHONPATH': str(ROOT)},
                capture_output=True,
                text=True,
            )
            if done.returncode:
                print(f'{name}: {done.stderr[-600:]}')
                continue
            results.append(json.loads(done.stdout.splitlines()[-1]))
    rows = []
    for one in results:
        versions = ', '.join(f'{k} {one[k]}' for k in ('python', 'numpy', 'scipy', 'numba'))
        said = []
        for solver in SOLVERS:
            d = difference(results[0]['found'][solver], one['found'][solver])
            said.append(f'{solver}: {", ".join(f"{k} {x:.1e}" for k, x in d.items())}')
        print(f'{versions}: {"; ".join(said)}')
        rows.append(
            {
                'what': f'other versions: {versions}',
                'how_often': 'one identification with each solver',
                'result': 'the reference' if one is results[0] else '; '.join(said),
                'command': 'python benchmarks/reliability/versions.py',
            }
        )
    if not args.quick:
        write_rows('versions', rows)
    return 0


if __name__ == '__main__':
    sys.exit(main())
