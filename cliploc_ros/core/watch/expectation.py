# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The landmarks that an image should show at a pose: near, large, wholly in view and not hidden.

Walls are in no map, so an expected landmark may be hidden. That a landmark is beside one that the
image shows tells that it is not, see mapping.evidence, which judges whole recordings.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.ellipsoid import (
    ellipse_bboxes,
    ellipses_in_pixels,
    project_ellipsoids,
)
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.core.map.landmark_map import LandmarkMap

# A detector finds landmarks up to here [m], with sides from here on [px], of which the image shows
# this share and nearer landmarks hide at most that share. Guesses, on the safe side.
_REACH_M, _LEAST_SIDE_PX, _SHOWN_SHARE, _HIDDEN_SHARE = 6.0, 20.0, 0.75, 0.4
#: Sides of a landmark, equal angles about the vertical.
SIDES = 8
# A landmark beside a shown one is within this angle of its direction, and not much further away.
_BESIDE_COSINE, _BESIDE_SHARE = np.cos(np.radians(20.0)), 0.8


class Expected(NamedTuple):
    """The k landmarks that an image should show, and whether it shows each."""

    landmarks: NDArray[np.int64]  #: (k,): one of each object
    was_seen: NDArray[np.bool_]  #: (k,): whether a detection shows it
    #: (k,): whether a shown landmark beside it or behind it tells that no wall hides it
    in_sight: NDArray[np.bool_]
    sides: NDArray[np.int64]  #: (k,): from which of SIDES sides the camera looks at it


def expect(landmark_map: LandmarkMap, camera: Camera, map_from_camera: NDArray[np.float64],
           shown: NDArray[np.int64]) -> Expected:
    """Return the landmarks that an image should show.

    Parameters
    ----------
    map_from_camera : ndarray (4, 4)
    shown : ndarray (m,) of int
        The landmarks that its detections show.
    """
    near = np.sort(np.array(landmark_map.tree.query_ball_point(map_from_camera[:3, 3], _REACH_M),
                            dtype=np.int64))
    camera_from_map = invert_transform(map_from_camera)
    outlines = project_ellipsoids(camera_from_map, landmark_map.centers[near],
                                  landmark_map.shapes[near])
    in_front = np.isfinite(outlines[:, 0])
    near, boxes = near[in_front], ellipse_bboxes(ellipses_in_pixels(outlines[in_front], camera))
    offsets = landmark_map.centers[near] @ camera_from_map[:3, :3].T + camera_from_map[:3, 3]
    clipped = np.clip(boxes, 0.0, [camera.width, camera.height] * 2)
    sides, full = clipped[:, 2:] - clipped[:, :2], boxes[:, 2:] - boxes[:, :2]
    visible = (sides.min(axis=1, initial=np.inf) >= _LEAST_SIDE_PX) & (
        sides.prod(axis=1) >= _SHOWN_SHARE * full.prod(axis=1))
    visible &= ~_hidden(clipped, offsets[:, 2], landmark_map.semi_axes[near].max(axis=1))
    was_seen = np.isin(landmark_map.objects[near], landmark_map.objects[shown])
    in_sight = _beside(offsets, was_seen)
    rows = np.nonzero(visible)[0]
    rows = rows[np.unique(landmark_map.objects[near[rows]], return_index=True)[1]]
    x, y, _ = (landmark_map.centers[near[rows]] - map_from_camera[:3, 3]).T
    sides = np.floor(SIDES * (np.arctan2(y, x) / (2.0 * np.pi) + 0.5)).astype(np.int64) % SIDES
    return Expected(near[rows], was_seen[rows], in_sight[rows], sides)


def _hidden(boxes: NDArray[np.float64], depths: NDArray[np.float64], radii: NDArray[np.float64]
            ) -> NDArray[np.bool_]:
    """Return which of k boxes (k, 4) one nearer landmark hides in part."""
    shared = (np.minimum(boxes[:, None, 2:], boxes[:, 2:])
              - np.maximum(boxes[:, None, :2], boxes[:, :2])).clip(0.0).prod(axis=2)
    areas = np.maximum((boxes[:, 2:] - boxes[:, :2]).prod(axis=1), 1e-9)
    nearer = depths + radii < depths[:, None]
    return np.asarray((nearer & (shared > _HIDDEN_SHARE * areas[:, None])).any(axis=1))


def _beside(offsets: NDArray[np.float64], was_seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which of k landmarks (k, 3) in the camera are beside a seen one or before it."""
    distances = np.linalg.norm(offsets, axis=1)
    directions = offsets / np.maximum(distances, 1e-9)[:, None]
    beside = (directions @ directions[was_seen].T > _BESIDE_COSINE) & (
        distances[was_seen] > _BESIDE_SHARE * distances[:, None])
    return np.asarray(beside.any(axis=1))
