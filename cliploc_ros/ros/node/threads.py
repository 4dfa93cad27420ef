# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The threads of a node: one for messages, a pool for services and timers, one for networks."""

import math
import threading
import time
import traceback
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from typing import Any

from rclpy.callback_groups import CallbackGroup, MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import InvalidHandle
from rclpy.executors import SingleThreadedExecutor, TimeoutException
from rclpy.node import Node
from rclpy.service import Service
from rclpy.task import Task
from rclpy.timer import Timer

from cliploc_ros.errors import CliplocError, InternalError, StoppedError, TimeUpError

# Greatest number of requests that wait in a thread; further requests wait in the middleware.
MAX_REQUESTS = 16
# Threads for waiting requests, transitions, parameters and timers, created on demand.
_THREADS = MAX_REQUESTS + 8
# Longest wait until a free thread gets a core and begins its callback.
_BEGIN_S = 0.1
# Greatest delay of the end of the process by a running network.
_GRACE_S = 0.2


def steady_timer(node: Node, period_s: float, callback: Callable[[], None]) -> Timer:
    """Return a timer in steady time, because simulated time may be paused."""
    return node.create_timer(period_s, callback, MutuallyExclusiveCallbackGroup(),
                             Clock(clock_type=ClockType.STEADY_TIME))


class BoundedCallbackGroup(CallbackGroup):
    """Runs up to `limit` callbacks at a time."""

    def __init__(self, limit: int) -> None:
        super().__init__()
        self._free = limit
        self._lock = threading.Lock()

    def can_execute(self, entity: object) -> bool:
        """Return whether a further callback may begin."""
        return self._free > 0

    def beginning_execution(self, entity: object) -> bool:
        """Count a callback that begins; return whether it may begin."""
        with self._lock:
            if not self._free:
                return False
            self._free -= 1
            return True

    def ending_execution(self, entity: object) -> None:
        """Count a callback that ended."""
        with self._lock:
            self._free += 1


class NodeExecutor(SingleThreadedExecutor):
    """Runs callbacks of messages in the spinning thread, services and timers in a pool.

    Services and timers may block. rclpy's MultiThreadedExecutor also passes each message to
    another thread. Until that thread takes it, a subscription with events wakes the executor
    repeatedly, which costs a whole core and contention for Python's lock.
    """

    def __init__(self) -> None:
        super().__init__()
        self._pool = ThreadPoolExecutor(_THREADS, thread_name_prefix='service')

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Execute one callback, or start it in the pool. Its exceptions are logged."""
        try:
            handler, entity, node = self.wait_for_ready_callbacks(timeout_sec)
        except (TimeoutException, InvalidHandle):  # an entity may be destroyed meanwhile
            return
        if not isinstance(entity, Service | Timer):
            _run(handler, node)
            return
        self._pool.submit(_run, handler, node)
        # wait, because rclpy returns a handler repeatedly until it has begun
        late = time.monotonic() + _BEGIN_S
        while not (handler.executing() or handler.done()) and time.monotonic() < late:
            time.sleep(0.0)


def _run(handler: Task, node: Node) -> None:
    handler()
    log_failure(handler.exception(), node)


def log_failure(error: Exception | None, node: Node) -> None:
    """Log the exception of a callback or of rclpy.

    InvalidHandle is ignored: an entity may be destroyed while rclpy waits for it. Exceptions
    after the shutdown of rclpy are ignored, too.
    """
    if error is not None and not isinstance(error, InvalidHandle) and node.context.ok():
        text = ''.join(traceback.format_exception(error))
        node.get_logger().error(f'internal error: {text}')


class Worker:
    """Runs tasks one at a time in a separate thread. It survives their exceptions.

    Parameters
    ----------
    report : callable
        Called with the traceback of an exception that is not a CliplocError.
    """

    def __init__(self, report: Callable[[str], object]) -> None:
        self._report = report
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix='inference')
        self._running: set[Future[Any]] = set()
        self._stopped: Future[None] = Future()

    def submit[T](self, task: Callable[[], T]) -> 'Future[T]':
        """Queue a task; return a future with its result or its CliplocError."""
        try:
            future = self._pool.submit(self._guarded, task)
        except RuntimeError as error:
            raise StoppedError('the node is shutting down') from error
        self._running.add(future)
        future.add_done_callback(self._running.discard)
        return future

    def run[T](self, task: Callable[[], T], deadline: float = math.inf) -> T:
        """Queue a task, wait for it and return its result.

        Parameters
        ----------
        deadline : float
            When to stop waiting (monotonic clock) [s]. A task that has begun continues. A task
            that still waits is dropped, because requests would pile up behind a slow task.

        Raises
        ------
        CliplocError
            The task raised it. StoppedError: the process ends before the task.
        TimeUpError
            The deadline passed before the task ended.
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
        raise TimeUpError('localization took longer than timeout_s: raise timeout_s, or choose '
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
        """Drop all queued tasks and wait briefly for the running task."""
        self._pool.shutdown(wait=False, cancel_futures=True)
        wait(list(self._running), _GRACE_S)
        if not self._stopped.done():
            self._stopped.set_result(None)


class LatestOnly[T]:
    """Passes items to a worker; while the worker is busy, only the newest item waits.

    Parameters
    ----------
    work : callable
        Called with an item, in the worker's thread.
    """

    def __init__(self, worker: Worker, work: Callable[[T], None]) -> None:
        self._worker = worker
        self._work = work
        self._lock = threading.Lock()
        self._items: list[T] = []
        self.dropped = 0

    def offer(self, item: T) -> None:
        """Queue an item in place of a waiting item."""
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
