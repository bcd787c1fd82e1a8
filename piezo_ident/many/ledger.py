# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
What is done of many records, kept line by line so that a stopped run can go on.

A line holds only as long as its record, its settings and this package are the same.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
import json
from pathlib import Path

from piezo_ident.common.errors import ConfigError, DataError
from piezo_ident.many.run import Outcome, Row

__all__ = ['LEDGER', 'Ledger', 'unwritable']

#: name of the file in the folder of results
LEDGER = 'done.jsonl'


def unwritable(path: Path, error: OSError) -> DataError:
    """Return what to raise where a result cannot be written."""
    return DataError(
        f'{path}: cannot be written ({error.strerror or error}); choose a folder with room and '
        'the right to write'
    )


@dataclass(frozen=True)
class Entry:
    """
    A line of the file.

    Attributes
    ----------
    verb : {'identify', 'diagnose'}
    record : str
    key : str
        Of settings and record, with a blank between them.
    row : Row
    seconds : float
        That it took.
    path : str
        Where the record was; empty where an earlier version of this package did not say it.
    """

    verb: str
    record: str
    key: str
    row: Row
    seconds: float
    path: str = ''


class Ledger:
    """
    The file of what is done.

    Parameters
    ----------
    folder : path
        Of the results; need not exist yet.
    verb : {'identify', 'diagnose'}
        What is being done.

    Raises
    ------
    ConfigError
        When the folder holds the results of another verb, or a file of that name is no ledger.
    """

    def __init__(self, folder: Path, verb: str) -> None:
        self.path, self._verb = folder / LEDGER, verb
        self._whole = False
        self._entries = {entry.record: entry for entry in self._read()}

    def _read(self) -> list[Entry]:
        try:
            lines = self.path.read_text(encoding='utf-8').splitlines()
        except FileNotFoundError:
            return []
        except (OSError, UnicodeDecodeError):
            raise ConfigError(f'{self.path}: cannot be read; choose another folder') from None
        entries = []
        for number, line in enumerate(lines, 1):
            try:
                data = json.loads(line)
                entry = Entry(**{**data, 'row': Row(**data['row'])})
            except (ValueError, TypeError, KeyError):
                # half a line of a run that was killed
                if number < len(lines):
                    raise ConfigError(
                        f'{self.path}: line {number} is none of this package; choose another '
                        'folder'
                    ) from None
                continue
            if entry.verb != self._verb:
                raise ConfigError(
                    f'{self.path.parent}: holds what {entry.verb} --each found; choose another '
                    'folder'
                )
            entries.append(entry)
        return entries

    @property
    def exists(self) -> bool:
        """Whether the folder has been begun, by this run or an earlier one."""
        return self.path.exists()

    def begin(self) -> None:
        """
        Make the file, by which the folder is known as one of results.

        Raises
        ------
        DataError
            When it cannot be written.
        """
        try:
            self.path.touch()
        except OSError as error:
            raise unwritable(self.path, error) from None

    def done(self, record: str, key: str) -> Row | None:
        """Return the row of a record that was good under the same key, None otherwise."""
        entry = self._entries.get(record)
        return entry.row if entry is not None and entry.key == key and entry.row.good else None

    def check_place(self, record: str, path: str, key: str) -> None:
        """
        Refuse a record under whose name the results of another one are kept.

        Raises
        ------
        ConfigError
        """
        entry = self._entries.get(record)
        if entry is None or not entry.row.good or entry.path in ('', path):
            return
        # one that was moved, or copied with its time, is still the same
        if entry.key.rpartition(' ')[2] != key.rpartition(' ')[2]:
            raise ConfigError(
                f'{path}: {self.path.parent} keeps the results of {entry.path} under the name '
                f'{record}; choose another folder for --each, or rename the record'
            )

    def add(self, key: str, outcome: Outcome, path: str) -> None:
        """
        Keep a row of the record at a path.

        Raises
        ------
        DataError
            When it cannot be written.
        """
        row = outcome.row
        entry = Entry(self._verb, row.record, key, row, round(outcome.seconds, 3), path)
        try:
            with self.path.open('ab') as file:
                if not self._whole:
                    file.truncate(self._size_of_whole_lines())
                    self._whole = True
                # file names need not be Unicode
                file.write(f'{json.dumps(asdict(entry))}\n'.encode('utf-8', 'replace'))
        except OSError as error:
            raise unwritable(self.path, error) from None
        self._entries[row.record] = entry

    def _size_of_whole_lines(self) -> int:
        # the last one of a run that was killed may be half written
        return self.path.read_bytes().rfind(b'\n') + 1
