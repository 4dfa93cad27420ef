# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A node's health on /diagnostics, once a second and after each result.

diagnostic_updater does the same, but has no package on PyPI.
"""

import csv
import io
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from cliploc_ros.ros.node.threads import steady_timer

_PERIOD_S = 1.0
# Least period of a rate: over a shorter time it fluctuates.
_MIN_RATE_PERIOD_S = 0.5
# Number of results in means and percentiles.
_WINDOW = 200


def join_names(names: Sequence[str]) -> str:
    """Return names as one CSV value: names with a comma or a quote are quoted."""
    text = io.StringIO()
    csv.writer(text).writerow(names)
    return text.getvalue().removesuffix('\r\n')


def split_names(text: str) -> tuple[str, ...]:
    """Return the names in a value of join_names."""
    return tuple(next(csv.reader(io.StringIO(text, newline='')), ()))


@dataclass
class Health:
    """Problems with their levels, and values."""

    #: Levels of diagnostic_msgs/DiagnosticStatus, and messages of one line
    problems: list[tuple[bytes, str]] = field(default_factory=list)
    values: dict[str, object] = field(default_factory=dict)

    def warn(self, problem: str) -> None:
        """Add a problem that may disappear without action."""
        self.problems.append((DiagnosticStatus.WARN, problem))

    def fail(self, problem: str) -> None:
        """Add a problem that the user must fix."""
        self.problems.append((DiagnosticStatus.ERROR, problem))

    def add(self, part: 'Health', name: str) -> None:
        """Add the problems of a component, and its values with its name as prefix."""
        self.problems += part.problems
        self.values |= {f'{name}: {key}' if name else key: value
                        for key, value in part.values.items()}

    @property
    def level(self) -> bytes:
        """Return the worst level."""
        return max((level for level, _ in self.problems), default=DiagnosticStatus.OK)

    @property
    def message(self) -> str:
        """Return the problems in one line, the worst first; empty without problems."""
        worst_first = sorted(self.problems, key=lambda problem: problem[0], reverse=True)
        return '; '.join(text for _, text in worst_first)


class StageTimes:
    """Times of the stages of one result, written in one thread and read in another.

    Parameters
    ----------
    stage : str
        The first stage.
    start : float
        When it began (monotonic clock) [s].
    """

    def __init__(self, stage: str, start: float) -> None:
        # A tuple, so that a reader in another thread never sees a partial change.
        self._now: tuple[dict[str, float], str, float] = ({}, stage, start)

    def begin(self, stage: str, at: float | None = None) -> None:
        """End the running stage and begin another, or continue it; by default now."""
        now = time.monotonic() if at is None else at
        self._now = (self._until(now), stage, now)

    @property
    def ms(self) -> dict[str, float]:
        """Return the duration of each stage until now [ms], in order."""
        return self._until(time.monotonic())

    def _until(self, now: float) -> dict[str, float]:
        ms, stage, start = self._now
        return {**ms, stage: ms.get(stage, 0.0) + max(0.0, now - start) * 1e3}


class Stages:
    """Times of the stages of recent results, written in one thread and read in another."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._ms: dict[str, deque[float]] = {}

    def add(self, stages_ms: Mapping[str, float]) -> None:
        """Add the times of one result [ms], by stage."""
        with self._lock:
            for stage, ms in stages_ms.items():
                self._ms.setdefault(stage, deque(maxlen=_WINDOW)).append(ms)

    def values(self) -> dict[str, object]:
        """Return last, mean and 99th percentile of each stage [ms]."""
        with self._lock:
            times = {stage: np.array(ms) for stage, ms in self._ms.items()}
        return {f'{stage} {name} [ms]': f'{value:.1f}' for stage, ms in times.items()
                for name, value in (('last', ms[-1]), ('mean', ms.mean()),
                                    ('p99', np.percentile(ms, 99)))}


class Rates:
    """Computes rates from counts."""

    def __init__(self) -> None:
        self._counts: dict[str, int] = {}
        self._at = time.monotonic()
        self._rates: dict[str, float] = {}

    def update(self, counts: Mapping[str, int]) -> dict[str, float]:
        """Return the rates over the last 0.5 s or more [Hz]; counts may restart at 0."""
        now = time.monotonic()
        period_s = now - self._at
        if period_s >= _MIN_RATE_PERIOD_S:
            self._rates = {name: max(0, count - self._counts.get(name, 0)) / period_s
                           for name, count in counts.items()}
            self._counts, self._at = dict(counts), now
        return {name: self._rates.get(name, 0.0) for name in counts}


class Diagnostics:
    """Publishes a node's health.

    Parameters
    ----------
    health : callable
        Returns the node's health.
    state : callable
        Returns the name of its lifecycle state.
    """

    def __init__(self, node: Node, health: Callable[[], Health], state: Callable[[], str]) -> None:
        self._node = node
        self._health = health
        self._state = state
        self._lock = threading.Lock()
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        steady_timer(node, _PERIOD_S, self.publish)

    def publish(self) -> None:
        """Publish the health now."""
        with self._lock:
            state, health = self._state(), self._health()
        pages = int(Path('/proc/self/statm').read_text().split()[1])  # resident pages
        values = {'state': state, **health.values, 'memory [MiB]':
                  f'{pages * os.sysconf("SC_PAGE_SIZE") / 2**20:.0f}'}
        name = self._node.get_fully_qualified_name().lstrip('/')
        status = DiagnosticStatus(level=health.level, name=f'{name}: status', hardware_id=name,
            message=health.message or state,
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()])
        msg = DiagnosticArray(status=[status])
        msg.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(msg)
