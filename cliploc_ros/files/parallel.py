# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Independent tasks on this process, on local processes, or on a Dask cluster.

A worker that dies costs the time of its tasks: they run again after all others, each alone. A task
that kills its worker a second time is given up and reported.
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

# Tasks at each worker: the next one waits there, and few are held in memory.
_TASKS_A_WORKER = 2
# Tasks at all workers lost this many times in a row, without a result, are not an accident.
_MOST_LOSSES = 3
# A cluster that lost all its workers starts new workers in this time, or never.
_CHECK_S, _RESTART_S = 5.0, 60.0
_CONNECT_S = 10
_PR_SET_PDEATHSIG = 1  # linux/prctl.h


class WorkersError(CliplocError):
    """Workers cannot be started, or die again and again."""


#: Makes the function that does a task; holds or loads what it needs. Each worker gets it once, and
#: each thread that does tasks makes a function of its own.
MakeWork = Callable[[], Callable[[Any], Any]]


class _Pool(NamedTuple):
    """Processes that do tasks, here or on a cluster."""

    most: int  #: Tasks that may be there at once
    deaths: tuple[type[Exception], ...]  #: Exceptions of a task whose worker died
    submit: Callable[[Any], Any]  #: Hands over a task; returns its future
    #: Returns those of some futures that are done, as soon as there are any
    wait: Callable[[list[Any]], Collection[Any]]


def run_tasks(make_work: MakeWork, tasks: Iterable[Any], *, workers: int = 1, scheduler: str = ''
              ) -> Generator[tuple[Any, Any]]:
    """Do tasks, and yield each with its result as soon as it is there.

    Tasks are taken from the iterable as workers become free, so that it may stream. Local workers
    end with this process, and as soon as this generator is closed.

    Parameters
    ----------
    tasks : iterable
        What can be sent to another process.
    workers : int
        Local processes; 1 does the tasks in this process.
    scheduler : str
        Address of a Dask scheduler, such as tcp://10.0.0.1:8786, whose workers do the tasks
        instead; '' for none.

    Yields
    ------
    task, result : object
        In no particular order. A task at which workers died twice has the result None.

    Raises
    ------
    WorkersError
        Workers cannot be started, die again and again, or have another version of this package.
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
        # a cluster blames every task of a dead worker, whichever of them killed it
        yield from _stream(pool, iter(again), 1, given_up)
    for task in given_up:
        logger.warning('left out: workers died again and again at %.200s', task)
        yield task, None


def _stream(pool: _Pool, tasks: Iterator[Any], most: int, lost: list[Any]
            ) -> Iterator[tuple[Any, Any]]:
    """Yield tasks with their results; add those whose worker died to `lost`."""
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
                    raise WorkersError('workers die again and again, perhaps out of memory; run '
                                       'again with fewer') from error
            else:
                losses = 0
                yield task, result


class _Work:
    """Does tasks; made once for each thread. It travels as what makes it."""

    def __init__(self, make_work: MakeWork) -> None:
        self._make_work = make_work
        self._of_thread = threading.local()

    def __reduce__(self) -> tuple[type['_Work'], tuple[MakeWork]]:
        """Return how another process makes an equal one."""
        return _Work, (self._make_work,)

    def __call__(self, task: Any) -> Any:
        """Do a task."""
        if not hasattr(self._of_thread, 'work'):
            self._of_thread.work = self._make_work()
        return self._of_thread.work(task)


_work: _Work  # of a local worker, which has no other memory


def _begin_worker(make_work: MakeWork) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C
    # a killed parent cannot end its workers, so the kernel does
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    global _work
    _work = _Work(make_work)  # makes it later: an error here would only break the pool


def _do(task: Any) -> Any:
    return _work(task)


@contextmanager
def _processes(make_work: MakeWork, workers: int) -> Iterator[_Pool]:
    """Yield local processes, each a pool of its own: the death of one breaks no other."""
    # spawned, since forking a process that has run PyTorch's threads may hang
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
    """Yield a Dask cluster. Client.get_executor would lose results of workers that die soon."""
    try:
        from distributed import Client, KilledWorker
        from distributed import wait as wait_on_dask
    except ImportError as error:
        raise OptionsError('a `scheduler` needs Dask: pip install distributed') from error
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
        # a task of its own: what makes the work reaches each worker once, and Dask makes it again
        # if the workers that hold it die
        work = client.submit(_Work, make_work, pure=False)
        try:
            yield _Pool(_TASKS_A_WORKER * sum(client.nthreads().values()), (KilledWorker,),
                        partial(client.submit, _Work.__call__, work, pure=False), wait_for_some)
        except CancelledError as error:
            raise WorkersError(f'the Dask scheduler at {address} is gone; start it and run again '
                               'to go on') from error


def _wait_for_workers(client: 'Client', address: str, time_s: float) -> None:
    try:
        client.wait_for_workers(1, timeout=time_s)
    except TimeoutError as error:
        raise WorkersError(f'the Dask scheduler at {address} has no workers; start some with '
                           f'"dask worker {address}"') from error


def _check_sources(client: 'Client', address: str) -> None:
    """Refuse workers whose results may differ: with other sources of this package, or none."""
    ours = digest_of_sources()
    for worker, theirs in client.run(digest_of_sources, on_error='return').items():
        if theirs != ours:
            raise WorkersError(
                f'the Dask worker {worker} has sources {theirs} of cliploc_ros, here are {ours}; '
                f'install the same on all workers of {address} and restart them')


def digest_of_sources() -> str:
    """Return a digest of the sources of this package."""
    folder = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for path in sorted(folder.rglob('*.py')):
        digest.update(path.relative_to(folder).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:8]
