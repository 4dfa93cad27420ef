# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Markers for RViz and the debug image, published while they have subscribers."""

import array
import colorsys
import textwrap
import threading
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from geometry_msgs.msg import Point, PoseArray
from numpy.typing import NDArray
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from sensor_msgs.msg import Image
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from cliploc_ros.core.geometry.camera import frusta
from cliploc_ros.core.geometry.ellipsoid import outline_points, project_ellipsoids, shape_matrices
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.core.keyframes.layer import PIXEL_SCALE, KeyframeLayer
from cliploc_ros.core.keyframes.places import RecognizedPlace
from cliploc_ros.core.map.joined_map import parts_of
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.similarities import pair_similarities
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.relocalizer import Relocalization
from cliploc_ros.ros import qos
from cliploc_ros.ros.conversions import pose_to_msg

#: Greatest number of landmarks shown: RViz is slow with more landmarks.
MAX_SHOWN = 5000
_TEXT_HEIGHT_M = 0.08
_LINE_WIDTH_M = 0.01
_ACCEPTED = ColorRGBA(r=0.0, g=0.62, b=0.45, a=0.9)
_REFUSED = ColorRGBA(r=0.84, g=0.37, b=0.0, a=0.9)
_KEYFRAMES = ColorRGBA(r=0.0, g=0.59, b=0.53, a=0.9)
_FRUSTUM_M = 0.12
_TEXT = (255, 255, 255)
_RADIUS_PX = 3
# Greatest number of lines between matched points: more lines would hide the images.
_MOST_LINES = 20
_UNMATCHED, _BOX, _ELLIPSE = (255, 255, 255), (86, 180, 233), (230, 159, 0)
# White text on these colours has a contrast of 5 or more.
_ACCEPTED_BAR, _REFUSED_BAR = (0, 114, 178), (176, 70, 0)
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_LABEL_CHARS = 40
# Least scale of text, scale per image width [1/px], and height of a line at scale 1 [px].
_LEAST_SCALE, _SCALE_PER_PX, _LINE_PX = 0.45, 1 / 1400, 44
# Scale of the bar's text relative to other text, and its greatest number of lines. A longer
# verdict is cut.
_BAR_SCALE, _BAR_LINES = 0.8, 2


def landmark_markers(landmark_map: LandmarkMap, layer: KeyframeLayer | None = None) -> MarkerArray:
    """Return an ellipsoid and a text for each landmark, coloured by class.

    With several maps, the markers are in the coordinate frame of their map. The cameras of
    keyframes are in the namespace `keyframes`, of several recordings with the name of theirs; with
    several maps, they are not shown.
    """
    markers = [Marker(header=Header(frame_id=landmark_map.frame_id), action=Marker.DELETEALL)]
    for part in parts_of(landmark_map):
        markers += _markers_of(part.landmark_map, part.first)
    if layer is not None and not layer.parts:
        parts: dict[str, list[int]] = {}
        for row in range(0, len(layer), -(-len(layer) // MAX_SHOWN)):  # every n-th of many
            parts.setdefault(f'keyframes {layer.recorded(row)}'.strip(), []).append(row)
        markers += [_line_marker(Header(frame_id=layer.frame_id), name, _KEYFRAMES, [
            end for edge in frusta([layer.camera_of(row) for row in rows],
                                   layer.map_from_camera[rows], _FRUSTUM_M) for end in edge])
            for name, rows in parts.items()]
    return MarkerArray(markers=markers)


def _markers_of(landmark_map: LandmarkMap, first: int) -> list[Marker]:
    """Return the markers of one map. Their ids start at `first`, and end below MAX_SHOWN."""
    header, markers = Header(frame_id=landmark_map.frame_id), []
    shown = max(0, MAX_SHOWN - first)
    rows = zip(landmark_map.centers[:shown], landmark_map.semi_axes, landmark_map.quats_xyzw,
               landmark_map.labels, landmark_map.class_ids, strict=False)
    for number, (center, semi_axes, quat_xyzw, label, class_id) in enumerate(rows, start=first):
        ellipsoid = Marker(header=header, ns='landmarks', id=number, type=Marker.SPHERE,
                           color=class_color(class_id))
        ellipsoid.pose.position = _point(center)
        q = ellipsoid.pose.orientation
        q.x, q.y, q.z, q.w = map(float, quat_xyzw)
        scale = ellipsoid.scale
        scale.x, scale.y, scale.z = map(float, 2.0 * semi_axes)
        text = Marker(header=header, ns='labels', id=number, type=Marker.TEXT_VIEW_FACING,
                      text=label, color=ColorRGBA(r=1.0, g=1.0, b=1.0, a=1.0))
        text.pose.position = _point(center)
        text.pose.position.z += float(semi_axes.max()) + _TEXT_HEIGHT_M
        text.pose.orientation.w = 1.0
        text.scale.z = _TEXT_HEIGHT_M
        markers += [ellipsoid, text]
    return markers


def match_markers(header: Header, camera_position: NDArray[np.float64],
                  centers: Sequence[NDArray[np.float64]], accepted: bool) -> MarkerArray:
    """Return lines from a camera to the matched landmarks.

    Parameters
    ----------
    header : Header
        Stamp of the image, coordinate frame of the map.
    camera_position : ndarray (3,)
        Position of the camera in the map [m].
    centers : sequence of ndarray (3,)
        Centres of the landmarks [m].
    accepted : bool
        Draw the lines in green, else in red.
    """
    lines = _line_marker(header, 'matches', _ACCEPTED if accepted else _REFUSED, [
        end for center in centers for end in (camera_position, center)])
    if not lines.points:
        lines.action = Marker.DELETEALL
    return MarkerArray(markers=[lines])


def _line_marker(header: Header, name: str, color: ColorRGBA,
                 ends: Sequence[NDArray[np.float64]]) -> Marker:
    """Return lines between successive pairs of end points (3,)."""
    lines = Marker(header=header, ns=name, type=Marker.LINE_LIST, color=color,
                   points=[_point(end) for end in ends])
    lines.pose.orientation.w = 1.0
    lines.scale.x = _LINE_WIDTH_M
    return lines


def class_color(class_id: str) -> ColorRGBA:
    """Return the colour of a class, by a hash: constant, and usually different between classes."""
    hue = zlib.crc32(class_id.encode()) / 2**32
    r, g, b = colorsys.hsv_to_rgb(hue, 0.7, 0.95)
    return ColorRGBA(r=r, g=g, b=b, a=0.6)


def _point(position: NDArray[np.float64]) -> Point:
    x, y, z = map(float, position)
    return Point(x=x, y=y, z=z)


def beside_keyframe(canvas: NDArray[np.uint8], seen: RecognizedPlace, layer: KeyframeLayer
                    ) -> NDArray[np.uint8]:
    """Return the image (h, w, 3) with its best keyframe to the right.

    Matched points have the same colour in both, and some are joined by lines. If the layer stores
    no images, only the points in the localized image are drawn.

    Parameters
    ----------
    canvas : ndarray (h, w, 3) uint8
        The localized image. It is not modified.
    seen : RecognizedPlace
        A place with at least one keyframe.
    layer : KeyframeLayer
        The layer that contains the keyframe.
    """
    keyframe = seen.keyframes[0]
    height, width = canvas.shape[:2]
    rows = layer.rows(keyframe)
    camera, image = layer.camera_of(keyframe), layer.image_rgb(keyframe)
    scale = height / camera.height
    own = np.nonzero((seen.rows >= rows.start) & (seen.rows < rows.stop))[0]
    if image is None:
        both = canvas.copy()
    else:
        size = max(1, round(scale * camera.width)), height
        both = np.concatenate([canvas, cv2.resize(image, size, interpolation=cv2.INTER_LINEAR)],
                              axis=1)
    pixels = np.asarray(layer.pixels[rows]) / PIXEL_SCALE * scale + np.array([width, 0])
    ours, theirs = (_pixels(points).tolist() for points in (
        seen.pixels[own], pixels[seen.rows[own] - rows.start]))
    # colour by column: neighbouring points have similar colours
    order = np.argsort(np.argsort(seen.pixels[own, 0], kind='stable'), kind='stable')
    colors = np.full((len(own), 1, 3), 255, dtype=np.uint8)
    colors[:, 0, 0] = 170.0 * order / max(1, len(order))
    colors = cv2.cvtColor(colors, cv2.COLOR_HSV2RGB) if len(own) else colors
    joined = set(np.linspace(0, len(own) - 1, min(len(own), _MOST_LINES)).astype(int).tolist())
    for row, (here, there, color) in enumerate(zip(ours, theirs, colors[:, 0].tolist(),
                                                   strict=True)):
        if image is not None and row in joined:
            cv2.line(both, here, there, color, 1, cv2.LINE_AA)
        for point in (here,) if image is None else (here, there):
            cv2.circle(both, point, _RADIUS_PX, color, cv2.FILLED, cv2.LINE_AA)
    _write(both, f'keyframe {keyframe}: {len(own)} of {seen.inliers} inliers',
           np.array([6 if image is None else width + 6, height - 8], dtype=np.int32), _TEXT)
    return both


def _above_bar(canvas: NDArray[np.uint8], verdict: str, color: tuple[int, int, int]
               ) -> NDArray[np.uint8]:
    """Return the image (h, w, 3) with the verdict in a bar below it."""
    scale = _BAR_SCALE * _scale(canvas)
    verdict = verdict.encode('ascii', 'replace').decode()  # OpenCV draws only ASCII
    (width, _), _ = cv2.getTextSize(verdict, _FONT, scale, 1)
    lines = textwrap.wrap(verdict, max(8, len(verdict) * (canvas.shape[1] - 24) // max(1, width)),
                          max_lines=_BAR_LINES, placeholder=' ...', break_long_words=False,
                          break_on_hyphens=False)
    bar = np.full((int((len(lines) + 0.3) * _LINE_PX * scale), canvas.shape[1], 3), color,
                  dtype=np.uint8)
    for line, text in enumerate(lines):
        at = 6, int((line + 0.85) * _LINE_PX * scale)
        cv2.putText(bar, text, at, _FONT, scale, _TEXT, 1, cv2.LINE_AA)
    return np.concatenate([canvas, bar], axis=0)


@dataclass(frozen=True)
class SeenImage:
    """An image (h, w, 3) uint8, RGB, its observation, and the map's keyframes."""

    image_rgb: NDArray[np.uint8]
    observation: Observation
    layer: KeyframeLayer | None = None


def draw_debug_image(seen: SeenImage, found: Relocalization, landmark_map: LandmarkMap,
                     verdict: str) -> NDArray[np.uint8]:
    """Return the image with all usable boxes, their depths, and outlines of matched landmarks.

    The best keyframe is on the right, if its image is stored. The image fills the upper left
    (h, w), so boxes and points keep their pixel coordinates.

    Parameters
    ----------
    found : Relocalization
        Its matches refer to the detections of the image.
    verdict : str
        Written on a bar below the image; empty: no bar.
    """
    canvas = np.ascontiguousarray(seen.image_rgb).copy()
    boxes = seen.observation.detections.bboxes_xyxy
    matched = {match.detection for match in found.matches}
    for row, box in enumerate(boxes):
        corners = _pixels(box)
        cv2.rectangle(canvas, corners[:2].tolist(), corners[2:].tolist(),
                      _BOX if row in matched else _UNMATCHED, 2)
        if seen.observation.depths is not None and np.isfinite(seen.observation.depths[row]):
            _write(canvas, f'{seen.observation.depths[row]:.1f} m',
                   _pixels(box[[0, 3]]) + np.array([4, -6], dtype=np.int32), _TEXT)
    if found.map_from_camera is not None and found.matches:
        rows = [match.landmark for match in found.matches]
        outlines = project_ellipsoids(invert_transform(found.map_from_camera),
                                      landmark_map.centers[rows], shape_matrices(
                                          landmark_map.semi_axes[rows],
                                          landmark_map.quats_xyzw[rows]))
        taken: list[NDArray[np.int32]] = []
        for match, outline in zip(found.matches, outlines, strict=True):
            if np.isfinite(outline).all():
                points = seen.observation.camera.project_normalized(outline_points(outline))
                points = points[np.isfinite(points).all(axis=1)]
                cv2.polylines(canvas, [_pixels(points).reshape(-1, 1, 2)], True, _ELLIPSE, 2,
                              cv2.LINE_AA)
            label = landmark_map.labels[match.landmark][:_LABEL_CHARS]
            similarities, row = seen.observation.similarities, \
                seen.observation.similarity_rows[match.detection]
            if similarities is not None and row >= 0:
                similarity, = pair_similarities(similarities, np.array([row]),
                                                np.array([match.landmark]))
                label = f'{label} CLIP {similarity:.2f}'
            _write_near(canvas, f'{label} IoU {match.iou:.2f}', boxes[match.detection], taken)
    if seen.layer is not None and not seen.layer.parts and found.recognized is not None:
        canvas = beside_keyframe(canvas, found.recognized, seen.layer)
    return canvas if not verdict else _above_bar(
        canvas, verdict, _ACCEPTED_BAR if found.accepted else _REFUSED_BAR)


def _pixels(points: NDArray[np.float64]) -> NDArray[np.int32]:
    """Round to whole pixels, within the range that OpenCV can draw."""
    return np.clip(np.rint(points), -30_000, 30_000).astype(np.int32)


def _write(canvas: NDArray[np.uint8], text: str, at: NDArray[np.int32],
           color: tuple[int, int, int]) -> None:
    """Write a line of text with a shadow inside the image, scaled with the image."""
    height, width = canvas.shape[:2]
    place = (int(np.clip(at[0], 0, max(0, width - 10))), int(np.clip(at[1], 12, height)))
    text = text.encode('ascii', 'replace').decode()  # OpenCV draws only ASCII
    # The shadow is as thick as the text: OpenCV 5 draws thicker text wider.
    shadow, scale = (place[0] + 1, place[1] + 1), _scale(canvas)
    thickness = max(1, round(2 * scale))
    cv2.putText(canvas, text, shadow, _FONT, scale, (0, 0, 0), thickness, cv2.LINE_AA)
    cv2.putText(canvas, text, place, _FONT, scale, color, thickness, cv2.LINE_AA)


def _write_near(canvas: NDArray[np.uint8], text: str, box: NDArray[np.float64],
                taken: list[NDArray[np.int32]]) -> None:
    """Write a line above or below a box, unless it would overlap another line."""
    (width, height), _ = cv2.getTextSize(text, _FONT, _scale(canvas), 1)
    for corner in (box[:2] - (0, 4), box[[0, 3]] + (0, height + 4)):
        left, bottom = _pixels(corner).tolist()
        place = np.array([left, bottom - height, left + width, bottom], dtype=np.int32)
        if not any((place[:2] < other[2:]).all() and (other[:2] < place[2:]).all()
                   for other in taken):
            taken.append(place)
            _write(canvas, text, _pixels(corner), _BOX)
            return


def _scale(canvas: NDArray[np.uint8]) -> float:
    return max(_LEAST_SCALE, canvas.shape[1] * _SCALE_PER_PX)


def image_to_msg(image_rgb: NDArray[np.uint8], header: Header) -> Image:
    """Return an RGB image (h, w, 3) as a message."""
    height, width = image_rgb.shape[:2]
    return Image(header=header, height=height, width=width, encoding='rgb8', step=3 * width,
                 data=array.array('B', image_rgb.tobytes()))


class Visualization:
    """Publishes `~/landmarks`, `~/matches`, `~/hypotheses` and `~/debug_image`."""

    def __init__(self, node: Node) -> None:
        # Subscribers are matched in one thread, maps are loaded in another.
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
        """Show a map with its keyframes from now on, or no map."""
        with self._lock:
            self._map, self._layer = landmark_map, layer
        self._show_map()

    def show(self, header: Header, landmark_map: LandmarkMap, found: Relocalization,
             camera_from_base: NDArray[np.float64]) -> None:
        """Show the matched landmarks and the best hypotheses.

        The header has the stamp of the image and the coordinate frame of the map.
        """
        if self._hypotheses.get_subscription_count() > 0:
            self._hypotheses.publish(PoseArray(header=header, poses=[
                pose_to_msg(hypothesis.map_from_camera @ camera_from_base)
                for hypothesis in found.hypotheses]))
        if self._matches.get_subscription_count() == 0:
            return
        position = np.zeros(3) if found.map_from_camera is None else found.map_from_camera[:3, 3]
        self._matches.publish(match_markers(
            header, position, [landmark_map.centers[match.landmark] for match in found.matches],
            found.accepted))

    def show_debug_image(self, header: Header, seen: SeenImage, landmark_map: LandmarkMap,
                         found: Relocalization, verdict: str) -> None:
        """Publish the image with the matches and the verdict. `header` is that of the image."""
        self._debug_image.publish(image_to_msg(
            draw_debug_image(seen, found, landmark_map, verdict), header))

    def _show_map(self) -> None:
        """Publish the map if it is new and has subscribers; later subscribers get it, too."""
        with self._lock:
            if self._map is self._shown or self._landmarks.get_subscription_count() == 0:
                return
            self._landmarks.publish(
                MarkerArray(markers=[Marker(action=Marker.DELETEALL)]) if self._map is None
                else landmark_markers(self._map, self._layer))
            self._shown = self._map
