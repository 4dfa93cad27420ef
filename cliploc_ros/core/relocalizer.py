# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The entry point of the method: Relocalizer.relocalize(observations) -> Relocalization."""

import math
from collections.abc import Sequence

import numpy as np

from cliploc_ros.core.acceptance.comparison import JoinedFrames, compare, evidence_of
from cliploc_ros.core.acceptance.confidence import utilities
from cliploc_ros.core.acceptance.looks import Looks
from cliploc_ros.core.acceptance.refusal_kind import Refusal, RefusalKind
from cliploc_ros.core.acceptance.spread import spread
from cliploc_ros.core.acceptance.verdict import refusal
from cliploc_ros.core.association.candidates import check_k
from cliploc_ros.core.fit.finalists import covariance_of, find_with_rivals
from cliploc_ros.core.fit.rig import cameras_from_last, make_rig
from cliploc_ros.core.kernels.compiled import warm_up
from cliploc_ros.core.maps.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalization import Hypothesis, Relocalization
from cliploc_ros.core.search.frame_search import SearchedFrame, coverage_of, search_frame
from cliploc_ros.core.time_budget import TimeBudget
from cliploc_ros.core.warm_up import call_every_kernel

_NO_LOOKS = Looks()


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
            return _nothing_found(frames, budget, Refusal(
                RefusalKind.TOO_FEW_OBJECTS,
                f'{detections} detections give fewer than {frames[-1].sample_size} distinct '
                'correspondence candidates; turn the camera to more objects'))
        rig = make_rig([one.scene for one in frames], cameras,
                       np.stack([one.vertical for one in frames]), self._map.position_sigmas)
        finalists, is_upright = find_with_rivals(frames, rig, self._options.refine,
                                                 budget.refinement_end)
        if not finalists:
            return _nothing_found(frames, budget, Refusal(
                RefusalKind.UNEXPLAINED,
                'no pose explains the detections; turn the camera to more objects'))
        joined = JoinedFrames(self._map, self._options, frames, rig, cameras)
        compared = compare(joined, finalists, is_upright)
        best, matches, poses = compared.finalists[0], compared.matches[0], compared.poses
        covariance = covariance_of(frames, rig, best, matches, self._map.shared_sigmas)
        nearby = np.zeros((6, 6)) if best.information is None else spread(
            poses, utilities(compared.supports) - compared.handicaps)
        evidence = evidence_of(joined, compared, covariance.matched, looks)
        refused = refusal(evidence, self._options)
        return Relocalization(
            accepted=refused is None, reason=refused.reason if refused else '',
            refusal_kind=refused.kind if refused else None,
            hypotheses=tuple(map(Hypothesis, poses, (one.score for one in compared.finalists),
                                 compared.likely * evidence.certainty, compared.supports,
                                 compared.handicaps.tolist())),
            matches=matches[-1], evidence=evidence, covariance=covariance.whole + nearby,
            tried=_tried(frames), best_iteration=best.iteration, coverage=coverage_of(frames),
            search_ms=budget.elapsed_ms, stamp_ns=frames[-1].observation.stamp_ns)


def _nothing_found(frames: Sequence[SearchedFrame], budget: TimeBudget, refused: Refusal
                   ) -> Relocalization:
    return Relocalization(False, refused.reason, refusal_kind=refused.kind, tried=_tried(frames),
                          coverage=coverage_of(frames), search_ms=budget.elapsed_ms,
                          stamp_ns=frames[-1].observation.stamp_ns)


def _tried(frames: Sequence[SearchedFrame]) -> int:
    return sum(one.progress.tried for one in frames)
