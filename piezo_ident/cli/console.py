# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Write text or JSON to standard output, and progress to a terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import json
import logging
import shutil
import signal
import sys
from typing import Any, TYPE_CHECKING

from piezo_ident.common.errors import printable

if TYPE_CHECKING:
    from piezo_ident.identification.settings import Progress


@contextmanager
def deferred_interrupts() -> Iterator[Callable[..., None]]:
    """
    Delay Ctrl-C until all outputs of a command are complete.

    The yielded function raises KeyboardInterrupt if an interrupt is waiting.  Long work before the
    first output calls it, with any arguments.
    """
    waiting: list[int] = []

    def check(*_: object) -> None:
        if waiting:
            raise KeyboardInterrupt

    try:
        before = signal.signal(signal.SIGINT, lambda number, _: waiting.append(number))
    except ValueError:
        # only the main thread can be interrupted
        yield check
        return
    try:
        yield check
    finally:
        signal.signal(signal.SIGINT, before)
    check()


class Console:
    """Standard output and error of one command; `as_json` restricts standard output to JSON."""

    def __init__(self, as_json: bool = False) -> None:
        self.as_json = as_json

    def say(self, text: str = '') -> None:
        """Write lines for people; with `as_json` they are dropped."""
        if not self.as_json:
            sys.stdout.write(f'{_harmless(text)}\n')

    def note(self, text: str) -> None:
        """Write a line to standard error, apart from the result."""
        sys.stderr.write(f'piezo_ident: {_harmless(text)}\n')

    def result(self, data: Any) -> None:
        """Write the result as JSON; without `as_json` it is dropped."""
        if self.as_json:
            from piezo_ident.model.files import finite, plain

            text = json.dumps(finite(plain(data)), indent=2, ensure_ascii=False, allow_nan=False)
            sys.stdout.write(f'{text}\n')

    @contextmanager
    def notices(self) -> Iterator[None]:
        """Show log records of the package, such as compiling, if standard error is a terminal."""
        log = logging.getLogger('piezo_ident')
        handler = _Lines() if sys.stderr.isatty() else logging.NullHandler()
        log.addHandler(handler)
        try:
            yield
        finally:
            log.removeHandler(handler)

    @contextmanager
    def progress(self) -> Iterator[Progress]:
        """Yield a function that shows progress: a bar for each step, on a terminal only."""
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
                    # tqdm would ask the terminal, which may not know its size
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
    """Handler that writes lines on a terminal, above the progress bars."""

    def emit(self, record: logging.LogRecord) -> None:
        from tqdm import tqdm

        tqdm.write(f'piezo_ident: {_harmless(record.getMessage())}', file=sys.stderr)


def _harmless(text: str) -> str:
    """Replace control characters in each line."""
    return '\n'.join(map(printable, text.split('\n')))
