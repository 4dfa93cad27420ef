# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The entry point of the method: Relocalizer.relocalize(observations) -> Relocalization."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.camera_check import CameraCheck, CameraLook, looks_of
from cliploc_ros.core.acceptance.comparison import Comparison, search_contenders
from cliploc_ros.core.acceptance.contenders import (
    Contender,
    JoinedFrames,
    join_frames,
    without_depth,
)
from cliploc_ros.core.acceptance.depth_check import check_depth
from cliploc_ros.core.acceptance.looks import Looks
from cliploc_ros.core.acceptance.verdict import Evidence, RefusalKind, refusal
from cliploc_ros.core.fit.finalists import find_with_rivals
from cliploc_ros.core.geometry.transforms import SAME_PLACE
from cliploc_ros.core.kernels.compiled import warm_up
from cliploc_ros.core.keyframes.localization import ImageRecognizer
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalization import Hypothesis, Relocalization
from cliploc_ros.core.search.candidates import check_k
from cliploc_ros.core.search.frame_search import SearchedFrame, coverage_of, search_frame
from cliploc_ros.core.warm_up import call_every_kernel

# Shares of the budget at which the search and the refinement end; acceptance takes the rest.
_SEARCH_SHARE, _REFINEMENT_SHARE = 0.8, 0.9
# Both end earlier by this time [s] for each frame, up to five, since poses are scored and compared
# on all frames. A budget below _SHORT_BUDGET_S scales these times down.
_EARLIER_SEARCH_S, _EARLIER_REFINEMENT_S, _SHORT_BUDGET_S = 0.0065, 0.003, 0.05
_MOST_FRAMES = 5
_NO_LOOKS = Looks()


@dataclass(frozen=True)
class TimeBudget:
    """A time budget that runs from `start`. All times are those of time.perf_counter [s]."""

    start: float
    total_s: float  #: Infinite for no limit
    frames: int  #: Number of frames that are localized together

    def search_end(self, number: int = 1, count: int = 1) -> float:
        """Return when the search of a frame ends: the number-th of count frames to search."""
        return self.start + self._time_s(_SEARCH_SHARE, _EARLIER_SEARCH_S) * number / count

    @property
    def refinement_end(self) -> float:
        """Return when the refinement ends."""
        return self.start + self._time_s(_REFINEMENT_SHARE, _EARLIER_REFINEMENT_S)

    @property
    def elapsed_ms(self) -> float:
        """Return the time since the start [ms]."""
        return (time.perf_counter() - self.start) * 1e3

    def _time_s(self, share: float, earlier_s: float) -> float:
        scale = min(1.0, self.total_s / _SHORT_BUDGET_S)
        frames = min(self.frames, _MOST_FRAMES)
        return share * self.total_s - scale * earlier_s * frames


class Relocalizer:
    """Finds camera poses in one map.

    Raises
    ------
    OptionsError
        k exceeds the number of landmarks.
    """

    def __init__(self, landmark_map: LandmarkMap, options: RelocalizerOptions) -> None:
        if options.needs_similarities:
            check_k(options.k, len(landmark_map))
        #: The map
        self.landmark_map = landmark_map
        landmark_map.prepare()
        #: The options
        self.options = options

    def warm_up(self) -> None:
        """Compile the kernels, or read them from disk, before the first request needs them."""
        warm_up(call_every_kernel)

    def relocalize(self, observations: Sequence[Observation],
                   recognizer: ImageRecognizer | None = None) -> Relocalization:
        """Find where the camera was when it saw the last of some frames.

        Several frames, up to MAX_FRAMES of one moving camera, are localized as one: each of them
        gives hypotheses, which are scored and refined on all of them. Each frame's search gets an
        equal share of the time budget. The recognizer is of the keyframes, for the image of the
        last frame.

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

    def begin(self, frames: int, cameras: int = 1) -> TimeBudget:
        """Return the time budget of a relocalization with some frames; it starts now.

        What several cameras see at one instant has the time of each.
        """
        return TimeBudget(time.perf_counter(), cameras * self.options.time_budget_s, frames)

    def search(self, observation: Observation, deadline: float = math.inf) -> SearchedFrame:
        """Search one frame, until a deadline of time.perf_counter [s]."""
        return search_frame(self.landmark_map, observation, self.options, deadline)

    def locate(self, frames: Sequence[SearchedFrame], budget: TimeBudget | None = None,
               looks: Looks = _NO_LOOKS, recognizer: ImageRecognizer | None = None,
               cameras: CameraCheck | None = None) -> Relocalization:
        """Find where the camera was when it saw the last of some searched frames.

        The budget is the time left for the refinement, by default a new one. Earlier looks have to
        agree. The recognizer is of the keyframes, for the image of the last frame. What is known
        of the cameras counts, by default nothing. Raises OptionsError, see relocalize.
        """
        budget = budget or self.begin(len(frames))
        joined = join_frames(self.landmark_map, self.options, frames)
        met = self._meet(joined, budget)
        depth = check_depth(joined.rig, met[0].finalist) if met else None
        if depth is not None and not depth.is_passed:
            joined = without_depth(joined)
            met = self._meet(joined, budget)
        compared = Comparison(joined, met, looks, recognizer)
        result = Relocalization(
            False, '', tried=sum(one.progress.tried for one in frames),
            coverage=coverage_of(frames), stamp_ns=frames[-1].observation.stamp_ns)
        if not compared.contenders:
            kind, reason = _nothing_found(frames)
            return replace(result, reason=reason, refusal_kind=kind, search_ms=budget.elapsed_ms)
        pose, covariance = compared.pose()
        evidence = compared.evidence(covariance)
        seen: list[CameraLook] = []
        if compared.by_boxes is not None and self.options.refine:
            # an uncertain position may be the camera's fault
            if refusal(replace(evidence, near=1.0), self.options) is None:
                seen = looks_of(joined, compared.by_boxes.finalist)
            camera, fault = (cameras or CameraCheck()).judge(seen, covariance)
            evidence = replace(evidence, camera=camera, camera_fault=fault)
        refused = refusal(evidence, self.options)
        shown = compared.by_objects or compared.contenders[0]
        return replace(
            result, accepted=refused is None, reason=refused.reason if refused else '',
            refusal_kind=refused.kind if refused else None,
            hypotheses=_hypotheses(pose, compared, evidence), frame_matches=tuple(shown.matches),
            evidence=evidence, covariance=covariance, best_iteration=shown.finalist.iteration,
            search_ms=budget.elapsed_ms, source=compared.source,
            recognition=compared.recognition, depth=depth, cameras=tuple(seen))

    def _meet(self, joined: JoinedFrames, budget: TimeBudget) -> list[Contender]:
        """Return the best poses that the search met, see search_contenders."""
        return search_contenders(joined, *find_with_rivals(
            joined.frames, joined.rig, self.options.refine, budget.refinement_end))


def _hypotheses(pose: NDArray[np.float64], compared: Comparison, evidence: Evidence
                ) -> tuple[Hypothesis, ...]:
    """Return the pose that leads, and the best one of each other place."""
    poses = np.array([pose, *compared.poses[1:]])
    confidences = compared.likely * evidence.found * evidence.certainty
    rows = SAME_PLACE.distinct(poses)
    found = [compared.contenders[row] for row in rows]
    return tuple(Hypothesis(
        poses[row], one.finalist.score, float(confidences[row]) if row else evidence.confidence,
        one.support, one.handicap) for row, one in zip(rows, found, strict=True))


def _nothing_found(frames: Sequence[SearchedFrame]) -> tuple[RefusalKind, str]:
    """Return why there is no pose."""
    if any(one.has_samples for one in frames):
        kind, reason = RefusalKind.UNEXPLAINED, 'no pose explains the detections'
    else:
        detections = sum(len(one.observation.detections) for one in frames)
        kind = RefusalKind.TOO_FEW_OBJECTS
        reason = (f'{detections} detections give fewer than {frames[-1].sample_size} distinct '
                  'correspondence candidates')
    return kind, f'{reason}; turn the camera to more objects'
