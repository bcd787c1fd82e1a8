# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Where jobs run: processes of this machine, or the workers of a dask cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import as_completed, Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
import os
import threading
from typing import Any

from piezo_ident import __version__
from piezo_ident.common.errors import ConfigError
from piezo_ident.common.process import Job, WorkerProcess

__all__ = ['completed', 'dask', 'processes']

WAIT_FOR_SCHEDULER = 10.0


def completed(futures: Iterable[Future[Any]], tick: Callable[[], None]) -> Iterator[Future[Any]]:
    """Yield futures as they complete; `tick` is called some times a second and may raise."""
    left = set(futures)
    while left:
        tick()
        try:
            for future in as_completed(left, timeout=0.2):
                left.discard(future)
                yield future
        except TimeoutError:
            pass


class _Processes(ThreadPoolExecutor):
    """Threads that each drive one process, so that a dead process costs one record."""

    def __init__(self, jobs: int) -> None:
        super().__init__(jobs)
        self._local = threading.local()
        self._workers: list[WorkerProcess] = []

    def submit(self, job: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        return super().submit(self._run, job)

    def _run(self, job: Job) -> Any:
        if not hasattr(self._local, 'worker'):
            self._local.worker = WorkerProcess()
            self._workers.append(self._local.worker)
        return self._local.worker.run(job)

    def end(self) -> None:
        self.shutdown(wait=False, cancel_futures=True)
        for worker in self._workers:
            worker.close()
        self.shutdown()


@contextmanager
def processes(jobs: int) -> Iterator[Executor]:
    """Yield an executor of so many processes; they are gone at the end."""
    # the matrices are narrow: a second thread of BLAS only waits; new processes inherit this
    for name in ('OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS', 'OMP_NUM_THREADS'):
        os.environ.setdefault(name, '1')
    executor = _Processes(jobs)
    try:
        yield executor
    finally:
        executor.end()


@contextmanager
def dask(address: str) -> Iterator[Executor]:
    """
    Yield the workers of a dask scheduler as an executor.

    Raises
    ------
    ConfigError
        When dask.distributed is not installed, no scheduler answers, it has no worker, or a worker
        has another version of this package.
    """
    try:
        from distributed import Client
    except ImportError:
        raise ConfigError(
            'dask.distributed is not installed; install the extra piezo_ident[cluster]'
        ) from None
    try:
        client = Client(address, timeout=WAIT_FOR_SCHEDULER, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ConfigError(f'{address}: no dask scheduler answers ({error})') from None
    try:
        try:
            client.wait_for_workers(1, timeout=WAIT_FOR_SCHEDULER)
        # the class of this error differs between versions of Python
        except Exception:  # noqa: BLE001
            raise ConfigError(f'{address}: the scheduler has no worker; start one') from None
        for worker, version in client.run(_version, on_error='return').items():
            if version != __version__:
                raise ConfigError(
                    f'{worker}: has piezo_ident {version}; install {__version__} there'
                )
        yield client.get_executor(pure=False)
    finally:
        client.close(timeout=WAIT_FOR_SCHEDULER)


def _version() -> str:
    return __version__
