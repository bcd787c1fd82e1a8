# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Run jobs in processes of this machine, or on the workers of a dask cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
import os
import threading
from typing import Any

from piezo_ident import __version__
from piezo_ident.common.errors import ConfigError
from piezo_ident.common.process import Job, WorkerProcess

#: function that takes a job and gives the future of its result
Submit = Callable[[Any], Future[Any]]

WAIT_FOR_SCHEDULER = 10.0


@contextmanager
def processes(jobs: int) -> Iterator[Submit]:
    """Yield a function that submits jobs to processes; a process that dies costs one job."""
    # for narrow matrices a second thread of BLAS only waits; new processes inherit the setting
    for name in ('OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS', 'OMP_NUM_THREADS'):
        os.environ.setdefault(name, '1')
    local, workers = threading.local(), []

    def begin() -> None:
        local.worker = WorkerProcess()
        workers.append(local.worker)

    def run(job: Job) -> Any:
        return local.worker.run(job)

    def end() -> None:
        for worker in workers:
            worker.close()

    # each thread drives one process
    threads = ThreadPoolExecutor(jobs, initializer=begin)
    try:
        yield lambda job: threads.submit(run, job)
    finally:
        threads.shutdown(wait=False, cancel_futures=True)
        end()
        threads.shutdown()
        # close the processes of threads that began meanwhile
        end()


@contextmanager
def dask(address: str) -> Iterator[Submit]:
    """
    Yield a function that submits jobs to the workers of a dask scheduler.

    Raises ConfigError if dask.distributed is not installed, no scheduler answers, the scheduler
    has no worker, or a worker has another version of this package.
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
        yield client.get_executor(pure=False).submit
    finally:
        client.close(timeout=WAIT_FOR_SCHEDULER)


def _version() -> str:
    return __version__
