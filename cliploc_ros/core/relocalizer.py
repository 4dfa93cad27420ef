# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The one door to the method: Relocalizer.relocalize(observations) -> Relocalization."""

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core import association
from cliploc_ros.core.acceptance import Evidence, Match, is_exhaustive, refusal
from cliploc_ros.core.camera import Camera
from cliploc_ros.core.compatibility import compatible_pairs
from cliploc_ros.core.compiled import warm_up
from cliploc_ros.core.confidence import Support, View, confidences, support
from cliploc_ros.core.ellipsoid import project_ellipsoids
from cliploc_ros.core.finalists import (
    Finalist,
    Searched,
    covariance_of,
    find_finalists,
    matches_of,
    meetings_of,
)
from cliploc_ros.core.fusion import Rig, choose_distinct, make_rig, refine_all, verify_rig
from cliploc_ros.core.landmark_map import LandmarkMap
from cliploc_ros.core.matching import match_frame
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.refinement import VERTICAL_UNKNOWN
from cliploc_ros.core.sampling import SAMPLE_SIZE, draw_prosac, draw_ransac
from cliploc_ros.core.scoring import Scene, Workspace, make_scene
from cliploc_ros.core.screening import Prior
from cliploc_ros.core.search import (
    MAX_DISTINCT,
    Leaders,
    Progress,
    same_place,
    search_exhaustively,
    search_progressively,
    search_samples,
    search_vertically,
)
from cliploc_ros.core.transforms import invert_transform, is_rigid
from cliploc_ros.errors import OptionsError

#: The most frames that are fused. Each frame's leaders are verified on every frame, so that time
#: grows with the square; and the tenth view of the same objects says little that is new.
MAX_FRAMES = 10
# The map's third axis is up (REP 103), and the optical frame's second is down.
_UP_IN_MAP = (0.0, 0.0, 1.0)
_UPRIGHT = (0.0, -1.0, 0.0)
_UNIT_TOLERANCE = 1e-3
# Of the time budget: when the search ends, and the refinement; judging the result takes the rest.
_SEARCH_SHARE, _REFINED_SHARE = 0.8, 0.9
# So many of the best are refined: what is worse has never led afterwards on real frames.
_REFINED = 32


@dataclass(frozen=True)
class Hypothesis:
    """A pose the camera may have had.

    Parameters
    ----------
    map_from_camera : ndarray (4, 4)
    score : float
        Sum of the IoUs that speak for it.
    confidence : float
        How likely it is within 1 m of the truth, 0 to 1.
    support : Support
        Why so.
    """

    map_from_camera: NDArray[np.float64]
    score: float
    confidence: float
    support: Support


@dataclass(frozen=True)
class Relocalization:
    """What a search found, and whether to believe it.

    Parameters
    ----------
    accepted : bool
        Whether the pose is to be acted on.
    reason : str
        Why not, in one line; empty when accepted.
    hypotheses : tuple of Hypothesis
        The distinct best, best first; empty when nothing was found.
    matches : tuple of Match
        The inliers of the best, in the frame that was asked about.
    covariance : ndarray (6, 6) or None
        Of the best, see cliploc_ros.core.uncertainty; None when nothing was found.
    tried : int
        How many hypotheses were made.
    best_iteration : int
        In which iteration the best was found, from 1; 0 when nothing was found.
    coverage : float
        The share of its samples that the search could try in its time, 0 to 1.
    search_ms : float
        How long association, search and verification took [ms].
    stamp_ns : int
        Stamp of the observation [ns].
    """

    accepted: bool
    reason: str
    hypotheses: tuple[Hypothesis, ...] = ()
    matches: tuple[Match, ...] = ()
    covariance: NDArray[np.float64] | None = None
    tried: int = 0
    best_iteration: int = 0
    coverage: float = 1.0
    search_ms: float = 0.0
    stamp_ns: int = 0

    @property
    def solved(self) -> bool:
        """Return whether any pose was found, believed or not."""
        return bool(self.hypotheses)

    @property
    def map_from_camera(self) -> NDArray[np.float64] | None:
        """Return the best pose (4, 4), believed or not; None when there is none."""
        return self.hypotheses[0].map_from_camera if self.hypotheses else None

    @property
    def confidence(self) -> float:
        """Return how likely the best pose is within 1 m; 0 when nothing was found."""
        return self.hypotheses[0].confidence if self.hypotheses else 0.0

    @property
    def score(self) -> float:
        """Return the best score; 0 when nothing was found."""
        return self.hypotheses[0].score if self.hypotheses else 0.0


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
        if options.needs_similarities and options.k != association.ADAPTIVE:
            association.check_k(options.k, len(landmark_map))
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
        list(search_vertically(scene, compatible_pairs(scene), Leaders.none_yet(), Prior()))
        rig = make_rig([scene], np.eye(4)[None], VERTICAL_UNKNOWN[None])
        choose_distinct(rig, np.eye(3)[None], np.zeros((1, 3)), 1, Workspace.allocate(3))
        refine_all(rig, np.eye(3)[None], np.zeros((1, 3)), Workspace.allocate(3))
        verify_rig(rig, np.eye(3), np.zeros(3), Workspace.allocate(3))
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
        share = _SEARCH_SHARE * self._options.time_budget_s / max(1, len(new))
        for number, observation in enumerate(new):
            frames.append(self._search_frame(observation, start + share * (number + 1)))
        return self._conclude(observations, frames, cameras, start)

    def _search_frame(self, observation: Observation, deadline: float) -> Searched:
        """Search one frame as if it were alone."""
        scene, share = match_frame(self._map, observation, self._options)
        vertical = self._vertical(observation)
        leaders = Leaders.none_yet(_REFINED if self._options.refine else MAX_DISTINCT)
        if _distinct(scene.pairs) < _sample_size(vertical):
            return Searched(scene, vertical, leaders, Progress(0, 1.0), None)
        progress, samples = self._search(scene, vertical, leaders, deadline)
        progress = progress._replace(coverage=progress.coverage * share)
        tilted, tried = self._search_tilted(scene, vertical, deadline)
        progress = progress._replace(tried=progress.tried + tried)
        return Searched(scene, vertical, leaders, progress, samples, tilted)

    def _vertical(self, observation: Observation) -> NDArray[np.float64]:
        """Return the vertical as make_rig takes it; the paper's algorithms know of none."""
        up = observation.up_in_camera
        if up is None or self._options.algorithm != 'auto':
            return VERTICAL_UNKNOWN
        if up.shape != (3,) or not abs(np.linalg.norm(up) - 1.0) < _UNIT_TOLERANCE:
            raise OptionsError(f'up_in_camera: {up} is no unit vector')
        return np.array([*up, *_UP_IN_MAP, np.radians(self._options.vertical_deviation_deg)])

    def _prior(self, vertical: NDArray[np.float64]) -> Prior:
        """Return what the search may take for granted."""
        up_in_camera = tuple(vertical[:3]) if vertical[6] > 0.0 else _UPRIGHT
        low, high = self._options.height_range_m
        return Prior(up_in_camera, _UP_IN_MAP, low, high,
                     np.radians(self._options.max_tilt_deg))

    def _search(self, scene: Scene, vertical: NDArray[np.float64], leaders: Leaders,
                deadline: float) -> tuple[Progress, NDArray[np.int64] | None]:
        """Run the algorithm that the options name, as far as time allows.

        Returns how far it came, and the samples (t, 3) where these were drawn.
        """
        options = self._options
        prior, samples = self._prior(vertical), None
        if options.algorithm == 'auto':
            try_all = search_vertically if vertical[6] > 0.0 else search_progressively
            search = try_all(scene, compatible_pairs(scene), leaders, prior,
                             options.iterations)
        elif options.algorithm == 'bf':
            search = search_exhaustively(scene, leaders, prior)
        else:
            draw = draw_ransac if options.algorithm == 'ransac' else draw_prosac
            seed = options.random_seed if options.random_seed >= 0 else None
            samples = draw(scene.pairs, options.iterations, np.random.default_rng(seed))
            search = search_samples(scene, samples, leaders, prior)
        return _run(search, deadline), samples

    def _search_tilted(self, scene: Scene, vertical: NDArray[np.float64], deadline: float
                       ) -> tuple[Leaders, int]:
        """Search poses that do not ask for the vertical; return how many were tried, too.

        Where what is said to be the vertical is wrong, as by a wrong mount, what the boxes say by
        themselves must be among the rivals of what it leads to.
        """
        leaders = Leaders.none_yet()
        if not vertical[6] > 0.0:
            return leaders, 0
        search = search_progressively(scene, compatible_pairs(scene), leaders,
                                      self._prior(vertical), self._options.iterations)
        return leaders, _run(search, deadline).tried

    def _conclude(self, observations: Sequence[Observation], frames: Sequence[Searched],
                  cameras: NDArray[np.float64], start: float) -> Relocalization:
        """Turn the leaders into a result, and decide whether to believe the first."""
        stamp_ns = observations[-1].stamp_ns
        if all(_distinct(one.scene.pairs) < _sample_size(one.vertical) for one in frames):
            boxes = sum(len(one.detections) for one in observations)
            return Relocalization(
                False, f'{boxes} detections give fewer than {_sample_size(frames[-1].vertical)} '
                'different correspondence candidates', stamp_ns=stamp_ns)
        tried = sum(one.progress.tried for one in frames)
        coverage = min(one.progress.coverage for one in frames)
        rig = make_rig([one.scene for one in frames], cameras,
                       np.stack([one.vertical for one in frames]))
        deadline = start + _REFINED_SHARE * self._options.time_budget_s
        finalists = find_finalists(frames, rig, self._options.refine, _REFINED, deadline)
        if not finalists:
            return Relocalization(False, 'no pose explains any three detections', tried=tried,
                                  coverage=coverage, search_ms=_elapsed_ms(start),
                                  stamp_ns=stamp_ns)
        upright = np.arange(len(finalists) + MAX_DISTINCT) < len(finalists)
        finalists += self._tilted_rivals(finalists, frames, rig, deadline)
        upright = upright[:len(finalists)]
        best, explained = finalists[0], [matches_of(rig, one) for one in finalists]
        covariance = covariance_of(frames, rig, best, explained[0])
        poses = np.array([one.map_from_camera for one in finalists])
        views = [View(observation, one.scene, self._map, self._options.needs_similarities)
                 for observation, one in zip(observations, frames, strict=True)]
        last_from_cameras = np.linalg.inv(cameras)
        supports = [support(views, pose @ last_from_cameras, matches)
                    for pose, matches in zip(poses, explained, strict=True)]
        likely = confidences(supports, poses, upright=upright)
        evidence = Evidence(
            supports[0].inliers, likely[0], max(likely[1:], default=0.0), coverage,
            # those that boxes contradict were looked at too
            tried=sum(max(one.progress.tried, math.comb(
                one.progress.reach, _sample_size(one.vertical))) for one in frames),
            meetings=math.inf if is_exhaustive(coverage, self._options)
            else meetings_of(frames, best, explained[0]))
        reason = refusal(evidence, self._options)
        hypotheses = tuple(map(Hypothesis, poses, (one.score for one in finalists),
                               likely * evidence.found, supports))
        return Relocalization(not reason, reason, hypotheses, explained[0][-1], covariance,
                              tried, best.iteration, coverage, _elapsed_ms(start), stamp_ns)

    def _tilted_rivals(self, finalists: Sequence[Finalist], frames: Sequence[Searched], rig: Rig,
                       deadline: float) -> list[Finalist]:
        """Return the best poses elsewhere that did not ask for a known vertical."""
        if not frames[-1].vertical[6] > 0.0:
            return []
        tilted = [one._replace(leaders=one.tilted or Leaders.none_yet()) for one in frames]
        return [one for one in find_finalists(tilted, rig, self._options.refine, MAX_DISTINCT,
                                              deadline)
                if not any(same_place(one.rotation, one.translation, other.rotation,
                                      other.translation) for other in finalists)]


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


def _run(search: Iterator[Progress], deadline: float) -> Progress:
    """Run a search until its end or until a deadline; return how far it came."""
    progress = Progress(0, 1.0)
    for step in search:
        progress = step
        if time.perf_counter() > deadline:
            break
    return progress


def _sample_size(vertical: NDArray[np.float64]) -> int:
    """Return how many candidates make a pose."""
    return SAMPLE_SIZE - 1 if vertical[6] > 0.0 else SAMPLE_SIZE


def _distinct(pairs: NDArray[np.int64]) -> int:
    """Return of how many candidates, at most, both detections and landmarks can differ."""
    return min(len(np.unique(pairs[:, 0])), len(np.unique(pairs[:, 1])))


def _elapsed_ms(start: float) -> float:
    return (time.perf_counter() - start) * 1e3
