# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The life of a node's process: the only caller of rclpy.init."""

import atexit
import ctypes
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import NoReturn

import rclpy
from rclpy.exceptions import InvalidHandle
from rclpy.executors import (
    ExternalShutdownException,
    SingleThreadedExecutor,
    TimeoutException,
)
from rclpy.node import Node
from rclpy.service import Service
from rclpy.task import Task
from rclpy.timer import Timer

from cliploc_ros.ros.lifecycle import ManagedNode
from cliploc_ros.ros.requests import MAX_REQUESTS

# For the requests that may wait, for transitions, parameters, timers and the rest. Threads are
# made when they are first needed.
_THREADS = MAX_REQUESTS + 8
# A thread is free, but may have to wait for a core.
_BEGIN_S = 0.1
_M_ARENA_MAX = -8  # malloc.h
# For callbacks to end before their node does.
_GRACE_S = 1.0


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
        """Execute one callback, or begin to; raise what one that is executed here raises."""
        try:
            handler, entity, node = self.wait_for_ready_callbacks(timeout_sec)
        except TimeoutException:
            return
        if isinstance(entity, Service | Timer):
            self._pool.submit(self._run_beside, handler, node)
            # rclpy hands out again what has not begun
            late = time.monotonic() + _BEGIN_S
            while not (handler.executing() or handler.done()) and time.monotonic() < late:
                time.sleep(0.0)
            return
        handler()
        handler.result()

    @staticmethod
    def _run_beside(handler: Task, node: Node) -> None:
        handler()
        _report(handler.exception(), node)


def _spin(executor: NodeExecutor, node: ManagedNode) -> None:
    """Execute callbacks until the process is told to end; no failure of one ends the node."""
    while node.context.ok():
        try:
            # rclpy loses the wake-up of a shutdown now and then: look up twice a second.
            executor.spin_once(timeout_sec=0.5)
        except Exception as error:
            _report(error, node)


def _report(error: Exception | None, node: Node) -> None:
    """Log what a callback raised.

    Not the InvalidHandle of what was destroyed while rclpy gathered what to wait for, which
    gathers again; nor what rclpy stumbles over while the process ends.
    """
    if error is not None and not isinstance(error, InvalidHandle) and node.context.ok():
        text = ''.join(traceback.format_exception(error))
        node.get_logger().error(f'internal error: {text}')


def run_node(make_node: Callable[[], ManagedNode]) -> NoReturn:
    """Spin a node until SIGINT or SIGTERM; then end the process with exit code 0 within 2 s."""
    # Two networks share a robot's cores, each in a process of its own: a thread of PyTorch that
    # waits by spinning, as they do, slows the other one tenfold. Read when PyTorch is loaded.
    os.environ.setdefault('OMP_WAIT_POLICY', 'PASSIVE')
    _bound_arenas()
    try:
        rclpy.init(args=sys.argv)
    except Exception as error:  # rcl raises its own types for arguments and for missing folders
        sys.exit(f'error: ROS does not start: {error} (is HOME or ROS_LOG_DIR set?)')
    executor = NodeExecutor()
    node = None
    try:
        node = make_node()
        node.context.on_shutdown(node.release)
        executor.add_node(node)
        _spin(executor, node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except Exception:
        if rclpy.ok():
            raise
        # a signal came while the node was made
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # a second Ctrl-C changes nothing
        if node is not None:
            node.release()
            node.worker.stop()
            # A callback that goes on in a destroyed node ends the process by a segmentation
            # fault. rclpy's own shutdown means to wait for callbacks, and does not.
            executor._work_tracker.wait(_GRACE_S)
            # What rclpy was about to hand out holds on to everything that it waited for.
            executor.shutdown(0.0)
            # Others would take a node that does not say good-bye for alive, and wait for it.
            node.destroy_node()
        rclpy.try_shutdown()
    _leave()


def _bound_arenas() -> None:
    """Let the threads share their heaps: what each of twenty keeps for later adds up."""
    mallopt = getattr(ctypes.CDLL(None), 'mallopt', None)
    if mallopt is not None:  # glibc
        mallopt(_M_ARENA_MAX, 2)


def _leave() -> NoReturn:
    """End the process now.

    A thread inside a network cannot be stopped, and Python would wait for it, and then take
    seconds to take torch apart.
    """
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError, AttributeError):
            stream.flush()
    os._exit(0)
