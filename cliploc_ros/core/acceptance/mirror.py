# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Whether an image may be a mirror image: of a room in a mirror, or of a flipped camera.

A pose may explain a mirror image well. A camera on the other side of a plane sees the points of
the plane mirrored, at the same distances: objects on a table from below, those along a wall from
behind. So the image is mirrored back, and the best pose for that competes with the pose found. It
starts where reflection takes the camera, at planes through the objects that are matched.
"""

import math
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.calibration import CALIBRATION
from cliploc_ros.core.acceptance.confidence import utilities
from cliploc_ros.core.acceptance.contenders import (
    Contender,
    JoinedFrames,
    join_frames,
    refined,
    supports_of,
    unrefined,
)
from cliploc_ros.core.fit.finalists import matches_of
from cliploc_ros.core.fit.verification import verify_rig
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.search.candidates import match_frame

_FLIP = np.diag([-1.0, 1.0, 1.0, 1.0])
_UP = np.array([0.0, 0.0, 1.0])
# Planes that are tried, poses that are refined, and frames with matches that count, the last ones:
# a camera mirrors them all. Chosen on mirrored images of TUM fr3.
_MOST_PLANES, _REFINED, _MOST_FRAMES = 16, 2, 3


def chance_not_mirrored(joined: JoinedFrames, best: Contender) -> float:
    """Return the probability that no mirror image explains the detections instead."""
    first = [row for row, found in enumerate(best.matches) if found][-_MOST_FRAMES:][0]
    joined = join_frames(joined.landmark_map, joined.options, joined.frames[first:])
    matches = best.matches[first:]
    mirrored = _mirrored(joined)
    centers = joined.landmark_map.centers[
        sorted({one.landmark for found in matches for one in found})]
    starts = [unrefined(pose) for pose in _reflections(*_planes(centers)) @ best.pose @ _FLIP]
    starts.sort(key=lambda one: -verify_rig(mirrored.rig, one.rotation, one.translation).score)
    found = [refined(mirrored, one) for one in starts[:_REFINED]]
    supports = supports_of(mirrored, np.array([one.map_from_camera for one in found]),
                           [matches_of(mirrored.rig, one) for one in found])
    own, = utilities([best.support] if len(joined.frames) == len(best.matches)
                     else supports_of(joined, best.pose[None], [matches]))
    lead = CALIBRATION.attitude.not_mirrored + float(own - utilities(supports).max())
    return 1.0 / (1.0 + math.exp(-max(lead, -50.0)))


def _mirrored(joined: JoinedFrames) -> JoinedFrames:
    """Return frames whose images are mirrored left to right, searched for nothing."""
    frames = []
    for one in joined.frames:
        observation = _mirrored_observation(one.observation)
        frames.append(one._replace(
            observation=observation, vertical=one.vertical * (-1, 1, 1, 1, 1, 1, 1),
            scene=match_frame(joined.landmark_map, observation, joined.options)[0]))
    return join_frames(joined.landmark_map, joined.options, frames)


def _mirrored_observation(observation: Observation) -> Observation:
    """Return an observation mirrored on the plane z = 1, where a lens distorts nothing."""
    camera, detections = observation.camera, observation.detections
    boxes = camera.normalize_bboxes(detections.bboxes_xyxy)
    odom = observation.odom_from_camera
    return replace(observation, odom_from_camera=None if odom is None else _FLIP @ odom @ _FLIP,
                   camera=Camera(camera.width, camera.height, 1.0, 1.0, 0.0, 0.0),
                   detections=replace(detections,
                                      bboxes_xyxy=boxes[:, [2, 1, 0, 3]] * (-1, 1, -1, 1)))


def _planes(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return points (m, 3) on planes with their normals (m, 3).

    The planes are level, fitted to all points, and through three points each.
    """
    middle = points.mean(axis=0)
    triples = np.array([*combinations(range(len(points)), 3)], dtype=np.int64).reshape(-1, 3)
    chosen = np.linspace(0, len(triples) - 1, min(_MOST_PLANES, len(triples))).astype(np.int64)
    first, second, third = np.moveaxis(points[triples[chosen]], 1, 0)
    normals = np.cross(second - first, third - first)
    lengths = np.linalg.norm(normals, axis=1)
    first, normals = first[lengths > 1e-6], (normals.T / np.maximum(lengths, 1e-6)).T
    return (np.vstack([middle, middle, first]),
            np.vstack([_UP, np.linalg.svd(points - middle)[2][-1], normals[lengths > 1e-6]]))


def _reflections(points: NDArray[np.float64], normals: NDArray[np.float64]
                 ) -> NDArray[np.float64]:
    """Return the transforms (m, 4, 4) that reflect points at planes."""
    reflections = np.tile(np.eye(4), (len(points), 1, 1))
    reflections[:, :3, :3] -= 2.0 * normals[:, :, None] * normals[:, None]
    reflections[:, :3, 3] = 2.0 * (points * normals).sum(axis=1, keepdims=True) * normals
    return reflections
