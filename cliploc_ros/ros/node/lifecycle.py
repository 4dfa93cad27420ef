# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The life of a managed node: what is loaded, what is listened to, and who brings it up."""

import logging
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Mapping

from lifecycle_msgs.srv import ChangeState
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import InvalidHandle
from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState
from rclpy.lifecycle import TransitionCallbackReturn as Outcome
from rclpy.node import Node

from cliploc_ros.errors import CliplocError, StoppedError
from cliploc_ros.models.devices import free_memory
from cliploc_ros.ros.node.diagnostics import Diagnostics, Health, Stages
from cliploc_ros.ros.node.parameters import NodeParameters, ParameterRow, Value
from cliploc_ros.ros.node.requests import BoundedCallbackGroup
from cliploc_ros.ros.node.worker import Worker

# A transition may load weights for seconds; meanwhile the state can be asked for.
_MAX_TRANSITION_REQUESTS = 3
# Between attempts of a node to bring itself up; the pause doubles from one to the next.
_FIRST_PAUSE_S = 2.0
_LONGEST_PAUSE_S = 60.0


class NotActiveError(CliplocError):
    """The node's state allows no work; the message names it, and why."""


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


class ManagedNode(LifecycleNodeMixin, Node):
    """A lifecycle node whose networks run in a worker beside its executor.

    It brings itself up, and tries again when that fails, until somebody else changes its state:
    from then on that one is its manager. With autostart false it waits for one.

    Parameters
    ----------
    name : str
        Name of the node. Parameters given at start-up are declared as they come.
    table : iterable of ParameterRow
        Its parameters, `autostart` among them.
    check : callable
        Takes all values by name; raises OptionsError where they do not fit together.
    """

    def __init__(self, name: str, table: Iterable[ParameterRow],
                 check: Callable[[Mapping[str, Value]], object]) -> None:
        Node.__init__(self, name, automatically_declare_parameters_from_overrides=True)
        LifecycleNodeMixin.__init__(
            self, callback_group=BoundedCallbackGroup(_MAX_TRANSITION_REQUESTS))
        self.worker = Worker(self._report)
        self.settings = NodeParameters(self, table, check)
        self.active = False
        package_logger = logging.getLogger('cliploc_ros')
        package_logger.setLevel(logging.INFO)
        package_logger.addHandler(RosLogHandler(self))
        self._transition = threading.Lock()
        self._failure = ''
        self._answer_impossible_transitions()
        self.stages = Stages()
        self.diagnostics = Diagnostics(self, self._health, lambda: self.state)
        self._self_managed: bool = self.settings['autostart']
        self._pause_s = _FIRST_PAUSE_S
        # simulated time may stand still
        self._starter = self.create_timer(0.0, self._start_by_itself,
                                          MutuallyExclusiveCallbackGroup(),
                                          Clock(clock_type=ClockType.STEADY_TIME))

    # ---- what a node fills in -------------------------------------------------------------------

    def load(self) -> str:
        """Load map and weights, in the worker's thread; return what was loaded, in a line."""
        raise NotImplementedError

    def unload(self) -> None:
        """Let go what load brought, in the worker's thread."""

    def open(self) -> None:
        """Listen, and begin to work; close undoes it, also where it was left halfway."""

    def close(self) -> None:
        """Stop to listen, and let go whoever waits. The worker may still be busy."""

    def examine(self, health: Health) -> None:
        """Say how the active node is."""

    def release(self) -> None:
        """Let go whoever waits in this node: the process ends."""

    # ---- state ----------------------------------------------------------------------------------

    @property
    def state(self) -> str:
        """Return the lifecycle state's name."""
        try:
            with self._state_machine:  # rclpy does not see to it that it is there still
                return str(self._state_machine.current_state[1])
        except InvalidHandle:
            return 'finalized'

    def bring_up(self) -> None:
        """Return when the node is active; one that manages itself is made so.

        Raises
        ------
        NotActiveError
            It cannot be, or its manager does not want it to be.
        """
        try:
            with self._transition, self._state_machine:
                if self._self_managed and self.state == 'unconfigured':
                    self.trigger_configure()
                if self._self_managed and self.state == 'inactive':
                    self.trigger_activate()
        except InvalidHandle as error:
            raise StoppedError('the node is shutting down') from error
        self.check_active()

    def check_active(self) -> None:
        """Raise NotActiveError unless the node is active."""
        if not self.active:
            raise NotActiveError(
                f'the node is {self.state}: ' + (self._failure or 'its manager has to configure '
                                                 'and activate it'))

    def _health(self) -> Health:
        health = Health()
        if self._failure:
            health.fail(self._failure)
        if self.active:
            self.examine(health)
            health.values |= self.stages.values()
        return health

    def _start_by_itself(self) -> None:
        """Bring the node up if nobody else will, else try again later."""
        try:
            if self._self_managed:
                self.bring_up()
            self._starter.cancel()
        except CliplocError:
            self._starter.timer_period_ns = int(self._pause_s * 1e9)
            self._pause_s = min(2 * self._pause_s, _LONGEST_PAUSE_S)

    # ---- transitions ----------------------------------------------------------------------------

    def on_configure(self, state: LifecycleState) -> Outcome:
        """Load map and weights."""
        return self._attempt(self._configure)

    def on_activate(self, state: LifecycleState) -> Outcome:
        """Begin to work."""
        return self._attempt(self._activate)

    def on_deactivate(self, state: LifecycleState) -> Outcome:
        """Stop to work; what is loaded stays."""
        return self._attempt(self._deactivate)

    def on_cleanup(self, state: LifecycleState) -> Outcome:
        """Free what is loaded."""
        return self._attempt(self._free)

    def on_shutdown(self, state: LifecycleState) -> Outcome:
        """Free everything, from any state."""
        return self._attempt(self._free)

    def on_error(self, state: LifecycleState) -> Outcome:
        """Free everything after a defect of this package; the node can be configured again."""
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

    def _deactivate(self) -> None:
        self.active = False
        self.close()

    def _free(self) -> None:
        if self.active:
            self._deactivate()
        self.worker.run(self._unload)

    def _unload(self) -> None:
        self.unload()
        free_memory()

    def _attempt(self, step: Callable[[], None]) -> Outcome:
        """Take a step; rclpy would swallow what it raises."""
        try:
            step()
        except StoppedError as error:
            self._failure = str(error)
            return Outcome.FAILURE
        except CliplocError as error:
            self._failure = str(error)
            self.get_logger().error(self._failure)
            return Outcome.FAILURE
        except Exception as error:
            self._failure = f'internal error: {error} (the traceback is in the log)'
            self._report(traceback.format_exc())
            return Outcome.ERROR
        self._failure = ''
        return Outcome.SUCCESS

    def _answer_impossible_transitions(self) -> None:
        """Let the service say no where rclpy raises, and would leave its caller waiting."""
        service = next(service for service in self.services if service.srv_type is ChangeState)
        change = service.callback

        def answer(request: ChangeState.Request, response: ChangeState.Response
                   ) -> ChangeState.Response:
            with self._transition, self._state_machine:
                self._self_managed = False
                try:
                    return change(request, response)
                except Exception as error:  # rcl's own type; rcl has warned of it
                    self.get_logger().debug(str(error))
                    response.success = False
                    return response
        service.callback = answer

    def destroy_node(self) -> None:
        """Say good-bye, which rclpy forgets for the services of the state machine."""
        self._state_machine.destroy_when_not_in_use()
        super().destroy_node()

    def _report(self, traceback_text: str) -> None:
        """Log a defect; one that comes with every frame must not fill the disk."""
        if self.context.ok():  # else rclpy stumbles over the end of the process
            self.get_logger().error(traceback_text, throttle_duration_sec=1.0)
