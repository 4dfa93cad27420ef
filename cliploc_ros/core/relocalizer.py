# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The one door to the method: Relocalizer.relocalize(observations) -> Relocalization."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core import association
from cliploc_ros.core.acceptance import Evidence, Match, refusal, support
from cliploc_ros.core.camera import Camera
from cliploc_ros.core.compatibility import compatible_pairs
from cliploc_ros.core.compiled import warm_up
from cliploc_ros.core.ellipsoid import project_ellipsoids
from cliploc_ros.core.finalists import as_found, covariance_of, matches_of, meetings_of, refined
from cliploc_ros.core.landmark_map import LandmarkMap
from cliploc_ros.core.matching import match_frame
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.refinement import VERTICAL_UNKNOWN, refine
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
from cliploc_ros.errors import OptionsError

# The map's third axis is up (REP 103), and the optical frame's second is down.
_UP_IN_MAP = (0.0, 0.0, 1.0)
_UPRIGHT = (0.0, -1.0, 0.0)
_UNIT_TOLERANCE = 1e-3
# So many of the best are refined: what is worse has never led afterwards on real frames.
_REFINED = 32


@dataclass(frozen=True)
class Hypothesis:
    """A pose the camera may have had, and the sum of IoUs that speaks for it."""

    map_from_camera: NDArray[np.float64]
    score: float


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
        The inliers of the best.
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
    evidence : float
        What acceptance compares with min_evidence; 0 when nothing was found.
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
    evidence: float = 0.0

    @property
    def solved(self) -> bool:
        """Return whether any pose was found, believed or not."""
        return bool(self.hypotheses)

    @property
    def map_from_camera(self) -> NDArray[np.float64] | None:
        """Return the best pose (4, 4), believed or not; None when there is none."""
        return self.hypotheses[0].map_from_camera if self.hypotheses else None

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
        if options.needs_similarities:
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
        refine(scene, np.eye(3), np.zeros(3), VERTICAL_UNKNOWN, Workspace.allocate(3))
        same_place(np.eye(3), np.zeros(3), np.eye(3), np.zeros(3))
        project_ellipsoids(np.eye(4), centers, shapes)

    def relocalize(self, observations: Sequence[Observation]) -> Relocalization:
        """Find where the camera was.

        Parameters
        ----------
        observations : sequence of Observation
            One frame. (Several frames joined by odometry are not searched together yet.)

        Returns
        -------
        Relocalization
            Refused, with the reason, when the pose is not to be acted on.

        Raises
        ------
        OptionsError
            The matching type needs similarities that are missing or of the wrong shape, the
            vertical is no unit vector, or not exactly one observation was given.
        """
        if len(observations) != 1:
            raise OptionsError(f'one observation at a time, not {len(observations)}')
        observation = observations[0]
        start = time.perf_counter()
        scene, share = match_frame(self._map, observation, self._options)
        vertical = self._vertical(observation)
        size = _sample_size(vertical)
        if _distinct(scene.pairs) < size:
            return Relocalization(
                False, f'{len(observation.detections)} detections give fewer than {size} '
                'different correspondence candidates', stamp_ns=observation.stamp_ns)
        leaders = Leaders.none_yet(_REFINED if self._options.refine else MAX_DISTINCT)
        progress, samples = self._search(scene, vertical, leaders, start)
        progress = progress._replace(coverage=progress.coverage * share)
        return self._conclude(observation, scene, vertical, leaders, progress, samples, start)

    def _vertical(self, observation: Observation) -> NDArray[np.float64]:
        """Return the vertical as refine takes it; the paper's algorithms know of none."""
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
                start: float) -> tuple[Progress, NDArray[np.int64] | None]:
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
        progress = Progress(0, 1.0)
        for step in search:
            progress = step
            if time.perf_counter() - start > options.time_budget_s:
                break
        return progress, samples

    def _conclude(self, observation: Observation, scene: Scene, vertical: NDArray[np.float64],
                  leaders: Leaders, progress: Progress, samples: NDArray[np.int64] | None,
                  start: float) -> Relocalization:
        """Turn the leaders into a result, and decide whether to believe the first."""
        finalists = refined(scene, leaders, vertical) if self._options.refine \
            else as_found(leaders)
        if not finalists:
            return Relocalization(False, 'no pose explains any three detections',
                                  tried=progress.tried, coverage=progress.coverage,
                                  search_ms=_elapsed_ms(start), stamp_ns=observation.stamp_ns)
        best, hypotheses = finalists[0], tuple(Hypothesis(one.map_from_camera, one.score)
                                               for one in finalists)
        explained = [matches_of(scene, one) for one in finalists]
        covariance = covariance_of(scene, best, explained[0], vertical)
        bboxes = observation.detections.bboxes_xyxy
        supports = [support(matches, bboxes) for matches in explained]
        evidence = Evidence(
            inliers=supports[0].inliers, score=supports[0].score,
            rival_score=max((rival.score for rival in supports[1:]), default=0.0),
            # those that boxes contradict were looked at too
            coverage=progress.coverage,
            tried=max(progress.tried, math.comb(progress.reach, _sample_size(vertical))),
            meetings=meetings_of(scene, best, explained[0], progress, samples))
        reason = refusal(evidence, self._options)
        return Relocalization(not reason, reason, hypotheses, explained[0], covariance,
                              progress.tried, best.iteration, progress.coverage,
                              _elapsed_ms(start), observation.stamp_ns, evidence.strength)


def _sample_size(vertical: NDArray[np.float64]) -> int:
    """Return how many candidates make a pose."""
    return SAMPLE_SIZE - 1 if vertical[6] > 0.0 else SAMPLE_SIZE


def _distinct(pairs: NDArray[np.int64]) -> int:
    """Return of how many candidates, at most, both detections and landmarks can differ."""
    return min(len(np.unique(pairs[:, 0])), len(np.unique(pairs[:, 1])))


def _elapsed_ms(start: float) -> float:
    return (time.perf_counter() - start) * 1e3
