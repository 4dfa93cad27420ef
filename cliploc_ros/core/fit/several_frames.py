# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Several frames of one moving camera, joined by odometry: scored and refined as one.

The frames' cameras are a rigid rig. A hypothesis is a pose of the reference frame's camera; it
fixes the others', and its score is the sum of the frames' scores. Refinement minimizes the sum of
all frames' robust squares: when the reference moves by a and turns by w about its centre, a camera
at the lever l from it moves by a + w x l and turns by w, so that its information H and gradient g
enter as A^T H A and A^T g with A = [1, -[l]; 0, 1].
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.association.culling import Groups
from cliploc_ros.core.association.scene import Scene, Workspace, verify
from cliploc_ros.core.compiled import compiled
from cliploc_ros.core.fit.refinement import (
    linearize,
    move,
    one_to_one,
    residuals_of,
    robust_cost,
    solve,
)
from cliploc_ros.core.search.search import same_place

# A round may lose so much of the best score so far: many edges that fit well are nearer to the
# truth than the greatest overlap, but a pose that loses its landmarks is none.
_LEAST_SHARE = 0.9
_ROUNDS = 4
_STEPS = 5
_TRIALS = 4
_FIRST_DAMPING = 1e-3
_SETTLED = 1e-5
# A step that is longer, in metres and in radians, has left where the residuals are nearly linear.
_LONGEST_STEP = 1.0


class Rig(NamedTuple):
    """The scenes of F frames one behind the other, and where their cameras are.

    Parameters
    ----------
    scene : Scene
        All arrays but the map's joined; numbers in them count within their frame, and starts have
        an end of their own for each frame. It has no pairs.
    bounds : ndarray (F + 1, 8)
        Where each frame's rows begin: of boxes, of potential_landmarks, of potential_detections,
        and of the groups' reaches, detections, members, levels and spheres.
    cameras : ndarray (F, 3, 4)
        Rotation and translation of each camera from the reference camera.
    verticals : ndarray (F, 7)
        See make_rig.
    """

    scene: Scene
    bounds: NDArray[np.int64]
    cameras: NDArray[np.float64]
    verticals: NDArray[np.float64]


def make_rig(scenes: Sequence[Scene], camera_from_reference: NDArray[np.float64],
             verticals: NDArray[np.float64]) -> Rig:
    """Return the rig of some frames.

    Parameters
    ----------
    scenes : sequence of Scene
        F of them, of one map.
    camera_from_reference : ndarray (F, 4, 4)
    verticals : ndarray (F, 7)
        Of each frame up in the camera (3,) and in the map (3,), unit vectors, and the standard
        deviation of the angle between them [rad]; VERTICAL_UNKNOWN where it is not known.
    """
    first = scenes[0]
    groups = Groups(*(np.concatenate(parts) for parts in
                      zip(*(one.groups for one in scenes), strict=True)))
    joined = Scene(
        np.concatenate([one.box_ellipses for one in scenes]),
        np.concatenate([one.bearings for one in scenes]), first.centers, first.shapes,
        np.concatenate([one.potential_landmarks for one in scenes]),
        np.concatenate([one.potential_starts for one in scenes]),
        np.concatenate([one.potential_detections for one in scenes]),
        first.pairs[:0], first.iou_threshold, first.nearby, groups)
    counts = [[0] * 8, *([len(one.box_ellipses), len(one.potential_landmarks),
                          len(one.potential_detections), len(one.groups.reaches),
                          len(one.groups.detections), len(one.groups.members),
                          len(one.groups.levels), len(one.groups.spheres)] for one in scenes)]
    return Rig(joined, np.cumsum(counts, axis=0, dtype=np.int64),
               np.ascontiguousarray(camera_from_reference[:, :3]),
               np.ascontiguousarray(verticals))


@compiled
def _scene_of(rig, frame):
    """Return the scene of one frame."""
    scene, groups = rig.scene, rig.scene.groups
    first, last = rig.bounds[frame], rig.bounds[frame + 1]
    own = Groups(groups.starts[first[3] + frame:last[3] + frame + 1],
                 groups.detections[first[4]:last[4]], groups.reaches[first[3]:last[3]],
                 groups.frusta[first[3] + frame:last[3] + frame + 1],
                 groups.members[first[5]:last[5]], groups.levels[first[6]:last[6]],
                 groups.spheres[first[7]:last[7]])
    return Scene(scene.box_ellipses[first[0]:last[0]], scene.bearings[first[0]:last[0]],
                 scene.centers, scene.shapes, scene.potential_landmarks[first[1]:last[1]],
                 scene.potential_starts[first[1] + frame:last[1] + frame + 1],
                 scene.potential_detections[first[2]:last[2]], scene.pairs, scene.iou_threshold,
                 scene.nearby, own)


@compiled
def _workspace_of(rig, frame, workspace):
    """Return the part of a workspace that is one frame's."""
    first, last = rig.bounds[frame, 0], rig.bounds[frame + 1, 0]
    return Workspace(workspace.sample_bearings, workspace.sample_points, workspace.rotations,
                     workspace.translations, workspace.ious[first:last],
                     workspace.landmarks[first:last])


@compiled
def verify_rig(rig, rotation, translation, workspace):
    """Return the sum of all frames' scores, and leave each detection's IoU and landmark behind."""
    score = 0.0
    own_rotation, own_translation = np.empty((3, 3)), np.empty(3)
    for frame in range(len(rig.cameras)):
        _place(rig.cameras[frame], rotation, translation, own_rotation, own_translation)
        score += verify(_scene_of(rig, frame), own_rotation, own_translation,
                        _workspace_of(rig, frame, workspace))
    return score


@compiled
def choose_distinct(rig, rotations, translations, count, workspace):
    """Return the rows (<= count,) of the best poses at distinct places, and all scores (m,)."""
    scores = np.empty(len(rotations))
    for row in range(len(rotations)):
        scores[row] = verify_rig(rig, rotations[row], translations[row], workspace)
    chosen = np.empty(count, dtype=np.int64)
    found = 0
    for best in np.argsort(-scores, kind='mergesort'):
        for other in chosen[:found]:
            if same_place(rotations[best], translations[best], rotations[other],
                          translations[other]):
                break
        else:
            chosen[found] = best
            found += 1
            if found == count:
                break
    return chosen[:found], scores


@compiled
def refine_all(rig, rotations, translations, workspace):
    """Refine poses (m, 3, 3), (m, 3) in place; return scores (m,), informations (m, 6, 6)."""
    scores, informations = np.empty(len(rotations)), np.empty((len(rotations), 6, 6))
    for row in range(len(rotations)):
        scores[row], informations[row] = refine_rig(rig, rotations[row], translations[row],
                                                    workspace)
    return scores, informations


@compiled
def refine_rig(rig, rotation, translation, workspace):
    """Refine a pose of the reference in place; return its score, and its information.

    Parameters
    ----------
    rig : Rig
    rotation, translation : ndarray (3, 3), (3,)
        Of camera_from_map of the reference; changed in place, unless the score would fall by a
        tenth.
    workspace : Workspace
        For all detections of the rig. Holds the matches of the refined pose afterwards.

    Returns
    -------
    score : float
        See verify_rig.
    information : ndarray (6, 6)
        Of the reference camera's position [m] and its rotation about the map's axes [rad].
    """
    score = verify_rig(rig, rotation, translation, workspace)
    best_score = score
    information = np.zeros((6, 6))
    new_rotation, new_translation = rotation.copy(), translation.copy()
    starts, cameras = np.zeros(len(rig.bounds), dtype=np.int64), rig.cameras
    # so many boxes fix a pose
    least = 2 if np.max(rig.verticals[:, 6]) > 0.0 else 3
    for _ in range(_ROUNDS):
        pairs = _pair(rig, workspace, starts)
        if len(pairs) < least:
            break
        _minimize(pairs, starts, cameras, rig.verticals, new_rotation, new_translation)
        new_score = verify_rig(rig, new_rotation, new_translation, workspace)
        if new_score < _LEAST_SHARE * best_score:
            break
        settled = abs(new_score - score) <= _SETTLED * score
        score, best_score = new_score, max(best_score, new_score)
        rotation[:] = new_rotation
        translation[:] = new_translation
        if settled:
            break
    score = verify_rig(rig, rotation, translation, workspace)
    pairs = _pair(rig, workspace, starts)
    if len(pairs) >= least:
        residuals = np.empty(4 * len(pairs) + 3 * len(cameras))
        if _residuals(pairs, starts, cameras, rig.verticals, rotation, translation, residuals):
            _linearize(pairs, starts, cameras, rig.verticals, rotation, translation, residuals,
                       information, np.empty(6))
    return score, information


@compiled
def _pair(rig, workspace, starts):
    """Return boxes and landmarks of each frame's one-to-one matches (m, 13), frame by frame.

    See residuals_of; starts is written: where each frame's begin.
    """
    scene = rig.scene
    detections = np.empty(len(workspace.landmarks), dtype=np.int64)
    landmarks = np.empty(len(workspace.landmarks), dtype=np.int64)
    pairs = np.empty((len(workspace.landmarks), 13))
    count = 0
    for frame in range(len(starts) - 1):
        matches = one_to_one(_workspace_of(rig, frame, workspace), detections, landmarks)
        for row in range(matches):
            pairs[count, :4] = scene.box_ellipses[rig.bounds[frame, 0] + detections[row]]
            pairs[count, 4:7] = scene.centers[landmarks[row]]
            pairs[count, 7:] = scene.shapes[landmarks[row]]
            count += 1
        starts[frame + 1] = count
    return pairs[:count]


@compiled
def _place(camera, rotation, translation, new_rotation, new_translation):
    """Write camera_from_map of a camera (3, 4) at a pose of the reference."""
    for i in range(3):
        for j in range(3):
            new_rotation[i, j] = (camera[i, 0] * rotation[0, j] + camera[i, 1] * rotation[1, j]
                                  + camera[i, 2] * rotation[2, j])
        new_translation[i] = (camera[i, 0] * translation[0] + camera[i, 1] * translation[1]
                              + camera[i, 2] * translation[2] + camera[i, 3])


@compiled
def _residuals(pairs, starts, cameras, verticals, rotation, translation, residuals):
    """Write all frames' residuals; False if a landmark is not in front."""
    own_rotation, own_translation = np.empty((3, 3)), np.empty(3)
    for frame in range(len(cameras)):
        _place(cameras[frame], rotation, translation, own_rotation, own_translation)
        first, last = starts[frame], starts[frame + 1]
        if not residuals_of(pairs[first:last], verticals[frame], own_rotation, own_translation,
                            residuals[4 * first + 3 * frame:4 * last + 3 * frame + 3]):
            return False
    return True


@compiled
def _linearize(pairs, starts, cameras, verticals, rotation, translation, residuals, information,
               gradient):
    """Write the normal equations of all frames, in steps of the reference."""
    own_rotation, own_translation = np.empty((3, 3)), np.empty(3)
    own_information, own_gradient = np.empty((6, 6)), np.empty(6)
    jacobian = np.empty((4 * len(pairs) + 3, 6))
    information[:] = 0.0
    gradient[:] = 0.0
    for frame in range(len(cameras)):
        _place(cameras[frame], rotation, translation, own_rotation, own_translation)
        first, last = starts[frame], starts[frame + 1]
        linearize(pairs[first:last], verticals[frame], own_rotation, own_translation,
                  residuals[4 * first + 3 * frame:4 * last + 3 * frame + 3],
                  jacobian[:4 * (last - first) + 3], own_information, own_gradient)
        _add(rotation, translation, own_rotation, own_translation, own_information, own_gradient,
             information, gradient)


@compiled
def _add(rotation, translation, own_rotation, own_translation, own_information, own_gradient,
         information, gradient):
    """Add a camera's information and gradient to the reference's; the camera's own change."""
    lever = np.zeros(3)
    for axis in range(3):
        for row in range(3):
            lever[axis] += (rotation[row, axis] * translation[row]
                            - own_rotation[row, axis] * own_translation[row])
    for axis in range(3):  # about this axis the reference turns: w x l = -[l] w
        i, j = (axis + 1) % 3, (axis + 2) % 3
        own_gradient[3 + axis] += lever[i] * own_gradient[j] - lever[j] * own_gradient[i]
        for row in range(6):
            own_information[row, 3 + axis] += (lever[i] * own_information[row, j]
                                               - lever[j] * own_information[row, i])
    for axis in range(3):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        for column in range(6):
            own_information[3 + axis, column] += (lever[i] * own_information[j, column]
                                                  - lever[j] * own_information[i, column])
    for i in range(6):
        gradient[i] += own_gradient[i]
        for j in range(6):
            information[i, j] += own_information[i, j]


@compiled
def _minimize(pairs, starts, cameras, verticals, rotation, translation):
    """Move a pose to where the robust sum of squares is least (Levenberg-Marquardt)."""
    count = 4 * len(pairs) + 3 * len(cameras)
    residuals, moved = np.empty(count), np.empty(count)
    gradient, step = np.empty(6), np.zeros(6)
    information, damped = np.empty((6, 6)), np.empty((6, 6))
    trial_rotation, trial_translation = rotation.copy(), translation.copy()
    damping = _FIRST_DAMPING
    if not _residuals(pairs, starts, cameras, verticals, rotation, translation, residuals):
        return
    cost = robust_cost(residuals)
    for _ in range(_STEPS):
        _linearize(pairs, starts, cameras, verticals, rotation, translation, residuals,
                   information, gradient)
        accepted = False
        for _ in range(_TRIALS):
            damped[:] = information
            for axis in range(6):
                damped[axis, axis] += damping * information[axis, axis] + 1e-9
            if not solve(damped, gradient, step):
                return
            if np.sum(step * step) > _LONGEST_STEP * _LONGEST_STEP:
                damping = 10.0 * damping
                continue
            move(rotation, translation, step, trial_rotation, trial_translation)
            if _residuals(pairs, starts, cameras, verticals, trial_rotation, trial_translation,
                          moved):
                new_cost = robust_cost(moved)
                if new_cost < cost:
                    accepted = True
                    break
            damping = 10.0 * damping
        if not accepted:
            return
        settled = cost - new_cost < _SETTLED * cost
        cost = new_cost
        residuals[:] = moved
        rotation[:] = trial_rotation
        translation[:] = trial_translation
        damping = 0.1 * damping
        if settled:
            return
