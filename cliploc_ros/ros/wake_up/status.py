# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a relocalizer says of itself on /diagnostics, and what it lacks for a request."""

import math
import time
from dataclasses import dataclass, field

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node

#: The diagnostics come once a second; a relocalizer that is silent for longer is taken for dead.
SILENT_S = 5.0


@dataclass(frozen=True)
class Report:
    """One report of the relocalizer.

    Parameters
    ----------
    received_at : float
        Monotonic clock [s].
    message : str
        Its problems in one line, or its state.
    values : dict of str to str
    """

    received_at: float = -math.inf
    message: str = ''
    values: dict[str, str] = field(default_factory=dict)


class RelocalizerStatus:
    """Listens to the diagnostics of one relocalizer.

    Parameters
    ----------
    node : Node
        Spun by the caller.
    name : str
        The relocalizer's name with its namespace, as ``/robot/relocalizer``.
    """

    def __init__(self, node: Node, name: str) -> None:
        self._name = name
        self._begun_at = time.monotonic()
        self._report = Report()
        node.create_subscription(DiagnosticArray, '/diagnostics', self._take, 10)

    @property
    def silent_s(self) -> float:
        """Return how long the relocalizer has been silent [s]."""
        return time.monotonic() - max(self._report.received_at, self._begun_at)

    @property
    def time_limit_s(self) -> float:
        """Return within which time it answers a request [s]; infinite if that is not known."""
        return float(self._report.values.get('time limit [s]', math.inf))

    def problem(self) -> str:
        """Return why the relocalizer cannot take a request, and what to do; empty if it can."""
        state, silent_s = self._report.values.get('state'), self.silent_s
        if state is None:
            return (f'{self._name} has sent no diagnostics yet: it is starting, or its '
                    '/diagnostics is remapped')
        if silent_s > SILENT_S:
            return (f'{self._name} has been silent for {silent_s:.0f} s: it died, or its '
                    'machine is overloaded; start it again if it died')
        if state != 'active':
            reason = self._report.message if self._report.message != state else \
                'it is loading, or its lifecycle manager must configure and activate it'
            return f'{self._name} is {state}: {reason}'
        return self._report.values.get('missing', '')

    def _take(self, msg: DiagnosticArray) -> None:
        for status in msg.status:
            if status.hardware_id == self._name.lstrip('/'):
                self._report = Report(time.monotonic(), status.message,
                                      {value.key: value.value for value in status.values})
