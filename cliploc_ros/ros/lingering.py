# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a request needed stays open a moment longer: the next one often follows at once."""

import threading
import time
from contextlib import ExitStack

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

_LINGER_S = 1.0


class Lingering:
    """Keeps what was opened last for a second or two, unless it is closed.

    A robot that is refused asks again. To find its publishers anew would cost it a tenth of a
    second, and the odometry that joins its images.

    Parameters
    ----------
    node : Node
        Its executor ends what nobody came back for.
    """

    def __init__(self, node: Node) -> None:
        self._lock = threading.Lock()
        self._kept = ExitStack()
        self._until = 0.0
        self._is_open = False
        # simulated time may stand still
        node.create_timer(_LINGER_S, self._end_when_due, MutuallyExclusiveCallbackGroup(),
                          Clock(clock_type=ClockType.STEADY_TIME))

    def open(self) -> None:
        """Begin to keep what is given."""
        with self._lock:
            self._is_open = True

    def close(self) -> None:
        """End what is kept, and keep nothing from now on."""
        with self._lock:
            self._is_open = False
            self._kept.close()

    def keep(self, stack: ExitStack) -> None:
        """Take over what a stack would close, in place of what was kept before."""
        with self._lock, stack:
            if self._is_open:
                former, self._kept = self._kept, stack.pop_all()
                former.close()
                self._until = time.monotonic() + _LINGER_S

    def _end_when_due(self) -> None:
        with self._lock:
            if time.monotonic() >= self._until:
                self._kept.close()
