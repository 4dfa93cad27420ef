# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Clients of a running relocalizer: its diagnostics, its parameters, and the wake-up of a robot.

The wake-up requests the robot's pose, turning between requests, until accepted or time is up. With
--watch, it repeats this whenever the relocalizer finds the robot lost. The robot turns by Nav2's
action `spin`, the only part that needs nav2_msgs.
"""

import importlib
import math
import sys
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from enum import IntEnum
from typing import Any

from action_msgs.msg import GoalStatus
from builtin_interfaces.msg import Duration
from diagnostic_msgs.msg import DiagnosticArray
from diagnostic_msgs.srv import SelfTest
from rcl_interfaces.msg import Parameter as ParameterMsg
from rclpy.action import ActionClient
from rclpy.exceptions import InvalidServiceNameException
from rclpy.executors import SingleThreadedExecutor
from rclpy.expand_topic_name import expand_topic_name
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.validate_full_topic_name import validate_full_topic_name

from cliploc_ros.command import Interruption
from cliploc_ros.errors import CliplocError, OptionsError
from cliploc_ros.ros.answer import Verdict

#: Diagnostics are published once a second; a relocalizer that is silent for longer is dead.
SILENT_S = 5.0
_SPIN_S = 0.05
# Nav2's default time limit of a turn, and the additional time for its result [s].
_ALLOWANCE_S = 10.0
_GRACE_S = 3.0
_STOP_S = 4.0
_ENDS = {GoalStatus.STATUS_ABORTED: 'aborted', GoalStatus.STATUS_CANCELED: 'cancelled'}

_SERVICE = 'relocalize_fields'
# Discovery takes time: nodes and topics appear late.
_DISCOVERY_S = 2.0
# The diagnostics report a change within this time.
_ON_DIAGNOSTICS_S = 1.5
# The reason for waiting is printed again after this time.
_AGAIN_S = 5.0
# Pause between requests if the robot does not turn.
_PAUSE_S = 1.0
# Additional time for an answer to arrive after the relocalizer's time limit.
_ON_ITS_WAY_S = 5.0


class RelocalizerStatus:
    """The state of one relocalizer by its diagnostics.

    Parameters
    ----------
    node : Node
        The subscribing node, which the caller spins.
    name : str
        The relocalizer's name with its namespace, as ``/robot/relocalizer``.
    """

    def __init__(self, node: Node, name: str) -> None:
        self._name = name
        self._begun_at = time.monotonic()
        #: Arrival of the last diagnostics (monotonic clock) [s]
        self.received_at = -math.inf
        self._message = ''
        #: The values of the last diagnostics
        self.values: dict[str, str] = {}
        node.create_subscription(DiagnosticArray, '/diagnostics', self._take, 10)

    @property
    def silent_s(self) -> float:
        """Return the time since the last diagnostics [s]."""
        return time.monotonic() - max(self.received_at, self._begun_at)

    def problem(self) -> str:
        """Return why the relocalizer cannot answer a request, and the remedy; empty if it can."""
        state, silent_s = self.values.get('state'), self.silent_s
        if state is None:
            return (f'{self._name} has sent no diagnostics yet: it is starting, or its '
                    '/diagnostics is remapped')
        if silent_s > SILENT_S:
            return (f'{self._name} has been silent for {silent_s:.0f} s: it has died, or its '
                    'machine is overloaded; restart it if it has died')
        if state != 'active':
            reason = self._message if self._message != state else \
                'it is loading, or its lifecycle manager must configure and activate it'
            return f'{self._name} is {state}: {reason}'
        return self.values.get('missing', '')

    def _take(self, msg: DiagnosticArray) -> None:
        for status in msg.status:
            if status.hardware_id == self._name.lstrip('/'):
                self.received_at, self._message = time.monotonic(), status.message
                self.values = {value.key: value.value for value in status.values}


class NotRunningError(CliplocError):
    """The relocalizer is not running, or does not respond; the message says what to do."""


def check_name(name: str) -> None:
    """Raise OptionsError unless the value of `--relocalizer` is a valid name of a node."""
    try:
        validate_full_topic_name(expand_topic_name(name, 'node', '/'), is_service=True)
    except (InvalidServiceNameException, ValueError) as error:
        text = str(error).splitlines()[0].partition(', at ')[0].rstrip(':')
        raise OptionsError(f'--relocalizer: {text}') from error


def ask(node: Node, name: str, patience_s: float) -> tuple[RelocalizerStatus, list[Parameter]]:
    """Return state and parameters of a running relocalizer.

    Parameters
    ----------
    node : Node
        Makes the service calls. It must not be in another executor.
    name : str
        The relocalizer's name with its namespace.
    patience_s : float
        Time limit of discovery, and of each service call [s].

    Raises
    ------
    NotRunningError
        The relocalizer is not found, or does not respond.
    """
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    status, client = RelocalizerStatus(node, name), AsyncParameterClient(node, name)
    deadline = time.monotonic() + patience_s
    while not status.values or not client.services_are_ready():
        if time.monotonic() > deadline:
            raise NotRunningError(f'{name} is not running: start it, give its name with '
                                  '--relocalizer, or its parameters with --params-file')
        executor.spin_once(timeout_sec=_SPIN_S)
    listed = client.list_parameters()
    executor.spin_until_future_complete(listed, patience_s)
    names = listed.result().result.names if listed.done() else []
    got = client.get_parameters(names)
    executor.spin_until_future_complete(got, patience_s)
    if not names or not got.done():
        raise NotRunningError(f'{name} does not respond: restart it')
    return status, [Parameter.from_parameter_msg(ParameterMsg(name=parameter, value=value))
                    for parameter, value in zip(names, got.result().values, strict=True)]


class Outcome(IntEnum):
    """The result of a wake-up, as an exit code."""

    ACCEPTED = 0
    REFUSED = 1
    NOT_READY = 2


class WakeUp(Node):
    """Requests poses from one relocalizer and prints one line for each answer.

    Parameters
    ----------
    interrupted : Interruption
        Set by a signal. Python's KeyboardInterrupt could be raised just after a goal was sent, and
        the goal would not be cancelled.
    relocalizer : str
        Its name, relative to the namespace or absolute.
    timeout_s : float
        No turn begins after this time [s]. One more request may follow the last turn.
    turn_deg : float
        Angle of the turn between requests; 0: do not turn.
    watch : bool
        After an accepted pose, wait until the robot is lost and at rest, then start again.
    """

    def __init__(self, interrupted: Interruption, relocalizer: str, timeout_s: float,
                 turn_deg: float, watch: bool) -> None:
        super().__init__('wake_up', start_parameter_services=False)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self)
        self._service = self.resolve_service_name(f'{relocalizer}/{_SERVICE}')
        self._client = self.create_client(SelfTest, self._service)
        self._status = RelocalizerStatus(self, self._service.removesuffix(f'/{_SERVICE}'))
        # Angle of the next turn [rad], and the goal of the current turn.
        self._step_rad = math.radians(turn_deg)
        self._goal: Any = None
        self._spinner: ActionClient | None = None
        if turn_deg:
            with suppress(ImportError):
                self._action = importlib.import_module('nav2_msgs.action').Spin
                self._spinner = ActionClient(self, self._action, 'spin')
        self._began_at = self._counts_from = time.monotonic()
        self._timeout_s, self._watches = timeout_s, watch
        self._interrupted = interrupted
        self._said: dict[str, tuple[str, float]] = {}

    def run(self) -> Outcome:
        """Request until a pose is accepted or time is up, then cancel any turn.

        With `watch`, repeat this until a wake-up fails.

        KeyboardInterrupt: the flag was set; the turn was cancelled.
        """
        try:
            while (outcome := self._look_about()) is Outcome.ACCEPTED and self._watches:
                if problem := self._until_lost():
                    return _end(Outcome.NOT_READY, f'not ready: {problem}')
                self._began_at = self._counts_from = time.monotonic()
            return outcome
        finally:
            self._interrupted = Interruption()  # the first interruption is handled
            self._stop()

    def _look_about(self) -> Outcome:
        looks, turned, kinds = 0, '', Counter[str]()
        while not (problem := self._until_ready()):
            looks += 1
            verdict, kind, message = self._look()
            kinds.update([kind] if kind else [])
            print(f'look {looks} [{self._elapsed_s:.1f} s]{turned}: {message}', flush=True)
            if verdict is Verdict.ACCEPTED:
                return Outcome.ACCEPTED
            if self._is_time_up:
                if verdict is Verdict.REFUSED:
                    return _end(Outcome.REFUSED, f'refused: {looks} looks in '
                                f'{self._elapsed_s:.0f} s: ' + ', '.join(
                                    f'{count} {kind}' for kind, count in kinds.most_common()))
                problem = message
                break
            turned = self._turn() if verdict is Verdict.REFUSED else self._rest()
        return _end(Outcome.NOT_READY, f'not ready: {problem}')

    def _until_ready(self) -> str:
        """Wait until the relocalizer can answer; return its problem if time is up before."""
        while True:
            problem = self._status.problem() if self._client.service_is_ready() else (
                f'nothing serves {self._service}: start the relocalizer, or give its name with '
                '--relocalizer or its namespace')
            if self._elapsed_s > _DISCOVERY_S:
                self._say('waiting', problem, _AGAIN_S)
            if self._status.values.get('state') == 'configuring' \
                    and self._status.silent_s <= SILENT_S:
                self._counts_from = time.monotonic()  # its first start takes long
            if not problem or self._is_time_up:
                return problem
            self._spin()

    def _until_lost(self) -> str:
        """Wait until the robot is lost and at rest; return the reason if this cannot be known."""
        accepted_at = time.monotonic() + _ON_DIAGNOSTICS_S  # earlier reports may be outdated
        while True:
            self._spin()
            self._say('waiting', self._status.problem())
            values = self._status.values
            if self._status.received_at <= accepted_at or values.get('state') != 'active':
                continue
            if 'watch' not in values:
                return 'the relocalizer does not watch: set its parameter watch to tf or amcl_pose'
            self._say('watch', values['watch'] if values['watch'] != 'lost' else
                      f'{values["watch reason"]}; {values["on lost"]}')
            if values['lost and at rest'] == 'True':
                return ''

    def _look(self) -> tuple[Verdict, str, str]:
        """Request the pose once; return the verdict, the kind of a refusal, and the answer."""
        begun_at, future = time.monotonic(), self._client.call_async(SelfTest.Request())
        limit_s = float(self._status.values.get('time limit [s]', math.inf))

        def is_over() -> bool:
            return bool(future.done() or self._status.silent_s > SILENT_S
                        or time.monotonic() - begun_at > limit_s + _ON_ITS_WAY_S)
        self._wait(is_over, math.inf)
        if future.done():
            (status,) = future.result().status
            fields = {field.key: field.value for field in status.values}
            return Verdict(fields['verdict']), fields['kind'], status.message
        self._client.remove_pending_request(future)
        return Verdict.FAILED, '', self._status.problem() or (
            f'no answer within {time.monotonic() - begun_at:.0f} s: the relocalizer was '
            'restarted, or the network lost the answer')

    def _turn(self) -> str:
        """Turn before the next request, if possible; return a description of the result.

        The direction is reversed after a failed turn.
        """
        name = self.resolve_topic_name('spin')
        obstacle = 'switched off' if not self._step_rad else \
            'nav2_msgs is not installed: sudo apt install ros-jazzy-nav2-msgs' \
            if self._spinner is None else '' if self._spinner.server_is_ready() else \
            f"nothing serves {name}: activate Nav2's behavior_server"
        self._say('not turning', obstacle)
        if obstacle:
            return self._rest()
        step = f'turned by {math.degrees(self._step_rad):.0f} deg'
        problem = self._problem_of(self._action.Goal(
            target_yaw=self._step_rad, time_allowance=Duration(sec=int(_ALLOWANCE_S))), name)
        if not problem:
            return f', {step}'
        self._step_rad = -self._step_rad
        self._rest()  # an immediate next turn would fail as well
        return f', not {step} ({problem})'

    def _stop(self) -> None:
        """Cancel the current turn, and wait until the server has accepted that."""
        if self._goal is None:
            return
        if not self._goal.done():  # the server may still accept the goal
            self._wait(self._goal.done, _STOP_S)
        handle = self._goal.result() if self._goal.done() else None
        self._goal = None
        if handle is not None and handle.accepted:
            self._wait(handle.cancel_goal_async().done, _STOP_S)

    def _problem_of(self, goal: Any, name: str) -> str:
        """Turn by the action `name`; return why that failed, empty after success."""
        assert self._spinner is not None
        end = time.monotonic() + _ALLOWANCE_S + _GRACE_S
        self._goal = self._spinner.send_goal_async(goal)
        if not self._wait(self._goal.done, _GRACE_S):
            self._stop()
            return f'no answer from {name}'
        handle = self._goal.result()
        if not handle.accepted:
            self._goal = None
            return f"refused by {name}: activate Nav2's behavior_server"
        result = handle.get_result_async()
        if not self._wait(result.done, end - time.monotonic()):
            self._stop()
            return f'no result from {name} within {_ALLOWANCE_S + _GRACE_S:g} s'
        self._goal = None
        outcome = result.result()
        if outcome.status == GoalStatus.STATUS_SUCCEEDED:
            return ''
        found, code = outcome.result, int(outcome.result.error_code)
        names = {getattr(type(found), kind): kind.lower().replace('_', ' ')
                 for kind in ('TIMEOUT', 'TF_ERROR', 'COLLISION_AHEAD')}
        # Nav2 before Jazzy has no field error_msg
        words = [*filter(None, [names.get(code), getattr(found, 'error_msg', '')]), f'code {code}']
        return f'{_ENDS.get(outcome.status, "failed")}: {", ".join(words)}'

    def _rest(self) -> str:
        self._wait(lambda: False, _PAUSE_S)
        return ''

    @property
    def _elapsed_s(self) -> float:
        return time.monotonic() - self._began_at

    @property
    def _is_time_up(self) -> bool:
        return time.monotonic() - self._counts_from > self._timeout_s

    def _say(self, topic: str, text: str, again_s: float = math.inf) -> None:
        """Print a text when it changes, and again after `again_s`."""
        said, said_at = self._said.get(topic, ('', -math.inf))
        elapsed_s = self._elapsed_s
        if text == said and elapsed_s - said_at < again_s:
            return
        if text:
            still = f'still {topic} [{elapsed_s:.0f} s]' if text == said else topic
            print(f'{still}: {text}', flush=True)
        self._said[topic] = text, elapsed_s

    def _wait(self, condition: Callable[[], bool], patience_s: float) -> bool:
        """Process callbacks until a condition holds or time is up; return whether it holds."""
        end = time.monotonic() + patience_s
        while not condition():
            if time.monotonic() > end:
                return False
            self._spin()
        return True

    def _spin(self) -> None:
        if self._interrupted.is_set():
            raise KeyboardInterrupt
        self._executor.spin_once(timeout_sec=_SPIN_S)


def _end(outcome: Outcome, text: str) -> Outcome:
    print(text, file=sys.stderr, flush=True)
    return outcome
