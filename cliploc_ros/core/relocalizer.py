# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The entry point of the method: Relocalizer.relocalize(observations) -> Relocalization."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.attitude import WRONG_MOUNT, tilt_handicaps
from cliploc_ros.core.acceptance.confidence import (
    RIGHT_M,
    ComparedFrame,
    Setting,
    Support,
    agreeing_poses,
    confidences,
    support,
    utilities,
)
from cliploc_ros.core.acceptance.look_alikes import chance_distinct, find_twins
from cliploc_ros.core.acceptance.looks import Looks
from cliploc_ros.core.acceptance.spread import spread
from cliploc_ros.core.acceptance.verdict import Evidence, is_exhaustive, refusal
from cliploc_ros.core.association.candidates import check_k
from cliploc_ros.core.compiled import warm_up
from cliploc_ros.core.fit.covariance import share_within
from cliploc_ros.core.fit.finalists import (
    Finalist,
    Match,
    covariance_of,
    find_finalists,
    first_of_each_place,
    matches_of,
    meetings_of,
)
from cliploc_ros.core.fit.refinement import refine_rig
from cliploc_ros.core.fit.rig import Rig, make_rig
from cliploc_ros.core.geometry.transforms import invert_transform, is_rigid
from cliploc_ros.core.joined_map import Place, place_of
from cliploc_ros.core.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalization import Hypothesis, Relocalization
from cliploc_ros.core.search.frame_search import REFINED, SearchedFrame, search_frame
from cliploc_ros.core.search.leaders import MAX_DISTINCT, same_place
from cliploc_ros.core.time_budget import TimeBudget
from cliploc_ros.core.warm_up import call_every_kernel
from cliploc_ros.errors import OptionsError

#: The most frames that are fused. The leaders of each frame are verified on every frame, so the
#: time grows with the square; and the tenth view of the same objects adds little.
MAX_FRAMES = 10
_NO_LOOKS = Looks()
_NONE = np.empty(0, dtype=np.int64)
# Factor on the covariance where it decides. On simulated worlds (seeds 0 to 39) a factor of 1
# accepts 8 more of 241 single images, and 2 of these are wrong.
_CAUTION = 1.35


class Relocalizer:
    """Finds camera poses in one map.

    Parameters
    ----------
    landmark_map : LandmarkMap
    options : RelocalizerOptions

    Raises
    ------
    OptionsError
        k exceeds the number of landmarks.
    """

    def __init__(self, landmark_map: LandmarkMap, options: RelocalizerOptions) -> None:
        if options.needs_similarities:
            check_k(options.k, len(landmark_map))
        self._map = landmark_map
        landmark_map.prepare()
        self._options = options

    @property
    def options(self) -> RelocalizerOptions:
        """Return the options."""
        return self._options

    def warm_up(self) -> None:
        """Compile the kernels, or read them from disk, before the first request needs them."""
        warm_up(call_every_kernel)

    def relocalize(self, observations: Sequence[Observation]) -> Relocalization:
        """Find where the camera was when it saw the last of some frames.

        Several frames are localized as one: each of them gives hypotheses, which are scored and
        refined on all of them. Each frame's search gets an equal share of the time budget.

        Parameters
        ----------
        observations : sequence of Observation
            One frame, or up to MAX_FRAMES of one moving camera, linked by odom_from_camera. The
            result is the pose of the last one.

        Returns
        -------
        Relocalization
            Accepted, or refused with the reason.

        Raises
        ------
        OptionsError
            Similarities that the matching type needs are missing or of the wrong shape; the
            vertical is no unit vector; odom_from_camera is missing or no rigid transform; there
            are no frames or too many.
        """
        budget = self.begin(len(observations))
        frames = [self.search(one, budget.search_end(number, len(observations)))
                  for number, one in enumerate(observations, start=1)]
        return self.locate(frames, budget)

    def begin(self, frames: int) -> TimeBudget:
        """Return the time budget of a relocalization with some frames; it starts now."""
        return TimeBudget.begin(self._options.time_budget_s, frames)

    def search(self, observation: Observation, deadline: float = math.inf) -> SearchedFrame:
        """Search one frame, until a deadline of time.perf_counter [s].

        Raises
        ------
        OptionsError
            See relocalize.
        """
        return search_frame(self._map, observation, self._options, deadline)

    def locate(self, frames: Sequence[SearchedFrame], budget: TimeBudget | None = None,
               looks: Looks = _NO_LOOKS) -> Relocalization:
        """Find where the camera was when it saw the last of some searched frames.

        Parameters
        ----------
        frames : sequence of SearchedFrame
        budget : TimeBudget, optional
            Time left for the refinement; a new one by default.
        looks : Looks, optional
            Results of earlier frames, which have to agree.

        Raises
        ------
        OptionsError
            See relocalize.
        """
        budget = budget or self.begin(len(frames))
        cameras = cameras_from_last([one.observation for one in frames])
        if not any(one.has_samples for one in frames):
            detections = sum(len(one.observation.detections) for one in frames)
            return _nothing_found(frames, budget, f'{detections} detections give fewer than '
                                  f'{frames[-1].sample_size} distinct correspondence candidates; '
                                  'turn the camera to more objects')
        rig = make_rig([one.scene for one in frames], cameras,
                       np.stack([one.vertical for one in frames]), self._map.position_sigmas)
        finalists, is_upright = self._finalists(frames, rig, budget.refinement_end)
        if not finalists:
            return _nothing_found(frames, budget, 'no pose explains the detections; turn the '
                                                  'camera to more objects')
        compared = self._compare(frames, rig, cameras, finalists, is_upright)
        best, matches, poses = compared.finalists[0], compared.matches[0], compared.poses
        likely = confidences(compared.supports, poses, self._setting(rig),
                             handicaps=compared.handicaps)
        covariance = covariance_of(frames, rig, best, matches, self._map.shared_sigmas)
        nearby = np.zeros((6, 6)) if best.information is None else spread(
            poses, utilities(compared.supports) - compared.handicaps)
        distinct, twin = self._distinct(frames, rig, cameras, compared)
        evidence = replace(
            self._evidence(frames, compared, likely, covariance.matched),
            earlier=looks.confidences_in(frames[-1].observation, poses[0]), distinct=distinct,
            place=place_of(self._map, poses[0]).position, twin=twin and twin.position,
            twin_map=twin.name if twin else '')
        reason = refusal(evidence, self._options)
        return Relocalization(
            accepted=not reason, reason=reason,
            hypotheses=tuple(map(Hypothesis, poses, (one.score for one in compared.finalists),
                                 likely * evidence.certainty, compared.supports,
                                 compared.handicaps.tolist())),
            matches=matches[-1], evidence=evidence, covariance=covariance.whole + nearby,
            tried=_tried(frames), best_iteration=best.iteration, coverage=_coverage(frames),
            search_ms=budget.elapsed_ms, stamp_ns=frames[-1].observation.stamp_ns)

    def _setting(self, rig: Rig) -> Setting:
        known = rig.verticals[:, 6].any()
        return Setting(len(self._map),
                       self._options.vertical_deviation_deg if known else math.inf)

    def _finalists(self, frames: Sequence[SearchedFrame], rig: Rig, deadline: float
                   ) -> tuple[list[Finalist], NDArray[np.bool_]]:
        """Return the best poses, best first, and which of them use the known vertical.

        The others are their rivals: the best poses elsewhere that ignore the vertical, which may
        be wrong.
        """
        upright = find_finalists(frames, rig, self._options.refine, REFINED, deadline)
        if not upright:
            return [], np.empty(0, dtype=np.bool_)
        tilted = find_finalists([one._replace(leaders=one.tilted) for one in frames], rig,
                                self._options.refine, MAX_DISTINCT, deadline)
        elsewhere = [one for one in tilted if not any(
            same_place(one.rotation, one.translation, other.rotation, other.translation)
            for other in upright)]
        finalists = upright + elsewhere
        return finalists, np.arange(len(finalists)) < len(upright)

    def _compare(self, frames: Sequence[SearchedFrame], rig: Rig, cameras: NDArray[np.float64],
                 finalists: Sequence[Finalist], is_upright: NDArray[np.bool_]) -> '_Compared':
        """Return the finalists with their supports, the likeliest first, one of each place.

        Poses that ignore the known vertical come last. Without refinement the greatest score is
        first, as in the paper.
        """
        poses = np.array([one.map_from_camera for one in finalists])
        matches = [matches_of(rig, one) for one in finalists]
        supports = self._supports(frames, cameras, poses, matches)
        handicaps = np.where(is_upright, 0.0, WRONG_MOUNT) if rig.verticals[:, 6].any() \
            else tilt_handicaps(poses, self._options.tilt_deviation_deg)
        order = list(range(len(finalists)))
        if self._options.refine:
            likeliest = np.argsort(handicaps - utilities(supports), kind='stable')
            order = [row for known in (True, False) for row in first_of_each_place(
                likeliest[is_upright[likeliest] == known].tolist(), finalists, MAX_DISTINCT)]
        return _Compared([finalists[row] for row in order], poses[order],
                         [matches[row] for row in order], [supports[row] for row in order],
                         handicaps[order])

    def _supports(self, frames: Sequence[SearchedFrame], cameras: NDArray[np.float64],
                  poses: NDArray[np.float64], matches: Sequence[list[tuple[Match, ...]]]
                  ) -> list[Support]:
        """Return the support of each pose, from its matches in each frame."""
        used = [one.observation if self._options.needs_similarities
                else replace(one.observation, similarities=None) for one in frames]
        compared = [ComparedFrame(
            one.observation.detections.bboxes_xyxy, one.observation.detections.class_ids,
            seen.similarities, one.scene, seen.similarity_rows)
            for one, seen in zip(frames, used, strict=True)]
        last_from_cameras = np.linalg.inv(cameras)
        return [support(self._map, compared, pose @ last_from_cameras, found)
                for pose, found in zip(poses, matches, strict=True)]

    def _distinct(self, frames: Sequence[SearchedFrame], rig: Rig, cameras: NDArray[np.float64],
                  compared: '_Compared') -> tuple[float, Place | None]:
        """Return the probability that no place that looks alike has the best pose's camera.

        Next to it is where the camera would be at the likeliest of these places.
        """
        matched = np.array(sorted({one.landmark for found in compared.matches[0]
                                   for one in found}), dtype=np.int64)
        elsewhere = ~agreeing_poses(compared.poses)[0]
        poses = find_twins(self._map, compared.poses[0], matched, compared.poses[elsewhere])
        low, high = self._options.height_range_m
        twins = [self._fitted(rig, pose) for pose in poses if low <= pose[2, 3] <= high]
        if not twins:
            return 1.0, None
        poses = np.array([one.map_from_camera for one in twins])
        supports = self._supports(frames, cameras, poses, [matches_of(rig, one) for one in twins])
        chance, likeliest = chance_distinct(compared.supports[0], supports)
        return chance, place_of(self._map, poses[likeliest])

    def _fitted(self, rig: Rig, map_from_camera: NDArray[np.float64]) -> Finalist:
        """Return a pose (4, 4) that no search met, refined like those that it met."""
        pose = invert_transform(map_from_camera)
        start = Finalist(np.ascontiguousarray(pose[:3, :3]), pose[:3, 3].copy(), 0.0, 0, 0, _NONE)
        if not self._options.refine:
            return start
        return start._replace(**refine_rig(rig, start.rotation, start.translation)._asdict())

    def _evidence(self, frames: Sequence[SearchedFrame], compared: '_Compared',
                  likely: NDArray[np.float64], covariance: NDArray[np.float64]) -> Evidence:
        """Return the evidence for the best pose, the first of all."""
        coverage, best, supports = _coverage(frames), compared.finalists[0], compared.supports
        elsewhere = np.nonzero(~agreeing_poses(compared.poses)[0])[0]
        rivals = likely[elsewhere]
        rival = elsewhere[np.argmax(rivals)] if len(elsewhere) else 0
        return Evidence(
            supports[0].inliers, likely[0],
            min(max(rivals, default=0.0), 1.0 - likely[0]),
            rival_map=place_of(self._map, compared.poses[rival]).name,
            # the covariance of a minimal sample is too rough to decide
            near=1.0 if best.information is None else share_within(
                RIGHT_M, _CAUTION * covariance),
            deviation_m=math.sqrt(np.trace(covariance[:3, :3])),
            coverage=coverage,
            tried=sum(one.known_tried for one in frames),
            meetings=math.inf if is_exhaustive(coverage, self._options)
            else meetings_of(frames, best, compared.matches[0]),
            unexplained=supports[0].unexplained)


class _Compared(NamedTuple):
    """The finalists, best first, and what supports or contradicts each.

    Parameters
    ----------
    finalists : list of m Finalist
    poses : ndarray (m, 4, 4)
        map_from_camera.
    matches : list of m list of tuple of Match
        Inliers in each frame.
    supports : list of m Support
    handicaps : ndarray (m,)
        See confidences.
    """

    finalists: list[Finalist]
    poses: NDArray[np.float64]
    matches: list[list[tuple[Match, ...]]]
    supports: list[Support]
    handicaps: NDArray[np.float64]


def _nothing_found(frames: Sequence[SearchedFrame], budget: TimeBudget, reason: str
                   ) -> Relocalization:
    return Relocalization(False, reason, tried=_tried(frames), coverage=_coverage(frames),
                          search_ms=budget.elapsed_ms, stamp_ns=frames[-1].observation.stamp_ns)


def _tried(frames: Sequence[SearchedFrame]) -> int:
    return sum(one.progress.tried for one in frames)


def _coverage(frames: Sequence[SearchedFrame]) -> float:
    return min(one.progress.coverage for one in frames)


def cameras_from_last(observations: Sequence[Observation]) -> NDArray[np.float64]:
    """Return each camera from the last (F, 4, 4), by odometry."""
    if not 1 <= len(observations) <= MAX_FRAMES:
        raise OptionsError(f'1 to {MAX_FRAMES} observations at a time, not {len(observations)}')
    cameras = np.tile(np.eye(4), (len(observations), 1, 1))
    if len(observations) == 1:
        return cameras
    linked = []
    for number, one in enumerate(observations, start=1):
        where = f'odom_from_camera of frame {number} of {len(observations)}'
        if one.odom_from_camera is None:
            raise OptionsError(f'{where} is missing: several frames need it')
        if not is_rigid(one.odom_from_camera):
            raise OptionsError(f'{where} is no rigid transform')
        linked.append(one.odom_from_camera)
    for row, odom_from_camera in enumerate(linked[:-1]):
        cameras[row] = invert_transform(odom_from_camera) @ linked[-1]
    return cameras
