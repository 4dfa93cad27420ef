# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The poses that may be right, of every source, and the evidence of the objects for each.

A mirror image, of a room in a mirror or of a flipped camera, may be explained well, too. A camera
on the other side of a plane sees the points of the plane mirrored, at the same distances: objects
on a table from below, those along a wall from behind. So the image is mirrored back, and the best
pose for that competes with the pose found. It starts where reflection takes the camera, at planes
through the objects that are matched.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.calibration import CALIBRATION
from cliploc_ros.core.acceptance.confidence import (
    ComparedFrame,
    Setting,
    Support,
    support,
    tilt_handicaps,
    utilities,
)
from cliploc_ros.core.fit.finalists import Finalist, Match, matches_of
from cliploc_ros.core.fit.refinement import refine_rig
from cliploc_ros.core.fit.verification import Rig, cameras_from_last, make_rig, verify_rig
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.core.keyframes.places import RecognizedPlace
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.search.candidates import match_frame
from cliploc_ros.core.search.frame_search import SearchedFrame

_NONE = np.empty(0, dtype=np.int64)
_FLIP = np.diag([-1.0, 1.0, 1.0, 1.0])
_UP = np.array([0.0, 0.0, 1.0])
# Planes that are tried, poses that are refined, and frames that count, the last ones: a camera
# mirrors them all. Chosen on mirrored images of TUM fr3.
_MOST_PLANES, _REFINED, _MOST_FRAMES = 16, 2, 3


class JoinedFrames(NamedTuple):
    """What poses are compared on: searched frames of one camera, in a map."""

    landmark_map: LandmarkMap
    options: RelocalizerOptions
    frames: Sequence[SearchedFrame]
    rig: Rig  #: The same frames
    cameras: NDArray[np.float64]  #: (F, 4, 4): each camera from the last

    @property
    def knows_vertical(self) -> bool:
        """Return whether the vertical of any frame is known."""
        return bool(self.rig.verticals[:, 6].any())

    @property
    def setting(self) -> Setting:
        """Return the setting: besides the supports, the chance of a wrong pose depends on it."""
        return Setting(len(self.landmark_map),
                       self.options.vertical_deviation_deg if self.knows_vertical else math.inf)


def join_frames(landmark_map: LandmarkMap, options: RelocalizerOptions,
                frames: Sequence[SearchedFrame]) -> JoinedFrames:
    """Return some searched frames, the last one of which is to be localized.

    Raises
    ------
    OptionsError
        odom_from_camera is missing or no rigid transform; there are no frames or too many.
    """
    cameras = cameras_from_last([one.observation for one in frames])
    rig = make_rig([one.scene for one in frames], cameras,
                   np.stack([one.vertical for one in frames]), landmark_map.position_sigmas)
    return JoinedFrames(landmark_map, options, frames, rig, cameras)


class Candidate(NamedTuple):
    """A pose that may be right, and what supports it."""

    finalist: Finalist  #: Of the search of objects, or the pose of keyframes as one
    pose: NDArray[np.float64]  #: (4, 4): map_from_camera
    matches: list[tuple[Match, ...]]  #: Inliers in each of F frames
    support: Support  #: By objects
    is_upright: bool  #: Whether it uses the known vertical, or agrees with it
    handicap: float  #: Log odds that its attitude takes from it
    odds: float  #: Logarithm of its odds, up to a constant that all candidates share
    #: What keyframes show there, where they propose the pose
    recognized: RecognizedPlace | None = None
    #: The odds of a pose that keyframes propose, without what objects say for it
    by_points: float = -math.inf


def candidates_of(joined: JoinedFrames, finalists: Sequence[Finalist], upright: Sequence[bool]
                ) -> list[Candidate]:
    """Return poses as candidates, with their odds by objects."""
    poses = np.array([one.map_from_camera for one in finalists]).reshape(-1, 4, 4)
    matches = [matches_of(joined.rig, one) for one in finalists]
    supports = supports_of(joined, poses, matches)
    handicaps = np.where(upright, 0.0, CALIBRATION.attitude.wrong_mount) \
        if joined.knows_vertical else tilt_handicaps(poses, joined.options.tilt_deviation_deg)
    return list(map(Candidate, finalists, poses, matches, supports, upright, handicaps.tolist(),
                    (utilities(supports) - handicaps).tolist()))


def supports_of(joined: JoinedFrames, poses: NDArray[np.float64],
                matches: Sequence[list[tuple[Match, ...]]]) -> list[Support]:
    """Return the support of each pose (m, 4, 4), from its matches in each frame."""
    used = [one.observation if joined.options.needs_similarities
            else replace(one.observation, similarities=None) for one in joined.frames]
    compared = [ComparedFrame(
        one.observation.detections.bboxes_xyxy, one.observation.detections.class_ids,
        seen.similarities, one.scene, seen.similarity_rows)
        for one, seen in zip(joined.frames, used, strict=True)]
    last_from_cameras = np.linalg.inv(joined.cameras)
    return [support(joined.landmark_map, compared, pose @ last_from_cameras, found)
            for pose, found in zip(poses, matches, strict=True)]


def unrefined(map_from_camera: NDArray[np.float64]) -> Finalist:
    """Return a pose (4, 4) of another source like those that a search met."""
    pose = invert_transform(map_from_camera)
    return Finalist(np.ascontiguousarray(pose[:3, :3]), pose[:3, 3].copy(), 0.0, 0, 0, _NONE)


def refined(joined: JoinedFrames, start: Finalist) -> Finalist:
    """Return a pose that no search met, refined like those that it met."""
    if not joined.options.refine:
        return start
    return start._replace(**refine_rig(joined.rig, start.rotation, start.translation)._asdict())


def chance_not_mirrored(joined: JoinedFrames, best: Candidate) -> float:
    """Return the probability that no mirror image explains the detections instead."""
    joined = join_frames(joined.landmark_map, joined.options, joined.frames[-_MOST_FRAMES:])
    matches = best.matches[-_MOST_FRAMES:]
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
