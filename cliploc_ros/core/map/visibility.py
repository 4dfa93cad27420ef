# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Find the landmarks that an image should show at a pose.

An image should show the landmarks that are near, large, entirely in view and not occluded. Maps
contain no walls, so a wall may hide an expected landmark. If the image shows a landmark beside it,
it is not hidden. cliploc_ros.offline.mapping.evidence and simulated detectors use these criteria
with other limits, for whole recordings and for single detections.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry import ellipsoid
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.core.map.landmark_map import LandmarkMap

#: A detector finds a landmark only if the image shows this share of its box.
SHOWN_SHARE = 0.6
#: A landmark is out of view if nearer landmarks hide more than this share of it. Chosen.
HIDDEN_SHARE = 0.4
# A detector is expected to find landmarks within this distance [m] whose boxes have at least these
# sides [px] and are visible to at least this share. Conservative guesses.
_REACH_M, _LEAST_SIDE_PX, _SURE_SHARE = 6.0, 20.0, 0.75
# A landmark is beside a place if the angle between their directions is smaller than this, and in
# front of it if its distance is less than this share of the place's distance. Chosen.
_BESIDE_COSINE, _BESIDE_SHARE = np.cos(np.radians(20.0)), 0.8
#: Number of sides of a landmark, sectors of equal angle about the vertical.
SIDES = 8


def is_in_image(box: NDArray[np.float64], bounds: NDArray[np.float64], least_share: float
                ) -> NDArray[np.bool_]:
    """Check whether an image shows more than a share of a box (4,), or of each of n boxes (4, n).

    The box and the image's bounds (4,) are left, top, right, bottom.
    """
    width = np.minimum(box[2], bounds[2]) - np.maximum(box[0], bounds[0])
    height = np.minimum(box[3], bounds[3]) - np.maximum(box[1], bounds[1])
    return (width > 0.0) & (height > 0.0) & (
        width * height > least_share * (box[2] - box[0]) * (box[3] - box[1]))


def is_beside(cosine: NDArray[np.float64], distance: NDArray[np.float64],
              of_place: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Check whether a visible landmark shows that no wall hides a place.

    The landmark must be beside the place or behind it. The arguments are the cosine of the angle
    between their directions, the landmark's distance, and the place's distance.
    """
    return (cosine > _BESIDE_COSINE) & (distance >= _BESIDE_SHARE * of_place)


class InImage(NamedTuple):
    """The boxes of n ellipsoids in an image [px]."""

    boxes: NDArray[np.float64]  #: (n, 4): NaN if not entirely in front of the camera
    shown: NDArray[np.float64]  #: (n, 4): the part within the image
    is_shown: NDArray[np.bool_]  #: (n,): whether that part is large enough


def boxes_in_image(camera: Camera, camera_from_map: NDArray[np.float64],
                   centers: NDArray[np.float64], shapes: NDArray[np.float64], least_share: float,
                   least_side_px: float) -> InImage:
    """Project ellipsoids (n, 3), (n, 6) to boxes in an image."""
    boxes = ellipsoid.ellipse_bboxes(ellipsoid.ellipses_in_pixels(
        ellipsoid.project_ellipsoids(camera_from_map, centers, shapes), camera))
    bounds = np.array([0.0, 0.0, camera.width, camera.height])
    shown = np.clip(boxes, 0.0, np.tile(bounds[2:], 2))
    return InImage(boxes, shown, is_in_image(boxes.T, bounds, least_share) & (
        (shown[:, 2:] - shown[:, :2]).min(axis=1) >= least_side_px))


def is_hidden(boxes: NDArray[np.float64], is_nearer: NDArray[np.bool_], most: float
              ) -> NDArray[np.bool_]:
    """Return a mask (n,) of hidden boxes (n, 4): a nearer box covers more than a share of them.

    Row i of is_nearer (n, n) marks the boxes that are nearer than box i.
    """
    areas = (boxes[:, 2:] - boxes[:, :2]).prod(axis=1)
    covers = ellipsoid.shared_areas(boxes, boxes) > most * areas[:, None]
    return np.asarray((is_nearer & covers).any(axis=1))


class Expected(NamedTuple):
    """The k landmarks that an image should show, and whether it shows them."""

    landmarks: NDArray[np.int64]  #: (k,): one landmark of each object
    was_seen: NDArray[np.bool_]  #: (k,): whether a detection shows it
    #: (k,): whether a visible landmark beside or behind it shows that no wall hides it
    in_sight: NDArray[np.bool_]
    sides: NDArray[np.int64]  #: (k,): side of the landmark that the camera sees, 0 to SIDES - 1


def expect(landmark_map: LandmarkMap, camera: Camera, map_from_camera: NDArray[np.float64],
           shown: NDArray[np.int64]) -> Expected:
    """Find the landmarks that an image should show.

    Parameters
    ----------
    map_from_camera : ndarray (4, 4)
    shown : ndarray (m,) of int
        The landmarks that match its detections.
    """
    near = np.sort(np.array(landmark_map.tree.query_ball_point(map_from_camera[:3, 3], _REACH_M),
                            dtype=np.int64))
    camera_from_map = invert_transform(map_from_camera)
    found = boxes_in_image(camera, camera_from_map, landmark_map.centers[near],
                           landmark_map.shapes[near], _SURE_SHARE, _LEAST_SIDE_PX)
    in_front = np.isfinite(found.boxes[:, 0])
    near, boxes, is_shown = near[in_front], found.shown[in_front], found.is_shown[in_front]
    offsets = landmark_map.centers[near] @ camera_from_map[:3, :3].T + camera_from_map[:3, 3]
    depths = offsets[:, 2]
    nearer = depths + landmark_map.semi_axes[near].max(axis=1) < depths[:, None]
    visible = is_shown & ~is_hidden(boxes, nearer, HIDDEN_SHARE)
    was_seen = np.isin(landmark_map.objects[near], landmark_map.objects[shown])
    distances = np.linalg.norm(offsets, axis=1)
    directions = offsets / np.maximum(distances, 1e-9)[:, None]
    in_sight = is_beside(directions @ directions[was_seen].T, distances[was_seen],
                         distances[:, None]).any(axis=1)
    rows = np.nonzero(visible)[0]
    rows = rows[np.unique(landmark_map.objects[near[rows]], return_index=True)[1]]
    x, y, _ = (landmark_map.centers[near[rows]] - map_from_camera[:3, 3]).T
    sides = np.floor(SIDES * (np.arctan2(y, x) / (2.0 * np.pi) + 0.5)).astype(np.int64) % SIDES
    return Expected(near[rows], was_seen[rows], in_sight[rows], sides)
