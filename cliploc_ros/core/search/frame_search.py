# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The search of one frame by the algorithm that the options name."""

import time
from collections.abc import Iterator, Sequence
from functools import partial
from math import comb, inf
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.map.joined_map import parts_of
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.search.candidates import match_frame
from cliploc_ros.core.search.sampling import (
    SAMPLE_SIZE,
    compatible_pairs,
    draw_prosac,
    draw_ransac,
)
from cliploc_ros.core.search.scene import VERTICAL_UNKNOWN, Constraint, Scene
from cliploc_ros.core.search.strategies import (
    MAX_DISTINCT,
    Leaders,
    Progress,
    search_exhaustively,
    search_progressively,
    search_samples,
)
from cliploc_ros.errors import OptionsError

#: The number of best hypotheses that are refined. On the recorded frames, worse ones never led
#: afterwards.
REFINED = 32
# The map's third axis is up (REP 103), and the optical frame's second is down.
_UP_IN_MAP = (0.0, 0.0, 1.0)
_UPRIGHT = (0.0, -1.0, 0.0)
_UNIT_TOLERANCE = 1e-3


class SearchedFrame(NamedTuple):
    """A frame and the result of the search among its samples."""

    observation: Observation
    scene: Scene  #: Of the observation
    vertical: NDArray[np.float64]  #: (7,): see VERTICAL_UNKNOWN
    leaders: Leaders  #: The best hypotheses, as poses of this frame's camera
    tilted: Leaders  #: The best hypotheses that ignore the vertical, where it is known; else none
    progress: Progress
    #: (t, 3): the samples tried; None for all samples of the first candidates, see progress.reach
    samples: NDArray[np.int64] | None = None
    firsts: tuple[int, ...] = (0,)  #: Row of the first landmark of each of several maps

    @property
    def sample_size(self) -> int:
        """Return how many candidates a minimal sample has."""
        return _sample_size(self.vertical)

    @property
    def has_samples(self) -> bool:
        """Return whether there are enough different detections and landmarks for a sample."""
        return _has_samples(self.scene, self.vertical)

    @property
    def known_tried(self) -> int:
        """Return how many samples were tried or ruled out as incompatible, of each map on average.

        Samples across maps are none: that they were not tried says nothing about rivals.
        """
        maps = np.searchsorted(self.firsts, self.scene.pairs[:self.progress.reach, 1], 'right')
        within = sum(comb(count, self.sample_size) for count in np.bincount(maps).tolist())
        return max(self.progress.tried, within) // len(self.firsts)


def search_frame(landmark_map: LandmarkMap, observation: Observation,
                 options: RelocalizerOptions, deadline: float) -> SearchedFrame:
    """Search one frame, until a deadline of time.perf_counter [s].

    OptionsError: similarities that the matching type needs are missing or of the wrong shape, or
    the vertical is no unit vector.
    """
    scene, left_out = match_frame(landmark_map, observation, options)
    vertical = vertical_of(observation, options)
    leaders = Leaders.none_yet(REFINED if options.refine else MAX_DISTINCT)
    tilted, samples, progress = Leaders.none_yet(), None, Progress(0, 1.0)
    if _has_samples(scene, vertical):
        constraint = constraint_of(observation, options)
        if options.algorithm == 'auto':
            try_all = partial(search_progressively, scene, compatible_pairs(scene),
                              constraint=constraint, limit=options.iterations)
            progress = _run(try_all(leaders, size=_sample_size(vertical)), deadline)
            if _is_known(vertical):
                # The vertical may be wrong, as with a wrong camera mount. Then the pose that the
                # boxes alone suggest must be among the rivals.
                free = _run(try_all(tilted), deadline)
                progress = progress._replace(tried=progress.tried + free.tried)
        elif options.algorithm == 'bf':
            progress = _run(search_exhaustively(scene, leaders, constraint), deadline)
        else:
            draw = draw_ransac if options.algorithm == 'ransac' else draw_prosac
            seed = options.random_seed if options.random_seed >= 0 else None
            samples = draw(scene.pairs, options.iterations, np.random.default_rng(seed))
            progress = _run(search_samples(scene, samples, leaders, constraint), deadline)
        if left_out:  # the share of all samples that consist of the candidates kept
            kept = comb(len(scene.pairs), SAMPLE_SIZE) / max(
                comb(len(scene.pairs) + left_out, SAMPLE_SIZE), 1)
            progress = progress._replace(coverage=progress.coverage * kept)
    return SearchedFrame(observation, scene, vertical, leaders, tilted, progress, samples,
                         tuple(part.first for part in parts_of(landmark_map)))


def constraint_of(observation: Observation, options: RelocalizerOptions) -> Constraint:
    """Return what is known of the camera of a frame before anything is searched."""
    vertical, (low, high) = vertical_of(observation, options), options.height_range_m
    known = _is_known(vertical)
    return Constraint(tuple(vertical[:3]) if known else _UPRIGHT, _UP_IN_MAP, low, high,
                 np.radians(options.max_tilt_deg), vertical[6] if known else inf)


def coverage_of(frames: Sequence[SearchedFrame]) -> float:
    """Return the share of its samples that the search of the least searched frame tried."""
    return min(one.progress.coverage for one in frames)


def vertical_of(observation: Observation, options: RelocalizerOptions) -> NDArray[np.float64]:
    """Return the vertical (7,) of a frame; the paper's algorithms do not use it.

    OptionsError: it is no unit vector.
    """
    up = observation.up_in_camera
    if up is None or options.algorithm != 'auto':
        return VERTICAL_UNKNOWN
    if up.shape != (3,) or not abs(np.linalg.norm(up) - 1.0) < _UNIT_TOLERANCE:
        raise OptionsError(f'up_in_camera: {up} is no unit vector')
    return np.array([*up, *_UP_IN_MAP, np.radians(options.vertical_deviation_deg)])


def _is_known(vertical: NDArray[np.float64]) -> bool:
    return bool(vertical[6] > 0.0)


def _sample_size(vertical: NDArray[np.float64]) -> int:
    return SAMPLE_SIZE - 1 if _is_known(vertical) else SAMPLE_SIZE


def _has_samples(scene: Scene, vertical: NDArray[np.float64]) -> bool:
    distinct = min(len(np.unique(scene.pairs[:, 0])), len(np.unique(scene.pairs[:, 1])))
    return distinct >= _sample_size(vertical)


def _run(search: Iterator[Progress], deadline: float) -> Progress:
    """Run a search to its end or to a deadline; return its progress."""
    progress = Progress(0, 1.0)
    for step in search:
        progress = step
        if time.perf_counter() > deadline:
            break
    return progress
