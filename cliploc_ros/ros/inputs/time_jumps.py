# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Stamps that are no time, and time that goes back: a simulation is reset, or a bag loops."""

import math
import time
from collections.abc import Callable
from typing import NamedTuple

from builtin_interfaces.msg import Time
from rclpy.clock import ClockChange, JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.node import Node

from cliploc_ros.errors import CliplocError
from cliploc_ros.ros.conversions import stamp_ns
from cliploc_ros.units import NS_PER_S

# Stamps may be this far ahead of /clock, which comes at 10 Hz or more (a guess).
_MAX_AHEAD_NS = NS_PER_S // 5
# DDS keeps the order of a publisher: a stamp that is older by more than this is a jump (a guess).
_MAX_DISORDER_NS = NS_PER_S


class TimeJumpError(CliplocError):
    """Time jumped back while a frame was in work; the message says by how much."""


class _Jump(NamedTuple):
    """The last jump: when it was seen (monotonic clock) [s], and how it is named."""

    seen_at: float
    name: str


class TimeJumps:
    """Watches a node's clock, and has the node forget its input when time goes back.

    A change of `use_sim_time` counts as a jump, too. Without simulated time the clock does not
    report jumps: what listens to stamped messages also has to watch their stamps.

    `forget` is called after each jump, in the thread that takes `/clock`. It must not block.
    """

    def __init__(self, node: Node, forget: Callable[[], None]) -> None:
        self._node = node
        self._clock = node.get_clock()
        self._forget = forget
        self._last = _Jump(-math.inf, '')
        # rcl keeps a bare pointer to the handle
        self._handle = self._clock.create_jump_callback(
            JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1),
                          on_clock_change=True), post_callback=self._on_jump)

    def check(self, stamp: Time, received_at: float) -> None:
        """Raise TimeJumpError if a message is from before the last jump.

        It may arrive, at `received_at` (monotonic clock) [s], after the clock's: then its stamp is
        in the future.
        """
        jump = self._last
        if not jump.name:
            return
        ahead_ns = stamp_ns(stamp) - self._clock.now().nanoseconds
        if received_at <= jump.seen_at or (self._clock.ros_time_is_active
                                           and ahead_ns > _MAX_AHEAD_NS):
            raise TimeJumpError(f'{jump.name}: the frame is from before')

    def close(self) -> None:
        """Watch the clock no longer."""
        self._handle.unregister()

    def _on_jump(self, jump: TimeJump) -> None:
        if jump.clock_change in (ClockChange.ROS_TIME_ACTIVATED, ClockChange.ROS_TIME_DEACTIVATED):
            name = 'use_sim_time changed'
        else:
            name = f'time jumped back by {-jump.delta.nanoseconds / NS_PER_S:.3f} s'
        self._last = _Jump(time.monotonic(), name)
        self._forget()
        self._node.get_logger().warning(f'{name}: all input from before is forgotten',
                                        throttle_duration_sec=1.0)


def stamp_problem(stamp: Time) -> str:
    """Return why a stamp is no time, as in "the stamp is 0"; empty if it may be one."""
    if stamp.nanosec > NS_PER_S:  # some drivers round up to a second
        return f'has {stamp.nanosec} nanoseconds (limit {NS_PER_S - 1})'
    if stamp.sec < 0:
        return f'is {stamp.sec} s, before 1970'
    return '' if stamp_ns(stamp) else 'is 0'


class StampOrder:
    """Finds jumps in the stamps of several streams, each of which is in order otherwise."""

    def __init__(self) -> None:
        self._newest_ns: dict[str, int] = {}

    def goes_back(self, stream: str, at_ns: int) -> bool:
        """Take in a stamp [ns]; return whether time jumped back, and forget all stamps if so."""
        newest_ns = self._newest_ns.get(stream, at_ns)
        jumped = at_ns < newest_ns - _MAX_DISORDER_NS
        if jumped:
            self._newest_ns.clear()
            newest_ns = at_ns
        self._newest_ns[stream] = max(at_ns, newest_ns)
        return jumped

    def clear(self) -> None:
        """Forget all stamps."""
        self._newest_ns.clear()
