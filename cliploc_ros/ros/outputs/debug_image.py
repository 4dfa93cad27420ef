# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The debug image: boxes, projected ellipsoids, labels and the verdict, drawn into an image."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.ellipsoid import outline_points, project_ellipsoids, shape_matrices
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.core.keyframes.layer import PIXEL_SCALE, KeyframeLayer
from cliploc_ros.core.keyframes.places import RecognizedPlace
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.similarities import CropSimilarities
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.relocalizer import Relocalization

_BLANK, _OTHER, _TEXT = (40, 40, 40), (120, 120, 120), (255, 255, 255)
_RADIUS_PX = 3
# Lines between more points hide the images.
_MOST_LINES = 20
_UNMATCHED, _BOX, _ELLIPSE = (255, 255, 255), (86, 180, 233), (230, 159, 0)
# White text on them has a contrast of 5 and more.
_ACCEPTED, _REFUSED = (0, 114, 178), (176, 70, 0)
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_LABEL_CHARS = 40
# The scale of text, by the width of the image [1/px]; the width of a character, at most, and the
# height of a line of scale 1 [px].
_LEAST_SCALE, _SCALE_PER_PX, _CHAR_PX, _LINE_PX = 0.45, 1 / 1400, 20, 44


def beside_keyframe(canvas: NDArray[np.uint8], seen: RecognizedPlace, layer: KeyframeLayer
                    ) -> NDArray[np.uint8]:
    """Return the image (h, w, 3) with the keyframe that fits it best to the right of it.

    Points that agree have the same colour in both, and some are joined by lines. A layer without
    images has a blank panel with the points of the keyframe.

    Parameters
    ----------
    canvas : ndarray (h, w, 3) uint8
        The localized image. It is not changed.
    seen : RecognizedPlace
        With one keyframe at least.
    layer : KeyframeLayer
        That it was recognized in.
    """
    keyframe = seen.keyframes[0]
    height, width = canvas.shape[:2]
    rows = layer.rows(keyframe)
    scale = height / layer.camera_of(keyframe).height
    panel, place = _panel(layer, keyframe, scale), np.array([width, 0])
    both = np.concatenate([canvas, panel], axis=1)
    pixels = np.asarray(layer.pixels[rows]) / PIXEL_SCALE * scale + place
    if layer.image_rgb(keyframe) is None:
        for there in _whole(pixels):
            cv2.circle(both, there, 1, _OTHER, cv2.FILLED)
    own = np.nonzero((seen.rows >= rows.start) & (seen.rows < rows.stop))[0]
    ours, theirs = _whole(seen.pixels[own]), _whole(pixels[seen.rows[own] - rows.start])
    colors = _colors(seen.pixels[own])
    joined = set(np.linspace(0, len(own) - 1, min(len(own), _MOST_LINES)).astype(int).tolist())
    for row, (here, there, color) in enumerate(zip(ours, theirs, colors, strict=True)):
        if row in joined:
            cv2.line(both, here, there, color, 1, cv2.LINE_AA)
        for point in (here, there):
            cv2.circle(both, point, _RADIUS_PX, color, cv2.FILLED, cv2.LINE_AA)
    text = f'keyframe {keyframe}: {len(own)} of {seen.inliers} inliers'
    at = (width + 6, height - 8)
    cv2.putText(both, text, (at[0] + 1, at[1] + 1), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1,
                cv2.LINE_AA)
    cv2.putText(both, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.45, _TEXT, 1, cv2.LINE_AA)
    return both


def _panel(layer: KeyframeLayer, keyframe: int, scale: float) -> NDArray[np.uint8]:
    """Return the keyframe's image, as high as the localized one; blank where there is none."""
    camera = layer.camera_of(keyframe)
    width, height = (max(1, round(scale * side)) for side in (camera.width, camera.height))
    image = layer.image_rgb(keyframe)
    if image is None:
        return np.full((height, width, 3), _BLANK, dtype=np.uint8)
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_LINEAR))


def _colors(pixels: NDArray[np.float64]) -> list[list[int]]:
    """Return a colour for each point, by its column: neighbours have similar ones."""
    order = np.argsort(np.argsort(pixels[:, 0], kind='stable'), kind='stable')
    hues = 170.0 * order / max(1, len(order))
    colors = np.full((len(order), 1, 3), 255, dtype=np.uint8)
    colors[:, 0, 0] = hues
    return [] if not len(order) else cv2.cvtColor(colors, cv2.COLOR_HSV2RGB)[:, 0].tolist()


def _whole(pixels: NDArray[np.float64]) -> list[list[int]]:
    """Return whole pixels, within the range that OpenCV can draw."""
    return np.clip(np.rint(pixels), -30_000, 30_000).astype(int).tolist()


@dataclass(frozen=True)
class SeenImage:
    """An image (h, w, 3) uint8, red first, what was observed in it, and the map's keyframes."""

    image_rgb: NDArray[np.uint8]
    observation: Observation
    layer: KeyframeLayer | None = None


def draw_debug_image(seen: SeenImage, found: Relocalization, landmark_map: LandmarkMap,
                     verdict: str) -> NDArray[np.uint8]:
    """Return the image with every usable box, its depth, and the outlines of matched landmarks.

    Where keyframes had something to say, the best one is to the right of it.

    Parameters
    ----------
    found : Relocalization
        Its matches refer to the detections of the image.
    verdict : str
        Written at the top, on a band of its own.
    """
    canvas = np.ascontiguousarray(seen.image_rgb).copy()
    boxes = seen.observation.detections.bboxes_xyxy
    matched = {match.detection for match in found.matches}
    for row, box in enumerate(boxes):
        _draw_box(canvas, box, _BOX if row in matched else _UNMATCHED)
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
            similarity = _similarity(seen.observation, match.detection, match.landmark)
            _write_near(canvas, f'{label} {similarity}IoU {match.iou:.2f}',
                        boxes[match.detection], taken)
    scale = _scale(canvas)
    lines = _lines(verdict, int(canvas.shape[1] / (_CHAR_PX * scale))) if verdict else []
    canvas[:int((len(lines) + 0.3 * bool(lines)) * _LINE_PX * scale)] = (
        _ACCEPTED if found.accepted else _REFUSED)
    for line, text in enumerate(lines):
        _write(canvas, text, np.array([6, int((line + 0.85) * _LINE_PX * scale)]), _TEXT)
    if seen.layer is None or found.recognized is None:
        return canvas
    return beside_keyframe(canvas, found.recognized, seen.layer)


def _similarity(observation: Observation, detection: int, landmark: int) -> str:
    similarities, row = observation.similarities, observation.similarity_rows[detection]
    if similarities is None or row < 0:
        return ''
    if isinstance(similarities, CropSimilarities):
        label = similarities.labels.unique[similarities.labels.of_landmarks[landmark]]
        return f'CLIP {float(similarities.crops[row] @ label):.2f} '
    return f'CLIP {float(similarities[row, landmark]):.2f} '


def _draw_box(canvas: NDArray[np.uint8], box: NDArray[np.float64], color: tuple[int, int, int]
              ) -> None:
    corners = _pixels(box)
    cv2.rectangle(canvas, corners[:2].tolist(), corners[2:].tolist(), color, 2)


def _pixels(points: NDArray[np.float64]) -> NDArray[np.int32]:
    """Return whole pixels, within the range that OpenCV can draw."""
    return np.clip(np.rint(points), -30_000, 30_000).astype(np.int32)


def _write(canvas: NDArray[np.uint8], text: str, at: NDArray[np.int32],
           color: tuple[int, int, int]) -> None:
    """Write a line with a shadow, inside the image, larger on a larger one."""
    height, width = canvas.shape[:2]
    place = (int(np.clip(at[0], 0, max(0, width - 10))), int(np.clip(at[1], 12, height)))
    text = text.encode('ascii', 'replace').decode()  # OpenCV has no other characters
    # As thick as the text: OpenCV 5 writes thicker text wider.
    shadow, scale = (place[0] + 1, place[1] + 1), _scale(canvas)
    thickness = max(1, round(2 * scale))
    cv2.putText(canvas, text, shadow, _FONT, scale, (0, 0, 0), thickness, cv2.LINE_AA)
    cv2.putText(canvas, text, place, _FONT, scale, color, thickness, cv2.LINE_AA)


def _write_near(canvas: NDArray[np.uint8], text: str, box: NDArray[np.float64],
                taken: list[NDArray[np.int32]]) -> None:
    """Write a line above a box or below it, where it covers no other line; else leave it out."""
    (width, height), _ = cv2.getTextSize(text, _FONT, _scale(canvas), 1)
    for corner in (box[:2] - (0, 4), box[[0, 3]] + (0, height + 4)):
        left, bottom = _pixels(corner).tolist()
        place = np.array([left, bottom - height, left + width, bottom], dtype=np.int32)
        if not any((place[:2] < one[2:]).all() and (one[:2] < place[2:]).all() for one in taken):
            taken.append(place)
            _write(canvas, text, _pixels(corner), _BOX)
            return


def _scale(canvas: NDArray[np.uint8]) -> float:
    return max(_LEAST_SCALE, canvas.shape[1] * _SCALE_PER_PX)


def _lines(text: str, width: int) -> list[str]:
    """Break a text into lines of a number of characters at most."""
    lines = ['']
    for word in text.split():
        if lines[-1] and len(lines[-1]) + 1 + len(word) > width:
            lines.append('')
        lines[-1] = f'{lines[-1]} {word}'.strip()
    return lines
