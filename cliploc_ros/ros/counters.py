# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Counts of requests since the start, for a fleet to collect from the diagnostics."""

import threading
from collections import Counter

from cliploc_ros.ros.answer import Answer, Verdict

# Of each kind of refusal what its reason contains; the first that fits counts.
_KINDS = (
    ('looks alike', 'look alike'),
    ('position uncertain', 'position uncertain'),
    ('ambiguous', 'ambiguous'),
    ('frames disagree', 'frames in this pose'),
    ('search too short', 'search stopped'),
    ('search too short', 'too few to find rivals'),
    ('search too short', 'pose met only'),
    ('too few objects', 'objects matched <'),
    ('too few objects', 'distinct correspondence candidates'),
    ('not all crops', 'without all crops'),
    ('objects unexplained', 'unexplained'),
    ('time is up', 'time is up'),
)
_OTHER = 'other'


def refusal_kind(reason: str) -> str:
    """Return what kind of refusal a reason is."""
    return next((kind for kind, part in _KINDS if part in reason), _OTHER)


class RequestCounters:
    """Counts requests by their answers; written in several threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        self._kinds: Counter[str] = Counter(
            dict.fromkeys((*(kind for kind, _ in _KINDS), _OTHER), 0))
        self._total_s = self._longest_s = 0.0

    def add(self, answer: Answer, duration_s: float) -> None:
        """Count a request that took so long [s]."""
        with self._lock:
            self._counts[answer.verdict] += 1
            if answer.verdict is Verdict.REFUSED:
                self._kinds[refusal_kind(answer.detail)] += 1
            self._total_s += duration_s
            self._longest_s = max(self._longest_s, duration_s)

    def values(self) -> dict[str, object]:
        """Return the counts; they only grow until the node is started anew."""
        with self._lock:
            return {'requests': self._counts.total(),
                    **{f'requests {verdict}': self._counts[verdict] for verdict in Verdict},
                    **{f'refused: {kind}': count for kind, count in self._kinds.items()},
                    'requests total [s]': f'{self._total_s:.3f}',
                    'requests longest [s]': f'{self._longest_s:.3f}'}
