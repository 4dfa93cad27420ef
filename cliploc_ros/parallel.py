# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Independent tasks on this process, on local processes, or on a Dask cluster.

A worker that dies costs time, not the run: its tasks run again, each alone. A task that kills
its worker a second time is given up and reported.
"""

import ctypes
import logging
import multiprocessing
import signal
from collections.abc import Callable, Hashable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from itertools import islice
from typing import Any, Protocol

from cliploc_ros.errors import CliplocError, OptionsError

logger = logging.getLogger(__name__)

# Tasks that wait beside each worker: enough to keep it busy, few enough to hold in memory.
_TASKS_A_WORKER = 2
# So many dead workers in a row, each with another task, are no accident.
_MOST_DEATHS_IN_A_ROW = 3
_PR_SET_PDEATHSIG = 1  # linux/prctl.h


class WorkersError(CliplocError):
    """Workers cannot be started, or die again and again."""


class MakeWork(Protocol, Hashable):
    """Makes the function that does a task; loads what it needs. Equal ones share a worker's."""

    def __call__(self) -> Callable[[Any], Any]:
        """Return the function."""


def run_tasks(make_work: MakeWork, tasks: Iterable[Any], *, workers: int = 1, scheduler: str = ''
              ) -> Iterator[tuple[Any, Any]]:
    """Do tasks, and yield each with its result as soon as it is there.

    Tasks are taken from the iterable as workers become free, so that it may stream.

    Parameters
    ----------
    make_work : MakeWork
        Called once in each process.
    tasks : iterable
        What can be sent to another process.
    workers : int
        Local processes; 1 does the tasks in this process.
    scheduler : str
        Address of a Dask scheduler, such as tcp://10.0.0.1:8786; '' for none.

    Yields
    ------
    task, result : object
        In no particular order. A task that killed its worker twice has the result None.

    Raises
    ------
    WorkersError
        Workers cannot be started, or die again and again.
    """
    if scheduler:
        yield from _on_dask(make_work, tasks, scheduler)
    elif workers == 1:
        work = make_work()
        for task in tasks:
            yield task, work(task)
    else:
        yield from _on_processes(make_work, iter(tasks), workers)


def _on_processes(make_work: MakeWork, tasks: Iterator[Any], workers: int
                  ) -> Iterator[tuple[Any, Any]]:
    suspects: list[Any] = []
    deaths = 0
    while True:
        with _local_pool(1 if suspects else workers) as pool:
            source = iter(suspects[:1]) if suspects else tasks
            most = 1 if suspects else _TASKS_A_WORKER * workers
            stream = _Stream(pool, make_work, source, most)
            try:
                for finished in stream:
                    deaths = 0
                    yield finished
                if not suspects:
                    return
                suspects.pop(0)
            except BrokenProcessPool:
                deaths += 1
                if suspects:
                    yield _given_up(suspects.pop(0))
                else:
                    logger.warning('a worker process died; its tasks run again')
                    suspects = stream.unfinished
                if deaths > _MOST_DEATHS_IN_A_ROW:
                    raise WorkersError(
                        f'{deaths} worker processes died in a row, perhaps out of memory; run '
                        'again with fewer --workers') from None


def _given_up(task: Any) -> tuple[Any, Any]:
    logger.warning('left out: workers died again and again at %s', task)
    return task, None


class _Stream:
    """Tasks in flight on an executor."""

    def __init__(self, executor: Executor, make_work: MakeWork, tasks: Iterator[Any], most: int,
                 lost: type[Exception] | tuple[()] = ()) -> None:
        self._executor, self._make_work = executor, make_work
        self._tasks, self._most, self._lost = tasks, most, lost
        self._in_flight: dict[Future[Any], Any] = {}
        self._next: list[Any] = []

    @property
    def unfinished(self) -> list[Any]:
        """Return the tasks that were taken and have no result."""
        return [*self._in_flight.values(), *self._next]

    def __iter__(self) -> Iterator[tuple[Any, Any]]:
        """Yield each task with its result."""
        while True:
            room = self._most - len(self._in_flight)
            self._next = list(islice(self._tasks, room))
            while self._next:
                future = self._executor.submit(_do, self._make_work, self._next[0])
                self._in_flight[future] = self._next.pop(0)
            if not self._in_flight:
                return
            done, _ = wait(self._in_flight, return_when=FIRST_COMPLETED)
            for future in done:
                if isinstance(future.exception(), self._lost):
                    yield _given_up(self._in_flight.pop(future))
                else:
                    result = future.result()  # raises before the task is forgotten
                    yield self._in_flight.pop(future), result


@contextmanager
def _local_pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    # spawned, since forking a process that has run PyTorch's threads may hang
    pool = ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context('spawn'),
                               initializer=_begin_worker)
    processes = pool._processes  # the pool forgets them when it shuts down
    try:
        yield pool
    except BaseException:
        for process in [*(processes or {}).values()]:
            process.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _begin_worker() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C
    # a killed parent cannot end its workers, so the kernel does
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def _on_dask(make_work: MakeWork, tasks: Iterable[Any], address: str) -> Iterator[tuple[Any, Any]]:
    try:
        from distributed import Client, KilledWorker
    except ImportError as error:
        raise OptionsError('--scheduler needs Dask: pip install distributed') from error
    try:
        client = Client(address, timeout='10s')
    except (OSError, ValueError, TimeoutError) as error:
        raise WorkersError(f'no Dask scheduler answers at {address}: {error}') from error
    with client:
        workers = sum(client.nthreads().values())
        if workers == 0:
            raise WorkersError(f'the Dask scheduler at {address} has no workers; start some')
        # Dask itself runs again what a dead worker had, and gives up after three deaths
        yield from _Stream(client.get_executor(pure=False), make_work, iter(tasks),
                           _TASKS_A_WORKER * workers, KilledWorker)


_works: dict[MakeWork, Callable[[Any], Any]] = {}


def _do(make_work: MakeWork, task: Any) -> Any:
    """Do a task in a worker, which makes what it needs once."""
    if make_work not in _works:
        _works[make_work] = make_work()
    return _works[make_work](task)
