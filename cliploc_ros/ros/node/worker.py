# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Work beside the executor: the node answers while a network runs."""

import threading
import traceback
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from typing import Any

from cliploc_ros.errors import CliplocError, InternalError, StoppedError

# How long a running network may delay the end of its process.
_GRACE_S = 0.2


class Worker:
    """One thread that works off tasks, one at a time, and survives all of them.

    Parameters
    ----------
    report : callable
        Takes the traceback of an exception that is no CliplocError.
    """

    def __init__(self, report: Callable[[str], object]) -> None:
        self._report = report
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix='inference')
        self._running: set[Future[Any]] = set()
        self._stopped: Future[None] = Future()

    def submit[T](self, task: Callable[[], T]) -> 'Future[T]':
        """Queue a task; its result or CliplocError is in the future returned."""
        try:
            future = self._pool.submit(self._guarded, task)
        except RuntimeError as error:
            raise StoppedError('the node is shutting down') from error
        self._running.add(future)
        future.add_done_callback(self._running.discard)
        return future

    def run[T](self, task: Callable[[], T]) -> T:
        """Return the result of a task, when its turn has come.

        Raises
        ------
        CliplocError
            What the task raised; StoppedError when the process ends first.
        """
        future = self.submit(task)
        either: list[Future[Any]] = [future, self._stopped]
        wait(either, return_when=FIRST_COMPLETED)
        if not future.done() or future.cancelled():
            raise StoppedError('the node is shutting down')
        return future.result()

    def _guarded[T](self, task: Callable[[], T]) -> T:
        try:
            return task()
        except CliplocError:
            raise
        except Exception as error:
            self._report(traceback.format_exc())
            raise InternalError(f'internal error: {type(error).__name__}: {error} (the traceback '
                                'is in the log)') from error

    def stop(self) -> None:
        """Drop what waits, and give the running task a moment to end; nobody waits for it then."""
        self._pool.shutdown(wait=False, cancel_futures=True)
        wait(list(self._running), _GRACE_S)
        if not self._stopped.done():
            self._stopped.set_result(None)


class LatestOnly[T]:
    """Hands items to a worker; while it is busy only the newest waits.

    Parameters
    ----------
    worker : Worker
    work : callable
        Takes one item, in the worker's thread.
    """

    def __init__(self, worker: Worker, work: Callable[[T], None]) -> None:
        self._worker = worker
        self._work = work
        self._lock = threading.Lock()
        self._items: list[T] = []
        self.dropped = 0

    @property
    def waiting(self) -> T | None:
        """Return the item that waits."""
        with self._lock:
            return self._items[0] if self._items else None

    def offer(self, item: T) -> None:
        """Give an item to be worked on, in place of one that still waits."""
        with self._lock:
            waiting = bool(self._items)
            self.dropped += waiting
            self._items = [item]
        if not waiting:
            self._worker.submit(self._take)

    def _take(self) -> None:
        with self._lock:
            item = self._items.pop()
        self._work(item)
