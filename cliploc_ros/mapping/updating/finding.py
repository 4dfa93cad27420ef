# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Objects of the recording that no old landmark explains."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.mapping.building import NothingFoundError, build_map
from cliploc_ros.mapping.landmarks import (
    Landmarks,
    group_boxes,
    join_landmarks,
    landmarks_of_map,
    no_landmarks,
)
from cliploc_ros.mapping.merging import normalized_distance, seen_apart
from cliploc_ros.mapping.options import MappingOptions
from cliploc_ros.mapping.posed_detections import PosedDetections
from cliploc_ros.mapping.report import LeftOut
from cliploc_ros.mapping.updating.options import UpdateOptions
from cliploc_ros.mapping.views import Views, map_from_cameras


class Finds(NamedTuple):
    """New landmarks: m of them."""

    landmarks: Landmarks
    details: tuple[LandmarkDetails, ...]
    #: (n,): the new landmark that each box of the recording shows, -1 for none
    shown: NDArray[np.int64]
    left_out: tuple[LeftOut, ...]  #: What is not good enough for a map

    def select(self, rows: NDArray[np.int64]) -> 'Finds':
        """Return some of the new landmarks."""
        numbers = np.full(len(self.details) + 1, -1, dtype=np.int64)
        numbers[rows] = np.arange(len(rows))
        return Finds(self.landmarks.select(rows), tuple(self.details[row] for row in rows),
                     numbers[self.shown], self.left_out)


def find_new(detections: PosedDetections, views: Views, is_free: NDArray[np.bool_],
             options: MappingOptions) -> Finds:
    """Return the landmarks that the free boxes show.

    Parameters
    ----------
    views : Views
        With the poses to map with.
    is_free : ndarray (n,) of bool
        Boxes that no old landmark explains.
    options : MappingOptions
        Poses are not refined again.
    """
    shown = np.full(len(is_free), -1, dtype=np.int64)
    nothing = Finds(no_landmarks(), (), shown, ())
    if not is_free.any():
        return nothing
    posed = detections.with_poses(map_from_cameras(views)).select_boxes(is_free)
    try:
        built = build_map(posed, replace(options, pose_errors=None, estimate_pose_errors=False,
                                         refine_mount=False))
    except NothingFoundError:
        return nothing
    shown[is_free] = built.shown
    return Finds(landmarks_of_map(built.landmark_map, detections.class_names),
                 built.landmark_map.details, shown, built.report.left_out)


def without_copies(views: Views, finds: Finds, old: Landmarks, old_shown: NDArray[np.int64],
                   majority: float, options: UpdateOptions) -> Finds:
    """Return the new landmarks without those that are an old one in its place.

    Of two landmarks that lie in one another, the boxes are those of one object: parts of it, or
    another name for it. If they only touch, frames that show both tell them apart.

    Parameters
    ----------
    old : Landmarks
        Those with boxes are in their place.
    old_shown : ndarray (n,) of int
        The old landmark that each box shows, -1 for none.
    majority : float
        An old landmark is in its place if it has a box, and so many for each of the new one's.
    """
    rows_of_old = group_boxes(old_shown, len(old.centers))
    rows_of_new = group_boxes(finds.shown, len(finds.details))
    copies = set()
    for new, row, distance in close_pairs(finds.landmarks, old, options.mapping.merge_distance):
        is_one_class = old.classes[row] == finds.landmarks.classes[new]
        if len(rows_of_old[row]) >= max(1.0, majority * len(rows_of_new[new])) and (
                (is_one_class and distance < options.least_move_shapes)
                or seen_apart(views, rows_of_old[row], rows_of_new[new])
                <= options.mapping.max_seen_apart):
            copies.add(new)
    return finds.select(np.array([new for new in range(len(finds.details)) if new not in copies],
                                 dtype=np.int64))


def is_taken(finds: Finds, old: Landmarks, old_shown: NDArray[np.int64], max_distance: float
             ) -> NDArray[np.bool_]:
    """Tell which old landmarks (L,) have a new one with more boxes in their place."""
    rows_of_old = group_boxes(old_shown, len(old.centers))
    rows_of_new = group_boxes(finds.shown, len(finds.details))
    taken = np.zeros(len(old.centers), dtype=np.bool_)
    for new, row, _ in close_pairs(finds.landmarks, old, max_distance):
        taken[row] |= len(rows_of_new[new]) > len(rows_of_old[row])
    return taken


def close_pairs(new: Landmarks, old: Landmarks, max_distance: float
                ) -> list[tuple[int, int, float]]:
    """Return pairs of a new and an old landmark nearer than a normalized distance, with it."""
    if len(new.centers) == 0 or len(old.centers) == 0:
        return []
    both = join_landmarks(new, old)
    reach = np.linalg.norm(both.bases, axis=(1, 2))
    tree, first_old = cKDTree(old.centers), len(new.centers)
    found = []
    for row in range(first_old):
        largest = max_distance * (reach[row] + float(reach[first_old:].max()))
        for other in tree.query_ball_point(new.centers[row], largest):
            distance = normalized_distance(both, row, first_old + other)
            if distance < max_distance:
                found.append((row, int(other), distance))
    return found
