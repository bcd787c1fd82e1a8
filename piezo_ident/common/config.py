# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The stages and programs that come with the package, wherever it was installed."""

from __future__ import annotations

from collections.abc import Iterator
import os
from pathlib import Path
import site
import sys
import sysconfig

from piezo_ident.common.errors import ConfigError, did_you_mean

_SHARE = Path('share', 'piezo_ident', 'config')
_SOURCE = Path(__file__).resolve().parents[2] / 'config'


def _folders() -> Iterator[Path]:
    """Yield the folders of the files: a ROS workspace, an environment, the source tree."""
    # as ament_index_python does
    for prefix in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep):
        if prefix:
            yield Path(prefix) / _SHARE
    yield Path(sys.prefix) / _SHARE
    # pip install --user, and distributions whose pip installs below /usr/local
    yield Path(sysconfig.get_path('data')) / _SHARE
    if site.ENABLE_USER_SITE:
        yield Path(site.getuserbase()) / _SHARE
    yield _SOURCE


def shipped_names(prefix: str = '') -> list[str]:
    """List the names, without prefix, of shipped files: ``program_`` or ``stage_``."""
    stems = {path.stem for folder in _folders() for path in folder.glob(f'{prefix}*.yaml')}
    return sorted(name.removeprefix(prefix) for name in stems)


def find_config(name: str | os.PathLike[str], kind: str) -> Path:
    """
    Find the file of a program or a stage, the `kind`, by its name or path.

    ``identification`` is the shipped ``program_identification.yaml``, even beside a file of that
    name.  A path without a file means the shipped one; else a ConfigError names those shipped.
    """
    path = Path(name)
    plain = path.suffix == '' and path.name == str(name)
    if path.is_file() and not plain:
        return path
    wanted = [path.name] if not plain else [f'{kind}_{name}.yaml', f'{name}.yaml']
    for folder in _folders():
        for file in wanted:
            if (folder / file).is_file():
                return folder / file
    if path.is_file():
        return path
    known = shipped_names(f'{kind}_')
    stem = path.stem.removeprefix(f'{kind}_')
    guess = did_you_mean(stem, known)
    raise ConfigError(
        f'{name}: no such {kind}; {guess}{guess and " "}give a file, or one of '
        f'{", ".join(known) or "none"}'
    )
