# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The poses of all sources compared: the likeliest one, and the evidence for and against it.

Poses that the search of objects met and poses that keyframes recognized compete in one list. Each
is measured on the detections of all frames and on the points of the keyframes. The likeliest one
leads, and the evidence for it is all that decides whether it is accepted.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.attitude import tilt_handicaps
from cliploc_ros.core.acceptance.calibration import CALIBRATION
from cliploc_ros.core.acceptance.confidence import (
    Setting,
    confidences,
    none_right,
    points_utility,
    utilities,
)
from cliploc_ros.core.acceptance.look_alikes import chance_distinct, find_twins
from cliploc_ros.core.acceptance.looks import Looks
from cliploc_ros.core.acceptance.spread import spread
from cliploc_ros.core.acceptance.support import ComparedFrame, Support, support
from cliploc_ros.core.acceptance.verdict import Evidence, is_exhaustive
from cliploc_ros.core.fit.covariance import share_within
from cliploc_ros.core.fit.finalists import (
    Finalist,
    Match,
    covariance_of,
    first_of_each_place,
    matches_of,
    meetings_of,
)
from cliploc_ros.core.fit.fusion import fuse
from cliploc_ros.core.fit.refinement import refine_rig
from cliploc_ros.core.fit.rig import Rig
from cliploc_ros.core.geometry.tolerances import RIGHT_M, SAME_ANSWER
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.core.keyframes.localization import RecognizedPlace
from cliploc_ros.core.maps.joined_map import Place, place_of
from cliploc_ros.core.maps.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.search.frame_search import SearchedFrame, coverage_of
from cliploc_ros.core.search.leaders import MAX_DISTINCT


_NONE = np.empty(0, dtype=np.int64)


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


class Candidate(NamedTuple):
    """A pose that may be right, and what supports it.

    Parameters
    ----------
    finalist : Finalist
        Of the search of objects, or the pose of keyframes as one.
    pose : ndarray (4, 4)
        map_from_camera.
    matches : list of F tuple of Match
        Inliers in each frame.
    support : Support
        By objects.
    handicap : float
        Log odds that its attitude takes from it.
    odds : float
        Logarithm of its odds, up to a constant that all candidates share.
    recognized : RecognizedPlace or None
        What keyframes show there, where they propose the pose.
    """

    finalist: Finalist
    pose: NDArray[np.float64]
    matches: list[tuple[Match, ...]]
    support: Support
    handicap: float
    odds: float
    recognized: RecognizedPlace | None = None


class Comparison(NamedTuple):
    """The candidates, and what decides between them.

    Parameters
    ----------
    candidates : list of m Candidate
        The leading one first; of those of one source, one of each place.
    poses : ndarray (m, 4, 4)
    likely : ndarray (m,)
        Probability of each, shared by those that agree.
    """

    candidates: list[Candidate]
    poses: NDArray[np.float64]
    likely: NDArray[np.float64]

    @property
    def leading(self) -> NDArray[np.bool_]:
        """Return which candidates (m,) agree with the leading one."""
        return SAME_ANSWER.agreeing(self.poses)[0]

    @property
    def by_objects(self) -> Candidate | None:
        """Return the best candidate of the leading place that the search of objects met."""
        return next((one for one, near in zip(self.candidates, self.leading, strict=True)
                     if near and one.recognized is None), None)

    @property
    def by_keyframes(self) -> Candidate | None:
        """Return the best candidate of the leading place that keyframes propose."""
        return next((one for one, near in zip(self.candidates, self.leading, strict=True)
                     if near and one.recognized is not None), None)


def compare(joined: JoinedFrames, finalists: Sequence[Finalist], is_upright: NDArray[np.bool_],
            places: Sequence[RecognizedPlace] = ()) -> Comparison:
    """Return the candidates compared.

    Poses that ignore the known vertical come last. Without refinement the greatest score is
    first, as in the paper.

    Parameters
    ----------
    joined : JoinedFrames
    finalists : sequence of m Finalist
        Of the search of objects.
    is_upright : ndarray (m,) of bool
        Which of them use the known vertical.
    places : sequence of RecognizedPlace
        Where keyframes recognize the last frame.
    """
    low, high = joined.options.height_range_m
    places = [one for one in places if low <= one.map_from_camera[2, 3] <= high]
    upright = [*is_upright.tolist(), *(_keeps_vertical(joined, one) for one in places)]
    every = _candidates(joined, [*finalists, *(_unrefined(one.map_from_camera)
                                               for one in places)],
                        upright, [None] * len(finalists) + [*places])
    order = list(range(len(every)))
    if joined.options.refine:
        likeliest = sorted(order, key=lambda row: -every[row].odds)
        order = [row for known in (True, False) for row in first_of_each_place(
            [row for row in likeliest if upright[row] == known and row < len(finalists)],
            finalists, MAX_DISTINCT)]
        order += range(len(finalists), len(every))
        order.sort(key=lambda row: (not upright[row], -every[row].odds))
    candidates = [every[row] for row in order]
    poses = np.array([one.pose for one in candidates]).reshape(-1, 4, 4)
    return Comparison(candidates, poses, confidences(
        np.array([one.odds for one in candidates]), poses, none_right(joined.setting)))


def _candidates(joined: JoinedFrames, finalists: Sequence[Finalist], upright: Sequence[bool],
                recognized: Sequence[RecognizedPlace | None]) -> list[Candidate]:
    poses = np.array([one.map_from_camera for one in finalists]).reshape(-1, 4, 4)
    matches = [matches_of(joined.rig, one) for one in finalists]
    supports = supports_of(joined, poses, matches)
    handicaps = np.where(upright, 0.0, CALIBRATION.attitude.wrong_mount) \
        if joined.knows_vertical else tilt_handicaps(poses, joined.options.tilt_deviation_deg)
    by_objects, none = utilities(supports), none_right(joined.setting)
    return [Candidate(one, pose, found, its, float(handicap),
                      (utility if place is None else none + points_utility(place, its)) - handicap,
                      place)
            for one, pose, found, its, handicap, utility, place in zip(
                finalists, poses, matches, supports, handicaps, by_objects.tolist(), recognized,
                strict=True)]


def _keeps_vertical(joined: JoinedFrames, place: RecognizedPlace) -> bool:
    """Return whether a pose of keyframes agrees with the vertical of the last frame."""
    up_in_camera, up_in_map, deviation = np.split(joined.rig.verticals[-1], [3, 6])
    if not deviation[0]:
        return True
    cosine = up_in_camera @ place.map_from_camera[:3, :3].T @ up_in_map
    own = math.sqrt(np.trace(place.covariance[3:, 3:]) / 3.0)
    return math.acos(min(cosine, 1.0)) <= CALIBRATION.attitude.vertical_sigmas * math.hypot(
        deviation[0], own)


def _unrefined(map_from_camera: NDArray[np.float64]) -> Finalist:
    """Return a pose (4, 4) of another source like those that a search met."""
    pose = invert_transform(map_from_camera)
    return Finalist(np.ascontiguousarray(pose[:3, :3]), pose[:3, 3].copy(), 0.0, 0, 0, _NONE)


def pose_of(joined: JoinedFrames, compared: Comparison
            ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the pose (4, 4) of the leading place and its covariance (6, 6).

    A pose of many points stays as it is: objects are rougher. One of few points can be off by
    more than its covariance says, so it is made less certain, and fused with that of the objects.
    """
    by_objects, by_keyframes = compared.by_objects, compared.by_keyframes
    found = None
    if by_objects is not None:
        covariance = covariance_of(joined.frames, joined.rig, by_objects.finalist,
                                   by_objects.matches, joined.landmark_map.shared_sigmas)
        if by_objects.finalist.information is not None:
            others = [one for one in compared.candidates if one.recognized is None]
            others.sort(key=lambda one: one is not by_objects)
            covariance = covariance + spread(np.array([one.pose for one in others]),
                                             np.array([one.odds for one in others]))
        found = by_objects.pose, covariance
    if by_keyframes is None or by_keyframes.recognized is None:
        assert found is not None
        return found
    place = by_keyframes.recognized
    doubt = max(1.0, CALIBRATION.keyframes.good_covariance / place.inliers) ** 4
    if found is None or doubt == 1.0:
        return by_keyframes.pose, doubt * place.covariance
    return fuse(*found, by_keyframes.pose, doubt * place.covariance)


def evidence_of(joined: JoinedFrames, compared: Comparison, covariance: NDArray[np.float64],
                looks: Looks, recognizer: ImageRecognizer | None = None) -> Evidence:
    """Return the evidence for the leading pose.

    Parameters
    ----------
    joined : JoinedFrames
    compared : Comparison
    covariance : ndarray (6, 6)
        Of the leading pose.
    looks : Looks
        Results of earlier frames.
    recognizer : ImageRecognizer, optional
        Of the keyframes, where there are some.
    """
    candidates, likely, leading = compared.candidates, compared.likely, compared.leading
    by_objects, by_keyframes = compared.by_objects, compared.by_keyframes
    best = by_objects or candidates[0]
    rival = max(np.nonzero(~leading)[0], key=lambda row: likely[row], default=None)
    coverage = coverage_of(joined.frames)
    distinct, twin = _distinct(joined, compared, recognizer)
    pose = compared.poses[0]
    return Evidence(
        best.support.inliers, likely[0], _by_points(joined, compared),
        rival=0.0 if rival is None else min(likely[rival], 1.0 - likely[0]),
        distinct=distinct, place=place_of(joined.landmark_map, pose).position,
        twin=twin and twin.position,
        # the covariance of a minimal sample is too rough to decide
        near=1.0 if by_keyframes is None and best.finalist.information is None else share_within(
            RIGHT_M, covariance),
        deviation_m=math.sqrt(np.trace(covariance[:3, :3])),
        coverage=coverage,
        tried=sum(one.known_tried for one in joined.frames),
        meetings=math.inf if is_exhaustive(coverage, joined.options) or by_objects is None
        else meetings_of(joined.frames, best.finalist, best.matches),
        unexplained=best.support.unexplained,
        earlier=looks.confidences_in(joined.frames[-1].observation, pose),
        rival_map='' if rival is None else place_of(joined.landmark_map,
                                                    compared.poses[rival]).name,
        twin_map=twin.name if twin else '',
        rival_by='' if rival is None else candidates[rival].source,
        recognized=by_keyframes and by_keyframes.recognized)


def _by_points(joined: JoinedFrames, compared: Comparison) -> float:
    """Return the probability of the leading place without what the search of objects met there."""
    if compared.by_keyframes is None:
        return 0.0
    rows = [row for row, (one, near) in enumerate(zip(compared.candidates, compared.leading,
                                                      strict=True))
            if one.recognized is not None or not near]
    found = confidences(np.array([compared.candidates[row].odds for row in rows]),
                        compared.poses[rows], none_right(joined.setting))
    return float(found[[compared.candidates[row] is compared.by_keyframes
                        for row in rows].index(True)])


def _distinct(joined: JoinedFrames, compared: Comparison, recognizer: ImageRecognizer | None
              ) -> tuple[float, Place | None]:
    """Return the probability that no place that looks alike has the leading pose's camera.

    Next to it is where the camera would be at the likeliest of these places. Keyframes tell a
    twin apart as far as they cover it.
    """
    best, low_high = compared.candidates[0], joined.options.height_range_m
    matched = np.array(sorted({one.landmark for found in best.matches for one in found}),
                       dtype=np.int64)
    found = find_twins(joined.landmark_map, best.pose, matched,
                       compared.poses[~compared.leading])
    low, high = low_high
    twins = [_fitted(joined, pose) for pose in found if low <= pose[2, 3] <= high]
    poses = np.array([best.pose, *(one.map_from_camera for one in twins)])
    # a twin that refinement moved back to the leading pose is no other place
    others = np.nonzero(~SAME_ANSWER.agreeing(poses)[0])[0]
    if len(others) == 0:
        return 1.0, None
    supports = supports_of(joined, poses[others],
                           [matches_of(joined.rig, twins[row - 1]) for row in others])
    recognized = compared.by_keyframes and compared.by_keyframes.recognized
    leads = np.zeros(len(others)) if recognizer is None or recognized is None else np.array(
        [recognizer.coverage(pose) for pose in poses[others]]) * max(
            0.0, points_utility(recognized, best.support))
    chance, likeliest = chance_distinct(best.support, supports, leads)
    return chance, place_of(joined.landmark_map, poses[others][likeliest])


def _fitted(joined: JoinedFrames, map_from_camera: NDArray[np.float64]) -> Finalist:
    """Return a pose (4, 4) that no search met, refined like those that it met."""
    start = _unrefined(map_from_camera)
    if not joined.options.refine:
        return start
    return start._replace(**refine_rig(joined.rig, start.rotation, start.translation)._asdict())


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
