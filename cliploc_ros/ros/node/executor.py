# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The executor of a node: messages in one thread, services and timers in others."""

import threading
import time
import traceback
from concurrent.futures import ThreadPoolExecutor

from rclpy.callback_groups import CallbackGroup
from rclpy.exceptions import InvalidHandle
from rclpy.executors import SingleThreadedExecutor, TimeoutException
from rclpy.node import Node
from rclpy.service import Service
from rclpy.task import Task
from rclpy.timer import Timer

# Requests that may wait at a time, a thread each; further ones wait in the middleware.
MAX_REQUESTS = 16
# For requests that wait, transitions, parameters and timers. The pool creates threads on demand.
_THREADS = MAX_REQUESTS + 8
# A thread is free, but may wait for a core.
_BEGIN_S = 0.1


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
        except TimeoutException:
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
