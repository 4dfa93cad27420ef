# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The entry point of the method: Relocalizer.relocalize(observations) -> Relocalization."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.candidates import join_frames
from cliploc_ros.core.acceptance.comparison import (
    Comparison,
    compare,
    evidence_of,
    pose_of,
)
from cliploc_ros.core.acceptance.looks import Looks
from cliploc_ros.core.acceptance.refusal_kind import RefusalKind
from cliploc_ros.core.acceptance.verdict import Evidence, refusal
from cliploc_ros.core.association.candidates import check_k
from cliploc_ros.core.fit.finalists import find_with_rivals
from cliploc_ros.core.geometry.tolerances import SAME_PLACE
from cliploc_ros.core.kernels.compiled import warm_up
from cliploc_ros.core.keyframes.recognizer import ImageRecognizer
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
    def landmark_map(self) -> LandmarkMap:
        """Return the map."""
        return self._map

    @property
    def options(self) -> RelocalizerOptions:
        """Return the options."""
        return self._options

    def warm_up(self) -> None:
        """Compile the kernels, or read them from disk, before the first request needs them."""
        warm_up(call_every_kernel)

    def relocalize(self, observations: Sequence[Observation],
                   recognizer: ImageRecognizer | None = None) -> Relocalization:
        """Find where the camera was when it saw the last of some frames.

        Several frames are localized as one: each of them gives hypotheses, which are scored and
        refined on all of them. Each frame's search gets an equal share of the time budget.

        Parameters
        ----------
        observations : sequence of Observation
            One frame, or up to MAX_FRAMES of one moving camera, linked by odom_from_camera. The
            result is the pose of the last one.
        recognizer : ImageRecognizer, optional
            Of the keyframes, for the image of the last frame.

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
        return self.locate(frames, budget, recognizer=recognizer)

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
               looks: Looks = _NO_LOOKS, recognizer: ImageRecognizer | None = None
               ) -> Relocalization:
        """Find where the camera was when it saw the last of some searched frames.

        Parameters
        ----------
        frames : sequence of SearchedFrame
        budget : TimeBudget, optional
            Time left for the refinement; a new one by default.
        looks : Looks, optional
            Results of earlier frames, which have to agree.
        recognizer : ImageRecognizer, optional
            Of the keyframes, for the image of the last frame.

        Raises
        ------
        OptionsError
            See relocalize.
        """
        budget = budget or self.begin(len(frames))
        joined = join_frames(self._map, self._options, frames)
        finalists, is_upright = find_with_rivals(frames, joined.rig, self._options.refine,
                                                 budget.refinement_end)
        compared = compare(joined, finalists, is_upright, recognizer)
        if not compared.candidates:
            return _nothing_found(frames, budget)
        pose, covariance = pose_of(joined, compared)
        evidence = evidence_of(joined, compared, covariance, looks, recognizer)
        refused = refusal(evidence, self._options)
        shown = compared.by_objects or compared.candidates[0]
        return Relocalization(
            accepted=refused is None, reason=refused.reason if refused else '',
            refusal_kind=refused.kind if refused else None,
            hypotheses=_hypotheses(pose, compared, evidence), matches=shown.matches[-1],
            evidence=evidence, covariance=covariance, tried=_tried(frames),
            best_iteration=shown.finalist.iteration, coverage=coverage_of(frames),
            search_ms=budget.elapsed_ms, stamp_ns=frames[-1].observation.stamp_ns,
            source=compared.source, recognition=compared.recognition)


def _hypotheses(pose: NDArray[np.float64], compared: Comparison, evidence: Evidence
                ) -> tuple[Hypothesis, ...]:
    """Return the pose that leads, and the best one of each other place."""
    found: list[Hypothesis] = []
    for one, its_pose, likely in zip(compared.candidates, [pose, *compared.poses[1:]],
                                     compared.likely, strict=True):
        if not any(SAME_PLACE.agree(its_pose, other.map_from_camera) for other in found):
            found.append(Hypothesis(
                its_pose, one.finalist.score, evidence.confidence if not found
                else float(likely) * evidence.found * evidence.certainty, one.support,
                one.handicap))
    return tuple(found)


def _nothing_found(frames: Sequence[SearchedFrame], budget: TimeBudget) -> Relocalization:
    if any(one.has_samples for one in frames):
        kind, reason = RefusalKind.UNEXPLAINED, 'no pose explains the detections'
    else:
        detections = sum(len(one.observation.detections) for one in frames)
        kind = RefusalKind.TOO_FEW_OBJECTS
        reason = (f'{detections} detections give fewer than {frames[-1].sample_size} distinct '
                  'correspondence candidates')
    return Relocalization(False, f'{reason}; turn the camera to more objects', refusal_kind=kind,
                          tried=_tried(frames), coverage=coverage_of(frames),
                          search_ms=budget.elapsed_ms, stamp_ns=frames[-1].observation.stamp_ns)


def _tried(frames: Sequence[SearchedFrame]) -> int:
    return sum(one.progress.tried for one in frames)
