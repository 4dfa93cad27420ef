# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Run independent tasks in this process, in local processes, or on a Dask cluster.

If a worker dies, its tasks run again after all other tasks, one at a time. A task whose worker
dies a second time is given up and reported.
"""

import ctypes
import hashlib
import logging
import multiprocessing
import signal
import threading
from collections import deque
from collections.abc import Callable, Collection, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from cliploc_ros.errors import CliplocError, OptionsError

if TYPE_CHECKING:
    from distributed import Client

logger = logging.getLogger(__name__)

# Tasks queued at each worker: the next task is ready there, and few tasks are in memory.
_TASKS_A_WORKER = 2
# If all workers lose their tasks this many times in a row, without any result, the run is aborted.
_MOST_LOSSES = 3
# Polling interval, and maximum wait for new workers after a cluster has lost all its workers [s].
_CHECK_S, _RESTART_S = 5.0, 60.0
_CONNECT_S = 10
_PR_SET_PDEATHSIG = 1  # linux/prctl.h


class WorkersError(CliplocError):
    """Workers cannot be started, or die repeatedly."""


#: Makes the function that runs a task, and loads the data that it needs. It is sent to each worker
#: once, and called once in each thread that runs tasks.
MakeWork = Callable[[], Callable[[Any], Any]]


class _Pool(NamedTuple):
    """Processes that run tasks, locally or on a cluster."""

    most: int  #: Maximum number of tasks in flight
    deaths: tuple[type[Exception], ...]  #: Exceptions of a task whose worker died
    submit: Callable[[Any], Any]  #: Submits a task; returns its future
    #: Waits until at least one of the futures is done; returns the finished futures
    wait: Callable[[list[Any]], Collection[Any]]


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
        In no particular order. A task whose workers died twice has the result None.

    Raises
    ------
    WorkersError
        Workers cannot be started, die repeatedly, or have another version of this package.
    """
    if workers == 1 and not scheduler:
        work = make_work()
        for task in tasks:
            yield task, work(task)
        return
    with _cluster(make_work, scheduler) if scheduler else _processes(make_work, workers) as pool:
        again: list[Any] = []
        given_up: list[Any] = []
        yield from _stream(pool, iter(tasks), pool.most, again)
        if again:
            logger.warning('workers died; %d tasks run again', len(again))
        # one at a time: a cluster reports all tasks of a dead worker, not only the task that
        # killed it
        yield from _stream(pool, iter(again), 1, given_up)
    for task in given_up:
        logger.warning('skipped: its workers died twice: %.200s', task)
        yield task, None


def _stream(pool: _Pool, tasks: Iterator[Any], most: int, lost: list[Any]
            ) -> Iterator[tuple[Any, Any]]:
    """Yield tasks with their results; add tasks whose worker died to `lost`."""
    in_flight: dict[Any, Any] = {}
    losses = 0
    while True:
        for task in islice(tasks, most - len(in_flight)):
            in_flight[pool.submit(task)] = task
        if not in_flight:
            return
        for future in pool.wait([*in_flight]):
            task = in_flight.pop(future)
            try:
                result = future.result()
            except pool.deaths as error:
                lost.append(task)
                losses += 1
                if losses > _MOST_LOSSES * most:
                    raise WorkersError('workers die repeatedly, perhaps out of memory; run again '
                                       'with fewer workers') from error
            else:
                losses = 0
                yield task, result


class _Work:
    """Runs tasks with a function made once for each thread. It is pickled as its MakeWork."""

    def __init__(self, make_work: MakeWork) -> None:
        self._make_work = make_work
        self._of_thread = threading.local()

    def __reduce__(self) -> tuple[type['_Work'], tuple[MakeWork]]:
        """Return the constructor and its argument, for pickling."""
        return _Work, (self._make_work,)

    def __call__(self, task: Any) -> Any:
        """Run a task."""
        if not hasattr(self._of_thread, 'work'):
            self._of_thread.work = self._make_work()
        return self._of_thread.work(task)


_work: _Work  # of a local worker: global, because tasks are submitted to a function without state


def _begin_worker(make_work: MakeWork) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C
    # a killed parent cannot end its workers: the kernel ends them
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    global _work
    _work = _Work(make_work)  # calls make_work at the first task: an error here breaks the pool


def _do(task: Any) -> Any:
    return _work(task)


@contextmanager
def _processes(make_work: MakeWork, workers: int) -> Iterator[_Pool]:
    """Start local processes, each in a separate pool: the death of a process breaks no other."""
    # spawned, because a fork of a process with PyTorch threads may hang
    start = partial(ProcessPoolExecutor, 1, mp_context=multiprocessing.get_context('spawn'),
                    initializer=_begin_worker, initargs=(make_work,))
    pools = [start() for _ in range(workers)]
    free = deque([*range(workers)] * _TASKS_A_WORKER)
    places: dict[Any, int] = {}

    def submit(task: Any) -> Any:
        place = free.popleft()
        try:
            future = pools[place].submit(_do, task)
        except BrokenProcessPool:
            pools[place] = start()
            future = pools[place].submit(_do, task)
        places[future] = place
        return future

    def wait_for_some(futures: list[Any]) -> Collection[Any]:
        done = wait(futures, return_when=FIRST_COMPLETED).done
        free.extend(map(places.pop, done))
        return done

    try:
        yield _Pool(len(free), (BrokenProcessPool,), submit, wait_for_some)
    except BaseException:
        for pool in pools:
            for process in [*(pool._processes or {}).values()]:
                process.terminate()  # a task may take minutes
        raise
    finally:
        for pool in pools:
            pool.shutdown(cancel_futures=True)


@contextmanager
def _cluster(make_work: MakeWork, address: str) -> Iterator[_Pool]:
    """Connect to a Dask cluster. Client.get_executor would lose results of workers that die."""
    try:
        from distributed import Client, KilledWorker
        from distributed import wait as wait_on_dask
    except ImportError as error:
        raise OptionsError('`scheduler` requires Dask: pip install distributed') from error
    try:
        client = Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise WorkersError(f'no Dask scheduler answers at {address}: {error}; start one with '
                           '"dask scheduler", or check address and firewall') from error

    def wait_for_some(futures: list[Any]) -> Collection[Any]:
        while True:
            try:
                with client.as_current():
                    return wait_on_dask(futures, timeout=_CHECK_S,
                                        return_when='FIRST_COMPLETED').done
            except TimeoutError:
                _wait_for_workers(client, address, _RESTART_S)

    with client:
        _wait_for_workers(client, address, _CONNECT_S)
        _check_sources(client, address)
        # a separate task: make_work is sent to each worker once, and Dask recreates it if the
        # workers that have it die
        work = client.submit(_Work, make_work, pure=False)
        try:
            yield _Pool(_TASKS_A_WORKER * sum(client.nthreads().values()), (KilledWorker,),
                        partial(client.submit, _Work.__call__, work, pure=False), wait_for_some)
        except CancelledError as error:
            raise WorkersError(f'the Dask scheduler at {address} is gone; start it and run again '
                               'to continue') from error


def _wait_for_workers(client: 'Client', address: str, time_s: float) -> None:
    try:
        client.wait_for_workers(1, timeout=time_s)
    except TimeoutError as error:
        raise WorkersError(f'the Dask scheduler at {address} has no workers; start some with '
                           f'"dask worker {address}"') from error


def _check_sources(client: 'Client', address: str) -> None:
    """Raise WorkersError if the sources of this package on a worker are missing or different."""
    ours = digest_of_sources()
    for worker, theirs in client.run(digest_of_sources, on_error='return').items():
        if theirs != ours:
            raise WorkersError(
                f'the Dask worker {worker} has sources {theirs} of cliploc_ros, expected {ours}; '
                f'install the same version on all workers of {address} and restart them')


def digest_of_sources() -> str:
    """Return a digest of the sources of this package."""
    folder = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for path in sorted(folder.rglob('*.py')):
        digest.update(path.relative_to(folder).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:8]
