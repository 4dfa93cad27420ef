# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The method in plain Python, as a reference for the compiled kernels.

Candidates are masks (n, L) of detections and landmarks. Poses are compared pair by pair, without
bounds and without culling.
"""

import numpy as np
from numpy.typing import NDArray
from scene import CAMERA, MAP_FROM_CAMERA, boxes_of

from cliploc_ros.core.fit.verification import Verified, make_rig, verify_rig
from cliploc_ros.core.geometry.ellipse import ellipse_iou
from cliploc_ros.core.geometry.ellipsoid import project_ellipsoids
from cliploc_ros.core.geometry.minimal_solvers import MAX_SOLUTIONS, p3p
from cliploc_ros.core.geometry.transforms import make_transform
from cliploc_ros.core.search.frame_search import Candidates
from cliploc_ros.core.search.scene import VERTICAL_UNKNOWN, Scene, make_scene

# A pose: rotation (3, 3) and translation (3,) of camera_from_map.
Pose = tuple[NDArray[np.float64], NDArray[np.float64]]


def same_class(detection_classes: tuple[str, ...], landmark_classes: tuple[str, ...]
               ) -> NDArray[np.bool_]:
    """Return a mask (n, L): detection and landmark have the same class name."""
    return np.array([[detection == landmark for landmark in landmark_classes]
                     for detection in detection_classes], dtype=bool).reshape(
                         len(detection_classes), len(landmark_classes))


def candidate_mask(candidates: Candidates, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Return a mask (n, L): the pair is a candidate."""
    mask = np.zeros(shape, dtype=bool)
    mask[candidates.detections, candidates.landmarks] = True
    return mask


def scene_of(room, map_from_camera=MAP_FROM_CAMERA, rows=slice(None), noise_px=0.0, rng=None
             ) -> Scene:
    """Return the scene of a frame: boxes of some landmarks, with all landmarks of their class."""
    boxes = boxes_of(room, map_from_camera)[rows]
    if noise_px:
        boxes = boxes + rng.normal(0, noise_px, boxes.shape)
    potential = same_class(room.class_ids, room.class_ids)[rows]
    return make_scene(CAMERA.normalize_bboxes(boxes), room.centers, room.shapes, potential,
                      np.argwhere(potential), 0.2)


def solve_p3p(bearings: NDArray[np.float64], points: NDArray[np.float64]
              ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the rotations (s, 3, 3) and translations (s, 3) of p3p, s = 0 to 4."""
    rotations, translations = np.empty((MAX_SOLUTIONS, 3, 3)), np.empty((MAX_SOLUTIONS, 3))
    count = p3p(np.ascontiguousarray(bearings), np.ascontiguousarray(points), rotations,
                translations)
    return rotations[:count], translations[:count]


def sample_pose(scene: Scene, sample: NDArray[np.int64]) -> tuple[Pose | None, float]:
    """Return the hypothesis of a minimal sample, and the sum of the IoUs of its three pairs.

    The hypothesis is the P3P solution with the greatest sum among those for which all three
    ellipsoids lie completely in front of the camera; None if there is none.
    """
    detections, landmarks = scene.pairs[sample].T
    best, best_total = None, -1.0
    for pose in zip(*solve_p3p(scene.bearings[detections], scene.centers[landmarks]), strict=True):
        total = sum(pair_iou(scene, detection, outline) for detection, outline in zip(
            detections, outlines_of(scene, landmarks, pose), strict=True))
        if total > best_total:  # always false for NaN
            best, best_total = pose, total
    return best, best_total


def outlines_of(scene: Scene, landmarks: NDArray[np.int64], pose: Pose) -> NDArray[np.float64]:
    """Return the outlines (m, 5) of landmarks (m,); NaN for those not wholly in front."""
    return project_ellipsoids(make_transform(*pose), scene.centers[landmarks],
                              scene.shapes[landmarks])


def pair_iou(scene: Scene, detection: int, outline: NDArray[np.float64]) -> float:
    """Return the IoU of a detection's box ellipse and an outline (5,); NaN for a NaN outline."""
    if np.isnan(outline[0]):
        return np.nan
    return ellipse_iou(*scene.box_ellipses[detection], *outline)


def nearest(rotations: NDArray[np.float64], translations: NDArray[np.float64],
            rotation: NDArray[np.float64], translation: NDArray[np.float64]) -> float:
    """Return the distance from a pose to the nearest of other poses, as the largest difference."""
    return min((max(np.abs(r - rotation).max(), np.abs(t - translation).max())
                for r, t in zip(rotations, translations, strict=True)), default=np.inf)


def verify(scene: Scene, rotation: NDArray[np.float64], translation: NDArray[np.float64]
           ) -> Verified:
    """Return the landmarks that a pose explains in one frame, by the kernel (a rig of one)."""
    rig = make_rig([scene], np.eye(4)[None], VERTICAL_UNKNOWN[None], np.zeros(len(scene.centers)))
    return verify_rig(rig, rotation, translation)
