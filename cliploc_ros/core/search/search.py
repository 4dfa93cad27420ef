# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The search: hypotheses from minimal samples, and the best of them at distinct places."""

import time
from collections.abc import Iterator
from math import comb, inf
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.association.scene import Scene
from cliploc_ros.core.compiled import compiled
from cliploc_ros.core.geometry.p3p import p3p
from cliploc_ros.core.geometry.two_point import two_point
from cliploc_ros.core.search.sampling import (
    SAMPLE_SIZE,
    enumerate_compatible_pairs,
    enumerate_compatible_triples,
    enumerate_triples,
)
from cliploc_ros.core.search.screening import (
    Prior,
    choose_pose,
    load_sample,
    set_up,
    verify_beyond,
)

MAX_DISTINCT = 8
# Hypotheses nearer than this to a better one are the same place, seen twice.
DISTINCT_DISTANCE_M = 0.5
DISTINCT_ANGLE_DEG = 20.0
# 1 + 2 cos(angle) is the trace of a rotation.
_DISTINCT_TRACE = 1.0 + 2.0 * np.cos(np.radians(DISTINCT_ANGLE_DEG))

# A sample whose own three pairs overlap less than this in sum is not verified, where every
# sample is tried: a better one of the same place comes.
_MIN_SAMPLED_IOU = 0.9
# The same of two pairs: of noisy verticals these are looser.
_MIN_SAMPLED_PAIR_IOU = 0.2
# How search_progressively goes through samples of each size.
_ORDERED = {3: (enumerate_compatible_triples, _MIN_SAMPLED_IOU),
            2: (enumerate_compatible_pairs, _MIN_SAMPLED_PAIR_IOU)}
# Scores nearer than this are equal, but for rounding: the hypothesis found first stays.
_TIE = 1e-9
# A block of a search takes about so long, so that time limits hold: this many samples at first.
_BLOCK_S = 1e-3
_FIRST_BLOCK, _LARGEST_BLOCK = 64, 1024


class Progress(NamedTuple):
    """How far a search is.

    Parameters
    ----------
    tried : int
        Hypotheses tried so far.
    coverage : float
        The share of its samples that were tried, 0 to 1.
    reach : int
        Of a progressive search, among how many of the first candidates all samples were tried.
    """

    tried: int
    coverage: float
    reach: int = 0


class Leaders(NamedTuple):
    """The best hypotheses so far, at places that differ; unused rows have the score -1.

    Parameters
    ----------
    scores : ndarray (m,)
    iterations : ndarray (m,) of int
        In which iteration each was found, from 1.
    samples : ndarray (m, 3) of int
        Its minimal sample, as candidate numbers.
    rotations, translations : ndarray (m, 3, 3), (m, 3)
        Of camera_from_map.
    """

    scores: NDArray[np.float64]
    iterations: NDArray[np.int64]
    samples: NDArray[np.int64]
    rotations: NDArray[np.float64]
    translations: NDArray[np.float64]

    @staticmethod
    def none_yet(count: int = MAX_DISTINCT) -> 'Leaders':
        """Return an empty list for so many leaders."""
        return Leaders(np.full(count, -1.0), np.zeros(count, dtype=np.int64),
                       np.full((count, 3), -1, dtype=np.int64),
                       np.zeros((count, 3, 3)), np.zeros((count, 3)))

    def ranked(self) -> NDArray[np.int64]:
        """Return the used rows, best first."""
        order = np.argsort(-self.scores, kind='stable')
        return order[self.scores[order] >= 0.0]


def search_samples(scene: Scene, samples: NDArray[np.int64], leaders: Leaders,
                   prior: Prior | None = None) -> Iterator[Progress]:
    """Try given minimal samples, a block at a time.

    Parameters
    ----------
    scene : Scene
    samples : ndarray (t, 3) of int
        Candidate numbers; rows of -1 are left out.
    leaders : Leaders
        Changed in place.
    prior : Prior, optional
        Poses that it rules out are left.

    Yields
    ------
    Progress
        After each block; the caller may stop there.
    """
    bench = set_up(scene, prior)
    tried = 0
    pace, start = _Pace(len(samples)), 0
    while not pace.at_end:
        block = pace.begin()
        block[:] = samples[start:start + len(block)]
        _try_samples(bench, block, len(block), start, 0.0, leaders)
        start += len(block)
        tried += int((block[:, 0] >= 0).sum())
        pace.end(len(block))
        yield Progress(tried, start / len(samples))


def search_exhaustively(scene: Scene, leaders: Leaders, prior: Prior | None = None
                        ) -> Iterator[Progress]:
    """Try every valid sample, a block at a time. Nothing is stored.

    Parameters
    ----------
    scene : Scene
    leaders : Leaders
        Changed in place.
    prior : Prior, optional
        Poses that it rules out are left.

    Yields
    ------
    Progress
        After each block; the caller may stop there.
    """
    bench = set_up(scene, prior)
    count = len(scene.pairs)
    cursor = np.array([0, 1, 2], dtype=np.int64)
    pace, tried = _Pace(), 0
    while cursor[0] < count - 2:
        block = pace.begin()
        found = enumerate_triples(scene.pairs, cursor, block)
        _try_samples(bench, block, found, tried, 0.0, leaders)
        tried += found
        pace.end(found)
        first, second, third = (int(row) for row in cursor)
        left = (comb(max(0, count - first - 1), 3) + comb(max(0, count - second - 1), 2)
                + max(0, count - third)) if first < count - 2 else 0
        yield Progress(tried, 1.0 - left / comb(count, 3))


def search_progressively(scene: Scene, compatible: NDArray[np.bool_], leaders: Leaders,
                         prior: Prior | None = None, limit: float = inf,
                         size: int = SAMPLE_SIZE) -> Iterator[Progress]:
    """Try every sample of compatible candidates, those of the first candidates first.

    All samples among the first n candidates are tried before one with the next: what PROSAC draws
    at random, without repetition, and to the end where there is time.

    Parameters
    ----------
    scene : Scene
    compatible : ndarray (c, c) of bool
        See cliploc_ros.core.search.compatibility.
    leaders : Leaders
        Changed in place.
    prior : Prior, optional
        Poses that it rules out are left.
    limit : float, optional
        The most samples to try.
    size : int, optional
        Of a sample: three; or two, which fix a pose where the prior's verticals are known to be
        equal (see cliploc_ros.core.geometry.two_point). Then the third column of the leaders'
        samples is -1.

    Yields
    ------
    Progress
        After each block; the caller may stop there.
    """
    bench = set_up(scene, prior)
    count = len(scene.pairs)
    fill_block, least_iou = _ORDERED[size]
    cursor = np.array([size - 1, *range(size - 1)], dtype=np.int64)  # newest, first, ...
    pace, tried = _Pace(limit), 0
    while cursor[0] < count and not pace.at_end:
        block = pace.begin()
        found = fill_block(compatible, cursor, block)
        _try_samples(bench, block, found, tried, least_iou, leaders)
        tried += found
        pace.end(found)
        reach = min(int(cursor[0]), count)
        yield Progress(tried, comb(reach, size) / max(comb(count, size), 1), reach)


class _Pace:
    """Cuts a search into blocks of about equal time; what is found does not depend on it.

    Parameters
    ----------
    limit : float
        How many samples to try in all.
    """

    def __init__(self, limit: float = inf) -> None:
        self._memory = np.full((_LARGEST_BLOCK, SAMPLE_SIZE), -1, dtype=np.int64)
        self._left, self._size, self._start = limit, _FIRST_BLOCK, 0.0

    @property
    def at_end(self) -> bool:
        """Return whether all samples were tried."""
        return self._left <= 0

    def begin(self) -> NDArray[np.int64]:
        """Return memory (b, 3) for the samples of the next block."""
        self._start = time.perf_counter()
        return self._memory[:int(min(self._size, self._left))]

    def end(self, tried: int) -> None:
        """Take note that a block is done, and how many samples it had."""
        self._left -= tried
        elapsed = max(time.perf_counter() - self._start, 1e-9)
        wanted = int(self._size * min(_BLOCK_S / elapsed, 4.0))
        self._size = min(max(wanted, 1), _LARGEST_BLOCK)


@compiled
def _try_samples(bench, samples, count, tried_before, least_iou, leaders):
    """Make the hypotheses of samples of three, or of two and -1; remember those that lead."""
    floor = np.min(leaders.scores)
    for t in range(count):
        if samples[t, 0] < 0:
            continue
        size = 3 if samples[t, 2] >= 0 else 2
        load_sample(bench.candidates, samples, t, size, bench.bearings, bench.points,
                    bench.sampled_boxes, bench.sampled_landmarks)
        if size == 3:
            poses = p3p(bench.bearings, bench.points, bench.rotations, bench.translations)
        else:
            poses = two_point(bench.bearings, bench.points, bench.prior, bench.rotations,
                              bench.translations)
        if poses == 0:
            continue
        which = choose_pose(bench.prior, bench.rotations, bench.translations, size, poses,
                            bench.sampled_boxes, bench.sampled_landmarks,
                            bench.sampled_outlines, bench.uppers, least_iou)
        if which < 0:
            continue
        score = verify_beyond(bench.nearby, bench.groups, bench.landmarks, bench.boxes,
                              bench.starts, bench.detections, bench.iou_threshold, bench.rotations,
                              bench.translations, which, bench.seen, bench.outlines,
                              bench.owners, bench.entries, bench.bounds, bench.best_bounds, floor)
        if score > floor:
            _remember(score, tried_before + t + 1, samples[t], bench.rotations[which],
                      bench.translations[which], leaders)
            floor = np.min(leaders.scores)


@compiled
def _remember(score, iteration, sample, rotation, translation, leaders):
    """Take a hypothesis in, unless a better one leads at its place; drop worse ones there."""
    free = -1
    for row in range(leaders.scores.shape[0]):
        if leaders.scores[row] < 0.0:
            continue
        if not same_place(rotation, translation, leaders.rotations[row],
                           leaders.translations[row]):
            continue
        if leaders.scores[row] >= score - _TIE:
            return
        leaders.scores[row] = -1.0
        free = row
    if free < 0:
        free = int(np.argmin(leaders.scores))
    leaders.scores[free] = score
    leaders.iterations[free] = iteration
    leaders.samples[free] = sample
    leaders.rotations[free] = rotation
    leaders.translations[free] = translation


@compiled
def same_place(rotation_a, translation_a, rotation_b, translation_b):
    """Tell whether two camera_from_map poses lie within the distinct distance and angle."""
    trace, square = 0.0, 0.0
    for i in range(3):
        center_a, center_b = 0.0, 0.0
        for j in range(3):
            trace += rotation_a[i, j] * rotation_b[i, j]
            center_a -= rotation_a[j, i] * translation_a[j]
            center_b -= rotation_b[j, i] * translation_b[j]
        square += (center_a - center_b) ** 2
    return trace >= _DISTINCT_TRACE and square <= DISTINCT_DISTANCE_M * DISTINCT_DISTANCE_M
