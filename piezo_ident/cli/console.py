# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Text or JSON on standard output, progress on a terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import json
import logging
import shutil
import signal
import sys
from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    from piezo_ident.identification.results import Progress


@contextmanager
def deferred_interrupts() -> Iterator[Callable[..., None]]:
    """
    Have Ctrl-C wait until all outputs of a command are whole.

    The function that is yielded raises KeyboardInterrupt when an interrupt is waiting, and takes
    any arguments: long work before the first output calls it.
    """
    waiting: list[int] = []

    def check(*_: object) -> None:
        if waiting:
            raise KeyboardInterrupt

    try:
        before = signal.signal(signal.SIGINT, lambda number, _: waiting.append(number))
    except ValueError:
        # only the main thread is interrupted
        yield check
        return
    try:
        yield check
    finally:
        signal.signal(signal.SIGINT, before)
    check()


class Console:
    """Standard output and error of one command; `as_json`: only JSON goes to standard output."""

    def __init__(self, as_json: bool = False) -> None:
        self.as_json = as_json

    def say(self, text: str = '') -> None:
        """Write lines for people; nothing in JSON."""
        if not self.as_json:
            sys.stdout.write(f'{_harmless(text)}\n')

    def note(self, text: str) -> None:
        """Write a line that belongs to no result."""
        sys.stderr.write(f'piezo_ident: {_harmless(text)}\n')

    def result(self, data: Any) -> None:
        """Write the result for programs; nothing as text."""
        if self.as_json:
            from piezo_ident.model.files import finite, plain

            text = json.dumps(finite(plain(data)), indent=2, ensure_ascii=False, allow_nan=False)
            sys.stdout.write(f'{text}\n')

    @contextmanager
    def notices(self) -> Iterator[None]:
        """Show what the package logs, such as that it compiles: on a terminal only."""
        log = logging.getLogger('piezo_ident')
        handler = _Lines() if sys.stderr.isatty() else logging.NullHandler()
        log.addHandler(handler)
        try:
            yield
        finally:
            log.removeHandler(handler)

    @contextmanager
    def progress(self) -> Iterator[Progress]:
        """Yield what shows the progress: one bar a step on a terminal, nothing elsewhere."""
        if not sys.stderr.isatty():
            yield lambda step, share: None
            return
        from tqdm import tqdm

        size = shutil.get_terminal_size()
        bars: dict[str, Any] = {}

        def show(step: str, share: float) -> None:
            if step not in bars:
                for bar in bars.values():
                    bar.close()
                bars[step] = tqdm(
                    total=1.0,
                    desc=f'{step:12s}',
                    bar_format='{desc} {percentage:3.0f}% |{bar}| {elapsed}',
                    # a terminal may not tell its size
                    ncols=min(80, size.columns),
                    nrows=size.lines,
                    leave=False,
                    file=sys.stderr,
                )
            bar = bars[step]
            bar.update(max(0.0, min(1.0, share) - bar.n))

        try:
            yield show
        finally:
            for bar in bars.values():
                bar.close()


class _Lines(logging.Handler):
    """Lines on a terminal, above the bars that are there."""

    def emit(self, record: logging.LogRecord) -> None:
        from tqdm import tqdm

        tqdm.write(f'piezo_ident: {_harmless(record.getMessage())}', file=sys.stderr)


def _harmless(text: str) -> str:
    """Return lines without control characters: names in files must not steer a terminal."""
    return ''.join(c if c.isprintable() or c == '\n' else '?' for c in text)
