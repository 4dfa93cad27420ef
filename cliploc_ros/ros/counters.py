# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Counts of requests since the start, for a fleet to collect from the diagnostics."""

import threading
from collections import Counter

from cliploc_ros.core.acceptance.refusal_kind import RefusalKind
from cliploc_ros.ros.answer import Answer, Verdict


class RequestCounters:
    """Counts requests by their answers; written in several threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        self._kinds: Counter[RefusalKind] = Counter()
        self._total_s = self._longest_s = 0.0

    def add(self, answer: Answer, duration_s: float) -> None:
        """Count a request that took so long [s]."""
        with self._lock:
            self._counts[answer.verdict] += 1
            if answer.kind is not None:
                self._kinds[answer.kind] += 1
            self._total_s += duration_s
            self._longest_s = max(self._longest_s, duration_s)

    def values(self) -> dict[str, object]:
        """Return the counts; they only grow until the node is started anew."""
        with self._lock:
            return {'requests': self._counts.total(),
                    **{f'requests {verdict}': self._counts[verdict] for verdict in Verdict},
                    **{f'refused: {kind}': self._kinds[kind] for kind in RefusalKind},
                    'requests total [s]': f'{self._total_s:.3f}',
                    'requests longest [s]': f'{self._longest_s:.3f}'}
