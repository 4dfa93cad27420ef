# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the relocalizer shows in RViz, each topic only while it has subscribers."""

import array
import threading

import numpy as np
from geometry_msgs.msg import PoseArray
from numpy.typing import NDArray
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from sensor_msgs.msg import Image
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray

from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.core.maps.landmark_map import LandmarkMap
from cliploc_ros.core.relocalization import Relocalization
from cliploc_ros.ros import qos
from cliploc_ros.ros.conversions import pose_array_msg
from cliploc_ros.ros.outputs.debug_image import SeenImage, draw_debug_image
from cliploc_ros.ros.outputs.markers import landmark_markers, match_markers, no_markers


class Visualization:
    """Publishes `~/landmarks`, `~/matches`, `~/hypotheses` and `~/debug_image`.

    Parameters
    ----------
    node : Node
    """

    def __init__(self, node: Node) -> None:
        # Subscribers match in one thread, a map is loaded in another.
        self._lock = threading.Lock()
        self._map: LandmarkMap | None = None
        self._shown: LandmarkMap | None = None
        self._layer: KeyframeLayer | None = None
        self._hypotheses = node.create_publisher(PoseArray, '~/hypotheses', qos.POSE)
        self._matches = node.create_publisher(MarkerArray, '~/matches', qos.POSE)
        self._debug_image = node.create_publisher(Image, '~/debug_image', qos.POSE)
        self._landmarks = node.create_publisher(
            MarkerArray, '~/landmarks', qos.LATCHED,
            event_callbacks=PublisherEventCallbacks(matched=lambda _: self._show_map()))

    @property
    def wants_debug_image(self) -> bool:
        """Return whether the debug image has subscribers."""
        return bool(self._debug_image.get_subscription_count() > 0)

    def set_map(self, landmark_map: LandmarkMap | None, layer: KeyframeLayer | None = None
                ) -> None:
        """Show another map with its keyframes from now on, or none."""
        with self._lock:
            self._map, self._layer = landmark_map, layer
        self._show_map()

    def show(self, header: Header, landmark_map: LandmarkMap, found: Relocalization,
             camera_from_base: NDArray[np.float64]) -> None:
        """Show the matched landmarks and the best hypotheses.

        The header has the stamp of the image and the coordinate frame of the map.
        """
        if self._hypotheses.get_subscription_count() > 0:
            self._hypotheses.publish(pose_array_msg(header, [
                hypothesis.map_from_camera @ camera_from_base
                for hypothesis in found.hypotheses]))
        if self._matches.get_subscription_count() == 0:
            return
        position = np.zeros(3) if found.map_from_camera is None else found.map_from_camera[:3, 3]
        self._matches.publish(match_markers(
            header, position, [landmark_map.centers[match.landmark] for match in found.matches],
            found.accepted))

    def show_debug_image(self, header: Header, seen: SeenImage, landmark_map: LandmarkMap,
                         found: Relocalization, verdict: str) -> None:
        """Publish the image, which has this header, with the matches and the verdict."""
        self._debug_image.publish(image_to_msg(
            draw_debug_image(seen, found, landmark_map, verdict), header))

    def _show_map(self) -> None:
        """Publish the map if it is new and somebody subscribes; it is kept for later ones."""
        with self._lock:
            if self._map is self._shown or self._landmarks.get_subscription_count() == 0:
                return
            self._landmarks.publish(no_markers() if self._map is None
                                    else landmark_markers(self._map, self._layer))
            self._shown = self._map


def image_to_msg(image_rgb: NDArray[np.uint8], header: Header) -> Image:
    """Return an image (h, w, 3), red first, as a message."""
    height, width = image_rgb.shape[:2]
    return Image(header=header, height=height, width=width, encoding='rgb8', step=3 * width,
                 data=array.array('B', image_rgb.tobytes()))
