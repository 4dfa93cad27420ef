# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where landmarks lie in views, and the views that show one best.

These are large, whole, sharp, and from different sides.
"""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.ellipsoid import (
    ellipse_bboxes,
    ellipses_in_pixels,
    project_ellipsoids,
    shape_matrices,
)
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.offline.datasets.images import Images
from cliploc_ros.offline.studio.landmark import Landmarks
from cliploc_ros.offline.studio.recording import Recording

# A box nearer to the edge of its image may be cut off [px].
_MARGIN_PX = 3.0
# Images that are read for a landmark, at most: sharpness needs them.
_LOOKED_AT = 12
# Sides that differ [deg], and what is looked at around a box, as a share of its size.
_LEAST_ANGLE_DEG, MARGIN = 12.0, 0.25
# Projections cost time: every n-th view of more than these is tried.
_MAX_PROJECTED = 400


class Outline(NamedTuple):
    """The outline of a landmark in a view."""

    landmark_id: str
    ellipse: NDArray[np.float64]  #: cx, cy, exx, exy, eyy [px]
    bbox_xyxy: NDArray[np.float64]  #: (4,) [px]
    distance_m: float


def outlines_of(landmarks: Landmarks, camera: Camera, map_from_camera: NDArray[np.float64]
                ) -> list[Outline]:
    """Return the outlines of the landmarks in a view, the nearest first."""
    if not landmarks:
        return []
    centers = np.array([one.center for one in landmarks.values()])
    shapes = shape_matrices(np.array([one.semi_axes for one in landmarks.values()]),
                            np.array([one.quat_xyzw for one in landmarks.values()]))
    ellipses = ellipses_in_pixels(project_ellipsoids(
        invert_transform(map_from_camera), centers, shapes), camera)
    boxes = ellipse_bboxes(ellipses)
    distances = np.linalg.norm(centers - map_from_camera[:3, 3], axis=1)
    with np.errstate(invalid='ignore'):
        inside = (boxes[:, 2:] > 0.0).all(axis=1) & (
            boxes[:, :2] < (camera.width, camera.height)).all(axis=1)
    ids = list(landmarks)
    return sorted((Outline(ids[row], ellipses[row], boxes[row], float(distances[row]))
                   for row in np.nonzero(inside)[0]), key=lambda one: one.distance_m)


class Sighting(NamedTuple):
    """A landmark in a view."""

    view: int
    bbox_xyxy: NDArray[np.float64]  #: (4,) [px]
    is_detected: bool  #: A box of the detector; else the landmark's projection
    is_whole: bool  #: Not cut off by the edge of the image
    size: float  #: Area of the box [px^2], less where the image is blurred


def find_sightings(recording: Recording, images: Images | None, landmarks: Landmarks,
                   landmark_id: str, limit: int = 6) -> list[Sighting]:
    """Return the views that show a landmark best, the best one first.

    The detector's boxes come first. Without three of them, views that should show it join.

    CliplocError: an image cannot be read.
    """
    detections, only = recording.detections, {'': landmarks[landmark_id]}
    found = []
    for row in recording.boxes_of(landmarks)[landmark_id]:
        view, box = int(detections.frames[row]), detections.bboxes_xyxy[row]
        shown = outlines_of(only, detections.camera_of(view), detections.map_from_camera[view])
        is_whole = bool(shown) and _inset(detections.camera_of(view), box) >= _MARGIN_PX and (
            _inset(detections.camera_of(view), shown[0].bbox_xyxy) >= 0.0)
        found.append(Sighting(view, box, True, is_whole, _area(box)))
    if len(found) < 3:
        known = {one.view for one in found}
        for view in range(0, len(detections), max(1, -(-len(detections) // _MAX_PROJECTED))):
            found += [Sighting(view, one.bbox_xyxy, False, True, _area(one.bbox_xyxy))
                      for one in outlines_of(only, detections.camera_of(view),
                                             detections.map_from_camera[view])
                      if view not in known
                      and _inset(detections.camera_of(view), one.bbox_xyxy) >= _MARGIN_PX]
    rays = detections.map_from_camera[:, :3, 3] - landmarks[landmark_id].center
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-9)
    found = _apart(found, rays, 0.5 * _LEAST_ANGLE_DEG, _LOOKED_AT)
    if images is not None and found:
        sharp = np.array([_sharpness(recording, images, one) for one in found])
        shares = np.minimum(1.0, sharp / max(float(np.median(sharp)), 1e-9))
        found = [one._replace(size=one.size * share ** 2)
                 for one, share in zip(found, shares.tolist(), strict=True)]
    return _apart(found, rays, _LEAST_ANGLE_DEG, limit)


def _inset(camera: Camera, box: NDArray[np.float64]) -> float:
    """Return how far a box (4,) lies within the image [px]; below 0 where it is cut off."""
    return float(min(*box[:2], camera.width - box[2], camera.height - box[3]))


def _area(box: NDArray[np.float64]) -> float:
    return float((box[2:] - box[:2]).prod())


def _apart(sightings: list[Sighting], rays: NDArray[np.float64], least_deg: float, limit: int
           ) -> list[Sighting]:
    """Return the best ones that lie apart from one another, filled up with the others."""
    kept: list[Sighting] = []
    near: list[Sighting] = []
    limit_cos = np.cos(np.radians(least_deg))
    for one in sorted(sightings, key=lambda one: (
            not one.is_whole, not one.is_detected, -one.size)):
        is_near = any(rays[one.view] @ rays[other.view] > limit_cos for other in kept)
        (near if is_near else kept).append(one)
    return (kept + near)[:limit]


def _sharpness(recording: Recording, images: Images, one: Sighting) -> float:
    """Return the share of fine detail in what the view shows around the landmark."""
    crop = crop_of(recording, images, one.view, one.bbox_xyxy)
    if crop is None:
        return 0.0
    grey = cv2.cvtColor(crop, cv2.COLOR_RGB2GRAY)
    return float(cv2.Laplacian(grey, cv2.CV_64F).var() / max(1.0, float(grey.var())))


def crop_of(recording: Recording, images: Images, view: int, box: NDArray[np.float64]
            ) -> NDArray[np.uint8] | None:
    """Return what a box (4,) [px] and a margin around it show; None without the image."""
    image = images.of(recording.detections, view)
    if image is None:
        return None
    around = MARGIN * (box[2:] - box[:2]).max()
    height, width = image.shape[:2]
    left, top = np.clip(np.floor(box[:2] - around), 0, (width - 1, height - 1)).astype(int)
    right, bottom = np.clip(np.ceil(box[2:] + around), (left + 1, top + 1), (width, height)
                            ).astype(int)
    return image[top:bottom, left:right]
