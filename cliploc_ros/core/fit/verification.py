# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How well a pose explains the detections of one frame or several.

Every detection takes the potential landmark whose outline overlaps its box's ellipse most, if
their IoU exceeds the threshold. The score is the sum of these IoUs (Matsuzaki et al. 2024,
Sec. III-D2). Detections of the minimal sample choose like all others.
"""

from math import sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.fit.rig import camera_pose, scene_of
from cliploc_ros.core.geometry.ellipse import ellipse_iou, iou_bound
from cliploc_ros.core.geometry.ellipsoid import project_ellipsoid
from cliploc_ros.core.geometry.projection import Poses
from cliploc_ros.core.kernels.compiled import ZERO, compiled
from cliploc_ros.core.map.culling import visible_members
from cliploc_ros.core.search.leaders import same_place


class Verified(NamedTuple):
    """What a pose explains: n detections, those of several frames one behind the other."""

    score: float  #: Sum of the IoUs
    ious: NDArray[np.float64]  #: (n,): IoU of each detection with its landmark; 0 if it has none
    landmarks: NDArray[np.int64]  #: (n,): landmark of each detection; -1 if it has none


@compiled
def verify_rig(rig, rotation, translation):
    """Return what a pose of the reference (3, 3), (3,) explains in all frames: Verified."""
    starts = rig.starts.boxes
    ious = np.full(starts[-1], rig.scene.iou_threshold)
    landmarks = np.full(starts[-1], -1)
    score = 0.0
    for frame in range(len(rig.cameras)):
        own_rotation, own_translation = camera_pose(rig.cameras[frame], rotation, translation)
        first, last = starts[frame], starts[frame + 1]
        score += _verify(scene_of(rig, frame), own_rotation, own_translation, ious[first:last],
                         landmarks[first:last])
    return Verified(score, ious, landmarks)


@compiled
def _verify(scene, rotation, translation, ious, landmarks):
    """Write each detection's landmark and its IoU; return the score of the frame."""
    boxes, potential = scene.box_ellipses, scene.potential
    for u in range(potential.landmarks.shape[0]):
        landmark = potential.landmarks[u]
        outline = project_ellipsoid(rotation, translation, scene.centers[landmark],
                                    scene.shapes[landmark])
        _offer(boxes, potential.detections[potential.starts[u]:potential.starts[u + 1]],
               landmark, outline, ious, landmarks)
    if scene.groups.members.shape[0] > 0:
        _offer_groups(scene, rotation, translation, ious, landmarks)
    score = 0.0
    for detection in range(ious.shape[0]):
        if landmarks[detection] < 0:
            ious[detection] = 0.0
        score += ious[detection]
    return score


@compiled
def _offer_groups(scene, rotation, translation, ious, landmarks):
    """Offer detections the landmarks of their class that the pose may see."""
    boxes, groups, numbers = scene.box_ellipses, scene.groups, scene.sorted_landmarks.numbers
    visible = np.empty((2, groups.members.shape[0]), dtype=np.int64)
    pose = Poses(rotation.reshape(1, 3, 3), translation.reshape(1, 3))
    for place in range(visible_members(groups, pose, ZERO, visible)):
        row, group = groups.members[visible[0, place], 0], groups.members[visible[0, place], 1]
        outline = project_ellipsoid(rotation, translation, scene.centers[numbers[row]],
                                    scene.shapes[numbers[row]])
        _offer(boxes, groups.detections[groups.starts[group]:groups.starts[group + 1]],
               numbers[row], outline, ious, landmarks)


@compiled
def _offer(boxes, detections, landmark, outline, ious, landmarks):
    """Offer a landmark to some detections: they take it if it overlaps them more than theirs."""
    in_front, cx, cy, exx, exy, eyy = outline
    if not in_front:
        return
    half_x, half_y, axes = sqrt(exx), sqrt(eyy), sqrt(max(0.0, exx * eyy - exy * exy))
    for detection in detections:
        u, v = boxes[detection, 0], boxes[detection, 1]
        half_width, half_height = boxes[detection, 2], boxes[detection, 3]
        if iou_bound(u, v, half_width, half_height, cx, cy, half_x, half_y,
                     axes) <= ious[detection]:
            continue
        iou = ellipse_iou(u, v, half_width, half_height, cx, cy, exx, exy, eyy)
        if iou > ious[detection]:
            ious[detection] = iou
            landmarks[detection] = landmark


@compiled
def scores_of(rig, rotations, translations):
    """Return the score (m,) of each pose (m, 3, 3), (m, 3) of the reference."""
    scores = np.empty(len(rotations))
    for row in range(len(rotations)):
        scores[row] = verify_rig(rig, rotations[row], translations[row]).score
    return scores


def choose_distinct(scores: NDArray[np.float64], rotations: NDArray[np.float64],
                    translations: NDArray[np.float64], count: int) -> NDArray[np.int64]:
    """Return the rows (<= count,) of the best of m poses at distinct places, best first.

    Poses are rotations (m, 3, 3) and translations (m, 3) of camera_from_map with scores (m,).
    """
    return _choose_distinct(np.argsort(-scores, kind='stable'), rotations, translations, count)


@compiled
def _choose_distinct(order, rotations, translations, count):
    chosen = np.empty(count, dtype=np.int64)
    found = 0
    for row in order:
        if found == count:
            break
        distinct = True
        for other in chosen[:found]:
            if same_place(rotations[row], translations[row], rotations[other],
                          translations[other]):
                distinct = False
                break
        if distinct:
            chosen[found] = row
            found += 1
    return chosen[:found]
