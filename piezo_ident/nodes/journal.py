# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Write events of a node to its log, each lasting problem once, and keep its recent faults."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
import logging
import re
import threading
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from piezo_ident.common.errors import printable

#: time for which a line is left out that differs from an earlier line only in numbers [s]
QUIET = 10.0
#: time for which an identical line is left out [s]
ECHO = 1.0
#: time for which a fault stays in the status [s]
FAULT_SHOWN = 3.0
#: most remembered lines; in a flood of lines the further ones are left out
MOST = 50
#: longest line, as of a parameter that holds a program
LONGEST = 500
#: longest path in a shortened text
PATH = 40

_PATH = re.compile(r'(?:/[^\s/:;,]+){2,}')
_NUMBER = re.compile(r'[-+]?\d[\d.]*(e[-+]?\d+)?')


class RecentFaults:
    """Faults of a stream: their `counts`, and the last message of each fault for some seconds."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._latest: dict[str, tuple[str, float]] = {}
        self._all: dict[str, str] = {}

    def clear(self) -> None:
        """Begin anew."""
        self.counts.clear()
        self._latest.clear()
        self._all.clear()

    def note(self, fault: str, message: str, count: int = 1) -> None:
        """Note `count` occurrences of a fault."""
        self.counts[fault] += count
        self._latest[fault] = (message, time.monotonic() + FAULT_SHOWN)
        self._all[fault] = message

    @property
    def summary(self) -> str:
        """The last message of each fault since the beginning, as the caveats of a result."""
        return '; '.join(self._all.values())

    @property
    def text(self) -> str:
        """The messages of the last `FAULT_SHOWN` seconds; empty without faults."""
        now = time.monotonic()
        self._latest = {k: fault for k, fault in self._latest.items() if fault[1] > now}
        return '; '.join(message for message, _ in self._latest.values())


class Journal:
    """Log of a node, through its rclpy logger; any thread may write to it."""

    def __init__(self, logger: Any) -> None:
        self._logger = logger
        self._lock = threading.Lock()
        # the time until which a line, and a line without its numbers, is left out
        self._lines: dict[str, float] = {}
        self._patterns: dict[str, float] = {}

    def tell(self, text: str, level: bytes = DiagnosticStatus.OK) -> None:
        """Write an event; `level` is a level of diagnostic_msgs/DiagnosticStatus."""
        line = one_line(text)
        with self._lock:
            lines = _fresh(self._lines)
            is_new = line not in lines and len(lines) < MOST
            if is_new:
                lines[line] = time.monotonic() + ECHO
                _fresh(self._patterns)[_NUMBER.sub('#', line)] = time.monotonic() + QUIET
        if is_new:
            self._write(line, level)

    def warn(self, text: str, level: bytes = DiagnosticStatus.WARN) -> None:
        """Write problems, separated by ``; ``; leave out those written within `QUIET`."""
        new = []
        with self._lock:
            patterns = _fresh(self._patterns)
            # the text lists several problems
            for part in one_line(text).split('; '):
                pattern = _NUMBER.sub('#', part)
                known = next((p for p in patterns if pattern in p), None)
                if known is None and len(patterns) < MOST:
                    new.append(part)
                patterns[known or pattern] = time.monotonic() + QUIET
        if new:
            self._write('; '.join(new), level)

    def _write(self, line: str, level: bytes) -> None:
        # rclpy allows one severity for each line of code that calls a logger
        if level == DiagnosticStatus.OK:
            self._logger.info(line)
        elif level == DiagnosticStatus.WARN:
            self._logger.warning(line)
        else:
            self._logger.error(line)


class FromPackage(logging.Handler):
    """Handler that passes log records of the package to a journal."""

    def __init__(self, journal: Journal) -> None:
        super().__init__()
        self._journal = journal

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record."""
        self._journal.tell(record.getMessage())


def one_line(text: str, longest: int = LONGEST) -> str:
    """Put a text into one line, cut if it is too long."""
    line = ' '.join(printable(text).split())
    return line if len(line) <= longest else f'{line[: longest - 4].rstrip()} ...'


def shortened(text: str, longest: int) -> str:
    """Put a text into one line, with long paths cut at their front, and cut at its end."""

    def end(match: re.Match[str]) -> str:
        path = match[0]
        return path if len(path) <= PATH else f'...{path[3 - PATH :]}'

    return one_line(_PATH.sub(end, text), longest)


def parameters_text(values: Mapping[str, Any]) -> str:
    """Format parameters, shortened: a parameter may hold a whole program."""
    return ', '.join(f'{name} = {shortened(str(value), 60)}' for name, value in values.items())


def _fresh(told: dict[str, float]) -> dict[str, float]:
    """Remove the lines whose time is over."""
    now = time.monotonic()
    for line in [line for line, until in told.items() if until <= now]:
        del told[line]
    return told
