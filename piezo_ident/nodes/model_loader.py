# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Load the models of a node: at its start, and later in a thread."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
import queue
import threading
from typing import Generic, TypeAlias, TypeVar

from piezo_ident.common.errors import naming, PiezoIdentError
from piezo_ident.common.files import parse_yaml
from piezo_ident.model.axes_file import from_dict, load
from piezo_ident.model.multi_axis import MultiAxisModel
from piezo_ident.model.stage_model import StageModel
from piezo_ident.nodes.wire import LATCHED
from rclpy.node import Node
from std_msgs.msg import String

T = TypeVar('T')
Model: TypeAlias = StageModel | MultiAxisModel


def no_file(path: str) -> str | None:
    """Return the problem if a named model file is missing, else None."""
    return f'model: {path}: no such file' if path and not Path(path).is_file() else None


class ModelLoader(Generic[T]):
    """
    Reads models from files and from the topic `model`.

    A thread reads the models, because reading YAML and compiling take longer than a block.  Of
    several waiting models the thread reads the newest alone.

    The thread calls `prepare` with a model.  The executor of the node then calls `take` with the
    prepared model and its source, or with None and an error.  Last, the executor calls `done`.
    """

    def __init__(
        self,
        node: Node,
        prepare: Callable[[Model], T],
        take: Callable[[T | None, str], None],
        done: Callable[[], None],
    ) -> None:
        self._prepare, self._take, self._done = prepare, take, done
        self._wishes: queue.SimpleQueue[tuple[str, Callable[[], Model]]] = queue.SimpleQueue()
        self._loaded: queue.SimpleQueue[tuple[T | None, str]] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._is_ending = False
        self._wake = node.create_guard_condition(self._take_loaded)
        node.create_subscription(String, 'model', self._load_text, LATCHED)

    def begin_with(self, path: str) -> None:
        """Load a file at once, at the start of a node; PiezoIdentError if it is bad."""
        try:
            with naming(path):
                self._take(self._prepare(load(path)), path)
        except PiezoIdentError as error:
            raise PiezoIdentError(f'model: {error}') from None

    def load_file(self, path: str) -> None:
        """Load a file."""
        self.load(path, lambda: load(path))

    def load(self, source: str, read: Callable[[], Model]) -> None:
        """Load the model that a function returns."""
        self._wishes.put((source, read))
        if self._thread is None:
            self._thread = threading.Thread(target=self._load_all, name='load', daemon=True)
            self._thread.start()

    def close(self) -> None:
        """Stop waking the executor."""
        self._is_ending = True

    def _load_text(self, message: String) -> None:
        name = 'topic model'
        self.load(name, lambda: from_dict(parse_yaml(message.data, name), name))

    def _load_all(self) -> None:
        while True:
            source, read = self._wishes.get()
            while not self._wishes.empty():
                source, read = self._wishes.get()
            try:
                with naming(source):
                    self._loaded.put((self._prepare(read()), source))
            except PiezoIdentError as error:
                self._loaded.put((None, ' '.join(str(error).split())))
            # no content of a file or text may end the node
            except Exception as error:  # noqa: BLE001
                self._loaded.put((None, f'{source}: {type(error).__name__}: {error}'))
            if self._is_ending:
                return
            self._wake.trigger()

    def _take_loaded(self) -> None:
        while not self._loaded.empty():
            self._take(*self._loaded.get())
        self._done()
