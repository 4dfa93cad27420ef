# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The picture of a view: its image with the detector's boxes, drawn boxes and landmarks."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.ellipsoid import (
    ellipses_in_pixels,
    outline_points,
    project_ellipsoids,
    shape_matrices,
)
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.studio.landmark import Landmark

SELECTED_RGB = (255, 220, 0)
DRAWN_RGB = (255, 0, 220)
_DETECTED_RGB = (255, 255, 255)
_BLANK = 70
# More outlines hide the image, and a drag would wait for them.
_MAX_OUTLINES = 200
# Subpixel bits of OpenCV's drawing functions; larger coordinates overflow its integers.
_SHIFT = 4
_MAX_PIXEL = 20_000.0


#: x and y [px].
Pixel = Sequence[float] | NDArray[np.float64]


class Outline(NamedTuple):
    """The outline of a landmark in a view: cx, cy, exx, exy, eyy [px]."""

    landmark_id: str
    ellipse: NDArray[np.float64]
    distance_m: float


def project(landmarks: Mapping[str, Landmark], camera: Camera,
            map_from_camera: NDArray[np.float64]) -> list[Outline]:
    """Return the outlines of the landmarks in a view, the nearest first."""
    if not landmarks:
        return []
    centers = np.array([one.center for one in landmarks.values()])
    shapes = shape_matrices(np.array([one.semi_axes for one in landmarks.values()]),
                            np.array([one.quat_xyzw for one in landmarks.values()]))
    camera_from_map = invert_transform(map_from_camera)
    ellipses = ellipses_in_pixels(project_ellipsoids(camera_from_map, centers, shapes), camera)
    distances = np.linalg.norm(centers - map_from_camera[:3, 3], axis=1)
    half = np.sqrt(ellipses[:, [2, 4]])
    with np.errstate(invalid='ignore'):
        inside = ((ellipses[:, :2] + half > 0.0).all(axis=1)
                  & (ellipses[:, :2] - half < (camera.width, camera.height)).all(axis=1))
    ids = list(landmarks)
    return sorted((Outline(ids[row], ellipses[row], float(distances[row]))
                   for row in np.nonzero(inside)[0]), key=lambda one: one.distance_m)


def landmark_at(outlines: Sequence[Outline], pixel: Pixel) -> str | None:
    """Return the landmark with the smallest outline around a pixel (2,)."""
    around = []
    for one in outlines:
        cx, cy, exx, exy, eyy = one.ellipse
        x, y = pixel[0] - cx, pixel[1] - cy
        determinant = exx * eyy - exy * exy
        if (eyy * x * x - 2.0 * exy * x * y + exx * y * y) <= determinant:
            around.append((determinant, one.landmark_id))
    return min(around)[1] if around else None


def box_at(boxes_xyxy: NDArray[np.float64], pixel: Pixel) -> int | None:
    """Return the row of the smallest box (n, 4) around a pixel (2,)."""
    x, y = pixel
    left, top, right, bottom = boxes_xyxy.T
    rows = np.nonzero((left <= x) & (x <= right) & (top <= y) & (y <= bottom))[0]
    areas = (right - left) * (bottom - top)
    return int(rows[np.argmin(areas[rows])]) if len(rows) else None


def draw(camera: Camera, image: NDArray[np.uint8] | None, boxes_xyxy: NDArray[np.float64],
         drawn_xyxy: Sequence[float] | None, outlines: Sequence[Outline],
         colors: Mapping[str, tuple[int, int, int]], selection: Sequence[str]
         ) -> NDArray[np.uint8]:
    """Return the picture (h, w, 3) of a view, red first.

    Parameters
    ----------
    camera : Camera
    image : ndarray (h, w, 3), optional
        Without one, the picture is grey.
    boxes_xyxy : ndarray (n, 4)
        Of the detector [px].
    drawn_xyxy : sequence of float, optional
        The box that a person drew [px].
    outlines : sequence of Outline
    colors : mapping
        Of each landmark.
    selection : sequence of str
    """
    picture = np.full((camera.height, camera.width, 3), _BLANK, dtype=np.uint8)
    if image is not None and image.shape == picture.shape:
        picture = image.copy()
    for box in boxes_xyxy:
        _rectangle(picture, box, _DETECTED_RGB, 1)
    # the farthest first, so that the nearest lie on top
    shown = [one for number, one in enumerate(outlines)
             if number < _MAX_OUTLINES or one.landmark_id in selection]
    for one in reversed(shown):
        is_selected = one.landmark_id in selection
        points = outline_points(one.ellipse)
        if np.abs(points).max() < _MAX_PIXEL:
            cv2.polylines(picture, [np.round(points * 2**_SHIFT).astype(np.int32)], True,
                          SELECTED_RGB if is_selected else colors.get(one.landmark_id, (0, 0, 0)),
                          3 if is_selected else 2, cv2.LINE_AA, _SHIFT)
    if drawn_xyxy is not None:
        _rectangle(picture, np.array(drawn_xyxy), DRAWN_RGB, 2)
    return picture


def _rectangle(picture: NDArray[np.uint8], box: NDArray[np.float64], rgb: tuple[int, int, int],
               width: int) -> None:
    left, top, right, bottom = (int(value) for value in np.clip(box, -_MAX_PIXEL, _MAX_PIXEL))
    cv2.rectangle(picture, (left, top), (right, bottom), rgb, width, cv2.LINE_AA)
