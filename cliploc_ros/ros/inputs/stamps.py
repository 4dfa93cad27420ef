# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Stamps of messages: validation, pairing of messages by stamp, and time jumps."""

import math
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Hashable, Iterable, Mapping
from typing import Any

from builtin_interfaces.msg import Time
from rclpy.clock import ClockChange, JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.node import Node

from cliploc_ros.errors import CliplocError
from cliploc_ros.ros.conversions import stamp_ns
from cliploc_ros.units import NS_PER_S

# Stamps may be this far ahead of /clock, which is published at 10 Hz or more. Not measured.
_MAX_AHEAD_NS = NS_PER_S // 5
# DDS keeps the order of a publisher's messages: if a stamp is older than the newest by more than
# this, time has jumped. Not measured.
_MAX_DISORDER_NS = NS_PER_S
# Number of images that are expected by the detector: two for each of the last two detections.
_EXPECTED = 4
# After this many successive messages with different stamps, stamps are taken to be unique; fewer
# do not suffice, because stamps in whole seconds also differ at times. A relay that repeats
# messages sends each at least this often.
_SHOWN, _REPEATED = 3, 2
# Number of images of a camera at 30 Hz in ten seconds.
_REMEMBERED = 300
# Spread of the delays of messages after their stamps, also for a simulation or a bag at another
# rate. A greater spread means that the clock changed. Not measured.
_UNEVEN_S = 5.0


class TimeJumpError(CliplocError):
    """Time jumped back while a frame was processed; the message says by how much."""


class TimeJumps:
    """Monitors a node's clock, and calls `forget` when time jumps back.

    A change of `use_sim_time` is a jump, too. Without simulated time the clock reports no jumps,
    so that subscribers of stamped messages must also check their stamps.

    `forget` is called after each jump, in the thread that receives `/clock`. It must not block.
    """

    def __init__(self, node: Node, forget: Callable[[], None]) -> None:
        self._node = node
        self._clock = node.get_clock()
        self._forget = forget
        # The last jump: when it was detected (monotonic clock) [s], and its description.
        self._last = (-math.inf, '')
        # keep a reference, because rcl stores only a raw pointer to the handle
        self._handle = self._clock.create_jump_callback(
            JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1),
                          on_clock_change=True), post_callback=self._on_jump)

    def check(self, stamp: Time, received_at: float) -> None:
        """Raise TimeJumpError if a message is from before the last jump.

        `received_at` is when it arrived (monotonic clock) [s]. A message from before the jump may
        arrive after the clock has jumped; then its stamp is in the future.
        """
        seen_at, name = self._last
        if not name:
            return
        ahead_ns = stamp_ns(stamp) - self._clock.now().nanoseconds
        if received_at <= seen_at or (self._clock.ros_time_is_active and ahead_ns > _MAX_AHEAD_NS):
            raise TimeJumpError(f'{name}: the frame is from before the jump')

    def _on_jump(self, jump: TimeJump) -> None:
        if jump.clock_change in (ClockChange.ROS_TIME_ACTIVATED, ClockChange.ROS_TIME_DEACTIVATED):
            name = 'use_sim_time changed'
        else:
            name = f'time jumped back by {-jump.delta.nanoseconds / NS_PER_S:.3f} s'
        self._last = (time.monotonic(), name)
        self._forget()
        self._node.get_logger().warning(f'{name}: all earlier input is forgotten',
                                        throttle_duration_sec=1.0)


def stamp_problem(stamp: Time) -> str:
    """Return why a stamp is invalid, to follow "the stamp", as in "is 0"; empty if it is valid."""
    if stamp.nanosec > NS_PER_S:  # some drivers round up to a full second
        return f'has {stamp.nanosec} nanoseconds (limit {NS_PER_S - 1})'
    if stamp.sec < 0:
        return f'is {stamp.sec} s, before 1970'
    return '' if stamp_ns(stamp) else 'is 0'


class StampOrder:
    """Detects time jumps in the stamps of several ordered streams."""

    def __init__(self) -> None:
        self._newest_ns: dict[str, int] = {}

    def goes_back(self, stream: str, at_ns: int) -> bool:
        """Add a stamp [ns]; return whether time jumped back. After a jump, forget all stamps."""
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


class ExactPairing:
    """Collects messages until every topic has a message with the same stamp. Memory is bounded.

    Stamps are compared for equality, not for order: frames may arrive out of order.

    Images wait for their detections. If large images fill the memory, the oldest are dropped, but
    not the two newest images when detections arrive: a detector that has finished an image usually
    takes the newest one next.

    Parameters
    ----------
    max_bytes : mapping of str to int
        The topics, and the memory limit of the messages of each [bytes].
    max_count : int
        Greatest number of messages kept per topic.
    early, late : str
        The topics of the images and of their detections. Without them, the oldest messages are
        dropped first.
    """

    def __init__(self, max_bytes: Mapping[str, int], max_count: int, early: str = '',
                 late: str = '') -> None:
        self._max_bytes = dict(max_bytes)
        self._max_count = max_count
        # Item, size, and number in the order of arrival, by topic and stamp.
        self._waiting: dict[str, OrderedDict[int, tuple[Any, int, int]]] = {
            topic: OrderedDict() for topic in max_bytes}
        self._early, self._late = early, late
        self.last_stamp_ns: dict[str, int] = {}
        # Numbers of the images that are dropped last, and stamps of images without room.
        self._expected: deque[int] = deque(maxlen=_EXPECTED)
        self._without_room: deque[int] = deque(maxlen=max_count)
        self.clear()

    def add(self, topic: str, stamp_ns: int, item: Any, size: int) -> dict[str, Any] | None:
        """Add a message; return the set that it completes, by topic, or None.

        Parameters
        ----------
        item : object
            The message as it is returned in the set.
        size : int
            Memory of the item [bytes].
        """
        self.received[topic] += 1
        self.last_stamp_ns[topic] = stamp_ns
        waiting = self._waiting[topic]
        if topic == self._late:
            newest = self.received[self._early]
            self._expected.extend([newest, newest + 1])
            self.is_outrun = stamp_ns in self._without_room
        if stamp_ns in waiting:
            self._forget(topic, stamp_ns)
        waiting[stamp_ns] = (item, size, self.received[topic])
        self._bytes[topic] += size
        while len(waiting) > self._max_count or (
                self._bytes[topic] > self._max_bytes[topic] and len(waiting) > 1):
            dropped = min(waiting, key=lambda stamp: (
                stamp == stamp_ns, topic == self._early and waiting[stamp][2] in self._expected))
            self._forget(topic, dropped)
            if topic == self._early:
                self._without_room.append(dropped)
        if any(stamp_ns not in other for other in self._waiting.values()):
            return None
        complete = {name: other[stamp_ns][0] for name, other in self._waiting.items()}
        for name, other in self._waiting.items():
            self.dropped[name] -= 1  # the loop below also counts the completed message
            # Older messages cannot be completed any more.
            while stamp_ns in other:
                self._forget(name, next(iter(other)))
        return complete

    def waiting(self, topic: str) -> Iterable[int]:
        """Return the stamps of the waiting items of a topic [ns]."""
        return self._waiting[topic]

    def oldest(self, topic: str) -> Any:
        """Return the oldest waiting item of a topic; None without any."""
        return next((item for item, *_ in self._waiting[topic].values()), None)

    def clear(self) -> None:
        """Forget all waiting messages and all counts."""
        for waiting in self._waiting.values():
            waiting.clear()
        self._bytes = dict.fromkeys(self._waiting, 0)
        self.received = dict.fromkeys(self._waiting, 0)
        self.dropped = dict.fromkeys(self.received, 0)
        self.last_stamp_ns.clear()
        self._expected.extend([1, 2, 1, 2])  # a starting detector takes one of the first images
        self._without_room.clear()
        #: Whether the newest detections arrived after their image was dropped for lack of memory
        self.is_outrun = False

    def _forget(self, topic: str, stamp_ns: int) -> None:
        _, size, _ = self._waiting[topic].pop(stamp_ns)
        self._bytes[topic] -= size
        self.dropped[topic] += 1


class MessageStamps:
    """Checks that the stamps of a topic are unique, so that a stamp identifies a message.

    Detections whose stamp several images share could belong to any of them. Repetitions of the
    same message are allowed.
    """

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget all stamps."""
        #: Why stamps do not identify messages, to follow "the stamp", as in "is 0"; empty if none.
        self.problem = ''
        # The last message of each stamp, and the number of its repetitions.
        self._known: dict[int, tuple[int, int]] = {}
        self._own, self._lag_s = 0, math.nan

    @property
    def are_own(self) -> bool:
        """Return whether each of the last messages had a new stamp."""
        return self._own >= _SHOWN

    def is_repeated(self, at_ns: int) -> bool:
        """Return whether the message with a stamp [ns] was repeated."""
        return self._known.get(at_ns, (0, 0))[1] >= _REPEATED

    def add(self, stamp: Time, content: Hashable, received_at: float) -> bool:
        """Add a stamp and its message's content; return whether the stamp identifies the message.

        After an invalid or shared stamp, the result is False until several successive stamps are
        valid. `received_at` is when the message arrived (monotonic clock) [s].
        """
        at_ns, message, why, times = stamp_ns(stamp), hash(content), stamp_problem(stamp), 0
        if not why:
            known, times = self._known.pop(at_ns, (message, 0))
            if known != message:
                times, why = 0, f'is {at_ns / NS_PER_S:.6f} for several of them'
            self._known[at_ns] = message, times + 1
            former_s, self._lag_s = self._lag_s, received_at - at_ns / NS_PER_S
            is_even = abs(self._lag_s - former_s) <= _UNEVEN_S
            self._own = (self._own if is_even else 0) + (not times)
            if len(self._known) > _REMEMBERED:
                del self._known[next(iter(self._known))]
        if why or times >= _REPEATED:
            self._own = 0
        if why:
            self.problem = why
        elif self.are_own or self.is_repeated(at_ns):
            self.problem = ''
        return not self.problem
