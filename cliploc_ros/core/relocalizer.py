# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The entry point of the method: Relocalizer.relocalize(observations) -> Relocalization."""

import logging
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.camera_check import CameraCheck, CameraLook, looks_of
from cliploc_ros.core.acceptance.comparison import Comparison, search_contenders
from cliploc_ros.core.acceptance.confidence import Support
from cliploc_ros.core.acceptance.contenders import Contender, JoinedFrames, join_frames
from cliploc_ros.core.acceptance.depth_check import DepthCheck, check_depth
from cliploc_ros.core.acceptance.links import Link, weakest_link
from cliploc_ros.core.acceptance.looks import NO_LOOKS, Looks
from cliploc_ros.core.acceptance.verdict import Evidence, RefusalKind, refusal
from cliploc_ros.core.calibration import CALIBRATION
from cliploc_ros.core.fit.finalists import Match, find_with_rivals
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.ellipsoid import ellipse_bboxes, project_ellipsoids
from cliploc_ros.core.geometry.transforms import SAME_PLACE
from cliploc_ros.core.kernels.compiled import warm_up
from cliploc_ros.core.keyframes.localization import ImageRecognizer
from cliploc_ros.core.keyframes.places import Recognition, RecognizedPlace
from cliploc_ros.core.keyframes.point_pose import refine
from cliploc_ros.core.map.joined_map import MapPart, parts_of, place_of
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.core.options import NEVER, Deadline, RelocalizerOptions
from cliploc_ros.core.search.frame_search import SearchedFrame, coverage_of, search_frame
from cliploc_ros.errors import OptionsError

# Shares of the budget at which the search and the refinement end. Acceptance uses the remaining
# time.
_SEARCH_SHARE, _REFINEMENT_SHARE = 0.8, 0.9
# Search and refinement end earlier by these times [s] for each frame, up to five frames, because
# poses are scored and compared on all frames. A budget below _SHORT_BUDGET_S scales them down.
_EARLIER_SEARCH_S, _EARLIER_REFINEMENT_S, _SHORT_BUDGET_S = 0.0065, 0.003, 0.05
_MOST_FRAMES = 5


@dataclass(frozen=True)
class Hypothesis:
    """A possible pose of the camera."""

    map_from_camera: NDArray[np.float64]  #: (4, 4)
    score: float  #: Sum of the IoUs of its inliers
    #: Probability that the pose is within 1 m of the truth, 0 to 1. All positions are assumed to
    #: be as uncertain as that of the best hypothesis.
    confidence: float
    support: Support  #: Evidence of the objects, on which the confidence is based
    #: Log odds subtracted for its attitude, see cliploc_ros.core.acceptance.confidence
    handicap: float = 0.0


@dataclass(frozen=True)
class Relocalization:
    """The hypotheses of a relocalization, and whether the best one is accepted."""

    accepted: bool  #: Whether to use the pose
    reason: str  #: Reason for a refusal, in one line; empty when accepted
    #: The best distinct hypotheses, best first; empty if no pose was found
    hypotheses: tuple[Hypothesis, ...] = ()
    #: Inliers of the best hypothesis in each frame, the newest frame last; empty if no pose was
    #: found
    frame_matches: tuple[tuple[Match, ...], ...] = ()
    #: Evidence for the best hypothesis, on which the decision is based; None if no pose was found
    evidence: Evidence | None = None
    #: (6, 6): covariance of the best hypothesis, see cliploc_ros.core.fit.covariance; None if no
    #: pose was found
    covariance: NDArray[np.float64] | None = None
    tried: int = 0  #: Number of hypotheses tried
    #: Iteration that found the best hypothesis, from 1; 0 if no pose was found
    best_iteration: int = 0
    coverage: float = 1.0  #: Share of its samples that the search tried, 0 to 1
    search_ms: float = 0.0  #: Time of association, search and verification [ms]
    source: str = 'objects'  #: The source of the best pose: 'objects', 'keyframes' or 'both'
    #: Kind of the refusal, for use by programs; None when accepted
    refusal_kind: RefusalKind | None = None
    #: Result of the search of keyframes, whatever the source of the best pose; None without
    #: keyframes
    recognition: Recognition | None = None
    #: Check of the depths of the objects; None without depth
    depth: DepthCheck | None = None
    #: Evidence about the cameras, from a pose that depends on boxes and is likely right
    cameras: tuple[CameraLook, ...] = ()
    #: Number of last frames that the answer is from. Odometry does not link earlier frames to them
    frames: int = 1

    @property
    def matches(self) -> tuple[Match, ...]:
        """Return the inliers of the best hypothesis in the newest frame."""
        return self.frame_matches[-1] if self.frame_matches else ()

    @property
    def recognized(self) -> RecognizedPlace | None:
        """Return the first place that keyframes recognize; None without one."""
        return self.recognition.places[0] if self.recognition and self.recognition.places else None

    @property
    def keyframe_search(self) -> str:
        """Return which search of keyframes was run last: 'none', 'fast' or 'thorough'."""
        if self.recognition is None:
            return 'none'
        return 'thorough' if self.recognition.is_thorough else 'fast'

    @property
    def solved(self) -> bool:
        """Return whether any pose was found, accepted or not."""
        return bool(self.hypotheses)

    @property
    def map_from_camera(self) -> NDArray[np.float64] | None:
        """Return the best pose (4, 4), accepted or not; None if no pose was found."""
        return self.hypotheses[0].map_from_camera if self.hypotheses else None

    @property
    def confidence(self) -> float:
        """Return the probability that the best pose is within 1 m; 0 if no pose was found."""
        return self.hypotheses[0].confidence if self.hypotheses else 0.0

    @property
    def score(self) -> float:
        """Return the score of the best pose; 0 if no pose was found."""
        return self.hypotheses[0].score if self.hypotheses else 0.0


def in_its_map(found: Relocalization, landmark_map: LandmarkMap) -> tuple[Relocalization, MapPart]:
    """Transform a result to the coordinate frame of the map of its best pose; return this map too.

    The result was found in landmark_map, which may be a JoinedMap. Poses on other maps are
    dropped, because they have no coordinates in this coordinate frame. The reason for a refusal
    names the map. A result from a single map is returned unchanged.
    """
    parts = parts_of(landmark_map)
    if found.map_from_camera is None or len(parts) == 1:
        return found, parts[0]
    places = [place_of(landmark_map, hypothesis.map_from_camera)
              for hypothesis in found.hypotheses]
    part, name = places[0].part, places[0].name
    rows = range(part.first, part.first + len(part.landmark_map))
    reason = found.reason and f'in {name}: {found.reason}'
    return replace(
        found, reason=reason,
        hypotheses=tuple(replace(hypothesis, map_from_camera=place.map_from_camera)
                         for hypothesis, place in zip(found.hypotheses, places, strict=True)
                         if place.name == name),
        frame_matches=tuple(tuple(replace(match, landmark=match.landmark - part.first)
                                  for match in of_frame if match.landmark in rows)
                            for of_frame in found.frame_matches),
        recognition=found.recognition and found.recognition._replace(places=tuple(
            place._replace(map_from_camera=own.map_from_camera, points=place.points - part.shift)
            for place in found.recognition.places
            if (own := place_of(landmark_map, place.map_from_camera)).name == name))), part


@dataclass(frozen=True)
class TimeBudget:
    """A budget of processor time of the thread that searches."""

    start: float  #: Processor time of the thread when it begins [s]
    total_s: float  #: Infinite for no limit
    frames: int  #: Number of frames that are localized together
    request: float = math.inf  #: See Deadline
    #: Start on the clock of time.perf_counter
    begun_s: float = field(default_factory=time.perf_counter)

    def search_end(self, number: int = 1, count: int = 1) -> Deadline:
        """Return the end of the search of frame `number`, from 1, of `count` frames."""
        return Deadline(self.start + self._time_s(_SEARCH_SHARE, _EARLIER_SEARCH_S)
                        * number / count, self.request)

    @property
    def refinement_end(self) -> Deadline:
        """Return the end of the refinement."""
        return Deadline(self.start + self._time_s(_REFINEMENT_SHARE, _EARLIER_REFINEMENT_S),
                        self.request)

    @property
    def elapsed_ms(self) -> float:
        """Return the time since the start [ms]."""
        return (time.perf_counter() - self.begun_s) * 1e3

    def _time_s(self, share: float, earlier_s: float) -> float:
        scale = min(1.0, self.total_s / _SHORT_BUDGET_S)
        return share * self.total_s - scale * earlier_s * min(self.frames, _MOST_FRAMES)


class Relocalizer:
    """Find camera poses in one map.

    Raises
    ------
    OptionsError
        k exceeds the number of landmarks.
    """

    def __init__(self, landmark_map: LandmarkMap, options: RelocalizerOptions) -> None:
        if options.needs_similarities and options.k > (count := len(landmark_map)) > 0:
            raise OptionsError(f'k = {options.k}, but the map has {count} landmarks: set k to '
                               f'{count} or less')
        self.landmark_map = landmark_map
        landmark_map.prepare()
        self.options = options

    @staticmethod
    def warm_up() -> None:
        """Compile the kernels, or read them from disk, before the first request."""
        warm_up(_call_every_kernel)

    def relocalize(self, observations: Sequence[Observation],
                   recognizer: ImageRecognizer | None = None) -> Relocalization:
        """Find the pose of the camera at the last of one or more frames.

        Up to MAX_FRAMES frames of one moving camera are localized together: each frame gives
        hypotheses, which are scored and refined on all frames. The search of each frame has an
        equal share of the time budget. The recognizer searches the keyframes for the image of the
        last frame.

        Raises
        ------
        OptionsError
            Similarities that the matching type needs are missing or have the wrong shape; the
            vertical is not a unit vector; odom_from_camera is missing or not a rigid transform;
            there are no frames or too many.
        """
        budget = self.begin(len(observations))
        frames = [self.search(observation, budget.search_end(number, len(observations)))
                  for number, observation in enumerate(observations, start=1)]
        return self.look_again(self.locate(frames, budget, recognizer=recognizer), frames,
                               recognizer=recognizer)

    def begin(self, frames: int, cameras: int = 1, request: float = math.inf) -> TimeBudget:
        """Return the time budget of a relocalization with a number of frames; it starts now.

        For several cameras of one instant, the time budget is multiplied by their number.
        `request` is when a request needs the result (monotonic clock) [s].
        """
        return TimeBudget(time.thread_time(), cameras * self.options.time_budget_s, frames,
                          request)

    def search(self, observation: Observation, deadline: Deadline = NEVER) -> SearchedFrame:
        """Search one frame, until a deadline."""
        return search_frame(self.landmark_map, observation, self.options, deadline)

    def locate(self, frames: Sequence[SearchedFrame], budget: TimeBudget | None = None,
               looks: Looks = NO_LOOKS, recognizer: ImageRecognizer | None = None,
               cameras: CameraCheck | None = None) -> Relocalization:
        """Find the pose of the camera at the last of one or more searched frames.

        Parameters
        ----------
        frames : sequence of SearchedFrame
            Frames that odometry links, the frame to localize last.
        budget : TimeBudget, optional
            Time budget that limits the refinement; by default a new budget.
        looks : Looks, optional
            Earlier looks, which must agree with the pose.
        recognizer : ImageRecognizer, optional
            Search of keyframes for the image of the last frame.
        cameras : CameraCheck, optional
            Evidence about the cameras; by default there is none.

        Raises
        ------
        OptionsError
            See relocalize.
        """
        budget = budget or self.begin(len(frames))
        joined = join_frames(self.landmark_map, self.options, frames)
        met = self._meet(joined, budget)
        depth = check_depth(joined.rig, met[0].finalist) if met else None
        if depth is not None and not depth.is_passed:
            joined = joined.without_depth()
            met = self._meet(joined, budget)
        compared = Comparison(joined, met, looks, recognizer)
        result = Relocalization(
            False, '', tried=sum(frame.progress.tried for frame in frames),
            coverage=coverage_of(frames), recognition=compared.recognition, frames=len(frames))
        if not compared.contenders:
            kind, reason = _nothing_found(self.landmark_map, frames)
            return replace(result, reason=reason, refusal_kind=kind, search_ms=budget.elapsed_ms)
        pose, covariance = compared.pose()
        link = Link()
        if len(frames) > 1 and self.options.refine:
            link = weakest_link(joined, pose, compared.recognition,
                                lambda own: self._meet(own, self.begin(len(own.frames))))
        if link.holds < self.options.min_confidence:
            alone = self.locate(frames[-link.kept:], None, looks, recognizer, cameras)
            if alone.accepted:
                return replace(alone, tried=result.tried, search_ms=budget.elapsed_ms)
        evidence = replace(compared.evidence(covariance), linked=link.chance)
        seen: list[CameraLook] = []
        if compared.by_boxes is not None and self.options.refine:
            # a wrong camera may be the cause of low confidence
            if refusal(replace(evidence, near=1.0), replace(self.options, min_confidence=min(
                    self.options.min_confidence, CALIBRATION.camera.likely))) is None:
                seen = looks_of(joined, compared.by_boxes.finalist)
            camera, covariance, fault = (cameras or CameraCheck()).judge(seen, covariance)
            evidence = replace(evidence, camera=camera, camera_fault=fault)
        refused = refusal(evidence, self.options)
        shown = compared.by_objects or compared.contenders[0]
        # the leading pose, and the best pose at each other place
        poses = np.array([pose, *compared.poses[1:]])
        confidences = (compared.likely * evidence.found * evidence.certainty).tolist()
        confidences[0] = evidence.confidence
        hypotheses = tuple(Hypothesis(
            poses[row], one.finalist.score, confidences[row], one.support, one.handicap)
            for row in SAME_PLACE.distinct(poses) for one in [compared.contenders[row]])
        return replace(
            result, accepted=refused is None, reason=refused.reason if refused else '',
            refusal_kind=refused.kind if refused else None,
            hypotheses=hypotheses, frame_matches=tuple(shown.matches),
            evidence=evidence, covariance=covariance, best_iteration=shown.finalist.iteration,
            search_ms=budget.elapsed_ms, source=compared.source, depth=depth,
            cameras=tuple(seen))

    def look_again(self, found: Relocalization, frames: Sequence[SearchedFrame],
                   looks: Looks = NO_LOOKS, recognizer: ImageRecognizer | None = None,
                   cameras: CameraCheck | None = None) -> Relocalization:
        """Repeat a refused result of locate with a thorough search of the keyframes.

        The result is returned unchanged if it was accepted, or if there is not enough time. The
        other arguments are those of locate.
        """
        if found.accepted or recognizer is None or not recognizer.begin_thorough():
            return found
        budget = self.begin(len(frames), request=recognizer.deadline)
        again = self.locate(frames, budget, looks, recognizer, cameras)
        assert again.recognition is not None
        kept = again if again.recognition.is_complete else found
        return replace(kept, search_ms=found.search_ms + again.search_ms)

    def _meet(self, joined: JoinedFrames, budget: TimeBudget) -> list[Contender]:
        """Return the best poses that the search found, see search_contenders."""
        return search_contenders(joined, *find_with_rivals(
            joined.frames, joined.rig, self.options.refine, budget.refinement_end))


def _nothing_found(landmark_map: LandmarkMap, frames: Sequence[SearchedFrame]
                   ) -> tuple[RefusalKind, str]:
    """Return kind and reason of the refusal if no pose was found."""
    if not len(landmark_map):
        return RefusalKind.TOO_FEW_OBJECTS, ('the map has only keyframes, and none matches the '
                                             'image; turn the camera to a recorded view')
    if any(frame.has_samples for frame in frames):
        kind, reason = RefusalKind.UNEXPLAINED, 'no pose explains the detections'
    else:
        detections = sum(len(frame.observation.detections) for frame in frames)
        kind = RefusalKind.TOO_FEW_OBJECTS
        reason = (f'{detections} detections give fewer than {frames[-1].sample_size} distinct '
                  'correspondence candidates')
    return kind, f'{reason}; turn the camera to more objects'


def _call_every_kernel() -> None:
    """Call every kernel that a localization needs: localize with eight boxes of a small map."""
    names = tuple('abcdefgh')
    centers = np.random.default_rng(0).uniform((-1.0, -1.0, 4.0), (1.0, 1.0, 6.0), (8, 3))
    landmark_map = LandmarkMap('map', names, names, names, centers, np.full((8, 3), 0.2),
                               np.tile([0.0, 0.0, 0.0, 1.0], (8, 1)))
    camera = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)
    boxes = camera.bboxes_in_pixels(ellipse_bboxes(project_ellipsoids(
        np.eye(4), centers, landmark_map.shapes)))
    frame = Observation(camera, Detections(boxes, names, np.ones(8)), np.eye(8, dtype=np.float32),
                        odom_from_camera=np.eye(4), depths=centers[:, 2])
    for algorithm in ('bf', 'ransac', 'auto'):
        relocalizer = Relocalizer(landmark_map, RelocalizerOptions(k=1, algorithm=algorithm))
        relocalizer.search(frame)
    relocalizer.relocalize([frame, replace(frame, up_in_camera=np.array([0.0, -1.0, 0.0]))])
    points = np.indices((3, 3, 2)).reshape(3, -1).T + np.array([0.0, 0.0, 3.0])
    refine(points, points[:, :2] / points[:, 2:], np.eye(4))


if __name__ == '__main__':
    logging.basicConfig(level=logging.INFO, format='%(message)s')
    Relocalizer.warm_up()
