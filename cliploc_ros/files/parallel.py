# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Independent tasks on this process, on local processes, or on a Dask cluster.

A worker that dies costs time, not the run: its tasks run again, each alone. A task that kills
its worker a second time is given up and reported.
"""

import ctypes
import hashlib
import importlib.metadata
import logging
import multiprocessing
import signal
import threading
import time
from collections.abc import Callable, Collection, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from cliploc_ros.errors import CliplocError, OptionsError

if TYPE_CHECKING:
    from distributed import Client

logger = logging.getLogger(__name__)

# Tasks that wait beside each worker: enough to keep it busy, few enough to hold in memory.
_TASKS_A_WORKER = 2
# So many dead workers in a row, each with another task, are no accident.
_MOST_DEATHS_IN_A_ROW = 3
# A cluster that lost all its workers starts new ones in this time, or never.
_CHECK_S, _RESTART_S = 5.0, 60.0
_CONNECT_S = 10
_PR_SET_PDEATHSIG = 1  # linux/prctl.h


class WorkersError(CliplocError):
    """Workers cannot be started, or die again and again."""


class MakeWork(Protocol):
    """Makes the function that does a task; holds or loads what it needs.

    Each worker gets it once, and each thread that does tasks makes a function of its own.
    """

    def __call__(self) -> Callable[[Any], Any]:
        """Return the function."""


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
        In no particular order. A task at which workers died again and again has the result None.

    Raises
    ------
    WorkersError
        Workers cannot be started, die again and again, or have another version of this package.
    """
    if scheduler:
        yield from _on_dask(make_work, iter(tasks), scheduler)
    elif workers == 1:
        work = make_work()
        for task in tasks:
            yield task, work(task)
    else:
        yield from _on_processes(make_work, iter(tasks), workers)


def _on_processes(make_work: MakeWork, tasks: Iterator[Any], workers: int
                  ) -> Iterator[tuple[Any, Any]]:
    suspects: list[Any] = []  # a worker died while these waited for their results
    deaths = 0
    while True:
        alone = bool(suspects)
        source = iter(suspects) if alone else tasks
        with _local_pool(make_work, 1 if alone else workers) as pool:
            stream = _Stream(_LocalPool(pool), source, 1 if alone else _TASKS_A_WORKER * workers)
            try:
                for finished in stream:
                    deaths = 0
                    yield finished
                suspects = []
            except BrokenProcessPool:
                deaths += 1
                suspects = stream.unfinished
                if alone:
                    yield _given_up(suspects.pop(0))
                    suspects += source
                else:
                    logger.warning('a worker process died; its tasks run again')
        if deaths > _MOST_DEATHS_IN_A_ROW:
            raise WorkersError(f'{deaths} worker processes died in a row, perhaps out of memory; '
                               'run again with fewer --workers')
        if not (alone or suspects):
            return


def _given_up(task: Any) -> tuple[Any, Any]:
    logger.warning('left out: workers died again and again at %.200s', task)
    return task, None


class _Workers(Protocol):
    """What tasks are handed to."""

    #: Exceptions of a task that say that its workers died.
    deaths: tuple[type[Exception], ...]

    def submit(self, task: Any) -> Any:
        """Hand over a task; return its future."""

    def wait(self, futures: list[Any]) -> Collection[Any]:
        """Return those of some futures that are done, as soon as there are any."""


class _Stream:
    """Tasks on their way through workers, a bounded number at once."""

    def __init__(self, workers: _Workers, tasks: Iterator[Any], most: int) -> None:
        self._workers, self._tasks, self._most = workers, tasks, most
        self._in_flight: dict[Any, Any] = {}
        self._next: list[Any] = []
        #: Tasks whose workers died.
        self.lost: list[Any] = []

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
                future = self._workers.submit(self._next[0])
                self._in_flight[future] = self._next.pop(0)
            if not self._in_flight:
                return
            for future in self._workers.wait([*self._in_flight]):
                try:
                    result = future.result()
                except self._workers.deaths:
                    self.lost.append(self._in_flight.pop(future))
                else:
                    yield self._in_flight.pop(future), result


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


# ---- local processes ----------------------------------------------------------------------------


@contextmanager
def _local_pool(make_work: MakeWork, workers: int) -> Iterator[ProcessPoolExecutor]:
    # spawned, since forking a process that has run PyTorch's threads may hang
    pool = ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context('spawn'),
                               initializer=_begin_worker, initargs=(make_work,))
    processes = pool._processes  # the pool forgets them when it shuts down
    try:
        yield pool
    except BaseException:
        for process in [*(processes or {}).values()]:
            process.terminate()  # a task may take minutes
        raise
    finally:
        pool.shutdown(cancel_futures=True)


class _LocalPool:
    deaths: tuple[type[Exception], ...] = ()  # the death of one breaks the pool

    def __init__(self, pool: ProcessPoolExecutor) -> None:
        self._pool = pool

    def submit(self, task: Any) -> Any:
        return self._pool.submit(_do, task)

    def wait(self, futures: list[Any]) -> Collection[Any]:
        return wait(futures, return_when=FIRST_COMPLETED).done


_work: _Work


def _begin_worker(make_work: MakeWork) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C
    # a killed parent cannot end its workers, so the kernel does
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    global _work  # a pool's workers have no other memory
    _work = _Work(make_work)  # makes it later: an error here would only break the pool


def _do(task: Any) -> Any:
    return _work(task)


# ---- a Dask cluster -----------------------------------------------------------------------------


def _on_dask(make_work: MakeWork, tasks: Iterator[Any], address: str
             ) -> Iterator[tuple[Any, Any]]:
    try:
        from distributed import KilledWorker
    except ImportError as error:
        raise OptionsError('--scheduler needs Dask: pip install distributed') from error
    with _connect(address) as client:
        _check_package(client, address)
        cluster = _Cluster(client, address, make_work, (KilledWorker,))
        threads = sum(client.nthreads().values())
        try:
            together = _Stream(cluster, tasks, _TASKS_A_WORKER * threads)
            yield from together
            # Dask itself runs again what a dead worker had. After some deaths it blames all the
            # tasks that waited there, not only the one that killed.
            alone = _Stream(cluster, iter(together.lost), 1)
            yield from alone
        except CancelledError as error:
            raise WorkersError(f'the Dask scheduler at {address} is gone; start it and run again '
                               'to go on') from error
    yield from map(_given_up, alone.lost)


class _Cluster:
    # Client.get_executor loses results of workers that die right after a task.

    def __init__(self, client: 'Client', address: str, make_work: MakeWork,
                 deaths: tuple[type[Exception], ...]) -> None:
        self.deaths = deaths
        self._client, self._address = client, address
        # a task of its own: what makes the work reaches each worker once, and Dask makes it again
        # if the workers that hold it die
        self._work = client.submit(_Work, make_work, pure=False)
        self._last_seen = time.monotonic()

    def submit(self, task: Any) -> Any:
        return self._client.submit(_call, self._work, task, pure=False)

    def wait(self, futures: list[Any]) -> Collection[Any]:
        from distributed import TimeoutError as NoneYet
        from distributed import wait

        while True:
            try:
                with self._client.as_current():
                    return wait(futures, timeout=_CHECK_S, return_when='FIRST_COMPLETED').done
            except NoneYet:
                self._look_for_workers()

    def _look_for_workers(self) -> None:
        if self._client.nthreads():
            self._last_seen = time.monotonic()
        elif time.monotonic() - self._last_seen > _RESTART_S:
            raise WorkersError(f'all workers of the Dask scheduler at {self._address} are gone; '
                               'start some and run again to go on')


def _call(work: _Work, task: Any) -> Any:
    return work(task)


@contextmanager
def _connect(address: str) -> Iterator['Client']:
    """Yield a client of a scheduler that has workers."""
    from distributed import Client

    try:
        client = Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise WorkersError(f'no Dask scheduler answers at {address}: {error}; start one with '
                           '"dask scheduler", or check address and firewall') from error
    with client:
        try:
            client.wait_for_workers(1, timeout=_CONNECT_S)
        except TimeoutError as error:
            raise WorkersError(f'the Dask scheduler at {address} has no workers; start some with '
                               f'"dask worker {address}"') from error
        yield client


def _check_package(client: 'Client', address: str) -> None:
    """Refuse workers whose results may differ.

    WorkersError: a worker has other sources of this package, or none.
    """
    def look() -> str | None:
        # sent by value, so that it runs where this package is missing
        from importlib.util import find_spec
        if find_spec('cliploc_ros') is None:
            return None
        from cliploc_ros.files import parallel
        return getattr(parallel, 'package_state', lambda: 'of another version')()

    ours = package_state()
    for worker, theirs in client.run(look, on_error='return').items():
        if theirs != ours:
            raise WorkersError(
                f'the Dask worker {worker} has cliploc_ros {theirs}, this is {ours}; install the '
                f'same on all workers of {address} and restart them')


def package_state() -> str:
    """Return the version of this package, and a digest of its sources."""
    folder = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for path in sorted(folder.rglob('*.py')):
        digest.update(path.relative_to(folder).as_posix().encode() + path.read_bytes())
    try:
        version = importlib.metadata.version('cliploc_ros')
    except importlib.metadata.PackageNotFoundError:
        version = 'not installed'
    return f'{version} (sources {digest.hexdigest()[:8]})'
