# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Requests that wait together are answered together."""

import threading
from collections.abc import Callable
from concurrent.futures import Future

from rclpy.callback_groups import CallbackGroup

# So many requests may wait at a time, a thread each; the rest wait on the wire.
MAX_REQUESTS = 16


class Flights[T]:
    """One answer for all who wait for the same departure.

    A robot that asks again and again while no frame comes, or clients that have died since, cost
    one search and one reset of the localizer, not one each. Who boards late waits less than
    the first, and is refused with it when no frame comes.

    Parameters
    ----------
    fly : callable
        Makes the answer. It takes a function to call when it departs: who boards later is not
        taken along; and how long it may wait for that [s].
    """

    def __init__(self, fly: Callable[[Callable[[], None], float], T]) -> None:
        self._fly = fly
        self._lock = threading.Lock()
        self._boarding: Future[T] | None = None

    def board(self, timeout_s: float) -> T:
        """Return the answer of the next flight, and fly it, in that time, if nobody does yet."""
        with self._lock:
            flight = self._boarding
            if flight is None:
                own = self._boarding = Future()
        if flight is not None:
            return flight.result()
        try:
            own.set_result(self._fly(self._depart, timeout_s))
        except BaseException as error:
            own.set_exception(error)
        finally:
            self._close(own)
        return own.result()

    def _depart(self) -> None:
        with self._lock:
            self._boarding = None

    def _close(self, flight: Future[T]) -> None:
        """Let nobody board a flight that ended before it departed."""
        with self._lock:
            if self._boarding is flight:
                self._boarding = None


class BoundedCallbackGroup(CallbackGroup):
    """Lets so many callbacks run at a time, and no more.

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
