# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A managed node with its lifecycle, and the main function of its process.

run_node is the main function, and the only caller of rclpy.init in a node.
"""

import atexit
import ctypes
import logging
import math
import os
import signal
import sys
import threading
import time
import traceback
from abc import abstractmethod
from collections.abc import Callable
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import suppress
from typing import Any, NoReturn

import rclpy
from lifecycle_msgs.srv import ChangeState
from rclpy.duration import Duration
from rclpy.exceptions import InvalidHandle
from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState
from rclpy.lifecycle import TransitionCallbackReturn as Outcome
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from cliploc_ros.command import Interruption, split_ros_args
from cliploc_ros.errors import CliplocError, OptionsError, StoppedError
from cliploc_ros.ros.node import threads
from cliploc_ros.ros.node.diagnostics import Diagnostics, Health, Stages
from cliploc_ros.ros.node.parameters import NodeParameters, Parameters
from cliploc_ros.units import NS_PER_S

#: Least time between two log lines of one cause that recurs with each frame [s].
LOG_PERIOD_S = 5.0
# Nav2's defaults (nav2_util::LifecycleNode and its parameter bond_heartbeat_period).
_HEARTBEAT_PERIOD_S = 0.1
_HEARTBEAT_TIMEOUT_S = 4.0
# Longest wait until a manager, which may hang, acknowledges the last message of a bond.
_LAST_WORD_S = 0.2
# A transition may load weights for seconds; meanwhile clients can request the state.
_MAX_TRANSITION_REQUESTS = 3
# Greatest length of the label of a transition; the labels of rclpy have up to 21 characters.
_MOST_LABEL = 100
# Pause between attempts of a node to activate itself; it doubles each time.
_FIRST_PAUSE_S = 2.0
_LONGEST_PAUSE_S = 60.0
_PACKAGE_LOGGER = logging.getLogger('cliploc_ros')
_M_ARENA_MAX = -8  # malloc.h
# Longest wait of the executor: Python handles signals between waits.
_SPIN_S = 0.2
# Time for callbacks to end before their node is destroyed, so that requests are answered.
_GRACE_S = 1.0
_HELP = """\
usage: ros2 run cliploc_ros {name} --ros-args [--params-file FILE] [-p NAME:=VALUE] [-r OLD:=NEW]

{about}
parameters, each with its default and meaning: config/{name}.yaml in
  install/share/cliploc_ros, or with ROS in $(ros2 pkg prefix --share cliploc_ros)

ros2 launch cliploc_ros relocalization.launch.py starts detector and relocalizer together."""


class RosLogHandler(logging.Handler):
    """Forwards records of Python's logging to the logger of a node."""

    def __init__(self, node: Node) -> None:
        super().__init__(logging.INFO)
        self._logger = node.get_logger()

    def emit(self, record: logging.LogRecord) -> None:
        """Log one record at its level."""
        # one call per level, because rclpy refuses different levels at one call site
        if record.levelno >= logging.ERROR:
            self._logger.error(record.getMessage())
        elif record.levelno >= logging.WARNING:
            self._logger.warning(record.getMessage())
        else:
            self._logger.info(record.getMessage())


class NotActiveError(CliplocError):
    """The node is not active; the message names its state and the remedy."""


class ManagedNode[P: Parameters](LifecycleNodeMixin, Node):
    """A lifecycle node whose networks run in a worker thread beside its executor.

    The node configures and activates itself, and retries after failures, until a client changes
    its state: from then on that client manages it. With autostart false it waits for a manager.

    Parameters
    ----------
    name : str
        Name of the node.
    parameters : type
        The dataclass of its parameters.
    others : type, optional
        Parameters of other nodes that may be in the same parameter file.
    options
        Further arguments of rclpy's Node.

    Raises
    ------
    OptionsError
        A parameter has no value.
    """

    def __init__(self, name: str, parameters: type[P],
                 others: type[Parameters] = Parameters, **options: Any) -> None:
        try:
            Node.__init__(self, name, automatically_declare_parameters_from_overrides=True,
                          **options)
        except ValueError as error:  # rclpy does not name the parameter
            raise OptionsError('a parameter has no value: correct the parameter file; a map of '
                               f'keyframes alone is given as map_file ({error})') from error
        LifecycleNodeMixin.__init__(
            self, callback_group=threads.BoundedCallbackGroup(_MAX_TRANSITION_REQUESTS))
        self._log_handler = RosLogHandler(self)
        _PACKAGE_LOGGER.setLevel(logging.INFO)
        _PACKAGE_LOGGER.addHandler(self._log_handler)
        self.worker = threads.Worker(self.report)
        self.settings = NodeParameters(self, parameters, others)
        self.active = False
        #: Values that the diagnostics report in every state
        self.facts: dict[str, object] = {}
        self._transition = threading.Lock()
        self._failure = ''
        self._bond: Any = None
        self._answer_impossible_transitions()
        self.stages = Stages()
        self.diagnostics = Diagnostics(self, self._health, lambda: self.state)
        self._self_managed = self.settings.values.autostart
        self._starting = ThreadPoolExecutor(1, 'start')
        self._start: Future[None] | None = None
        self._start_lock = threading.Lock()
        self._pause_s = _FIRST_PAUSE_S
        self._starter = threads.steady_timer(self, 0.0, self._start_by_itself)

    # ---- what a node implements -----------------------------------------------------------------

    @abstractmethod
    def load(self) -> str:
        """Load map and weights, in the worker's thread; return a description in one line."""

    @abstractmethod
    def unload(self) -> None:
        """Drop map and weights, in the worker's thread."""

    @abstractmethod
    def open(self) -> None:
        """Start work. close() undoes it, also after open() failed."""

    @abstractmethod
    def close(self) -> None:
        """Stop work, and release waiting requests. The worker may still be busy."""

    @abstractmethod
    def examine(self, health: Health) -> None:
        """Add problems and values of the active node to its health."""

    def release(self) -> None:
        """Release waiting requests, because the process is ending."""

    def end_bond(self) -> None:
        """End the bond with the manager. The node must still exist.

        bondpy destroys its publisher directly after its last message, which is then lost, so this
        waits for the acknowledgement. bondpy also leaves the destroyed publisher and subscription
        in the node, where they would keep the executor busy for ever, so they are removed.
        """
        bond, self._bond = self._bond, None
        if bond is not None:
            bond.break_bond()
            bond.pub.wait_for_all_acked(Duration(seconds=_LAST_WORD_S))
            bond.shutdown()
            self.destroy_publisher(bond.pub)
            self.destroy_subscription(bond.sub)

    # ---- state ----------------------------------------------------------------------------------

    @property
    def state(self) -> str:
        """Return the name of the lifecycle state."""
        try:
            with self._state_machine:  # so that rclpy does not destroy it meanwhile
                return str(self._state_machine.current_state[1])
        except InvalidHandle:
            return 'finalized'

    def bring_up(self, deadline: float = math.inf) -> None:
        """Wait until the node is active; configure and activate it if it manages itself.

        Parameters
        ----------
        deadline : float
            When to stop waiting (monotonic clock) [s]. Loading continues.

        Raises
        ------
        NotActiveError
            The node failed to activate, is still loading, or its manager has not activated it.
        """
        if self._self_managed and not self.active:
            left_s = None if deadline == math.inf else max(0.0, deadline - time.monotonic())
            try:  # not concurrent.futures.wait, which never returns after cancel()
                self._begin_start().result(left_s)
            except TimeoutError as error:
                raise NotActiveError(f'the node is {self.state}: it is still loading; retry'
                                     ) from error
            except CancelledError as error:
                raise StoppedError('the node is shutting down') from error
        self.check_active()

    def check_active(self) -> None:
        """Raise NotActiveError unless the node is active."""
        if not self.active:
            state = self.state
            remedy = 'restart it' if state == 'finalized' else \
                'its lifecycle manager must configure and activate it'
            raise NotActiveError(f'the node is {state}: {self._failure or remedy}')

    def report(self, traceback_text: str) -> None:
        """Log a traceback, throttled, because an error in every frame would fill the disk."""
        if self.context.ok():  # rclpy cannot log after its shutdown
            self.get_logger().error(traceback_text, throttle_duration_sec=1.0)

    def _health(self) -> Health:
        health = Health(values=dict(self.facts))
        if self._failure:
            health.fail(self._failure)
        if self.active:
            self.examine(health)
            health.values |= self.stages.values()
        return health

    def _begin_start(self) -> 'Future[None]':
        """Return the running activation, or begin a new one."""
        with self._start_lock:
            if self._start is None or self._start.done():
                try:
                    self._start = self._starting.submit(self._configure_and_activate)
                except RuntimeError as error:
                    raise StoppedError('the node is shutting down') from error
            return self._start

    def _configure_and_activate(self) -> None:
        try:
            with self._transition, self._state_machine:
                if self._self_managed and self.state == 'unconfigured':
                    self.trigger_configure()
                if self._self_managed and self.state == 'inactive':
                    self.trigger_activate()
        except InvalidHandle as error:
            raise StoppedError('the node is shutting down') from error

    def _start_by_itself(self) -> None:
        """Activate the node unless it has a manager; retry later after a failure."""
        try:
            if self._self_managed:
                self.bring_up()
            self._starter.cancel()
        except CliplocError:
            self._starter.timer_period_ns = int(self._pause_s * NS_PER_S)
            self._pause_s = min(2 * self._pause_s, _LONGEST_PAUSE_S)

    # ---- transitions ----------------------------------------------------------------------------

    def on_configure(self, state: LifecycleState) -> Outcome:
        """Load map and weights."""
        return self._attempt(self._configure)

    def on_activate(self, state: LifecycleState) -> Outcome:
        """Start work."""
        return self._attempt(self._activate)

    def on_deactivate(self, state: LifecycleState) -> Outcome:
        """Stop work, but keep map and weights."""
        return self._attempt(self._deactivate)

    def on_cleanup(self, state: LifecycleState) -> Outcome:
        """Free map and weights. A shutdown does the same, from any state."""
        return self._attempt(self._free)

    on_shutdown = on_cleanup

    def on_error(self, state: LifecycleState) -> Outcome:
        """Free everything after an internal error; the node can be configured again."""
        failure = self._failure
        outcome = self._attempt(self._free)
        self._failure = failure
        return outcome

    def _configure(self) -> None:
        start = time.monotonic()
        description = self.worker.run(self.load)
        self.get_logger().info(f'ready after {time.monotonic() - start:.1f} s: {description}')

    def _activate(self) -> None:
        try:
            self.open()
        except BaseException:
            self.close()
            raise
        self.active = True
        if not self._self_managed:
            with suppress(ImportError):  # without bondpy, the manager has no bond
                from bondpy.bondpy import Bond
                self._bond = Bond(self, 'bond', self.get_name())
                self._bond.set_heartbeat_period(_HEARTBEAT_PERIOD_S)
                self._bond.set_heartbeat_timeout(_HEARTBEAT_TIMEOUT_S)
                self._bond.start()

    def _deactivate(self) -> None:
        self.active = False
        self.end_bond()
        self.close()

    def _free(self) -> None:
        from cliploc_ros.models.onnx_network import free_memory
        if self.active:
            self._deactivate()
        self.worker.run(self.unload)
        self.worker.run(free_memory)

    def _attempt(self, step: Callable[[], None]) -> Outcome:
        """Run a transition and log its exceptions, which rclpy would hide.

        The same failure of a retry is not logged again.
        """
        try:
            step()
        except CliplocError as error:
            known, self._failure = self._failure, str(error)
            if self._failure != known and not isinstance(error, StoppedError):
                self.get_logger().error(self._failure)
            return Outcome.FAILURE
        except Exception as error:
            self._failure = f'internal error: {error} (the traceback is in the log)'
            self.report(traceback.format_exc())
            return Outcome.ERROR
        self._failure = ''
        return Outcome.SUCCESS

    def _answer_impossible_transitions(self) -> None:
        """Make the service refuse impossible transitions; rclpy raises and never answers."""
        service = next(service for service in self.services if service.srv_type is ChangeState)
        change = service.callback

        def answer(request: ChangeState.Request, response: ChangeState.Response
                   ) -> ChangeState.Response:
            self._self_managed = False
            # rcl logs unknown labels of any length
            request.transition.label = request.transition.label[:_MOST_LABEL]
            with self._transition, self._state_machine:
                try:
                    return change(request, response)
                except Exception as error:  # a type of rcl, which has logged it
                    self.get_logger().debug(str(error))
                    response.success = False
                    return response
        service.callback = answer

    def destroy_node(self) -> None:
        """Destroy the node, and the services of its state machine, which rclpy would leave."""
        _PACKAGE_LOGGER.removeHandler(self._log_handler)
        self._starting.shutdown(wait=False, cancel_futures=True)
        self._state_machine.destroy_when_not_in_use()
        super().destroy_node()


def run_node(name: str, make_node: Callable[[], ManagedNode], about: str) -> NoReturn:
    """Spin a node until SIGINT or SIGTERM; then end the process with exit code 0 within 2 s.

    With --help, print the text `about` instead.
    """
    if {'-h', '--help'} & {*split_ros_args(sys.argv[1:])[0]}:
        print(_HELP.format(name=name, about=about))
        sys.exit()
    # Both nodes share a robot's cores. While a network is exported, PyTorch's threads wait by
    # spinning, which slows the other process tenfold. PyTorch reads this variable on import.
    os.environ.setdefault('OMP_WAIT_POLICY', 'PASSIVE')
    # Two heaps for all threads: free memory in twenty heaps adds up.
    mallopt = getattr(ctypes.CDLL(None), 'mallopt', None)
    if mallopt is not None:  # glibc
        mallopt(_M_ARENA_MAX, 2)
    # Python would raise KeyboardInterrupt anywhere, even inside a callback. rclpy would shut down
    # its context at once, so that the current request is not answered and the bond not ended.
    interrupted = Interruption()
    interrupted.catch(signal.SIGINT, signal.SIGTERM)
    try:
        rclpy.init(args=sys.argv, signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # rcl raises different types for arguments and for folders
        sys.exit(f'error: ROS does not start: {error}; correct the arguments, or set HOME or '
                 'ROS_LOG_DIR to a writable folder')
    executor = threads.NodeExecutor()
    node = None
    try:
        try:
            node = make_node()
        except OptionsError as error:
            sys.exit(f'error: {error}')
        node.context.on_shutdown(node.release)
        executor.add_node(node)
        while node.context.ok() and not interrupted.is_set():
            try:
                executor.spin_once(timeout_sec=_SPIN_S)
            except Exception as error:
                threads.log_failure(error, node)
    except Exception:
        if rclpy.ok():
            raise
    finally:
        if node is not None:
            node.end_bond()
            node.release()
            node.worker.stop()
            # A callback that still runs in a destroyed node causes a segmentation fault. The
            # shutdown of rclpy should wait for callbacks, but does not.
            executor._work_tracker.wait(_GRACE_S)
            # Pending handlers of the executor keep references to all entities it waited for.
            executor.shutdown(0.0)
            # Otherwise other nodes see the node for another 20 s, and requests to it are lost.
            node.destroy_node()
        rclpy.try_shutdown()
    # End the process immediately. A thread that runs a network cannot be stopped. Python would
    # wait for it, and then need seconds to unload torch.
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError, AttributeError):
            stream.flush()
    os._exit(0)
