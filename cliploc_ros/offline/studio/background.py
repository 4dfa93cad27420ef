# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Long computations in a background thread."""

import threading
from collections.abc import Callable, Hashable

_MOST_KEPT = 1000


class Background[Answer]:
    """Computes answers in a thread, and caches them. Only the newest question is computed.

    ``on_change`` is called in the thread after each answer.
    """

    def __init__(self, on_change: Callable[[], None]):
        self._on_change = on_change
        self._answers: dict[Hashable, Answer] = {}
        self._wanted: tuple[Hashable, Callable[[], Answer]] | None = None
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._is_stopped = False

    def ask(self, key: Hashable, find: Callable[[], Answer]) -> Answer | None:
        """Return the answer to the question with this key; None until it is computed.

        ``find`` computes the answer, and must not raise. After a stop, nothing is computed.
        """
        with self._lock:
            if key not in self._answers and not self._is_stopped:
                self._wanted = key, find
                if self._thread is None:
                    self._thread = threading.Thread(target=self._work, daemon=True)
                    self._thread.start()
            return self._answers.get(key)

    def stop(self) -> None:
        """Drop the question, refuse further questions, and wait for the thread."""
        with self._lock:
            self._is_stopped, self._wanted, thread = True, None, self._thread
        if thread is not None:
            thread.join()

    def _work(self) -> None:
        while True:
            with self._lock:
                if self._wanted is None or self._wanted[0] in self._answers:
                    self._wanted = self._thread = None
                    return
                key, find = self._wanted
            answer = find()
            with self._lock:
                if len(self._answers) >= _MOST_KEPT:
                    self._answers.clear()
                self._answers[key] = answer
            self._on_change()
