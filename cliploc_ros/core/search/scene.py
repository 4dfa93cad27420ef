# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Input of the compiled search: one frame, the map, and the constraints on the camera."""

from math import atan2, cos, hypot, inf, pi, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.map.culling import NO_LANDMARKS, Groups, SortedLandmarks, make_groups

#: A vertical (7,) consists of the up direction in the camera (3,) and in the map (3,), unit
#: vectors, and the standard deviation of the angle between them [rad]. Zeros: unknown.
VERTICAL_UNKNOWN = np.zeros(7)


class Potential(NamedTuple):
    """Pairs of a detection and a landmark that it may show: u landmarks, p pairs."""

    landmarks: NDArray[np.int64]  #: (u,): rows in the map, without repetitions
    #: (u + 1,): index in `detections` of the first detection of each landmark
    starts: NDArray[np.int64]
    detections: NDArray[np.int64]  #: (p,): detections that may show each landmark


class Scene(NamedTuple):
    """One frame and the map: n detections, L landmarks, c candidates."""

    #: (n, 4): centre x, y and semi-axes x, y of the ellipse inscribed in each box, on the plane z
    #: = 1
    box_ellipses: NDArray[np.float64]
    bearings: NDArray[np.float64]  #: (n, 3): unit vectors through the box centres
    #: (n, 2): depth of the object in each box and its standard deviation [m]; 0, 0 if unknown
    depths: NDArray[np.float64]
    #: (L, 3), (L, 6): centres and shapes of the landmarks, see cliploc_ros.core.geometry.ellipsoid
    centers: NDArray[np.float64]
    shapes: NDArray[np.float64]
    potential: Potential  #: Pairs of single detections and landmarks to verify
    #: (c, 2): detection and landmark of each correspondence candidate, in order of preference
    pairs: NDArray[np.int64]
    iou_threshold: float  #: A detection and a landmark match only if their IoU exceeds this
    #: Large map: the landmarks of the detected classes. Small map: both are empty, and `potential`
    #: contains these pairs.
    sorted_landmarks: SortedLandmarks
    groups: Groups


def make_scene(bboxes: NDArray[np.float64], centers: NDArray[np.float64],
               shapes: NDArray[np.float64], potential: NDArray[np.bool_] | NDArray[np.int64],
               pairs: NDArray[np.int64], iou_threshold: float,
               sorted_landmarks: SortedLandmarks | None = None,
               classes: NDArray[np.int64] | None = None,
               depths: NDArray[np.float64] | None = None) -> Scene:
    """Build the scene of one frame.

    Parameters
    ----------
    bboxes : ndarray (n, 4)
        Boxes x, y, x, y on the plane z = 1 (undistorted).
    centers, shapes : ndarray (L, 3), (L, 6)
        Centres and shapes of the landmarks.
    potential : ndarray (n, L) of bool, or (p, 2) of int
        The landmarks that each detection may show: a mask, or pairs of detection and landmark.
    pairs : ndarray (c, 2)
        Correspondence candidates, in order of preference.
    iou_threshold : float
        0 to 1.
    sorted_landmarks : SortedLandmarks, optional
        The landmarks of the map: each detection may also show every landmark of its class.
    classes : ndarray (n,) of int, optional
        Class of each detection, as numbered in sorted_landmarks; negative: no class of the map.
    depths : ndarray (n, 2), optional
        See Scene.
    """
    middle, half = (bboxes[:, :2] + bboxes[:, 2:]) / 2, (bboxes[:, 2:] - bboxes[:, :2]) / 2
    bearings = np.concatenate([middle, np.ones((len(bboxes), 1))], axis=1)
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    boxes = np.ascontiguousarray(np.concatenate([middle, half], axis=1))
    single = np.argwhere(potential) if potential.dtype == np.bool_ else potential.astype(np.int64)
    single = single[np.lexsort(single.T)]
    shown, starts = np.unique(single[:, 1], return_index=True)
    if sorted_landmarks is None or classes is None:
        sorted_landmarks, classes = NO_LANDMARKS, np.full(len(boxes), -1, dtype=np.int64)
    by_landmark = Potential(shown, np.append(starts, len(single)),
                            np.ascontiguousarray(single[:, 0]))
    if depths is None:
        depths = np.zeros((len(boxes), 2))
    return Scene(boxes, bearings, depths, np.ascontiguousarray(centers),
                 np.ascontiguousarray(shapes), by_landmark, np.ascontiguousarray(pairs),
                 float(iou_threshold), sorted_landmarks,
                 make_groups(sorted_landmarks, classes, boxes, iou_threshold))


class Constraint(NamedTuple):
    """Vertical and height of the camera. Poses that contradict them are rejected.

    Default: both unknown. A prior of the robot's position rejects no poses, see
    cliploc_ros.core.acceptance.confidence.
    """

    #: The up direction, unit vectors in the camera's optical frame and in the map frame
    up_in_camera: tuple[float, float, float] = (0.0, -1.0, 0.0)
    up_in_map: tuple[float, float, float] = (0.0, 0.0, 1.0)
    #: Limits of the camera's centre along up_in_map, from the map's origin [m]
    min_height: float = -inf
    max_height: float = inf
    #: Maximum angle between the two verticals at a pose from three points [rad]. At poses from
    #: two points they are equal by construction.
    max_tilt: float = pi
    #: Standard deviation of the angle between the two verticals [rad]; inf: only max_tilt applies
    vertical_deviation: float = inf

    def as_array(self) -> NDArray[np.float64]:
        """Return up in camera and map, height range, and minimum cosine of the tilt (9,)."""
        least_cosine = cos(self.max_tilt) if self.max_tilt < pi else -inf
        return np.array([*self.up_in_camera, *self.up_in_map, self.min_height, self.max_height,
                         least_cosine])

    def allows(self, map_from_camera: NDArray[np.float64]) -> bool:
        """Check whether the height range and max_tilt allow a pose (4, 4)."""
        up = map_from_camera[:3, :3] @ self.up_in_camera
        return self.outside_m(map_from_camera) is None and (
            self.max_tilt >= pi or float(up @ self.up_in_map) >= cos(self.max_tilt))

    def outside_m(self, map_from_camera: NDArray[np.float64]) -> float | None:
        """Return the height of a pose (4, 4) that is outside the height range [m]; else None."""
        height = float(np.dot(self.up_in_map, map_from_camera[:3, 3]))
        return None if self.min_height <= height <= self.max_height else height

    def tilt_error(self, map_from_camera: NDArray[np.float64], covariance: NDArray[np.float64]
                   ) -> float:
        """Return the angle between the two verticals at a pose (4, 4), in standard deviations.

        The standard deviation combines the vertical's with that of the pose, whose covariance is
        (6, 6). If the vertical is correct, one correct pose in 1,000 exceeds 3.7. An unknown
        vertical gives 0.
        """
        up = map_from_camera[:3, :3] @ self.up_in_camera
        axis = np.cross(up, self.up_in_map)
        sine = float(np.linalg.norm(axis))
        axis /= max(sine, 1e-12)
        deviation = hypot(self.vertical_deviation, sqrt(axis @ covariance[3:, 3:] @ axis))
        return atan2(sine, float(up @ self.up_in_map)) / deviation
