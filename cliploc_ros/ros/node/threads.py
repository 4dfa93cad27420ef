# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The threads of a node: messages in one, services and timers in others, networks in a worker."""

import math
import threading
import time
import traceback
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.exceptions import InvalidHandle
from rclpy.executors import SingleThreadedExecutor, TimeoutException
from rclpy.node import Node
from rclpy.service import Service
from rclpy.task import Task
from rclpy.timer import Timer

from cliploc_ros.errors import CliplocError, InternalError, StoppedError, TimeUpError

# Requests that may wait at a time, a thread each; further requests wait in the middleware.
MAX_REQUESTS = 16
# For requests that wait, transitions, parameters and timers. The pool creates threads on demand.
_THREADS = MAX_REQUESTS + 8
# A thread is free, but may wait for a core.
_BEGIN_S = 0.1
# How long a running network may delay the end of its process.
_GRACE_S = 0.2


class BoundedCallbackGroup(CallbackGroup):
    """Runs up to `limit` callbacks at a time."""

    def __init__(self, limit: int) -> None:
        super().__init__()
        self._limit = limit
        self._running: list[object] = []
        self._lock = threading.Lock()

    def can_execute(self, entity: object) -> bool:
        """Return whether another callback may begin."""
        with self._lock:
            return len(self._running) < self._limit

    def beginning_execution(self, entity: object) -> bool:
        """Count a callback that begins; return whether it may."""
        with self._lock:
            if len(self._running) >= self._limit:
                return False
            self._running.append(entity)
            return True

    def ending_execution(self, entity: object) -> None:
        """Count a callback that ended."""
        with self._lock:
            self._running.remove(entity)


class NodeExecutor(SingleThreadedExecutor):
    """Takes messages in the thread that spins; services and timers may block, so others run them.

    rclpy's MultiThreadedExecutor passes each message to another thread. Until that thread takes
    it, a subscription with events wakes the executor again and again, which costs a whole core
    and contention for Python's lock.
    """

    def __init__(self) -> None:
        super().__init__()
        self._pool = ThreadPoolExecutor(_THREADS, thread_name_prefix='service')

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Execute one callback, or begin to. Its exceptions are logged and end nothing."""
        try:
            handler, entity, node = self.wait_for_ready_callbacks(timeout_sec)
        except (TimeoutException, InvalidHandle):  # an entity may be destroyed meanwhile
            return
        if not isinstance(entity, Service | Timer):
            _run(handler, node)
            return
        self._pool.submit(_run, handler, node)
        # rclpy returns a handler again until it has begun
        late = time.monotonic() + _BEGIN_S
        while not (handler.executing() or handler.done()) and time.monotonic() < late:
            time.sleep(0.0)


def _run(handler: Task, node: Node) -> None:
    handler()
    log_failure(handler.exception(), node)


def log_failure(error: Exception | None, node: Node) -> None:
    """Log the exception of a callback, or of rclpy itself.

    InvalidHandle is left out: an entity may be destroyed while rclpy waits for it. So is
    everything that rclpy raises while the process ends.
    """
    if error is not None and not isinstance(error, InvalidHandle) and node.context.ok():
        text = ''.join(traceback.format_exception(error))
        node.get_logger().error(f'internal error: {text}')


class Worker:
    """Runs tasks one at a time in a thread of its own, and survives all of them.

    Parameters
    ----------
    report : callable
        Takes the traceback of an exception that is not a CliplocError.
    """

    def __init__(self, report: Callable[[str], object]) -> None:
        self._report = report
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix='inference')
        self._running: set[Future[Any]] = set()
        self._stopped: Future[None] = Future()

    def submit[T](self, task: Callable[[], T]) -> 'Future[T]':
        """Queue a task; the returned future holds its result or its CliplocError."""
        try:
            future = self._pool.submit(self._guarded, task)
        except RuntimeError as error:
            raise StoppedError('the node is shutting down') from error
        self._running.add(future)
        future.add_done_callback(self._running.discard)
        return future

    def run[T](self, task: Callable[[], T], deadline: float = math.inf) -> T:
        """Return the result of a task when its turn has come.

        Parameters
        ----------
        deadline : float
            When to stop waiting (monotonic clock) [s]. A task that has begun goes on; one that
            still waits is dropped, else requests would pile up behind a slow task.

        Raises
        ------
        CliplocError
            The task raised it; StoppedError when the process ends first.
        TimeUpError
            The deadline passed first.
        """
        future = self.submit(task)
        either: list[Future[Any]] = [future, self._stopped]
        left_s = None if deadline == math.inf else max(0.0, deadline - time.monotonic())
        wait(either, left_s, return_when=FIRST_COMPLETED)
        if future.done() and not future.cancelled():
            return future.result()
        if self._stopped.done() or future.cancelled():
            raise StoppedError('the node is shutting down')
        if not future.cancel() and future.done():
            return future.result()  # it has just ended
        raise TimeUpError('localizing took longer than timeout_s: raise timeout_s, or choose '
                          'smaller networks')

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
        """Drop the queue and give the running task a moment to end."""
        self._pool.shutdown(wait=False, cancel_futures=True)
        wait(list(self._running), _GRACE_S)
        if not self._stopped.done():
            self._stopped.set_result(None)


class LatestOnly[T]:
    """Passes items to a worker; while the worker is busy, only the newest item waits.

    Parameters
    ----------
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
        """Return the waiting item, if there is one."""
        with self._lock:
            return self._items[0] if self._items else None

    def offer(self, item: T) -> None:
        """Queue an item; it replaces an item that still waits."""
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
