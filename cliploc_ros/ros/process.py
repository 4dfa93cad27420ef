# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The life of a node's process: the only caller of rclpy.init."""

import atexit
import logging
import os
import signal
import sys
import traceback
from collections.abc import Callable
from contextlib import suppress
from typing import NoReturn

import rclpy
from rclpy.exceptions import InvalidHandle
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node

from cliploc_ros.ros.requests import MAX_REQUESTS
from cliploc_ros.ros.worker import Worker

# For the requests that may wait, for frames, for parameters and the rest. Threads are made when
# they are first needed.
_THREADS = MAX_REQUESTS + 3


class RosLogHandler(logging.Handler):
    """Passes what the package's modules without ROS log on to a node's logger."""

    def __init__(self, node: Node) -> None:
        super().__init__(logging.INFO)
        self._logger = node.get_logger()

    def emit(self, record: logging.LogRecord) -> None:
        """Log one record at its level."""
        if record.levelno >= logging.ERROR:
            self._logger.error(record.getMessage())
        elif record.levelno >= logging.WARNING:
            self._logger.warning(record.getMessage())
        else:
            self._logger.info(record.getMessage())


class WorkingNode(Node):
    """A node whose networks run in a worker beside its executor.

    Parameters
    ----------
    name : str
        Name of the node. Parameters given at start-up are declared as they come.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name, automatically_declare_parameters_from_overrides=True)
        self.worker = Worker(self._report)
        package_logger = logging.getLogger('cliploc_ros')
        package_logger.setLevel(logging.INFO)
        package_logger.addHandler(RosLogHandler(self))

    def _report(self, traceback_text: str) -> None:
        """Log a defect; one that comes with every frame must not fill the disk."""
        self.get_logger().error(traceback_text, throttle_duration_sec=1.0)

    def release(self) -> None:
        """Let go whoever waits in this node: the process ends."""


def _spin(executor: MultiThreadedExecutor, node: WorkingNode) -> None:
    """Execute callbacks until the process is told to end; no failure of one ends the node."""
    while node.context.ok():
        try:
            # rclpy loses the wake-up of a shutdown now and then: look up twice a second.
            executor.spin_once(timeout_sec=0.5)
        except InvalidHandle:
            # A subscription was destroyed while rclpy gathered what to wait for: it gathers
            # again.
            continue
        except Exception:
            node.get_logger().error(f'internal error: {traceback.format_exc()}')


def run_node(make_node: Callable[[], WorkingNode]) -> NoReturn:
    """Spin a node until SIGINT or SIGTERM; then end the process with exit code 0 within 2 s."""
    # Two networks share a robot's cores, each in a process of its own: a thread of PyTorch that
    # waits by spinning, as they do, slows the other one tenfold. Read when PyTorch is loaded.
    os.environ.setdefault('OMP_WAIT_POLICY', 'PASSIVE')
    try:
        rclpy.init(args=sys.argv)
    except Exception as error:  # rcl raises its own types for arguments and for missing folders
        sys.exit(f'error: ROS does not start: {error} (is HOME or ROS_LOG_DIR set?)')
    executor = MultiThreadedExecutor(num_threads=_THREADS)
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
            # Others would take a node that does not say good-bye for alive, and wait for it.
            node.destroy_node()
        rclpy.try_shutdown()
    _leave()


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
