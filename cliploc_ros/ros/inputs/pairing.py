# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pairing of the messages of several topics by exactly equal stamps."""

from collections import OrderedDict
from collections.abc import Mapping
from typing import Any


class ExactPairing:
    """Collects messages until every topic has one of the same stamp. Memory is bounded.

    Stamps are compared for equality, not for order: frames may arrive out of order.

    Parameters
    ----------
    max_bytes : mapping of str to int
        The topics, and how much memory the messages of each may hold [bytes].
    max_count : int
        How many messages of each topic are kept.
    """

    def __init__(self, max_bytes: Mapping[str, int], max_count: int) -> None:
        self._max_bytes = dict(max_bytes)
        self._max_count = max_count
        self._waiting: dict[str, OrderedDict[int, tuple[Any, int]]] = {
            topic: OrderedDict() for topic in max_bytes}
        self._bytes = dict.fromkeys(max_bytes, 0)
        self.received = dict.fromkeys(max_bytes, 0)
        self.dropped = dict.fromkeys(max_bytes, 0)
        self.last_stamp_ns: dict[str, int] = {}

    def add(self, topic: str, stamp_ns: int, item: Any, size: int) -> dict[str, Any] | None:
        """Take in a message; return the set by topic that it completes, or None.

        Parameters
        ----------
        topic : str
        stamp_ns : int
        item : object
            Returned in the set.
        size : int
            Memory that the item holds [bytes].
        """
        self.received[topic] += 1
        self.last_stamp_ns[topic] = stamp_ns
        waiting = self._waiting[topic]
        if stamp_ns in waiting:
            self._forget(topic, stamp_ns)
        waiting[stamp_ns] = (item, size)
        self._bytes[topic] += size
        while len(waiting) > self._max_count or (
                self._bytes[topic] > self._max_bytes[topic] and len(waiting) > 1):
            self._forget(topic, next(iter(waiting)))
        if any(stamp_ns not in other for other in self._waiting.values()):
            return None
        complete = {name: other[stamp_ns][0] for name, other in self._waiting.items()}
        for name, other in self._waiting.items():
            self.dropped[name] -= 1  # the loop below counts the completed one, too
            # Older messages will not be completed any more.
            while stamp_ns in other:
                self._forget(name, next(iter(other)))
        return complete

    def oldest(self, topic: str) -> Any:
        """Return the oldest item of a topic that waits; None if there is none."""
        return next((item for item, _ in self._waiting[topic].values()), None)

    def waiting_bytes(self) -> int:
        """Return the memory that all waiting messages hold [bytes]."""
        return sum(self._bytes.values())

    def clear(self) -> None:
        """Forget all waiting messages and all counts."""
        for waiting in self._waiting.values():
            waiting.clear()
        self._bytes = dict.fromkeys(self._bytes, 0)
        self.received = dict.fromkeys(self.received, 0)
        self.dropped = dict.fromkeys(self.dropped, 0)
        self.last_stamp_ns.clear()

    def _forget(self, topic: str, stamp_ns: int) -> None:
        _, size = self._waiting[topic].pop(stamp_ns)
        self._bytes[topic] -= size
        self.dropped[topic] += 1
