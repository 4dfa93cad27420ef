# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Run independent tasks in this process, in local processes, or on a Dask cluster.

joblib offers both kinds of workers, but its Dask backend waits forever for a task whose workers
died: it calls no callback for KilledWorker (joblib 1.6.0).
"""

import ctypes
import multiprocessing
import signal
from collections.abc import Callable, Collection, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from itertools import islice
from typing import Any

from cliploc_ros.errors import CliplocError, OptionsError

# Tasks queued at each worker: the next task is ready there, and few tasks are in memory.
_TASKS_A_WORKER = 2
_CONNECT_S, _CHECK_S = 10, 60
_PR_SET_PDEATHSIG = 1  # linux/prctl.h


class WorkersError(CliplocError):
    """Workers cannot be started, or have died."""


#: Makes the function that runs a task, and loads the data that it needs. It is sent to each worker
#: once, and called at the worker's first task.
MakeWork = Callable[[], Callable[[Any], Any]]
# Submits a task and returns its future; returns the finished ones of some futures, at least one;
# the maximum number of tasks in flight.
_Pool = tuple[Callable[[Any], Any], Callable[[list[Any]], Collection[Any]], int]


def run_tasks(make_work: MakeWork, tasks: Iterable[Any], *, workers: int = 1, scheduler: str = ''
              ) -> Generator[tuple[Any, Any]]:
    """Run tasks; yield each task with its result as soon as it is finished.

    Tasks are taken from the iterable as workers become free, so the iterable may be a stream.
    Local workers end with this process, or as soon as this generator is closed.

    Parameters
    ----------
    tasks : iterable
        Picklable tasks.
    workers : int
        Number of local processes; 1 runs the tasks in this process.
    scheduler : str
        Address of a Dask scheduler, such as tcp://10.0.0.1:8786, whose workers run the tasks
        instead; '' for none.

    Yields
    ------
    task, result : object
        In no particular order.

    Raises
    ------
    WorkersError
        Workers cannot be started, a local worker died, or workers of the cluster died repeatedly
        at one task.
    """
    if workers == 1 and not scheduler:
        work = make_work()
        for task in tasks:
            yield task, work(task)
        return
    pool = _cluster(make_work, scheduler) if scheduler else _processes(make_work, workers)
    with pool as (submit, wait_for_some, most):
        left, in_flight = iter(tasks), dict[Any, Any]()
        while True:
            for task in islice(left, most - len(in_flight)):
                in_flight[submit(task)] = task
            if not in_flight:
                return
            for future in wait_for_some([*in_flight]):
                yield in_flight.pop(future), future.result()


def map_tasks(work: Callable[..., Any], tasks: Iterable[tuple[Any, ...]], **running: Any
              ) -> list[Any]:
    """Return work(*task) of all tasks in their order; `running`: see run_tasks."""
    found = {number: result for (number, _), result in run_tasks(
        partial(partial, _do_numbered, work), enumerate(tasks), **running)}
    return [found[number] for number in range(len(found))]


def _do_numbered(work: Callable[..., Any], task: tuple[int, tuple[Any, ...]]) -> Any:
    return work(*task[1])


class _Work:
    """Runs tasks with a function that is made at the first task. It is pickled as its MakeWork."""

    def __init__(self, make_work: MakeWork) -> None:
        self._make_work = make_work
        self._work: Callable[[Any], Any] | None = None

    def __reduce__(self) -> tuple[type['_Work'], tuple[MakeWork]]:
        """Return the constructor and its argument, for pickling."""
        return _Work, (self._make_work,)

    def __call__(self, task: Any) -> Any:
        """Run a task."""
        self._work = self._work or self._make_work()
        return self._work(task)


_work: _Work  # of a local worker: global, because tasks are submitted to a function without state


def _begin_worker(make_work: MakeWork) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C
    # a killed parent cannot end its workers: the kernel ends them
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    global _work
    _work = _Work(make_work)


def _do(task: Any) -> Any:
    return _work(task)


@contextmanager
def _processes(make_work: MakeWork, workers: int) -> Iterator[_Pool]:
    # spawned, because a fork of a process with PyTorch threads may hang
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context('spawn'), _begin_worker,
                               (make_work,))
    try:
        yield (lambda task: pool.submit(_do, task),
               lambda futures: wait(futures, return_when=FIRST_COMPLETED).done,
               _TASKS_A_WORKER * workers)
    except BaseException as error:
        for process in [*(pool._processes or {}).values()]:
            process.terminate()  # a task may take minutes
        if isinstance(error, BrokenProcessPool):
            raise WorkersError('a worker died, perhaps out of memory; run again with fewer '
                               'workers') from error
        raise
    finally:
        pool.shutdown(cancel_futures=True)


@contextmanager
def _cluster(make_work: MakeWork, address: str) -> Iterator[_Pool]:
    """Connect to a Dask cluster. Client.get_executor would lose results of workers that die."""
    try:
        from distributed import Client, KilledWorker
        from distributed import wait as wait_on_dask
    except ImportError as error:
        raise OptionsError('`scheduler` requires Dask: pip install distributed') from error

    def wait_for_workers() -> None:
        try:
            client.wait_for_workers(1, timeout=_CONNECT_S)
        except TimeoutError as error:
            raise WorkersError(f'the Dask scheduler at {address} has no workers; start some with '
                               f'"dask worker {address}"') from error

    def wait_for_some(futures: list[Any]) -> Collection[Any]:
        while True:
            try:
                with client.as_current():
                    return wait_on_dask(futures, _CHECK_S, 'FIRST_COMPLETED').done
            except TimeoutError:
                wait_for_workers()

    try:
        client = Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise WorkersError(f'no Dask scheduler answers at {address}: {error}; start one with '
                           '"dask scheduler", or check address and firewall') from error
    with client:
        wait_for_workers()
        # a separate task: make_work is sent to each worker once
        work = client.submit(_Work, make_work, pure=False)
        try:
            yield (partial(client.submit, _Work.__call__, work, pure=False), wait_for_some,
                   _TASKS_A_WORKER * sum(client.nthreads().values()))
        except (CancelledError, KilledWorker) as error:
            raise WorkersError(f'the Dask scheduler at {address} is gone, or its workers died, '
                               f'perhaps out of memory: {error}; run again') from error
