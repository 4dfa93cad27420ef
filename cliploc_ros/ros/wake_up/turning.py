# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Turning a robot on the spot with Nav2's action `spin`; the only module that needs nav2_msgs."""

import importlib
import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple

from action_msgs.msg import GoalStatus
from builtin_interfaces.msg import Duration
from rclpy.action import ActionClient
from rclpy.node import Node

# Nav2's default limit of a turn, and what its answer may take beyond [s].
_ALLOWANCE_S = 10.0
_GRACE_S = 3.0
_STOP_S = 4.0
_ENDS = {GoalStatus.STATUS_ABORTED: 'aborted', GoalStatus.STATUS_CANCELED: 'cancelled'}

#: Spins the node until a condition holds or a number of seconds is over; returns whether it holds.
Wait = Callable[[Callable[[], bool], float], bool]


class Turn(NamedTuple):
    """A turn that was asked for [rad], and why it failed; empty if it did not."""

    step_rad: float
    problem: str

    def __str__(self) -> str:
        """Return what was done, in words."""
        step = f'turned by {math.degrees(self.step_rad):.0f} deg'
        return f'not {step} ({self.problem})' if self.problem else step


class Turning:
    """Turns a robot by a step at a time; to the other side after a turn that failed.

    Parameters
    ----------
    step_rad : float
        Positive: counterclockwise. 0: never turn.
    """

    def __init__(self, node: Node, wait: Wait, step_rad: float) -> None:
        self._wait = wait
        self._step_rad = step_rad
        self._action = spin_action() if step_rad else None
        self._client = None if self._action is None else ActionClient(node, self._action, 'spin')
        self._name = node.resolve_topic_name('spin')
        self._goal: Any = None

    def obstacle(self) -> str:
        """Return why the robot cannot turn; empty if it can."""
        if not self._step_rad:
            return 'switched off'
        if self._client is None:
            return 'nav2_msgs is not installed: sudo apt install ros-jazzy-nav2-msgs'
        if not self._client.server_is_ready():
            return f"nothing serves {self._name}: activate Nav2's behavior_server"
        return ''

    def turn(self) -> Turn:
        """Turn by a step."""
        assert self._action is not None
        step_rad = self._step_rad
        problem = self._problem_of(self._action.Goal(
            target_yaw=step_rad, time_allowance=Duration(sec=int(_ALLOWANCE_S))))
        if problem:
            self._step_rad = -step_rad
        return Turn(step_rad, problem)

    def stop(self) -> None:
        """Cancel the turn under way, and wait a moment until the server has taken that."""
        if self._goal is None:
            return
        if not self._goal.done():  # not accepted yet, but it may be in a moment
            self._wait(self._goal.done, _STOP_S)
        handle = self._goal.result() if self._goal.done() else None
        self._goal = None
        if handle is not None and handle.accepted:
            self._wait(handle.cancel_goal_async().done, _STOP_S)

    def _problem_of(self, goal: Any) -> str:
        """Turn; return why that failed, empty if it did not."""
        assert self._client is not None
        end = time.monotonic() + _ALLOWANCE_S + _GRACE_S
        self._goal = self._client.send_goal_async(goal)
        if not self._wait(self._goal.done, _GRACE_S):
            self.stop()
            return f'no answer from {self._name}'
        handle = self._goal.result()
        if not handle.accepted:
            self._goal = None
            return f"refused by {self._name}: activate Nav2's behavior_server"
        result = handle.get_result_async()
        if not self._wait(result.done, end - time.monotonic()):
            self.stop()
            return f'no result from {self._name} within {_ALLOWANCE_S + _GRACE_S:g} s'
        self._goal = None
        outcome = result.result()
        if outcome.status == GoalStatus.STATUS_SUCCEEDED:
            return ''
        return f'{_ENDS.get(outcome.status, "failed")}: {_reason(outcome.result)}'


def spin_action() -> Any:
    """Return the type of Nav2's action Spin; None where nav2_msgs is not installed."""
    try:
        return importlib.import_module('nav2_msgs.action').Spin
    except ImportError:
        return None


def _reason(result: Any) -> str:
    """Return the error of a turn in words; the field error_msg came with Jazzy."""
    code = int(result.error_code)
    names = {getattr(type(result), name): name.lower().replace('_', ' ')
             for name in ('TIMEOUT', 'TF_ERROR', 'COLLISION_AHEAD')}
    words = [names.get(code, ''), getattr(result, 'error_msg', '')]
    return ', '.join([*filter(None, words), f'code {code}'])
