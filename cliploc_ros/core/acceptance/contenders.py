# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The poses that may be right, from all sources, and the evidence of objects for each pose."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance import confidence
from cliploc_ros.core.calibration import CALIBRATION
from cliploc_ros.core.fit.finalists import Finalist, Match, instants_of, matches_of
from cliploc_ros.core.fit.refinement import refine_rig
from cliploc_ros.core.fit.tag_pose import TagPlace
from cliploc_ros.core.fit.verification import Rig, cameras_from_last, make_rig
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.core.keyframes.places import RecognizedPlace
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.search.frame_search import SearchedFrame

_NONE = np.empty(0, dtype=np.int64)


class Contender(NamedTuple):
    """A pose that may be right, and its support."""

    finalist: Finalist  #: The pose, found by the search of objects or by keyframes
    pose: NDArray[np.float64]  #: (4, 4): map_from_camera
    matches: list[tuple[Match, ...]]  #: Inliers in each of F frames
    support: confidence.Support  #: Evidence of the objects
    is_upright: bool  #: Whether the pose uses the known vertical, or agrees with it
    handicap: float  #: Log odds that are subtracted for the attitude of the pose
    #: Log odds of the pose, up to a constant that all contenders share: the utility of its support
    #: minus the handicap. For poses from keyframes, the utility of points and objects minus it.
    odds: float
    #: Log odds, at most 0, of the pose given the prior region; they are never sharpened
    prior: float = 0.0
    #: The place that keyframes recognize, if they propose the pose
    recognized: RecognizedPlace | None = None
    #: Log odds of a pose that keyframes or tags propose, without the evidence of objects for it
    by_points: float = -math.inf
    tagged: TagPlace | None = None  #: The place that tags name, if they propose the pose
    #: (6, 6): mean square of its differences to other poses there that tags propose
    spread: NDArray[np.float64] | float = 0.0

    @property
    def is_of_objects(self) -> bool:
        """Return whether the search of objects found the pose."""
        return self.recognized is None and self.tagged is None

    @property
    def landmarks(self) -> NDArray[np.int64]:
        """Return the sorted landmarks (n,) that the pose matches in any frame."""
        return np.array(sorted({match.landmark for of_frame in self.matches
                                for match in of_frame}), dtype=np.int64)

    @property
    def rank(self) -> float:
        """Return the log odds by which the contenders are ranked."""
        return self.odds + self.prior


@dataclass(frozen=True)
class JoinedFrames:
    """The data on which poses are compared: F searched frames, joined to a rig, and the map."""

    landmark_map: LandmarkMap
    options: RelocalizerOptions
    frames: Sequence[SearchedFrame]
    rig: Rig  #: The rig of these frames
    cameras: NDArray[np.float64]  #: (F, 4, 4): camera_from_last of each frame

    @cached_property
    def compared(self) -> list[confidence.ComparedFrame]:
        """Return the data of each frame that the supports of all poses need."""
        return [confidence.compared_frame(
            self.landmark_map, frame.scene, frame.observation if self.options.needs_similarities
            else replace(frame.observation, similarities=None)) for frame in self.frames]

    @property
    def knows_vertical(self) -> bool:
        """Return whether the vertical of any frame is known."""
        return bool(self.rig.verticals[:, 6].any())

    @property
    def none_right(self) -> float:
        """Return the utility of the case that no pose is right."""
        return confidence.none_right(confidence.Setting(
            len(self.landmark_map),
            self.options.vertical_deviation_deg if self.knows_vertical else math.inf))

    @property
    def instants(self) -> NDArray[np.int64]:
        """Return the number (F,) of each frame's instant, see instants_of."""
        return instants_of(self.frames)

    def without_depth(self) -> 'JoinedFrames':
        """Return the joined frames without their depths."""
        return join_frames(self.landmark_map, self.options, [frame._replace(
            observation=replace(frame.observation, depths=None),
            scene=frame.scene._replace(depths=np.zeros_like(frame.scene.depths)))
            for frame in self.frames])

    def contenders(self, finalists: Sequence[Finalist], upright: Sequence[bool]
                   ) -> list[Contender]:
        """Return poses as contenders, with their odds by objects."""
        poses = np.array([finalist.map_from_camera for finalist in finalists]).reshape(-1, 4, 4)
        matches = [matches_of(self.rig, finalist) for finalist in finalists]
        supports = self.supports(poses, matches)
        handicaps = np.where(upright, 0.0, CALIBRATION.attitude.wrong_mount) \
            if self.knows_vertical else confidence.tilt_handicaps(
                poses, self.options.tilt_deviation_deg)
        region = self.frames[-1].observation.region
        priors = np.zeros(len(poses)) if region is None else confidence.region_odds(
            self.landmark_map, region, poses)
        return list(map(Contender, finalists, poses, matches, supports, upright,
                        handicaps.tolist(), (confidence.utilities(supports) - handicaps).tolist(),
                        priors.tolist()))

    def supports(self, poses: NDArray[np.float64],
                 matches: Sequence[list[tuple[Match, ...]]]) -> list[confidence.Support]:
        """Return the support of each pose (m, 4, 4), from its matches in each frame."""
        last_from_cameras = np.linalg.inv(self.cameras)
        return [confidence.support(self.landmark_map, self.compared, pose @ last_from_cameras,
                                   found) for pose, found in zip(poses, matches, strict=True)]

    def refined(self, start: Finalist) -> Finalist:
        """Refine a pose that the search did not find, if the options ask for refinement."""
        if not self.options.refine:
            return start
        return start._replace(**refine_rig(self.rig, start.rotation, start.translation)._asdict())


def join_frames(landmark_map: LandmarkMap, options: RelocalizerOptions,
                frames: Sequence[SearchedFrame]) -> JoinedFrames:
    """Join searched frames, the last of which is to be localized.

    Raises
    ------
    OptionsError
        odom_from_camera is missing or not a rigid transform; there are no frames or too many.
    """
    cameras = cameras_from_last([frame.observation for frame in frames])
    rig = make_rig([frame.scene for frame in frames], cameras,
                   np.stack([frame.vertical for frame in frames]), landmark_map.position_sigmas)
    return JoinedFrames(landmark_map, options, frames, rig, cameras)


def unrefined(map_from_camera: NDArray[np.float64]) -> Finalist:
    """Return a pose (4, 4) of another source as a finalist without score or sample."""
    pose = invert_transform(map_from_camera)
    return Finalist(np.ascontiguousarray(pose[:3, :3]), pose[:3, 3].copy(), 0.0, 0, _NONE)
