# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Who executes the callbacks of a node, and in which thread."""

import time
import traceback
from concurrent.futures import ThreadPoolExecutor

from rclpy.exceptions import InvalidHandle
from rclpy.executors import SingleThreadedExecutor, TimeoutException
from rclpy.node import Node
from rclpy.service import Service
from rclpy.task import Task
from rclpy.timer import Timer

from cliploc_ros.ros.node.callback_group import MAX_REQUESTS

# For the requests that may wait, for transitions, parameters, timers and the rest. Threads are
# made when they are first needed.
_THREADS = MAX_REQUESTS + 8
# A thread is free, but may have to wait for a core.
_BEGIN_S = 0.1


class NodeExecutor(SingleThreadedExecutor):
    """Takes messages in the thread that spins, services and timers in others, for they may wait.

    rclpy's MultiThreadedExecutor hands each message to another thread. Until that has taken it,
    the message wakes the executor again and again, for a subscription with events is waited for
    even while it is being served: that costs a whole core, and Python's lock is passed around.
    """

    def __init__(self) -> None:
        super().__init__()
        self._pool = ThreadPoolExecutor(_THREADS, thread_name_prefix='service')

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Execute one callback, or begin to; what it raises is logged, and ends nothing."""
        try:
            handler, entity, node = self.wait_for_ready_callbacks(timeout_sec)
        except TimeoutException:
            return
        if not isinstance(entity, Service | Timer):
            _run(handler, node)
            return
        self._pool.submit(_run, handler, node)
        # rclpy hands out again what has not begun
        late = time.monotonic() + _BEGIN_S
        while not (handler.executing() or handler.done()) and time.monotonic() < late:
            time.sleep(0.0)


def _run(handler: Task, node: Node) -> None:
    handler()
    log_failure(handler.exception(), node)


def log_failure(error: Exception | None, node: Node) -> None:
    """Log what a callback raised, or rclpy before it.

    Not the InvalidHandle of what was destroyed while rclpy gathered what to wait for, or before
    its event was taken; nor what rclpy stumbles over while the process ends.
    """
    if error is not None and not isinstance(error, InvalidHandle) and node.context.ok():
        text = ''.join(traceback.format_exception(error))
        node.get_logger().error(f'internal error: {text}')
