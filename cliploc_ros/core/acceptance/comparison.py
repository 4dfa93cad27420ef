# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The best poses of a search, compared: the likeliest one, and what speaks for and against it.

Each pose is measured on all frames. The likeliest one of each place remains. The evidence for the
first of them is all that decides whether it is accepted.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.attitude import WRONG_MOUNT, tilt_handicaps
from cliploc_ros.core.acceptance.confidence import Setting, confidences, utilities
from cliploc_ros.core.acceptance.look_alikes import chance_distinct, find_twins
from cliploc_ros.core.acceptance.looks import Looks
from cliploc_ros.core.acceptance.support import ComparedFrame, Support, support
from cliploc_ros.core.acceptance.verdict import Evidence, is_exhaustive
from cliploc_ros.core.fit.covariance import share_within
from cliploc_ros.core.fit.finalists import (
    Finalist,
    Match,
    first_of_each_place,
    matches_of,
    meetings_of,
)
from cliploc_ros.core.fit.refinement import refine_rig
from cliploc_ros.core.fit.rig import Rig
from cliploc_ros.core.geometry.tolerances import RIGHT_M, SAME_ANSWER
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.core.maps.joined_map import Place, place_of
from cliploc_ros.core.maps.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.search.frame_search import SearchedFrame, coverage_of
from cliploc_ros.core.search.leaders import MAX_DISTINCT

_NONE = np.empty(0, dtype=np.int64)
# Factor on the covariance where it decides. On simulated worlds (seeds 0 to 39) a factor of 1
# accepts 8 more of 241 single images, and 2 of these are wrong.
_CAUTION = 1.35


class JoinedFrames(NamedTuple):
    """What poses are compared on: searched frames of one camera, in a map.

    Parameters
    ----------
    landmark_map : LandmarkMap
    options : RelocalizerOptions
    frames : sequence of F SearchedFrame
    rig : Rig
        The same frames.
    cameras : ndarray (F, 4, 4)
        Each camera from the last.
    """

    landmark_map: LandmarkMap
    options: RelocalizerOptions
    frames: Sequence[SearchedFrame]
    rig: Rig
    cameras: NDArray[np.float64]

    @property
    def knows_vertical(self) -> bool:
        """Return whether the vertical of any frame is known."""
        return bool(self.rig.verticals[:, 6].any())

    @property
    def setting(self) -> Setting:
        """Return what the chance of a wrong pose depends on, besides the supports."""
        return Setting(len(self.landmark_map),
                       self.options.vertical_deviation_deg if self.knows_vertical else math.inf)


class Comparison(NamedTuple):
    """The finalists, best first, and what supports or contradicts each.

    Parameters
    ----------
    finalists : list of m Finalist
    poses : ndarray (m, 4, 4)
        map_from_camera.
    matches : list of m list of tuple of Match
        Inliers in each frame.
    supports : list of m Support
    handicaps, likely : ndarray (m,)
        See confidences: the log odds against each, and its probability.
    """

    finalists: list[Finalist]
    poses: NDArray[np.float64]
    matches: list[list[tuple[Match, ...]]]
    supports: list[Support]
    handicaps: NDArray[np.float64]
    likely: NDArray[np.float64]


def compare(joined: JoinedFrames, finalists: Sequence[Finalist], is_upright: NDArray[np.bool_]
            ) -> Comparison:
    """Return the finalists with their supports, the likeliest first, one of each place.

    Poses that ignore the known vertical come last. Without refinement the greatest score is
    first, as in the paper.

    Parameters
    ----------
    joined : JoinedFrames
    finalists : sequence of m Finalist
    is_upright : ndarray (m,) of bool
        Which of them use the known vertical.
    """
    poses = np.array([one.map_from_camera for one in finalists])
    matches = [matches_of(joined.rig, one) for one in finalists]
    supports = _supports(joined, poses, matches)
    handicaps = np.where(is_upright, 0.0, WRONG_MOUNT) if joined.knows_vertical \
        else tilt_handicaps(poses, joined.options.tilt_deviation_deg)
    order = list(range(len(finalists)))
    if joined.options.refine:
        likeliest = np.argsort(handicaps - utilities(supports), kind='stable')
        order = [row for known in (True, False) for row in first_of_each_place(
            likeliest[is_upright[likeliest] == known].tolist(), finalists, MAX_DISTINCT)]
    supports, poses, handicaps = [supports[row] for row in order], poses[order], handicaps[order]
    return Comparison([finalists[row] for row in order], poses, [matches[row] for row in order],
                      supports, handicaps,
                      confidences(supports, poses, joined.setting, handicaps=handicaps))


def _supports(joined: JoinedFrames, poses: NDArray[np.float64],
              matches: Sequence[list[tuple[Match, ...]]]) -> list[Support]:
    """Return the support of each pose, from its matches in each frame."""
    used = [one.observation if joined.options.needs_similarities
            else replace(one.observation, similarities=None) for one in joined.frames]
    compared = [ComparedFrame(
        one.observation.detections.bboxes_xyxy, one.observation.detections.class_ids,
        seen.similarities, one.scene, seen.similarity_rows)
        for one, seen in zip(joined.frames, used, strict=True)]
    last_from_cameras = np.linalg.inv(joined.cameras)
    return [support(joined.landmark_map, compared, pose @ last_from_cameras, found)
            for pose, found in zip(poses, matches, strict=True)]


def evidence_of(joined: JoinedFrames, compared: Comparison, covariance: NDArray[np.float64],
                looks: Looks) -> Evidence:
    """Return the evidence for the best pose, the first of all.

    Parameters
    ----------
    joined : JoinedFrames
    compared : Comparison
    covariance : ndarray (6, 6)
        Of the best pose, given its matches.
    looks : Looks
        Results of earlier frames.
    """
    frames, best, pose = joined.frames, compared.finalists[0], compared.poses[0]
    coverage, its, likely = coverage_of(frames), compared.supports[0], compared.likely
    elsewhere = np.nonzero(~SAME_ANSWER.agreeing(compared.poses)[0])[0]
    rivals = likely[elsewhere]
    rival = elsewhere[np.argmax(rivals)] if len(elsewhere) else 0
    distinct, twin = _distinct(joined, compared)
    return Evidence(
        its.inliers, likely[0],
        min(max(rivals, default=0.0), 1.0 - likely[0]),
        distinct=distinct, place=place_of(joined.landmark_map, pose).position,
        twin=twin and twin.position,
        # the covariance of a minimal sample is too rough to decide
        near=1.0 if best.information is None else share_within(
            RIGHT_M, _CAUTION * covariance),
        deviation_m=math.sqrt(np.trace(covariance[:3, :3])),
        coverage=coverage,
        tried=sum(one.known_tried for one in frames),
        meetings=math.inf if is_exhaustive(coverage, joined.options)
        else meetings_of(frames, best, compared.matches[0]),
        unexplained=its.unexplained,
        earlier=looks.confidences_in(frames[-1].observation, pose),
        rival_map=place_of(joined.landmark_map, compared.poses[rival]).name,
        twin_map=twin.name if twin else '')


def _distinct(joined: JoinedFrames, compared: Comparison) -> tuple[float, Place | None]:
    """Return the probability that no place that looks alike has the best pose's camera.

    Next to it is where the camera would be at the likeliest of these places.
    """
    matched = np.array(sorted({one.landmark for found in compared.matches[0]
                               for one in found}), dtype=np.int64)
    elsewhere = ~SAME_ANSWER.agreeing(compared.poses)[0]
    poses = find_twins(joined.landmark_map, compared.poses[0], matched, compared.poses[elsewhere])
    low, high = joined.options.height_range_m
    twins = [_fitted(joined, pose) for pose in poses if low <= pose[2, 3] <= high]
    poses = np.array([compared.poses[0], *(one.map_from_camera for one in twins)])
    # a twin that refinement moved back to the best pose is no other place
    other = np.nonzero(~SAME_ANSWER.agreeing(poses)[0])[0]
    if len(other) == 0:
        return 1.0, None
    twins, poses = [twins[row - 1] for row in other], poses[other]
    supports = _supports(joined, poses, [matches_of(joined.rig, one) for one in twins])
    chance, likeliest = chance_distinct(compared.supports[0], supports)
    return chance, place_of(joined.landmark_map, poses[likeliest])


def _fitted(joined: JoinedFrames, map_from_camera: NDArray[np.float64]) -> Finalist:
    """Return a pose (4, 4) that no search met, refined like those that it met."""
    pose = invert_transform(map_from_camera)
    start = Finalist(np.ascontiguousarray(pose[:3, :3]), pose[:3, 3].copy(), 0.0, 0, 0, _NONE)
    if not joined.options.refine:
        return start
    refined = refine_rig(joined.rig, start.rotation, start.translation)
    return start._replace(**refined._asdict())
