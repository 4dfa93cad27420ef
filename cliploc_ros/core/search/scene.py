# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One frame and the map, as the compiled search and verification read them."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.map.culling import Groups, SortedLandmarks, make_groups, no_landmarks


class Potential(NamedTuple):
    """Landmarks that single detections may show: u landmarks, p pairs."""

    landmarks: NDArray[np.int64]  #: (u,): rows in the map, each once
    #: (u + 1,): where the detections of each landmark begin in detections
    starts: NDArray[np.int64]
    detections: NDArray[np.int64]  #: (p,): the detections that may show each landmark


class Scene(NamedTuple):
    """One frame and the map: n detections, L landmarks, c candidates."""

    #: (n, 4): centre x, y and semi-axes x, y of the ellipse inscribed in each box, on the plane z
    #: = 1
    box_ellipses: NDArray[np.float64]
    bearings: NDArray[np.float64]  #: (n, 3): unit vectors through the box centres
    #: (L, 3), (L, 6): of the landmarks, see cliploc_ros.core.geometry.ellipsoid
    centers: NDArray[np.float64]
    shapes: NDArray[np.float64]
    potential: Potential  #: Landmarks that single detections may show
    #: (c, 2): detection and landmark of each correspondence candidate, in order of preference
    pairs: NDArray[np.int64]
    iou_threshold: float  #: A detection and a landmark match only if their IoU is above this
    #: Of a large map, the landmarks that detections may show because of their class. In a small
    #: map both are empty, and these pairs are in potential.
    sorted_landmarks: SortedLandmarks
    groups: Groups


def make_scene(bboxes: NDArray[np.float64], centers: NDArray[np.float64],
               shapes: NDArray[np.float64], potential: NDArray[np.bool_] | NDArray[np.int64],
               pairs: NDArray[np.int64], iou_threshold: float,
               sorted_landmarks: SortedLandmarks | None = None,
               classes: NDArray[np.int64] | None = None) -> Scene:
    """Return the scene of one frame.

    Parameters
    ----------
    bboxes : ndarray (n, 4)
        Boxes x, y, x, y on the plane z = 1 (undistorted).
    centers, shapes : ndarray (L, 3), (L, 6)
        Of the landmarks.
    potential : ndarray (n, L) of bool, or (p, 2) of int
        Which landmarks each detection may show: a mask, or pairs of detection and landmark.
    pairs : ndarray (c, 2)
        Correspondence candidates, in order of preference.
    iou_threshold : float
        0 to 1.
    sorted_landmarks : SortedLandmarks, optional
        The map's. Each detection may also show every landmark of its class.
    classes : ndarray (n,) of int, optional
        Class of each detection, as the sorted landmarks have them; below 0 for none.
    """
    middle, half = (bboxes[:, :2] + bboxes[:, 2:]) / 2, (bboxes[:, 2:] - bboxes[:, :2]) / 2
    bearings = np.concatenate([middle, np.ones((len(bboxes), 1))], axis=1)
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    boxes = np.ascontiguousarray(np.concatenate([middle, half], axis=1))
    single = np.argwhere(potential) if potential.dtype == np.bool_ else potential.astype(np.int64)
    single = single[np.lexsort(single.T)]
    shown, starts = np.unique(single[:, 1], return_index=True)
    if sorted_landmarks is None or classes is None:
        sorted_landmarks, classes = no_landmarks(), np.full(len(boxes), -1, dtype=np.int64)
    by_landmark = Potential(shown, np.append(starts, len(single)),
                            np.ascontiguousarray(single[:, 0]))
    return Scene(boxes, bearings, np.ascontiguousarray(centers), np.ascontiguousarray(shapes),
                 by_landmark, np.ascontiguousarray(pairs), float(iou_threshold),
                 sorted_landmarks, make_groups(sorted_landmarks, classes, boxes, iou_threshold))
