# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which minimal samples a search tries: given ones, all of them, or the likeliest first.

Leaders take the best hypotheses; poses that contradict the constraint are not verified. Each
search yields its progress after each block of samples, and the caller may stop there.

Leaders are the best hypotheses of a search, each at a place of its own.
"""

import time
from collections.abc import Callable, Iterator
from functools import partial
from math import comb, inf
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.transforms import SAME_PLACE
from cliploc_ros.core.kernels.compiled import compiled
from cliploc_ros.core.search.sampling import (
    SAMPLE_SIZE,
    enumerate_compatible_pairs,
    enumerate_compatible_triples,
    enumerate_triples,
)
from cliploc_ros.core.search.scene import Constraint, Scene
from cliploc_ros.core.search.screening import make_hypothesis, set_up, verify_beyond

MAX_DISTINCT = 8
# Plain numbers, for the kernels.
_PLACE_M, _PLACE_TRACE = SAME_PLACE.distance_m, SAME_PLACE.least_trace
# Scores nearer than this differ by rounding only: the hypothesis found first stays.
_TIE = 1e-9
# search_progressively drops a sample whose three pairs have a smaller sum of IoUs: it tries every
# sample, so a better one of the same place follows.
_MIN_SAMPLED_IOU = 0.9
# The same of two pairs, whose poses inherit the noise of the vertical.
_MIN_SAMPLED_PAIR_IOU = 0.2
# How search_progressively enumerates samples of each size.
_ORDERED = {3: (enumerate_compatible_triples, _MIN_SAMPLED_IOU),
            2: (enumerate_compatible_pairs, _MIN_SAMPLED_PAIR_IOU)}
# A block of a search takes about this long, so that it keeps time limits.
_BLOCK_S = 1e-3
# Samples in a block.
_FIRST_BLOCK, _LARGEST_BLOCK = 64, 1024


class Leaders(NamedTuple):
    """The best hypotheses so far, at distinct places; unused rows have the score -1."""

    scores: NDArray[np.float64]  #: (m,)
    iterations: NDArray[np.int64]  #: (m,): in which iteration each was found, from 1
    samples: NDArray[np.int64]  #: (m, 3): its minimal sample, as candidate numbers
    #: (m, 3, 3), (m, 3): of camera_from_map
    rotations: NDArray[np.float64]
    translations: NDArray[np.float64]

    @staticmethod
    def none_yet(count: int = MAX_DISTINCT) -> 'Leaders':
        """Return room for a number of leaders, all unused."""
        return Leaders(np.full(count, -1.0), np.zeros(count, dtype=np.int64),
                       np.full((count, 3), -1, dtype=np.int64),
                       np.zeros((count, 3, 3)), np.zeros((count, 3)))

    def ranked(self) -> NDArray[np.int64]:
        """Return the used rows, best first."""
        order = np.argsort(-self.scores, kind='stable')
        return order[self.scores[order] >= 0.0]


@compiled
def worst_score(leaders):
    """Return the score that a hypothesis must exceed to lead."""
    worst = leaders.scores[0]
    for row in range(1, leaders.scores.shape[0]):
        worst = min(worst, leaders.scores[row])
    return worst


@compiled
def remember(leaders, score, iteration, sample, rotation, translation):
    """Add a hypothesis, unless a better one leads at its place; drop worse ones there."""
    scores = leaders.scores
    free = -1
    for row in range(scores.shape[0]):
        if scores[row] < 0.0:
            continue
        if not same_place(rotation, translation, leaders.rotations[row],
                          leaders.translations[row]):
            continue
        if scores[row] >= score - _TIE:
            return
        scores[row] = -1.0
        free = row
    if free < 0:
        free = 0
        for row in range(1, scores.shape[0]):
            if scores[row] < scores[free]:
                free = row
    scores[free] = score
    leaders.iterations[free] = iteration
    for i in range(3):
        leaders.samples[free, i] = sample[i]
        leaders.translations[free, i] = translation[i]
        for j in range(3):
            leaders.rotations[free, i, j] = rotation[i, j]


@compiled
def same_place(rotation_a, translation_a, rotation_b, translation_b):
    """Return whether two camera_from_map poses are at one place, as Tolerance does.

    The trace of the rotation between them is 1 + 2 cos(angle).
    """
    trace, square = 0.0, 0.0
    for i in range(3):
        center_a, center_b = 0.0, 0.0
        for j in range(3):
            trace += rotation_a[i, j] * rotation_b[i, j]
            center_a -= rotation_a[j, i] * translation_a[j]
            center_b -= rotation_b[j, i] * translation_b[j]
        square += (center_a - center_b) ** 2
    return trace >= _PLACE_TRACE and square <= _PLACE_M * _PLACE_M


class Progress(NamedTuple):
    """How far a search is."""

    tried: int  #: Hypotheses tried so far
    coverage: float  #: The share of its samples that were tried, 0 to 1
    reach: int = 0  #: A progressive search tried all samples among this number of candidates


def search_samples(scene: Scene, samples: NDArray[np.int64], leaders: Leaders,
                   constraint: Constraint | None = None) -> Iterator[Progress]:
    """Try given minimal samples, a block at a time.

    Parameters
    ----------
    samples : ndarray (t, 3) of int
        Candidate numbers; rows of -1 are skipped.
    """
    start = skipped = 0

    def fill(block: NDArray[np.int64]) -> int:
        nonlocal start, skipped
        block[:] = samples[start:start + len(block)]
        start, skipped = start + len(block), skipped + int((block[:, 0] < 0).sum())
        return len(block)
    for tried in _blocks(scene, constraint, leaders, fill, len(samples)):
        yield Progress(tried - skipped, start / len(samples))


def search_exhaustively(scene: Scene, leaders: Leaders, constraint: Constraint | None = None
                        ) -> Iterator[Progress]:
    """Try every valid sample, a block at a time, without storing them."""
    count, cursor = len(scene.pairs), np.array([0, 1, 2], dtype=np.int64)
    if count < SAMPLE_SIZE:
        return
    for tried in _blocks(scene, constraint, leaders,
                         partial(enumerate_triples, scene.pairs, cursor)):
        first, second, third = cursor.tolist()
        left = (comb(max(0, count - first - 1), 3) + comb(max(0, count - second - 1), 2)
                + max(0, count - third)) if first < count - 2 else 0
        yield Progress(tried, 1.0 - left / comb(count, 3))
        if not left:
            return


def search_progressively(scene: Scene, compatible: NDArray[np.bool_], leaders: Leaders,
                         constraint: Constraint | None = None, limit: float = inf,
                         size: int = SAMPLE_SIZE) -> Iterator[Progress]:
    """Try every sample of compatible candidates, those of the first candidates first.

    All samples among the first n candidates precede those with the next one. PROSAC draws in this
    order at random; this search does not repeat samples, and ends when all are tried.

    Parameters
    ----------
    compatible : ndarray (c, c) of bool
        See cliploc_ros.core.search.sampling.
    size : int, optional
        Candidates in a sample: three, or two where the constraint's vertical is known (see
        cliploc_ros.core.geometry.minimal_solvers). With two, the third column of the leaders'
        samples is -1.
    """
    count, (enumerate_samples, least_iou) = len(scene.pairs), _ORDERED[size]
    cursor = np.array([size - 1, *range(size - 1)], dtype=np.int64)  # newest, first, ...
    if cursor[0] >= count:
        return
    for tried in _blocks(scene, constraint, leaders,
                         partial(enumerate_samples, compatible, cursor), limit, least_iou):
        reach = min(int(cursor[0]), count)
        yield Progress(tried, comb(reach, size) / max(comb(count, size), 1), reach)
        if reach == count:
            return


def _blocks(scene: Scene, constraint: Constraint | None, leaders: Leaders,
            fill: Callable[[NDArray[np.int64]], int], limit: float = inf, least_iou: float = 0.0
            ) -> Iterator[int]:
    """Try blocks of samples of about equal time; yield how many were tried after each.

    Results do not depend on the sizes of the blocks. `fill` writes the next samples into a block
    (b, 3) and returns their number.
    """
    bench, tried, size = set_up(scene, constraint), 0, _FIRST_BLOCK
    memory = np.full((_LARGEST_BLOCK, SAMPLE_SIZE), -1, dtype=np.int64)
    while tried < limit:
        start = time.perf_counter()
        block = memory[:int(min(size, limit - tried))]
        found = fill(block)
        _try_samples(bench, block, found, tried, least_iou, leaders)
        tried += found
        elapsed = max(time.perf_counter() - start, 1e-9)
        size = min(max(int(size * min(_BLOCK_S / elapsed, 4.0)), 1), _LARGEST_BLOCK)
        yield tried


@compiled
def _try_samples(bench, samples, count, tried_before, least_iou, leaders):
    """Make the hypotheses of the first samples, and remember those that lead."""
    candidates, constraint, targets, sample, poses, overlaps = bench
    floor = worst_score(leaders)
    for number in range(count):
        if samples[number, 0] < 0:
            continue
        which = make_hypothesis(candidates, constraint, sample, poses, samples, number, least_iou)
        if which < 0:
            continue
        score = verify_beyond(targets, poses, which, overlaps, floor)
        if score > floor:
            remember(leaders, score, tried_before + number + 1, samples[number],
                     poses.rotations[which], poses.translations[which])
            floor = worst_score(leaders)
