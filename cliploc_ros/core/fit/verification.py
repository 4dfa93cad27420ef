# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Verification of a pose: find its inliers among the detections of one or several frames.

Each detection is matched with the potential landmark whose outline has the largest IoU with the
ellipse of its box, if the IoU exceeds the threshold. The score is the sum of these IoUs (Matsuzaki
et al. 2024, Sec. III-D2). Detections of the minimal sample are matched like all others.

Odometry joins the frames of one moving camera to a rigid rig of cameras. The pose of the rig is
the pose of the reference frame's camera, from which the poses of the other cameras follow.
"""

from collections.abc import Sequence
from math import sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.ellipse import ellipse_iou, iou_bound
from cliploc_ros.core.geometry.ellipsoid import Poses, project_ellipsoid
from cliploc_ros.core.geometry.transforms import invert_transform, is_rigid
from cliploc_ros.core.kernels.compiled import ZERO, compiled
from cliploc_ros.core.map.culling import Groups, visible_members
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.search.scene import Potential, Scene
from cliploc_ros.errors import OptionsError

#: Maximum number of frames that are fused. The leaders of each frame are verified on every frame,
#: so the time grows with the square of this number, and a tenth view of the same objects adds
#: little.
MAX_FRAMES = 10


class FrameStarts(NamedTuple):
    """The first row of each frame in the arrays of a rig, followed by their length: (F + 1,)."""

    #: (F + 1,): rows in the box ellipses, and in the landmarks and detections of potential
    boxes: NDArray[np.int64]
    landmarks: NDArray[np.int64]
    pairs: NDArray[np.int64]
    #: (F + 1,): rows in the groups, and in their detections, members, levels and spheres
    groups: NDArray[np.int64]
    shown: NDArray[np.int64]
    members: NDArray[np.int64]
    levels: NDArray[np.int64]
    spheres: NDArray[np.int64]


class Rig(NamedTuple):
    """The concatenated scenes of F frames, and the poses of their cameras."""

    #: All arrays except those of the map are concatenated. Indices in them count within their
    #: frame, and `starts` arrays have an end for each frame. The scene has no pairs.
    scene: Scene
    starts: FrameStarts
    #: (F, 3, 4): rotation and translation of each camera_from_reference
    cameras: NDArray[np.float64]
    verticals: NDArray[np.float64]  #: (F, 7): see VERTICAL_UNKNOWN
    #: (L,): standard deviation of each landmark's centre on each axis [m]
    sigmas: NDArray[np.float64]


def cameras_from_last(observations: Sequence[Observation]) -> NDArray[np.float64]:
    """Return camera_from_last (F, 4, 4) of each camera, by odometry.

    Raises
    ------
    OptionsError
        odom_from_camera is missing or not a rigid transform; there are no observations or too
        many.
    """
    if not 1 <= len(observations) <= MAX_FRAMES:
        raise OptionsError(f'{len(observations)} observations, expected 1 to {MAX_FRAMES}')
    cameras = np.tile(np.eye(4), (len(observations), 1, 1))
    if len(observations) == 1:
        return cameras
    linked = []
    for number, observation in enumerate(observations, start=1):
        where = f'odom_from_camera of frame {number} of {len(observations)}'
        if observation.odom_from_camera is None:
            raise OptionsError(f'{where} is missing; it is required for more than one frame')
        if not is_rigid(observation.odom_from_camera):
            raise OptionsError(f'{where} is not a rigid transform')
        linked.append(observation.odom_from_camera)
    for row, odom_from_camera in enumerate(linked[:-1]):
        cameras[row] = invert_transform(odom_from_camera) @ linked[-1]
    return cameras


def make_rig(scenes: Sequence[Scene], camera_from_reference: NDArray[np.float64],
             verticals: NDArray[np.float64], sigmas: NDArray[np.float64]) -> Rig:
    """Return the rig of F scenes of one map.

    See Rig for camera_from_reference (F, 4, 4), verticals (F, 7) and sigmas (L,).
    """
    first = scenes[0]
    joined = first._replace(
        box_ellipses=np.concatenate([scene.box_ellipses for scene in scenes]),
        bearings=np.concatenate([scene.bearings for scene in scenes]),
        depths=np.concatenate([scene.depths for scene in scenes]),
        potential=Potential(*map(np.concatenate, zip(*(scene.potential for scene in scenes),
                                                     strict=True))),
        pairs=first.pairs[:0],
        groups=Groups(*map(np.concatenate, zip(*(scene.groups for scene in scenes), strict=True))))
    # number of rows of each frame in each array, in the order of FrameStarts
    sizes = [[0] * len(FrameStarts._fields), *(
        [len(scene.box_ellipses), len(scene.potential.landmarks), len(scene.potential.detections),
         len(scene.groups.starts) - 1, *(len(rows) for rows in (
             scene.groups.detections, scene.groups.members, scene.groups.levels,
             scene.groups.spheres))]
        for scene in scenes)]
    starts = np.ascontiguousarray(np.cumsum(sizes, axis=0, dtype=np.int64).T)
    return Rig(joined, FrameStarts(*starts), np.ascontiguousarray(camera_from_reference[:, :3]),
               np.ascontiguousarray(verticals), sigmas)


@compiled
def scene_of(rig, frame):
    """Return the scene of one frame of a rig."""
    scene, starts, potential, groups = rig.scene, rig.starts, rig.scene.potential, rig.scene.groups
    after = frame + 1
    # for each frame, starts and frusta have one row more than there are landmarks or groups
    landmarks, landmarks_end = starts.landmarks[frame], starts.landmarks[after]
    groups_begin, groups_end = starts.groups[frame] + frame, starts.groups[after] + after
    boxes = scene.box_ellipses[starts.boxes[frame]:starts.boxes[after]]
    bearings = scene.bearings[starts.boxes[frame]:starts.boxes[after]]
    own_potential = Potential(
        potential.landmarks[landmarks:landmarks_end],
        potential.starts[landmarks + frame:landmarks_end + after],
        potential.detections[starts.pairs[frame]:starts.pairs[after]])
    own_groups = Groups(
        groups.starts[groups_begin:groups_end],
        groups.detections[starts.shown[frame]:starts.shown[after]],
        groups.frusta[groups_begin:groups_end],
        groups.members[starts.members[frame]:starts.members[after]],
        groups.levels[starts.levels[frame]:starts.levels[after]],
        groups.spheres[starts.spheres[frame]:starts.spheres[after]])
    depths = scene.depths[starts.boxes[frame]:starts.boxes[after]]
    return Scene(boxes, bearings, depths, scene.centers, scene.shapes, own_potential, scene.pairs,
                 scene.iou_threshold, scene.sorted_landmarks, own_groups)


@compiled
def camera_pose(camera, rotation, translation):
    """Return camera_from_map (3, 3), (3,) of a camera (3, 4) of a rig, given the rig's pose."""
    own_rotation, own_translation = np.empty((3, 3)), np.empty(3)
    for i in range(3):
        for j in range(3):
            own_rotation[i, j] = (camera[i, 0] * rotation[0, j] + camera[i, 1] * rotation[1, j]
                                  + camera[i, 2] * rotation[2, j])
        own_translation[i] = (camera[i, 0] * translation[0] + camera[i, 1] * translation[1]
                              + camera[i, 2] * translation[2] + camera[i, 3])
    return own_rotation, own_translation


class Verified(NamedTuple):
    """The matches of a pose, for the n detections of all frames in sequence."""

    score: float  #: Sum of the IoUs
    ious: NDArray[np.float64]  #: (n,): IoU of each detection with its landmark; 0 without a match
    landmarks: NDArray[np.int64]  #: (n,): landmark of each detection; -1 without a match


@compiled
def verify_rig(rig, rotation, translation):
    """Match the detections of all frames at a pose (3, 3), (3,) of the rig: Verified."""
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
    """Write the landmark and IoU of each detection; return the score of the frame."""
    boxes, potential, groups = scene.box_ellipses, scene.potential, scene.groups
    for u in range(potential.landmarks.shape[0]):
        landmark = potential.landmarks[u]
        outline = project_ellipsoid(rotation, translation, scene.centers[landmark],
                                    scene.shapes[landmark])
        _offer(boxes, potential.detections[potential.starts[u]:potential.starts[u + 1]],
               landmark, outline, ious, landmarks)
    if groups.members.shape[0] > 0:  # the landmarks of each class that may be in view
        numbers = scene.sorted_landmarks.numbers
        visible = np.empty((2, groups.members.shape[0]), dtype=np.int64)
        pose = Poses(rotation.reshape(1, 3, 3), translation.reshape(1, 3))
        for place in range(visible_members(groups, pose, ZERO, visible)):
            row, group = groups.members[visible[0, place], 0], groups.members[visible[0, place], 1]
            outline = project_ellipsoid(rotation, translation, scene.centers[numbers[row]],
                                        scene.shapes[numbers[row]])
            _offer(boxes, groups.detections[groups.starts[group]:groups.starts[group + 1]],
                   numbers[row], outline, ious, landmarks)
    score = 0.0
    for detection in range(ious.shape[0]):
        if landmarks[detection] < 0:
            ious[detection] = 0.0
        score += ious[detection]
    return score


@compiled
def _offer(boxes, detections, landmark, outline, ious, landmarks):
    """Match a landmark with each detection that it overlaps more than its present match."""
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
    """Return the score (m,) of each pose (m, 3, 3), (m, 3) of the rig."""
    scores = np.empty(len(rotations))
    for row in range(len(rotations)):
        scores[row] = verify_rig(rig, rotations[row], translations[row]).score
    return scores
