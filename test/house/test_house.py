# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The house rules that no linter knows."""

import ast
from collections.abc import Iterator
import json
from pathlib import Path
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / 'piezo_ident'

HEADER = """\
# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0
"""

# The rooms of the package: a room imports only itself and rooms that stand before it.
ROOMS = (
    'common',
    'operators',
    'record',
    'excitation',
    'effects',
    'model',
    'residual',
    'fitting',
    'selection',
    'identification',
    'diagnosis',
    'uncertainty',
    'control',
    'export',
    'verbs',
    'live',
    'report',
    'many',
    'cli',
    'nodes',
)

# Lines and modules of rooms, at most: what was reached, to the next hundred.
SIZES = {
    'cli': (2100, 12),
    'common': (1000, 9),
    'control': (2200, 10),
    'diagnosis': (6000, 24),
    'effects': (3100, 23),
    'excitation': (1100, 6),
    'export': (700, 5),
    'fitting': (1800, 10),
    'identification': (4400, 18),
    'identification/solvers': (800, 5),
    'live': (3800, 16),
    'many': (800, 6),
    'model': (4500, 19),
    'nodes': (4000, 18),
    'nodes/identifier': (1400, 7),
    'operators': (1900, 10),
    'record': (2800, 11),
    'record/bags': (1100, 4),
    'record/readings': (1000, 6),
    'record/tables': (1400, 7),
    'report': (2100, 10),
    'report/figures': (1500, 8),
    'residual': (2000, 10),
    'selection': (300, 4),
    'uncertainty': (900, 12),
}

# Import names whose rosdep keys read otherwise; a ROS package is its own key.
ROSDEP_KEYS = {
    'click': 'python3-click',
    'h5py': 'python3-h5py',
    'jinja2': 'python3-jinja2',
    'matplotlib': 'python3-matplotlib',
    'numba': 'python3-numba',
    'numpy': 'python3-numpy',
    'rosbags': 'python3-rosbags-pip',
    'scipy': 'python3-scipy',
    'tqdm': 'python3-tqdm',
    'yaml': 'python3-yaml',
}

# Have no rosdep key: imported only to read unfinished or compressed bags, and need not be there.
PIP_ONLY = {'mcap', 'zstandard'}

# Of the extras: imported only where somebody asks for what they do.
OPTIONAL = {'control', 'distributed'}

# Runs in an interpreter of its own: imports the modules named as arguments with ROS out of reach,
# prints which of them asked for it all the same.
BLOCKED_IMPORTS = """
import importlib
import json
import sys

ROS = ('rclpy', 'rcl_interfaces', 'rosidl_', 'builtin_interfaces', 'std_msgs', 'std_srvs',
       'sensor_msgs', 'diagnostic_msgs', 'ament_index_python', 'launch')
asked = []


class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.startswith(ROS):
            asked.append([module, name])
            raise ModuleNotFoundError(f'{name} is blocked', name=name)
        return None


sys.meta_path.insert(0, Blocker())
for module in sys.argv[1:]:
    importlib.import_module(module)
print(json.dumps(asked))
"""


def python_files(*folders: str) -> list[Path]:
    return [path for folder in folders for path in sorted((ROOT / folder).rglob('*.py'))]


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix('').parts
    return '.'.join(parts[:-1] if parts[-1] == '__init__' else parts)


def imported_names(path: Path) -> Iterator[str]:
    """Absolute dotted names of all that a file imports, wherever in the file it does so."""
    package = path.relative_to(ROOT).parts[:-1]
    for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parents = package[: len(package) - node.level + 1] if node.level else ()
            base = '.'.join([*parents, *filter(None, [node.module])])
            yield from (f'{base}.{alias.name}' for alias in node.names)


def room(name: str) -> int:
    """Place in `ROOMS` of a dotted name below piezo_ident; the root stands before all."""
    below = name.split('.')[1:2]
    return ROOMS.index(below[0]) if below and below[0] in ROOMS else -1


def breaches(path: Path) -> list[str]:
    """List imports of a room that stands later."""
    name = module_name(path)
    if room(name) < 0:
        return []
    return [
        f'{name} imports {target}'
        for target in imported_names(path)
        if target.startswith('piezo_ident.') and room(target) > room(name)
    ]


def is_node(name: str) -> bool:
    return f'{name}.'.startswith('piezo_ident.nodes.')


def tracked_files() -> list[Path]:
    """Files that git has or would take."""
    if shutil.which('git') is None or not (ROOT / '.git').exists():
        pytest.skip('not a git working tree')
    listing = subprocess.run(
        ['git', 'ls-files', '-z', '--cached', '--others', '--exclude-standard'],
        cwd=ROOT,
        check=True,
        capture_output=True,
        text=True,
    ).stdout
    return [ROOT / name for name in listing.split('\0') if name and (ROOT / name).is_file()]


def setup_keywords() -> dict[str, ast.expr]:
    tree = ast.parse((ROOT / 'setup.py').read_text(encoding='utf-8'))
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    (setup,) = (c for c in calls if isinstance(c.func, ast.Name) and c.func.id == 'setup')
    return {keyword.arg: keyword.value for keyword in setup.keywords if keyword.arg}


def dependencies(tag: str) -> set[str]:
    return {node.text or '' for node in ElementTree.parse(ROOT / 'package.xml').iter(tag)}


def test_versions_are_equal():
    tree = ast.parse((PACKAGE / '__init__.py').read_text(encoding='utf-8'))
    (in_package,) = (
        ast.literal_eval(node.value)
        for node in tree.body
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == '__version__'
    )
    manifest = ElementTree.parse(ROOT / 'package.xml').findtext('version')
    assert in_package == manifest == ast.literal_eval(setup_keywords()['version'])
    assert re.fullmatch(r'\d+\.\d+\.\d+', in_package)


def test_licence_headers():
    files = [ROOT / 'setup.py', *python_files('piezo_ident', 'test', 'benchmarks', 'launch')]
    without = [str(p.relative_to(ROOT)) for p in files if not p.read_text().startswith(HEADER)]
    assert without == []


def test_everything_but_the_nodes_imports_without_ros():
    names = [module_name(path) for path in python_files('piezo_ident')]
    names = [name for name in names if not is_node(name) and not name.endswith('.__main__')]
    done = subprocess.run(
        [sys.executable, '-c', BLOCKED_IMPORTS, *names], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == []


def test_imports_point_one_way():
    found = [breach for path in python_files('piezo_ident') for breach in breaches(path)]
    assert found == []


@pytest.mark.parametrize('name', SIZES)
def test_a_room_grows_no_further(name):
    files = list((PACKAGE / name).glob('*.py'))
    lines = sum(len(path.read_text(encoding='utf-8').splitlines()) for path in files)
    most_lines, most_modules = SIZES[name]
    assert lines <= most_lines and len(files) <= most_modules


def test_the_root_holds_the_front_door_alone():
    assert {path.name for path in PACKAGE.glob('*.py')} == {'__init__.py', '__main__.py'}
    folders = {path.name for path in PACKAGE.iterdir() if any(path.glob('*.py'))}
    assert folders <= set(ROOMS)


def test_tests_mirror_the_package():
    # what asks more than one module stands in a folder `whole`
    files = [path.relative_to(ROOT / 'test') for path in (ROOT / 'test').rglob('test_*.py')]
    mirrored = (
        (file, PACKAGE / file.parent / file.stem.removeprefix('test_'))
        for file in files
        if file.parts[0] in ROOMS and 'whole' not in file.parts
    )
    others = [
        str(file)
        for file, module in mirrored
        if not module.is_dir() and not module.with_suffix('.py').exists()
    ]
    assert others == []


def test_manifest_declares_what_is_imported():
    names = {
        name.partition('.')[0]
        for path in python_files('piezo_ident', 'launch')
        for name in imported_names(path)
    }
    names -= {*sys.stdlib_module_names, 'piezo_ident', *OPTIONAL, *PIP_ONLY}
    assert {ROSDEP_KEYS.get(name, name) for name in names} <= dependencies('exec_depend')


def test_manifest_and_setup_require_the_same_libraries():
    required = ast.literal_eval(setup_keywords()['install_requires'])
    distributions = {re.match(r'[\w-]+', text)[0] for text in required} - PIP_ONLY
    keys = {ROSDEP_KEYS['yaml' if name == 'PyYAML' else name] for name in distributions}
    assert keys == {name for name in dependencies('exec_depend') if name.startswith('python3-')}


def test_manifest_says_where_to_go_and_colcon_what_to_run():
    assert ElementTree.parse(ROOT / 'package.xml').findtext('url')
    chosen = json.loads((ROOT / 'colcon.pkg').read_text(encoding='utf-8'))['pytest-args']
    places = [ROOT / place for place in chosen if place.startswith('test/')]
    assert places and all(place.exists() and place.name != 'nodes' for place in places)


def test_changelog_has_a_forthcoming_section():
    # REP-132, which catkin_prepare_release reads
    lines = (ROOT / 'CHANGELOG.rst').read_text(encoding='utf-8').splitlines()
    assert lines[1] == 'Changelog for package piezo_ident'
    assert lines[0] == lines[2] == '^' * len(lines[1])
    assert lines[lines.index('Forthcoming') + 1] == '-' * len('Forthcoming')


def test_every_page_begins_with_what_it_is_for():
    others = [
        path.name
        for path in sorted((ROOT / 'docs').glob('*.md'))
        # pages that only list others have no prose
        if (prose := [x for x in path.read_text(encoding='utf-8').splitlines() if x[:1].isalpha()])
        and 'toctree' not in path.read_text(encoding='utf-8')
        and not prose[0].startswith('This page ')
    ]
    assert others == []


def test_no_test_is_asked_twice():
    # a test that passes when it is asked again has failed
    places = ('Makefile', 'setup.cfg', 'setup.py', 'pyproject.toml', '.ci/run', 'colcon.pkg')
    files = [*(ROOT / place for place in places), *(ROOT / 'test').rglob('conftest.py')]
    twice = re.compile(r'(?i)rerun|flaky|last-failed|failed-first|--[lf]f\b|retr(y|ies)')
    found = [
        f'{file.relative_to(ROOT)}: {line.strip()}'
        for file in files
        for line in file.read_text(encoding='utf-8').splitlines()
        if twice.search(line)
    ]
    assert found == []


def test_no_file_names_a_package_registry():
    hosts = ['py' + 'pi.org', 'python' + 'hosted']
    found = [
        f'{path.relative_to(ROOT)}: {host}'
        for path in tracked_files()
        for host in hosts
        if host.encode() in path.read_bytes().lower()
    ]
    assert found == []
