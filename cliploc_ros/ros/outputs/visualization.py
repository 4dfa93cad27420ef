# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the relocalizer shows in RViz, each topic only while it has subscribers."""

import array
import colorsys
import threading
import zlib
from collections.abc import Sequence

import numpy as np
from geometry_msgs.msg import Point, PoseArray
from numpy.typing import NDArray
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from sensor_msgs.msg import Image
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from cliploc_ros.core.geometry.camera import frusta
from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.core.map.joined_map import parts_of
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.relocalizer import Relocalization
from cliploc_ros.ros import qos
from cliploc_ros.ros.conversions import pose_array_msg
from cliploc_ros.ros.outputs.debug_image import SeenImage, draw_debug_image

#: The most landmarks that are shown: with more, RViz draws slowly.
MAX_SHOWN = 5000
_TEXT_HEIGHT_M = 0.08
_LINE_WIDTH_M = 0.01
_ACCEPTED = ColorRGBA(r=0.0, g=0.62, b=0.45, a=0.9)
_REFUSED = ColorRGBA(r=0.84, g=0.37, b=0.0, a=0.9)
_KEYFRAMES = ColorRGBA(r=0.0, g=0.59, b=0.53, a=0.9)
_FRUSTUM_M = 0.12


def landmark_markers(landmark_map: LandmarkMap, layer: KeyframeLayer | None = None) -> MarkerArray:
    """Return an ellipsoid and a text for each landmark, one colour for each class.

    Several maps get markers in their own coordinate frames. The cameras of keyframes are in the
    namespace `keyframes`.
    """
    markers = [Marker(header=Header(frame_id=landmark_map.frame_id), action=Marker.DELETEALL)]
    for part in parts_of(landmark_map):
        markers += _markers_of(part.landmark_map, part.first)
    if layer is not None:
        markers.append(_keyframe_marker(layer))
    return MarkerArray(markers=markers)


def _markers_of(landmark_map: LandmarkMap, first: int) -> list[Marker]:
    """Return the markers of one map, whose numbers begin with the first; at most MAX_SHOWN."""
    header, markers = Header(frame_id=landmark_map.frame_id), []
    shown = max(0, MAX_SHOWN - first)
    rows = zip(landmark_map.centers[:shown], landmark_map.semi_axes, landmark_map.quats_xyzw,
               landmark_map.labels, landmark_map.class_ids, strict=False)
    for number, (center, semi_axes, quat_xyzw, label, class_id) in enumerate(rows, start=first):
        ellipsoid = Marker(header=header, ns='landmarks', id=number, type=Marker.SPHERE,
                           color=class_color(class_id))
        _place(ellipsoid, center)
        q = ellipsoid.pose.orientation
        q.x, q.y, q.z, q.w = map(float, quat_xyzw)
        scale = ellipsoid.scale
        scale.x, scale.y, scale.z = map(float, 2.0 * semi_axes)
        text = Marker(header=header, ns='labels', id=number, type=Marker.TEXT_VIEW_FACING,
                      text=label, color=ColorRGBA(r=1.0, g=1.0, b=1.0, a=1.0))
        _place(text, center + np.array([0.0, 0.0, semi_axes.max() + _TEXT_HEIGHT_M]))
        text.scale.z = _TEXT_HEIGHT_M
        markers += [ellipsoid, text]
    return markers


def _keyframe_marker(layer: KeyframeLayer) -> Marker:
    """Return the frusta of keyframes; of more than MAX_SHOWN, every n-th."""
    shown = range(0, len(layer), -(-len(layer) // MAX_SHOWN))
    lines = Marker(header=Header(frame_id=layer.frame_id), ns='keyframes', type=Marker.LINE_LIST,
                   color=_KEYFRAMES)
    lines.pose.orientation.w = 1.0
    lines.scale.x = _LINE_WIDTH_M
    lines.points = [_point(end) for edge in frusta(
        [layer.camera_of(row) for row in shown], layer.map_from_camera[shown], _FRUSTUM_M)
        for end in edge]
    return lines


def no_markers() -> MarkerArray:
    """Return a message that removes all markers."""
    return MarkerArray(markers=[Marker(action=Marker.DELETEALL)])


def match_markers(header: Header, camera_position: NDArray[np.float64],
                  centers: Sequence[NDArray[np.float64]], accepted: bool) -> MarkerArray:
    """Return lines from a camera to the landmarks matched.

    Parameters
    ----------
    header : Header
        Stamp of the image, coordinate frame of the map.
    camera_position : ndarray (3,)
        [m].
    centers : sequence of ndarray (3,)
        Of the landmarks [m].
    accepted : bool
        Green if so, else red.
    """
    lines = Marker(header=header, ns='matches', type=Marker.LINE_LIST,
                   color=_ACCEPTED if accepted else _REFUSED)
    lines.pose.orientation.w = 1.0
    lines.scale.x = _LINE_WIDTH_M
    lines.points = [_point(end) for center in centers for end in (camera_position, center)]
    if not lines.points:
        lines.action = Marker.DELETEALL
    return MarkerArray(markers=[lines])


def class_color(class_id: str) -> ColorRGBA:
    """Return the colour of a class: always the same, and mostly a different one for each class."""
    hue = zlib.crc32(class_id.encode()) / 2**32
    r, g, b = colorsys.hsv_to_rgb(hue, 0.7, 0.95)
    return ColorRGBA(r=r, g=g, b=b, a=0.6)


def _place(marker: Marker, position: NDArray[np.float64]) -> None:
    marker.pose.position = _point(position)
    marker.pose.orientation.w = 1.0


def _point(position: NDArray[np.float64]) -> Point:
    x, y, z = map(float, position)
    return Point(x=x, y=y, z=z)


class Visualization:
    """Publishes `~/landmarks`, `~/matches`, `~/hypotheses` and `~/debug_image`."""

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
