# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The life of a node's process: the only caller of rclpy.init."""

import atexit
import ctypes
import os
import signal
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import NoReturn

import rclpy

from cliploc_ros.ros.node.executor import NodeExecutor, log_failure
from cliploc_ros.ros.node.lifecycle import ManagedNode

_M_ARENA_MAX = -8  # malloc.h
# For callbacks to end before their node does.
_GRACE_S = 1.0


def run_node(make_node: Callable[[], ManagedNode]) -> NoReturn:
    """Spin a node until SIGINT or SIGTERM; then end the process with exit code 0 within 2 s."""
    # Two networks share a robot's cores, each in a process of its own: a thread of PyTorch that
    # waits by spinning, as they do, slows the other one tenfold. Read when PyTorch is loaded.
    os.environ.setdefault('OMP_WAIT_POLICY', 'PASSIVE')
    _bound_arenas()
    # Python would raise KeyboardInterrupt wherever it is, in the middle of a callback, too.
    interrupted = threading.Event()
    signal.signal(signal.SIGINT, lambda *_: interrupted.set())
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
        while node.context.ok() and not interrupted.is_set():
            try:
                # rclpy loses the wake-up of a shutdown now and then: look up twice a second.
                executor.spin_once(timeout_sec=0.5)
            except Exception as error:
                log_failure(error, node)
    except Exception:
        if rclpy.ok():
            raise
        # a signal came while the node was made
    finally:
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
