# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The main function of a node's process: the only caller of rclpy.init."""

import atexit
import ctypes
import os
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import NoReturn

import rclpy
from rclpy.signals import SignalHandlerOptions

from cliploc_ros.command import Interruption, split_ros_args
from cliploc_ros.ros.node.lifecycle import ManagedNode
from cliploc_ros.ros.node.threads import NodeExecutor, log_failure

_M_ARENA_MAX = -8  # malloc.h
# Python handles a signal between two waits.
_SPIN_S = 0.2
# Time for callbacks to end before their node is destroyed: requests are answered meanwhile.
_GRACE_S = 1.0
_HELP = """\
usage: ros2 run cliploc_ros {name} --ros-args [--params-file FILE] [-p NAME:=VALUE] [-r OLD:=NEW]

{about}
parameters, each with its default and meaning: config/{name}.yaml in
  install/share/cliploc_ros, or with ROS in $(ros2 pkg prefix --share cliploc_ros)

ros2 launch cliploc_ros relocalization.launch.py starts detector and relocalizer together."""


def run_node(name: str, make_node: Callable[[], ManagedNode], about: str) -> NoReturn:
    """Spin a node until SIGINT or SIGTERM; then end the process with exit code 0 within 2 s.

    With --help print what it is about in place of that.
    """
    if {'-h', '--help'} & {*split_ros_args(sys.argv[1:])[0]}:
        print(_HELP.format(name=name, about=about))
        sys.exit()
    # The networks of both nodes share a robot's cores. PyTorch's threads wait by spinning, which
    # slows the other process tenfold. PyTorch reads this when it is loaded.
    os.environ.setdefault('OMP_WAIT_POLICY', 'PASSIVE')
    # All threads share two heaps: free memory kept in twenty of them adds up.
    mallopt = getattr(ctypes.CDLL(None), 'mallopt', None)
    if mallopt is not None:  # glibc
        mallopt(_M_ARENA_MAX, 2)
    # Python would raise KeyboardInterrupt anywhere, even in the middle of a callback. rclpy would
    # end its context at once: a request under way could not be answered, nor a bond be ended.
    interrupted = Interruption()
    interrupted.catch(signal.SIGINT, signal.SIGTERM)
    try:
        rclpy.init(args=sys.argv, signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # rcl has its own types, for arguments and for missing folders
        sys.exit(f'error: ROS does not start: {error} (is HOME or ROS_LOG_DIR set?)')
    executor = NodeExecutor()
    node = None
    try:
        node = make_node()
        node.context.on_shutdown(node.release)
        executor.add_node(node)
        while node.context.ok() and not interrupted.is_set():
            try:
                executor.spin_once(timeout_sec=_SPIN_S)
            except Exception as error:
                log_failure(error, node)
    except Exception:
        if rclpy.ok():
            raise
    finally:
        if node is not None:
            node.release()
            node.worker.stop()
            # A callback that runs on in a destroyed node causes a segmentation fault. rclpy's
            # own shutdown should wait for callbacks, but does not.
            executor._work_tracker.wait(_GRACE_S)
            node.end_bond()
            # The executor's pending handlers keep references to all entities it waited for.
            executor.shutdown(0.0)
            # Without this, other nodes take it for alive for 20 s, and requests to it are lost.
            node.destroy_node()
        rclpy.try_shutdown()
    _leave()


def _leave() -> NoReturn:
    """End the process now.

    A thread inside a network cannot be stopped. Python would wait for it, and then need seconds
    to unload torch.
    """
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError, AttributeError):
            stream.flush()
    os._exit(0)
