# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Choose the views that show a landmark best: large, whole, sharp, and from different sides."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry import ellipsoid
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.offline.mapping.posed_detections import PosedDetections

# A box nearer to the edge of its image may be cut off [px].
_MARGIN_PX = 3.0
# Greatest number of views whose sharpness is measured, which needs their images.
_LOOKED_AT = 12
# Least angle between views of different sides [deg].
_LEAST_ANGLE_DEG = 12.0
# Projections cost time: if there are more views, only every n-th one is tried.
_MAX_PROJECTED = 400


class Sighting(NamedTuple):
    """A landmark in a view."""

    view: int
    bbox_xyxy: NDArray[np.float64]  #: (4,) [px]
    is_detected: bool  #: A detected box; otherwise the projected landmark
    is_whole: bool  #: Not cut off by the edge of the image
    size: float  #: Area of the box [px^2], reduced if the image is blurred


def outlines_in_view(detections: PosedDetections, view: int, centers: NDArray[np.float64],
                     shapes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the outlines (n, 5) of ellipsoids in a view [px]; NaN behind the camera."""
    return ellipsoid.ellipses_in_pixels(ellipsoid.project_ellipsoids(
        invert_transform(detections.map_from_camera[view]), centers, shapes),
        detections.camera_of(view))


def crop_around(image: NDArray[np.uint8], box: NDArray[np.float64], margin: float
                ) -> NDArray[np.uint8]:
    """Return the part of an image (h, w, 3) around a box (4,) [px].

    The margin is a multiple of the longer side of the box.
    """
    around = margin * (box[2:] - box[:2]).max()
    height, width = image.shape[:2]
    left, top = np.clip(np.floor(box[:2] - around), 0, (width - 1, height - 1)).astype(int)
    right, bottom = np.clip(np.ceil(box[2:] + around), (left + 1, top + 1), (width, height)
                            ).astype(int)
    return image[top:bottom, left:right]


def find_sightings(detections: PosedDetections, rows: NDArray[np.int64],
                   center: NDArray[np.float64], shape: NDArray[np.float64], limit: int = 6,
                   sharpness: Callable[[Sighting], float] | None = None) -> list[Sighting]:
    """Return the views that show a landmark best, best first.

    Detected boxes come first. If there are fewer than three, views that should show the landmark
    are added.

    Parameters
    ----------
    rows : ndarray (k,) of int
        The boxes that show the landmark.
    center, shape : ndarray (3,), (6,)
        Of the landmark's ellipsoid in the map.
    sharpness : callable, optional
        Returns the share of fine detail in the image around the landmark.
    """
    found = []
    for row in rows:
        view, box = int(detections.frames[row]), detections.bboxes_xyxy[row]
        camera = detections.camera_of(view)
        is_whole = _inset(camera, box) >= _MARGIN_PX and _inset(
            camera, _projection(detections, view, center, shape)) >= 0.0
        found.append(Sighting(view, box, True, is_whole, _area(box)))
    if len(found) < 3:
        known = {sighting.view for sighting in found}
        for view in range(0, len(detections), max(1, -(-len(detections) // _MAX_PROJECTED))):
            box = _projection(detections, view, center, shape)
            if view not in known and _inset(detections.camera_of(view), box) >= _MARGIN_PX:
                found.append(Sighting(view, box, False, True, _area(box)))
    rays = detections.map_from_camera[:, :3, 3] - center
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-9)
    if sharpness is not None and found:
        found = _apart(found, rays, 0.5 * _LEAST_ANGLE_DEG, _LOOKED_AT)
        sharp = np.array([sharpness(sighting) for sighting in found])
        shares = np.minimum(1.0, sharp / max(float(np.median(sharp)), 1e-9))
        found = [sighting._replace(size=sighting.size * share ** 2)
                 for sighting, share in zip(found, shares.tolist(), strict=True)]
    return _apart(found, rays, _LEAST_ANGLE_DEG, limit)


def _projection(detections: PosedDetections, view: int, center: NDArray[np.float64],
                shape: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the box (4,) around an ellipsoid in a view [px]; NaN behind the camera."""
    return np.asarray(ellipsoid.ellipse_bboxes(
        outlines_in_view(detections, view, center[None], shape[None]))[0])


def _inset(camera: Camera, box: NDArray[np.float64]) -> float:
    """Return the distance of a box (4,) to the image border [px]; negative if it is cut off."""
    return float(np.min([*box[:2], camera.width - box[2], camera.height - box[3]]))


def _area(box: NDArray[np.float64]) -> float:
    return float((box[2:] - box[:2]).prod())


def _apart(sightings: list[Sighting], rays: NDArray[np.float64], least_deg: float, limit: int
           ) -> list[Sighting]:
    """Return the best sightings, first those that are far enough apart, then the others."""
    kept: list[Sighting] = []
    near: list[Sighting] = []
    limit_cos = np.cos(np.radians(least_deg))
    for sighting in sorted(sightings, key=lambda sighting: (
            not sighting.is_whole, not sighting.is_detected, -sighting.size)):
        is_near = any(rays[sighting.view] @ rays[other.view] > limit_cos for other in kept)
        (near if is_near else kept).append(sighting)
    return (kept + near)[:limit]
