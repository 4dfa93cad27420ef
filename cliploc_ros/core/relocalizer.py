# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The one door to the method: Relocalizer.relocalize(observations) -> Relocalization."""

import math
import time
from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.confidence import Support, View, confidences, support
from cliploc_ros.core.acceptance.verdict import Evidence, is_exhaustive, refusal
from cliploc_ros.core.association.candidates import check_k
from cliploc_ros.core.association.scene import make_scene
from cliploc_ros.core.compiled import warm_up
from cliploc_ros.core.fit.finalists import (
    Finalist,
    Match,
    covariance_of,
    find_finalists,
    matches_of,
    meetings_of,
)
from cliploc_ros.core.fit.refinement import refine_rig
from cliploc_ros.core.fit.rig import Rig, make_rig
from cliploc_ros.core.fit.verification import choose_distinct, scores_of
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.ellipsoid import project_ellipsoids
from cliploc_ros.core.geometry.transforms import invert_transform, is_rigid
from cliploc_ros.core.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalization import Hypothesis, Relocalization
from cliploc_ros.core.search.compatibility import compatible_pairs
from cliploc_ros.core.search.frame_search import REFINED, Searched, search_frame
from cliploc_ros.core.search.leaders import MAX_DISTINCT, Leaders, same_place
from cliploc_ros.core.search.prior import VERTICAL_UNKNOWN
from cliploc_ros.core.search.sampling import draw_ransac
from cliploc_ros.core.search.strategies import (
    search_exhaustively,
    search_progressively,
    search_samples,
)
from cliploc_ros.errors import OptionsError

#: The most frames that are fused. Each frame's leaders are verified on every frame, so that time
#: grows with the square; and the tenth view of the same objects says little that is new.
MAX_FRAMES = 10
# Of the time budget: when the search ends, and the refinement; judging the result takes the rest.
_SEARCH_SHARE, _REFINED_SHARE = 0.8, 0.9
# And so much earlier [s] for each further frame, on which what all have found is scored and
# judged; as shares of a budget that is shorter than this.
_EARLIER_SEARCH_S, _EARLIER_REFINED_S, _SHORT_BUDGET_S = 0.0025, 0.001, 0.05


class Relocalizer:
    """Finds camera poses in one map.

    Parameters
    ----------
    landmark_map : LandmarkMap
    options : RelocalizerOptions

    Raises
    ------
    OptionsError
        k is larger than the map.
    """

    def __init__(self, landmark_map: LandmarkMap, options: RelocalizerOptions) -> None:
        if options.needs_similarities:
            check_k(options.k, len(landmark_map))
        self._map = landmark_map
        landmark_map.prepare()
        self._options = options

    def warm_up(self) -> None:
        """Compile the kernels, or read them from disk, before the first request needs them."""
        warm_up(self._call_every_kernel)

    @staticmethod
    def _call_every_kernel() -> None:
        rng = np.random.default_rng(0)
        bboxes = np.array([[100, 100, 150, 160], [300, 120, 360, 150], [200, 300, 260, 390]],
                          dtype=np.float64)
        pairs = np.array([[0, 0], [1, 1], [2, 2]], dtype=np.int64)
        centers = np.array([[0.0, 0, 5], [1, 0, 6], [0, 1, 5]])
        shapes = np.tile([0.04, 0.0, 0.0, 0.04, 0.0, 0.04], (3, 1))
        scene = make_scene(Camera(640, 480, 500.0, 500.0, 320.0, 240.0).normalize_bboxes(bboxes),
                           centers, shapes, np.ones((3, 3), dtype=np.bool_), pairs, 0.2)
        list(search_samples(scene, draw_ransac(pairs, 1, rng), Leaders.none_yet()))
        list(search_exhaustively(scene, Leaders.none_yet()))
        list(search_progressively(scene, compatible_pairs(scene), Leaders.none_yet()))
        list(search_progressively(scene, compatible_pairs(scene), Leaders.none_yet(), size=2))
        rig = make_rig([scene], np.eye(4)[None], VERTICAL_UNKNOWN[None])
        scores = scores_of(rig, np.eye(3)[None], np.zeros((1, 3)))
        choose_distinct(scores, np.eye(3)[None], np.zeros((1, 3)), 1)
        refine_rig(rig, np.eye(3), np.zeros(3))
        same_place(np.eye(3), np.zeros(3), np.eye(3), np.zeros(3))
        project_ellipsoids(np.eye(4), centers, shapes)

    def relocalize(self, observations: Sequence[Observation],
                   searched: list[Searched] | None = None) -> Relocalization:
        """Find where the camera was when it saw the last of some frames.

        Several frames are one question: hypotheses come from each of them, and are scored on and
        refined with all of them. Of each frame's search the time budget is an equal share.

        Parameters
        ----------
        observations : sequence of Observation
            One frame, or up to MAX_FRAMES of one moving camera that odom_from_camera joins; the
            last is the one whose pose is wanted.
        searched : list of Searched, optional
            What was found in the first of these frames when they were asked about before, in
            their order; what is found in the others is appended. They have all of the time.

        Returns
        -------
        Relocalization
            Refused, with the reason, when the pose is not to be acted on.

        Raises
        ------
        OptionsError
            The matching type needs similarities that are missing or of the wrong shape, the
            vertical is no unit vector, of several frames odom_from_camera is missing or no rigid
            transform, or there are no frames or too many.
        """
        start = time.perf_counter()
        cameras = _cameras_from_last(observations)
        frames = [] if searched is None else searched
        new = observations[len(frames):]
        each_s = self._time_s(_SEARCH_SHARE, _EARLIER_SEARCH_S, observations) / max(1, len(new))
        for number, observation in enumerate(new):
            deadline = start + each_s * (number + 1)
            frames.append(search_frame(self._map, observation, self._options, deadline))
        return self._conclude(observations, frames, cameras, start)

    def _time_s(self, share: float, earlier_s: float, observations: Sequence[Observation]
                ) -> float:
        """Return a share of the time budget [s], less what further frames need afterwards."""
        budget_s = self._options.time_budget_s
        shorter = min(1.0, budget_s / _SHORT_BUDGET_S)
        return share * budget_s - shorter * earlier_s * (len(observations) - 1)

    def _conclude(self, observations: Sequence[Observation], frames: Sequence[Searched],
                  cameras: NDArray[np.float64], start: float) -> Relocalization:
        """Turn what the searches found into an answer, and decide whether to believe it."""
        answer = partial(Relocalization, tried=sum(one.progress.tried for one in frames),
                         coverage=min(one.progress.coverage for one in frames),
                         stamp_ns=observations[-1].stamp_ns)
        if not any(one.has_samples for one in frames):
            return answer(False, f'{sum(len(one.detections) for one in observations)} detections '
                          f'give fewer than {frames[-1].sample_size} different correspondence '
                          'candidates')
        rig = make_rig([one.scene for one in frames], cameras,
                       np.stack([one.vertical for one in frames]))
        deadline = start + self._time_s(_REFINED_SHARE, _EARLIER_REFINED_S, observations)
        upright = find_finalists(frames, rig, self._options.refine, REFINED, deadline)
        if not upright:
            return answer(False, 'no pose explains any three detections',
                          search_ms=_elapsed_ms(start))
        found = upright + self._tilted_rivals(upright, frames, rig, deadline)
        poses = np.array([one.map_from_camera for one in found])
        explained = [matches_of(rig, one) for one in found]
        supports = self._supports(observations, frames, cameras, poses, explained)
        likely = confidences(supports, poses, upright=np.arange(len(found)) < len(upright))
        evidence = self._evidence(frames, found[0], explained[0], supports[0], likely)
        reason = refusal(evidence, self._options)
        hypotheses = tuple(map(Hypothesis, poses, (one.score for one in found),
                               likely * evidence.found, supports))
        return answer(not reason, reason, hypotheses, explained[0][-1],
                      covariance_of(frames, rig, found[0], explained[0]),
                      best_iteration=found[0].iteration, search_ms=_elapsed_ms(start))

    def _tilted_rivals(self, upright: Sequence[Finalist], frames: Sequence[Searched], rig: Rig,
                       deadline: float) -> list[Finalist]:
        """Return the best poses elsewhere that did not ask for a known vertical."""
        tilted = [one._replace(leaders=one.tilted) for one in frames]
        return [one for one in find_finalists(tilted, rig, self._options.refine, MAX_DISTINCT,
                                              deadline)
                if not any(same_place(one.rotation, one.translation, other.rotation,
                                      other.translation) for other in upright)]

    def _supports(self, observations: Sequence[Observation], frames: Sequence[Searched],
                  cameras: NDArray[np.float64], poses: NDArray[np.float64],
                  explained: Sequence[list[tuple[Match, ...]]]) -> list[Support]:
        """Return what speaks for each pose, by what it explains in each frame."""
        views = [View(observation, one.scene, self._map, self._options.needs_similarities)
                 for observation, one in zip(observations, frames, strict=True)]
        last_from_cameras = np.linalg.inv(cameras)
        return [support(views, pose @ last_from_cameras, matches)
                for pose, matches in zip(poses, explained, strict=True)]

    def _evidence(self, frames: Sequence[Searched], best: Finalist,
                  matches: Sequence[tuple[Match, ...]], its_support: Support,
                  likely: NDArray[np.float64]) -> Evidence:
        coverage = min(one.progress.coverage for one in frames)
        return Evidence(
            its_support.inliers, likely[0], max(likely[1:], default=0.0), coverage,
            tried=sum(one.known_tried for one in frames),
            meetings=math.inf if is_exhaustive(coverage, self._options)
            else meetings_of(frames, best, matches),
            unexplained=its_support.unexplained)


def _cameras_from_last(observations: Sequence[Observation]) -> NDArray[np.float64]:
    """Return each camera from the last (F, 4, 4), as odometry has it."""
    if not 1 <= len(observations) <= MAX_FRAMES:
        raise OptionsError(f'1 to {MAX_FRAMES} observations at a time, not {len(observations)}')
    cameras = np.tile(np.eye(4), (len(observations), 1, 1))
    if len(observations) == 1:
        return cameras
    joined = []
    for number, one in enumerate(observations, start=1):
        where = f'odom_from_camera of frame {number} of {len(observations)}'
        if one.odom_from_camera is None:
            raise OptionsError(f'{where} is missing: it joins several frames')
        if not is_rigid(one.odom_from_camera):
            raise OptionsError(f'{where} is no rigid transform')
        joined.append(one.odom_from_camera)
    for row, odom_from_camera in enumerate(joined[:-1]):
        cameras[row] = invert_transform(odom_from_camera) @ joined[-1]
    return cameras


def _elapsed_ms(start: float) -> float:
    return (time.perf_counter() - start) * 1e3
