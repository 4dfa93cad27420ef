# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The robot's laser: the scan nearest to an image, and the occupancy grid that it shows."""

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence

from builtin_interfaces.msg import Time
from nav_msgs.msg import OccupancyGrid as OccupancyGridMsg
from rclpy.node import Node
from sensor_msgs.msg import LaserScan

from cliploc_ros.core.geometry.grid import OccupancyGrid
from cliploc_ros.errors import CliplocError, OptionsError
from cliploc_ros.messages import grid_from_msg
from cliploc_ros.ros import qos
from cliploc_ros.ros.conversions import stamp_ns
from cliploc_ros.ros.parameters import RelocalizerParameters
from cliploc_ros.units import NS_PER_S

# Scans of 10 s are kept, for boxes of a slow detector; those of a fast laser are thinned out.
_MOST_SCANS, _LEAST_STEP_NS = 200, NS_PER_S // 20
#: Greatest time between image and scan [ns] if odometry covers it, and if not. A laser at 5 Hz has
#: a scan within 0.1 s. Not measured.
LINKED_NS, UNLINKED_NS = NS_PER_S // 2, NS_PER_S // 10
# Limit of memory: 400 m x 400 m at 5 cm have 64 million cells.
_MOST_CELLS = 2**26


class NoScanError(CliplocError):
    """There is no scan or no grid for an image; the message says why."""


class LaserSource:
    """Subscribes to scans and the grid while the node is active, if the parameter scan is set."""

    def __init__(self, node: Node) -> None:
        self._node, self._lock = node, threading.Lock()
        self._subscriptions: list[qos.AdaptiveSubscription] = []
        self._scans: deque[LaserScan] = deque(maxlen=_MOST_SCANS)
        self._heard_at = -math.inf
        # The current grid, or why it is invalid.
        self._grid: OccupancyGrid | None = None
        self._fault = ''

    def open(self, parameters: RelocalizerParameters) -> None:
        """Subscribe to the topics that the parameters name."""
        if not parameters.scan or self._subscriptions:
            return
        self._subscriptions.append(qos.AdaptiveSubscription(
            self._node, LaserScan, parameters.scan, self.take, qos.SCAN))
        if not parameters.grid_file:
            self._subscriptions.append(qos.AdaptiveSubscription(
                self._node, OccupancyGridMsg, parameters.grid,
                lambda msg: self.use(lambda: grid_from_msg(msg)), qos.LATCHED))

    def close(self) -> None:
        """Unsubscribe, and forget the scans."""
        for subscription in self._subscriptions:
            subscription.destroy()
        self._subscriptions.clear()
        self.forget()

    def forget(self) -> None:
        """Forget all scans: time jumped."""
        with self._lock:
            self._scans.clear()

    def take(self, msg: LaserScan) -> None:
        """Keep a scan, unless it follows another one closely."""
        at_ns, msg.intensities = stamp_ns(msg.header.stamp), []
        with self._lock:
            self._heard_at = time.monotonic()
            newest_ns = stamp_ns(self._scans[-1].header.stamp) if self._scans else 0
            if at_ns < newest_ns:  # time jumped back
                self._scans.clear()
            if not 0 <= at_ns - newest_ns < _LEAST_STEP_NS:
                self._scans.append(msg)

    def use(self, read: Callable[[], OccupancyGrid]) -> None:
        """Replace the grid; an invalid grid replaces it, too, because the former is outdated."""
        try:
            grid = read()
            if grid.cells.size > _MOST_CELLS:
                raise OptionsError(f'the grid has {grid.cells.size} cells (limit {_MOST_CELLS})')
            _ = grid.field  # no request waits for it
            self._grid, self._fault = grid, ''
        except CliplocError as error:
            self._grid, self._fault = None, str(error)

    def problem(self, parameters: RelocalizerParameters) -> str:
        """Return why scans or the grid are missing, and the remedy; empty without a problem."""
        is_heard = time.monotonic() - self._heard_at < parameters.stale_after_s
        for name, kind, is_there in (('scan', LaserScan, is_heard), (
                'grid', OccupancyGridMsg, self._grid is not None or self._fault)):
            if parameters.scan and not is_there:
                topic = qos.resolved(self._node, getattr(parameters, name))
                return qos.why_silent(self._node, name, topic, kind)
        return self._fault

    def near(self, stamp: Time, parameters: RelocalizerParameters, frame_ids: Sequence[str]
             ) -> tuple[LaserScan, OccupancyGrid]:
        """Return the scan that is nearest to an image, and the grid of a map with these frames.

        NoScanError: there is none, or the grid is of no map.
        """
        at_ns, grid = stamp_ns(stamp), self._grid
        with self._lock:
            scan = min(self._scans, default=None,
                       key=lambda kept: abs(stamp_ns(kept.header.stamp) - at_ns))
        if scan is None or grid is None or abs(stamp_ns(scan.header.stamp) - at_ns) > LINKED_NS:
            raise NoScanError(self.problem(parameters) or 'no scan within '
                              f'{LINKED_NS / NS_PER_S:g} s of the image: stamp both by one clock')
        if grid.frame_id not in frame_ids:
            raise NoScanError(f"the grid is in frame '{grid.frame_id}', the map in "
                              f"'{', '.join(frame_ids)}': correct the frame_id of one of them")
        return scan, grid
