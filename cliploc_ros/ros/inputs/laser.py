# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The robot's laser: the scan nearest to an image, and the occupancy grid that it shows."""

import math
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
# Greatest time between image and scan. Not measured.
_LATEST_NS = NS_PER_S // 2


class LaserSource:
    """Subscribes to scans and the grid while the node is active, if the parameter scan is set."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._subscriptions = list[qos.AdaptiveSubscription]()
        self._scans, self._heard_at = deque[LaserScan](maxlen=_MOST_SCANS), -math.inf
        # The current grid, or why it is invalid.
        self._grid: OccupancyGrid | None = None
        self._fault = ''

    def open(self, parameters: RelocalizerParameters) -> None:
        """Subscribe to the topics that the parameters name."""
        if parameters.scan:
            self._subscriptions = [qos.AdaptiveSubscription(
                self._node, LaserScan, parameters.scan, self.take, qos.SCAN)]
        if parameters.scan and not parameters.grid_file:
            self._subscriptions.append(qos.AdaptiveSubscription(
                self._node, OccupancyGridMsg, parameters.grid,
                lambda msg: self.use(lambda: grid_from_msg(msg)), qos.LATCHED))

    def close(self) -> None:
        """Unsubscribe, and forget the scans."""
        while self._subscriptions:
            self._subscriptions.pop().destroy()
        self.forget()

    def forget(self) -> None:
        """Forget all scans: time jumped."""
        self._scans.clear()

    def take(self, msg: LaserScan) -> None:
        """Keep a scan, unless it follows another one closely."""
        msg.intensities, self._heard_at = [], time.monotonic()
        later_ns = stamp_ns(msg.header.stamp) - (
            stamp_ns(self._scans[-1].header.stamp) if self._scans else 0)
        if later_ns < 0:  # time jumped back
            self._scans.clear()
        if not 0 <= later_ns < _LEAST_STEP_NS:
            self._scans.append(msg)

    def use(self, read: Callable[[], OccupancyGrid]) -> None:
        """Replace the grid; an invalid grid replaces it, too, because the former is outdated."""
        try:
            grid, self._fault = read(), ''
            _ = grid.field  # no request waits for it
            self._grid = grid
        except CliplocError as error:
            self._grid, self._fault = None, str(error)

    def problem(self, parameters: RelocalizerParameters) -> str:
        """Return why scans or the grid are missing, and the remedy; empty without a problem."""
        is_silent = time.monotonic() - self._heard_at > parameters.stale_after_s
        if not parameters.scan or not (is_silent or (self._grid is None and not self._fault)):
            return self._fault
        name, kind = ('scan', LaserScan) if is_silent else ('grid', OccupancyGridMsg)
        topic = qos.resolved(self._node, getattr(parameters, name))
        return qos.why_silent(self._node, name, topic, kind)

    def near(self, stamp: Time, parameters: RelocalizerParameters, frame_ids: Sequence[str]
             ) -> tuple[LaserScan, OccupancyGrid]:
        """Return the scan that is nearest to an image, and the grid of a map with these frames.

        OptionsError: there is none, or the grid is of no map.
        """
        def away_ns(scan: LaserScan) -> int:
            return abs(stamp_ns(scan.header.stamp) - stamp_ns(stamp))
        grid, scan = self._grid, min(tuple(self._scans), key=away_ns, default=None)
        if scan is None or grid is None or away_ns(scan) > _LATEST_NS:
            raise OptionsError(self.problem(parameters) or 'no scan within '
                               f'{_LATEST_NS / NS_PER_S} s of the image: stamp both by one clock')
        if grid.frame_id not in frame_ids:
            raise OptionsError(f"the grid is in frame '{grid.frame_id}', the map in "
                               f"'{', '.join(frame_ids)}': correct the frame_id of one of them")
        return scan, grid
