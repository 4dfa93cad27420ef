# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A callback group that runs a limited number of callbacks at a time."""

import threading

from rclpy.callback_groups import CallbackGroup

# Requests that may wait at a time, a thread each; further ones wait in the middleware.
MAX_REQUESTS = 16


class BoundedCallbackGroup(CallbackGroup):
    """Runs up to `limit` callbacks at a time.

    Parameters
    ----------
    limit : int
    """

    def __init__(self, limit: int) -> None:
        super().__init__()
        self._limit = limit
        self._running: list[object] = []
        self._lock = threading.Lock()

    def can_execute(self, entity: object) -> bool:
        """Return whether another callback may begin."""
        with self._lock:
            return len(self._running) < self._limit

    def beginning_execution(self, entity: object) -> bool:
        """Count a callback that begins; return whether it may."""
        with self._lock:
            if len(self._running) >= self._limit:
                return False
            self._running.append(entity)
            return True

    def ending_execution(self, entity: object) -> None:
        """Count a callback that ended."""
        with self._lock:
            self._running.remove(entity)
