# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The life of a node's process: the only caller of rclpy.init."""

import sys
from collections.abc import Callable

import rclpy
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node

from cliploc_ros.ros.worker import Worker, leave

# One for a request that waits, one for frames, one for parameters and the rest.
_THREADS = 3


class WorkingNode(Node):
    """A node whose networks run in a worker beside its executor.

    Parameters
    ----------
    name : str
        Name of the node. Parameters given at start-up are declared as they come.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name, automatically_declare_parameters_from_overrides=True)
        self.worker = Worker(self.get_logger().error)

    def release(self) -> None:
        """Let go whoever waits in this node: the process ends."""


def run_node(make_node: Callable[[], WorkingNode]) -> int:
    """Spin a node until SIGINT or SIGTERM; return 0, or end the process with it within 2 s."""
    rclpy.init(args=sys.argv)
    executor = MultiThreadedExecutor(num_threads=_THREADS)
    node = None
    try:
        node = make_node()
        node.context.on_shutdown(node.release)
        executor.add_node(node)
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        ended = True
        if node is not None:
            node.release()
            ended = node.worker.stop()
        rclpy.try_shutdown()
    leave(ended)
    return 0
