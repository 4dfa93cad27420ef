# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How well a pose explains the detections: overlap of projected ellipsoids with the boxes.

Matsuzaki et al. 2024, Sec. III-D2: of the poses that P3P finds, the one whose three sampled
landmarks overlap their boxes most. Every detection then takes the potential landmark that overlaps
it most, if by more than a threshold; the score is the sum of these IoUs.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.association.culling import (
    Groups,
    SortedLandmarks,
    make_groups,
    no_landmarks,
    visible_members,
)
from cliploc_ros.core.compiled import compiled
from cliploc_ros.core.geometry.ellipse import ellipse_iou
from cliploc_ros.core.geometry.ellipsoid import project_ellipsoid
from cliploc_ros.core.geometry.p3p import MAX_SOLUTIONS, p3p


class Scene(NamedTuple):
    """One frame and the map, as the compiled search reads them: n detections, L landmarks.

    Parameters
    ----------
    box_ellipses : ndarray (n, 4)
        Centre x, y and semi-axes x, y of the ellipse inscribed in each box, on the plane z = 1.
    bearings : ndarray (n, 3)
        Unit vectors through the box centres.
    centers, shapes : ndarray (L, 3), (L, 6)
        Of the landmarks, see cliploc_ros.core.geometry.ellipsoid.
    potential_landmarks : ndarray (u,)
        Landmarks that any detection may show, beside those of the groups, each once.
    potential_starts : ndarray (u + 1,)
        Where each one's detections begin in potential_detections.
    potential_detections : ndarray (v,)
        The detections that may show it.
    pairs : ndarray (c, 2)
        Detection and landmark of each correspondence candidate, in order of preference.
    iou_threshold : float
        A detection whose best IoU is not above it has no landmark.
    nearby, groups : SortedLandmarks, Groups
        Of a large map the landmarks that detections may show by their class.
    """

    box_ellipses: NDArray[np.float64]
    bearings: NDArray[np.float64]
    centers: NDArray[np.float64]
    shapes: NDArray[np.float64]
    potential_landmarks: NDArray[np.int64]
    potential_starts: NDArray[np.int64]
    potential_detections: NDArray[np.int64]
    pairs: NDArray[np.int64]
    iou_threshold: float
    nearby: SortedLandmarks
    groups: Groups


class Workspace(NamedTuple):
    """Memory that one thread's hypotheses use again and again."""

    sample_bearings: NDArray[np.float64]
    sample_points: NDArray[np.float64]
    rotations: NDArray[np.float64]
    translations: NDArray[np.float64]
    ious: NDArray[np.float64]
    landmarks: NDArray[np.int64]

    @staticmethod
    def allocate(detection_count: int) -> 'Workspace':
        """Return the memory for frames of so many detections."""
        return Workspace(np.empty((3, 3)), np.empty((3, 3)), np.empty((MAX_SOLUTIONS, 3, 3)),
                         np.empty((MAX_SOLUTIONS, 3)), np.empty(detection_count),
                         np.empty(detection_count, dtype=np.int64))


def make_scene(bboxes: NDArray[np.float64], centers: NDArray[np.float64],
               shapes: NDArray[np.float64], potential: NDArray[np.bool_] | NDArray[np.int64],
               pairs: NDArray[np.int64], iou_threshold: float,
               nearby: SortedLandmarks | None = None,
               classes: NDArray[np.int64] | None = None) -> Scene:
    """Return the scene of one frame.

    Parameters
    ----------
    bboxes : ndarray (n, 4)
        Boxes x, y, x, y on the plane z = 1 (undistorted).
    centers, shapes : ndarray (L, 3), (L, 6)
        Of the landmarks.
    potential : ndarray (n, L) of bool, or (p, 2) of int
        Which landmark each detection may show: a mask, or pairs of detection and landmark.
    pairs : ndarray (c, 2)
        Correspondence candidates, in order of preference.
    iou_threshold : float
        0 to 1.
    nearby : SortedLandmarks, optional
        The map's, with classes: a detection may show every landmark of its class as well.
    classes : ndarray (n,) of int, optional
        Of each detection, as the sorted landmarks have them; below 0 for none.
    """
    middle, half = (bboxes[:, :2] + bboxes[:, 2:]) / 2, (bboxes[:, 2:] - bboxes[:, :2]) / 2
    bearings = np.concatenate([middle, np.ones((len(bboxes), 1))], axis=1)
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    boxes = np.ascontiguousarray(np.concatenate([middle, half], axis=1))
    single = np.argwhere(potential) if potential.dtype == np.bool_ else potential
    single = single[np.lexsort(single.T)].astype(np.int64)  # by landmark
    unique, starts = np.unique(single[:, 1], return_index=True)
    if nearby is None or classes is None:
        nearby, classes = no_landmarks(), np.full(len(boxes), -1, dtype=np.int64)
    return Scene(boxes, bearings, np.ascontiguousarray(centers), np.ascontiguousarray(shapes),
                 unique, np.append(starts, len(single)), np.ascontiguousarray(single[:, 0]),
                 np.ascontiguousarray(pairs), float(iou_threshold), nearby,
                 make_groups(nearby, classes, boxes, iou_threshold))


@compiled
def sampled_iou(scene, pair, rotation, translation):
    """Return the IoU of one candidate pair at a pose; NaN if it is not wholly in front."""
    box, landmark = scene.box_ellipses[scene.pairs[pair, 0]], scene.pairs[pair, 1]
    visible, cx, cy, exx, exy, eyy = project_ellipsoid(
        rotation, translation, scene.centers[landmark], scene.shapes[landmark])
    if not visible:
        return np.nan
    return ellipse_iou(box[0], box[1], box[2], box[3], cx, cy, exx, exy, eyy)


@compiled
def sample_pose(scene, sample, workspace):
    """Return which P3P solution of a minimal sample to verify, and the sum of its own IoUs.

    It is the one with the greatest sum of IoUs over the sampled pairs, among those for which all
    three ellipsoids lie wholly in front of the camera; an index into the workspace's rotations
    and translations; -1 if there is none.
    """
    for row in range(3):
        detection, landmark = scene.pairs[sample[row], 0], scene.pairs[sample[row], 1]
        for axis in range(3):
            workspace.sample_bearings[row, axis] = scene.bearings[detection, axis]
            workspace.sample_points[row, axis] = scene.centers[landmark, axis]
    count = p3p(workspace.sample_bearings, workspace.sample_points, workspace.rotations,
                workspace.translations)
    best, best_total = -1, -1.0
    for solution in range(count):
        rotation, translation = workspace.rotations[solution], workspace.translations[solution]
        total = (sampled_iou(scene, sample[0], rotation, translation)
                 + sampled_iou(scene, sample[1], rotation, translation)
                 + sampled_iou(scene, sample[2], rotation, translation))
        if total > best_total:  # never true of NaN
            best, best_total = solution, total
    return best, best_total


@compiled
def verify(scene, rotation, translation, workspace):
    """Return the score of a pose, and leave each detection's IoU and landmark behind.

    In the workspace, ious is 0 and landmarks -1 where a detection has no landmark. Sampled
    detections choose like all others.
    """
    ious, landmarks = workspace.ious, workspace.landmarks
    ious[:] = scene.iou_threshold
    landmarks[:] = -1
    for u in range(scene.potential_landmarks.shape[0]):
        landmark = scene.potential_landmarks[u]
        _compare(scene.box_ellipses, scene.potential_detections, scene.potential_starts[u],
                 scene.potential_starts[u + 1], rotation, translation, scene.centers[landmark],
                 scene.shapes[landmark], landmark, ious, landmarks)
    if scene.groups.reaches.shape[0] > 0:
        _verify_groups(scene, rotation, translation, ious, landmarks)
    score = 0.0
    for detection in range(ious.shape[0]):
        if landmarks[detection] < 0:
            ious[detection] = 0.0
        score += ious[detection]
    return score


@compiled
def _compare(boxes, detections, first, last, rotation, translation, center, shape, landmark, ious,
             landmarks):
    """Let detections first to last take a landmark if it overlaps them more than what they had."""
    visible, cx, cy, exx, exy, eyy = project_ellipsoid(rotation, translation, center, shape)
    if not visible:
        return
    for v in range(first, last):
        detection = detections[v]
        box = boxes[detection]
        if _iou_bound(box, cx, cy, exx, eyy) <= ious[detection]:
            continue
        iou = ellipse_iou(box[0], box[1], box[2], box[3], cx, cy, exx, exy, eyy)
        if iou > ious[detection]:
            ious[detection] = iou
            landmarks[detection] = landmark


@compiled
def _iou_bound(box, cx, cy, exx, eyy):
    """Return an upper bound of an IoU from the ellipses' extents alone."""
    half_x, half_y = np.sqrt(exx), np.sqrt(eyy)
    width = min(box[0] + box[2], cx + half_x) - max(box[0] - box[2], cx - half_x)
    height = min(box[1] + box[3], cy + half_y) - max(box[1] - box[3], cy - half_y)
    if width <= 0.0 or height <= 0.0:
        return 0.0
    # The shared area lies in the shared box and in the box's own ellipse; the union holds the
    # latter.
    return width * height / (np.pi * box[2] * box[3])


@compiled
def _verify_groups(scene, rotation, translation, ious, landmarks):
    """Compare detections with what a pose may see of their groups."""
    groups = scene.groups
    seen = np.empty((2, len(groups.members)), dtype=np.int64)
    count = visible_members(groups, rotation.reshape(1, 3, 3), translation.reshape(1, 3), 0, seen)
    for member in seen[0, :count]:
        landmark = scene.nearby.numbers[groups.members[member, 0]]
        group = groups.members[member, 1]
        _compare(scene.box_ellipses, groups.detections, groups.starts[group],
                 groups.starts[group + 1], rotation, translation, scene.centers[landmark],
                 scene.shapes[landmark], landmark, ious, landmarks)
