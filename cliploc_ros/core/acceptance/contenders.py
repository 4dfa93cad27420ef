# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The poses that may be right, of every source, and the evidence of the objects for each."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.confidence import (
    Setting,
    Support,
    compared_frame,
    region_odds,
    support,
    tilt_handicaps,
    utilities,
)
from cliploc_ros.core.calibration import CALIBRATION
from cliploc_ros.core.fit.finalists import Finalist, Match, matches_of
from cliploc_ros.core.fit.refinement import refine_rig
from cliploc_ros.core.fit.verification import Rig, cameras_from_last, make_rig
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.core.keyframes.places import RecognizedPlace
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.search.frame_search import SearchedFrame

_NONE = np.empty(0, dtype=np.int64)


class JoinedFrames(NamedTuple):
    """The data that poses are compared on: searched frames of one camera, in a map."""

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
        """Return the setting: with the supports, it determines the chance of a wrong pose."""
        return Setting(len(self.landmark_map),
                       self.options.vertical_deviation_deg if self.knows_vertical else math.inf)


def join_frames(landmark_map: LandmarkMap, options: RelocalizerOptions,
                frames: Sequence[SearchedFrame]) -> JoinedFrames:
    """Return some searched frames, of which the last is to be localized.

    OptionsError: odom_from_camera is missing or no rigid transform; there are no frames or too
    many.
    """
    cameras = cameras_from_last([frame.observation for frame in frames])
    rig = make_rig([frame.scene for frame in frames], cameras,
                   np.stack([frame.vertical for frame in frames]), landmark_map.position_sigmas)
    return JoinedFrames(landmark_map, options, frames, rig, cameras)


def without_depth(joined: JoinedFrames) -> JoinedFrames:
    """Return frames as of cameras without depth."""
    return join_frames(joined.landmark_map, joined.options, [frame._replace(
        observation=replace(frame.observation, depths=None),
        scene=frame.scene._replace(depths=np.zeros_like(frame.scene.depths)))
        for frame in joined.frames])


class Contender(NamedTuple):
    """A pose that may be right, and its support."""

    finalist: Finalist  #: Finalist of the search of objects, or the pose of keyframes
    pose: NDArray[np.float64]  #: (4, 4): map_from_camera
    matches: list[tuple[Match, ...]]  #: Inliers in each of F frames
    support: Support  #: By objects
    is_upright: bool  #: Whether it uses the known vertical, or agrees with it
    handicap: float  #: Log odds that its attitude takes from it
    #: Logarithm of its odds, up to a constant that all contenders share: the utility of its
    #: support less the handicap. For poses of keyframes, that of points, objects and handicap.
    odds: float
    #: Log odds, 0 or less, that a region known before gives it; never steepened
    prior: float = 0.0
    #: The place that keyframes recognize, if they propose the pose
    recognized: RecognizedPlace | None = None
    #: The odds of a pose that keyframes propose, without what objects say for it
    by_points: float = -math.inf

    @property
    def landmarks(self) -> NDArray[np.int64]:
        """Return the landmarks (n,) that it matches in any frame, in order."""
        return np.array(sorted({one.landmark for found in self.matches for one in found}),
                        dtype=np.int64)

    @property
    def rank(self) -> float:
        """Return the log odds by which it competes with other contenders."""
        return self.odds + self.prior


def contenders_of(joined: JoinedFrames, finalists: Sequence[Finalist], upright: Sequence[bool]
                ) -> list[Contender]:
    """Return poses as contenders, with their odds by objects."""
    poses = np.array([finalist.map_from_camera for finalist in finalists]).reshape(-1, 4, 4)
    matches = [matches_of(joined.rig, finalist) for finalist in finalists]
    supports = supports_of(joined, poses, matches)
    handicaps = np.where(upright, 0.0, CALIBRATION.attitude.wrong_mount) \
        if joined.knows_vertical else tilt_handicaps(poses, joined.options.tilt_deviation_deg)
    region = joined.frames[-1].observation.region
    priors = np.zeros(len(poses)) if region is None else region_odds(joined.landmark_map, region,
                                                                     poses)
    return list(map(Contender, finalists, poses, matches, supports, upright, handicaps.tolist(),
                    (utilities(supports) - handicaps).tolist(), priors.tolist()))


def supports_of(joined: JoinedFrames, poses: NDArray[np.float64],
                matches: Sequence[list[tuple[Match, ...]]]) -> list[Support]:
    """Return the support of each pose (m, 4, 4), from its matches in each frame."""
    compared = []
    for frame in joined.frames:
        seen = frame.observation if joined.options.needs_similarities \
            else replace(frame.observation, similarities=None)
        compared.append(compared_frame(joined.landmark_map, seen.detections, frame.scene,
                                       seen.similarities, seen.similarity_rows))
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
