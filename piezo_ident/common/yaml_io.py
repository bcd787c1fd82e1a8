# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0
"""
YAML that may come from a stranger: the safe loader only, and no more than a file should hold.

A few lines can stand for more than any memory holds: an alias repeats a whole tree, a merge key
copies one, a number in base 60 grows with every colon.
"""

from __future__ import annotations

from collections.abc import Mapping
import errno
import os
from pathlib import Path
from typing import Any

from piezo_ident.common.errors import ConfigError
from piezo_ident.common.limits import YAML_DEPTH, YAML_LENGTH, YAML_NODES
import yaml

__all__ = ['broken_link', 'endless', 'load_yaml', 'parse_yaml']

#: no number that means anything has more characters
_LONGEST_NUMBER = 100


class _Loader(yaml.SafeLoader):
    """The safe loader, which stops where a text asks for too much."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._depth = 0
        self._count = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        self._count += 1
        self._depth += 1
        if self._count > YAML_NODES or self._depth > YAML_DEPTH + 1:
            parser: Any = self  # the stubs lack a type here
            mark = parser.peek_event().start_mark
            raise self._refusal('nested too deeply, or too large', mark)
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        for key, _ in node.value:
            if key.tag == 'tag:yaml.org,2002:merge':
                raise self._refusal('merge keys (<<) are not read', key.start_mark)

    def construct_number(self, node: yaml.ScalarNode) -> Any:
        if len(node.value) > _LONGEST_NUMBER:
            raise self._refusal('a number of too many digits', node.start_mark)
        kind = node.tag.rpartition(':')[2]
        return getattr(super(), f'construct_yaml_{kind}')(node)

    def _refusal(self, why: str, mark: Any) -> yaml.MarkedYAMLError:
        return yaml.constructor.ConstructorError(None, None, why, mark)


for _kind in ('int', 'float'):
    _Loader.add_constructor(f'tag:yaml.org,2002:{_kind}', _Loader.construct_number)


def broken_link(path: str | os.PathLike[str]) -> str | None:
    """
    Return what is wrong with a symbolic link that leads nowhere, and the cure.

    Returns
    -------
    str or None
        None when it is no link, or leads somewhere.
    """
    if not os.path.islink(path):
        return None
    try:
        os.stat(path)
    except FileNotFoundError:
        return f'is a link to {os.readlink(path)}, which does not exist; mend the link'
    except OSError as error:
        if error.errno == errno.ELOOP:
            return 'is a link that leads back to itself; mend the link'
    return None


def load_yaml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """
    Read a YAML mapping with the safe loader.

    Raises
    ------
    ConfigError
        When the file cannot be read, is not YAML, or is not a mapping, or as `parse_yaml` says.
    """
    broken = broken_link(path)
    if broken:
        raise ConfigError(f'{path}: {broken}')
    file = Path(path)
    try:
        if file.exists() and not (file.is_file() or file.is_dir()):
            raise ConfigError(f'{path}: is a device or a pipe, no file; copy the text into a file')
        with file.open(encoding='utf-8') as stream:
            text = stream.read(YAML_LENGTH + 1)
    except FileNotFoundError:
        raise ConfigError(f'{path}: no such file; check the name') from None
    except (OSError, ValueError) as error:
        reason = getattr(error, 'strerror', None) or type(error).__name__
        raise ConfigError(f'{path}: cannot be read as text ({reason})') from None
    return parse_yaml(text, str(path))


def parse_yaml(text: str, name: str) -> dict[str, Any]:
    """
    Parse a YAML mapping with the safe loader.

    Raises
    ------
    ConfigError
        When the text is not YAML, or not a mapping, or holds more than `piezo_ident.common.limits`
        allow.
    """
    if len(text) > YAML_LENGTH:
        raise ConfigError(
            f'{name}: more than {YAML_LENGTH} characters of YAML; is it the right file?'
        )
    try:
        data = yaml.load(text, Loader=_Loader)
    except (
        # the loader lets through what its own constructors trip over
        yaml.YAMLError,
        ArithmeticError,
        AttributeError,
        LookupError,
        RecursionError,
        TypeError,
        ValueError,
    ) as error:
        mark = getattr(error, 'problem_mark', None)
        where = f' at line {mark.line + 1}' if mark is not None else ''
        ours = error.problem if isinstance(error, yaml.constructor.ConstructorError) else None
        why = f' ({ours})' if ours and '\n' not in ours and len(ours) < 60 else ''
        raise ConfigError(
            f'{name}: not valid YAML{where}{why}; correct it or write it again'
        ) from None
    if not isinstance(data, dict):
        raise ConfigError(
            f'{name}: expected a YAML mapping, got {type(data).__name__}; is it the right file?'
        )
    found = endless(data)
    if found is not None:
        raise ConfigError(f'{name}: {found} is nested too deeply, or too large')
    return data


def endless(data: Mapping[str, Any]) -> str | None:
    """
    Return the key under which a mapping holds more than can be walked through, or None.

    An alias may stand for a tree of any size in a few bytes, or for the list that holds it.
    """
    left = YAML_NODES
    for key, value in data.items():
        todo = [(value, 0)]
        while todo:
            node, depth = todo.pop()
            inner = list(node.values()) if isinstance(node, Mapping) else node
            if not isinstance(inner, (list, tuple, set)):
                continue
            left -= len(inner)
            if left < 0 or depth > YAML_DEPTH:
                return str(key)[:40]
            todo += [(x, depth + 1) for x in inner]
    return None
