# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Many jobs at once: over the cores of this machine, or over those of a cluster of dask.

Both are executors of `concurrent.futures`, so one loop serves them.  This module imports nothing
heavy: a new process sets its threads before NumPy is loaded.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import (
    BrokenExecutor,
    CancelledError,
    Executor,
    FIRST_COMPLETED,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import contextmanager
import multiprocessing
from multiprocessing.connection import Connection
import os
import signal
import threading
from typing import Any, Generic, TypeVar

from piezo_ident import __version__
from piezo_ident.common.errors import ConfigError, PiezoIdentError

__all__ = ['Cores', 'Places', 'cluster', 'cores', 'run_all']

#: what a job returns
T = TypeVar('T')
Job = Callable[[], T]
#: time between two looks at whether to stop [s]
EVERY = 0.1
#: how long to wait for a scheduler, and for its first worker [s]
PATIENCE = 10.0


class Places:
    """
    Where jobs are done.

    Attributes
    ----------
    executor : concurrent.futures.Executor
    window : int
        Jobs that are given out at once.
    """

    def __init__(self, executor: Executor, window: int) -> None:
        self.executor, self.window = executor, window

    def renew(self) -> None:
        """
        Go on after the executor broke.

        Raises
        ------
        PiezoIdentError
            When that is not possible.
        """
        raise PiezoIdentError('the workers are gone; start them again')


class Cores(Places):
    """
    Processes of this machine, which end with this one whatever ends it.

    Parameters
    ----------
    jobs : int
        How many.
    """

    def __init__(self, jobs: int) -> None:
        self._jobs = jobs
        # a fork would copy locks that other threads hold
        self._context = multiprocessing.get_context('spawn')
        # twice as many, so that no process waits for the next
        super().__init__(self._start(), 2 * jobs)

    def _start(self) -> ProcessPoolExecutor:
        receiver, self._sender = self._context.Pipe(duplex=False)
        return ProcessPoolExecutor(
            self._jobs, self._context, initializer=_begin, initargs=(receiver,)
        )

    def renew(self) -> None:
        """Start the processes again, after one of them died."""
        self.close()
        self.executor = self._start()

    def close(self) -> None:
        """End the processes, whatever they are doing."""
        self._sender.close()
        self.executor.shutdown(wait=True, cancel_futures=True)


def _begin(lifeline: Connection) -> None:
    """Prepare a process: one thread of BLAS, and an end as soon as the lifeline is cut."""
    for name in ('OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS', 'OMP_NUM_THREADS'):
        os.environ.setdefault(name, '1')
    # Ctrl-C at a terminal reaches all; the parent decides
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        try:
            lifeline.recv()
        except (EOFError, OSError):
            os._exit(0)

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def cores(jobs: int) -> Iterator[Cores]:
    """
    Yield processes of this machine; they are gone at the end.

    Parameters
    ----------
    jobs : int
        How many, at least 1.
    """
    places = Cores(jobs)
    try:
        yield places
    finally:
        places.close()


@contextmanager
def cluster(address: str) -> Iterator[Places]:
    """
    Yield the workers of a dask scheduler; what is not done at the end is taken back.

    Parameters
    ----------
    address : str
        Of the scheduler, ``tcp://host:8786`` or ``host:8786``.

    Raises
    ------
    ConfigError
        When dask.distributed is not installed, nothing answers at the address, there is no
        worker, or one of them has another version of this package or none.
    """
    try:
        import distributed
    except ImportError:
        raise ConfigError(
            'dask.distributed is not installed here; pip install "piezo_ident[cluster]"'
        ) from None
    try:
        client = distributed.Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ConfigError(
            f'{address}: no dask scheduler answers there ({_line(error)}); start one with '
            'dask scheduler'
        ) from None
    try:
        _check_workers(client, address)
        threads = sum(client.nthreads().values())
        executor = client.get_executor(pure=False)
        try:
            yield Places(executor, 4 * threads)
        finally:
            executor.shutdown(wait=False)
    finally:
        client.close(timeout=PATIENCE)


def _check_workers(client: Any, address: str) -> None:
    try:
        client.wait_for_workers(1, timeout=PATIENCE)
    # the class of this error differs between versions of Python
    except Exception as error:  # noqa: BLE001
        raise ConfigError(
            f'{address}: the scheduler has no worker ({_line(error)}); start some with '
            f'dask worker {address} --nthreads 1'
        ) from None
    for worker, found in client.run(version_there, on_error='return').items():
        if found != __version__:
            has = 'has none' if isinstance(found, BaseException) else f'has {found}'
            raise ConfigError(
                f'{worker}: needs piezo_ident {__version__}, the worker {has}; install the same '
                'on all machines'
            )


def version_there() -> str:
    """Return the version of the package where this runs."""
    return __version__


def _line(error: BaseException) -> str:
    return ' '.join(str(error).split()) or type(error).__name__


class _Loop(Generic[T]):
    """Gives jobs out and takes their results in, until none is left."""

    def __init__(self, places: Places, failed: Callable[[int, BaseException], T]) -> None:
        self._places = places
        self._failed = failed

    def run(
        self, jobs: Sequence[Job[T]], numbers: Sequence[int], tick: Callable[[], None]
    ) -> Iterator[tuple[int, T]]:
        todo, out = list(numbers), dict[Future[T], int]()
        while todo or out:
            suspects: list[int] = []
            while todo and len(out) < self._places.window and not suspects:
                number = todo.pop(0)
                try:
                    out[self._places.executor.submit(jobs[number])] = number
                except BrokenExecutor:
                    suspects.append(number)
            done = wait(out, EVERY, FIRST_COMPLETED).done
            tick()
            for future in done:
                number = out.pop(future)
                try:
                    result = future.result()
                except BrokenExecutor:
                    suspects.append(number)
                except CancelledError:
                    raise PiezoIdentError(
                        'the scheduler is gone; start it again, and the same command goes on'
                    ) from None
                # the job itself raises nothing: it could not be sent, or its worker died over it
                except Exception as error:  # noqa: BLE001
                    yield number, self._failed(number, error)
                else:
                    yield number, result
            if suspects:
                suspects += out.values()
                out.clear()
                yield from self._one_by_one(jobs, sorted(suspects), tick)

    def _one_by_one(
        self, jobs: Sequence[Job[T]], numbers: Sequence[int], tick: Callable[[], None]
    ) -> Iterator[tuple[int, T]]:
        """Do again, each in a process of its own, what was at work when one of them died."""
        self._places.renew()
        for number in numbers:
            with cores(1) as alone:
                future = alone.executor.submit(jobs[number])
                while not wait([future], EVERY).done:
                    tick()
                try:
                    result = future.result()
                except BrokenExecutor:
                    reason = PiezoIdentError(
                        'the process at work ended by itself; is there enough memory?'
                    )
                    yield number, self._failed(number, reason)
                except Exception as error:  # noqa: BLE001
                    yield number, self._failed(number, error)
                else:
                    yield number, result


def run_all(
    jobs: Sequence[Job[T]],
    places: Places,
    failed: Callable[[int, BaseException], T],
    tick: Callable[[], None] = lambda: None,
) -> Iterator[tuple[int, T]]:
    """
    Do jobs, and yield the number and the result of each as they come.

    Parameters
    ----------
    jobs : sequence of callable
        Picklable; what one of them raises, or dies of, ends none of the others.
    places : Places
        From `cores` or `cluster`.
    failed : callable
        Makes a result of the number of a job and what went wrong with it.
    tick : callable, optional
        Called some times a second; may raise to stop.

    Yields
    ------
    number : int
    result : object

    Raises
    ------
    PiezoIdentError
        When a scheduler is lost.
    """
    yield from _Loop(places, failed).run(jobs, range(len(jobs)), tick)
