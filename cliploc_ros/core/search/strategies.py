# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Minimal samples, and the order of a search: random, exhaustive, or most likely first.

A sample is three candidates with three different detections and three different landmarks.

The size of a box gives an approximate distance to its landmark. Two boxes and the angle between
them therefore bound the distance between their landmarks, which the map contains. Two candidates
that cannot both be correct never form a sample.

Leaders are the best hypotheses of a search, at most one at each place. Poses that contradict the
constraint are not verified. Each search yields its progress after each block of samples, and the
caller may stop it there.
"""

import time
from collections.abc import Callable, Iterator
from functools import partial
from math import comb, inf, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.transforms import SAME_PLACE
from cliploc_ros.core.kernels.compiled import compiled
from cliploc_ros.core.search.scene import Constraint, Scene
from cliploc_ros.core.search.screening import make_hypothesis, set_up, verify_beyond

SAMPLE_SIZE = 3
# An enumeration returns after this number of steps, of a few nanoseconds each, even if it found no
# sample.
_MAX_STEPS = 500_000
# A draw that yields no valid sample within this number of attempts is skipped (its row is -1):
# PROSAC's first candidates may not contain a valid sample.
_MAX_ATTEMPTS = 100
# Limits of the ratio of a landmark's distance to the distance that the size of its box gives. Of
# 1375 boxes of the recorded TUM frames, to which the map was fitted, 99.8 % lie between .67 and
# 2.5: boxes are larger than the ellipsoid, or cut off by the border of the image.
NEAREST, FARTHEST = 0.55, 2.5
MAX_DISTINCT = 8
# Compiled kernels need plain numbers.
_PLACE_M, _PLACE_TRACE = SAME_PLACE.distance_m, SAME_PLACE.least_trace
# Scores that differ by less than this are equal up to rounding: the hypothesis found first stays.
_TIE = 1e-9
# search_progressively drops a sample whose three pairs have a smaller sum of IoUs: it tries all
# samples, so a better sample of the same place follows.
_MIN_SAMPLED_IOU = 0.9
# The same limit for samples of two pairs, whose poses inherit the noise of the vertical.
_MIN_SAMPLED_PAIR_IOU = 0.2
# Target duration of a block: a search can stop only between blocks.
_BLOCK_S = 1e-3
# Samples in a block.
_FIRST_BLOCK, _LARGEST_BLOCK = 64, 1024


def prosac_growth(candidate_count: int, iterations: int) -> NDArray[np.int64]:
    """Return T'_3 .. T'_N (N - 2,): PROSAC's last iteration at each size of its candidate set.

    Chum and Matas, "Matching with PROSAC", CVPR 2005, Eqs. 3 to 5, for N >= 3 candidates. T_N,
    after which PROSAC becomes RANSAC, equals the number of iterations here. With the paper's
    200,000, a search of 500 iterations would never go beyond its first five candidates.
    """
    sizes = np.arange(SAMPLE_SIZE, candidate_count)
    drawn = iterations * np.prod([(SAMPLE_SIZE - i) / (candidate_count - i)
                                  for i in range(SAMPLE_SIZE)])
    expected = drawn * np.cumprod(np.concatenate([[1.0], (sizes + 1) / (sizes + 1 - SAMPLE_SIZE)]))
    # The tolerance prevents floating-point error from rounding whole numbers up.
    steps = np.ceil(np.diff(expected) - 1e-9).astype(np.int64)
    return 1 + np.concatenate([[0], np.cumsum(steps)])


def draw_ransac(pairs: NDArray[np.int64], iterations: int, rng: np.random.Generator,
                growth: NDArray[np.int64] | None = None) -> NDArray[np.int64]:
    """Draw samples (iterations, 3) of candidates uniformly; rows of -1 are skipped.

    Parameters
    ----------
    pairs : ndarray (c, 2)
        Detection and landmark of each candidate.
    growth : ndarray (c - 2,), optional
        See prosac_growth; by default, all candidates are sampled from the first iteration on.
    """
    samples = np.full((iterations, SAMPLE_SIZE), -1, dtype=np.int64)
    if len(pairs) >= SAMPLE_SIZE:
        _draw(np.ascontiguousarray(pairs), np.zeros(len(pairs) - SAMPLE_SIZE + 1, dtype=np.int64)
              if growth is None else growth, rng, samples)
    return samples


def draw_prosac(pairs: NDArray[np.int64], iterations: int, rng: np.random.Generator
                ) -> NDArray[np.int64]:
    """Draw samples in the order of PROSAC, of candidates in order of preference: draw_ransac."""
    return draw_ransac(pairs, iterations, rng, prosac_growth(max(SAMPLE_SIZE, len(pairs)),
                                                             iterations))


@compiled
def _draw(pairs, growth, rng, samples):
    """Fill samples: while t <= T'_n, u_n and two of the n - 1 before it; then any three."""
    size = SAMPLE_SIZE
    for t in range(1, samples.shape[0] + 1):
        while size < pairs.shape[0] and t > growth[size - SAMPLE_SIZE]:
            size += 1
        newest = t <= growth[size - SAMPLE_SIZE]
        for _ in range(_MAX_ATTEMPTS):
            i = size - 1 if newest else int(rng.random() * size)
            j = int(rng.random() * (size - 1 if newest else size))
            k = int(rng.random() * (size - 1 if newest else size))
            if (pairs[i, 0] != pairs[j, 0] and pairs[i, 0] != pairs[k, 0]
                    and pairs[j, 0] != pairs[k, 0] and pairs[i, 1] != pairs[j, 1]
                    and pairs[i, 1] != pairs[k, 1] and pairs[j, 1] != pairs[k, 1]):
                samples[t - 1, 0], samples[t - 1, 1], samples[t - 1, 2] = i, j, k
                break


@compiled
def enumerate_triples(pairs, cursor, samples):
    """Write the next valid samples in lexicographic order; return their number.

    Parameters
    ----------
    pairs : ndarray (c, 2)
        Detection and landmark of each candidate.
    cursor : ndarray (3,)
        The next sample, initially 0, 1, 2; updated. Its first value is c - 2 at the end.
    samples : ndarray (t, 3)
        Output, filled from the first row.
    """
    count = pairs.shape[0]
    first, second, third = cursor[0], cursor[1], cursor[2]
    found, steps = 0, 0
    while first < count - 2 and found < samples.shape[0] and steps < _MAX_STEPS:
        steps += 1
        if second >= count - 1:
            first += 1
            second, third = first + 1, first + 2
            continue
        if third >= count or _clash(pairs, first, second):
            second += 1
            third = second + 1
            continue
        if not (_clash(pairs, first, third) or _clash(pairs, second, third)):
            samples[found, 0], samples[found, 1], samples[found, 2] = first, second, third
            found += 1
        third += 1
    cursor[0], cursor[1], cursor[2] = first, second, third
    return found


@compiled
def _clash(pairs, a, b):
    """Check whether two candidates share a detection or a landmark."""
    return pairs[a, 0] == pairs[b, 0] or pairs[a, 1] == pairs[b, 1]


@compiled
def enumerate_compatible_triples(compatible, cursor, samples):
    """Write the next compatible triples, ordered by newest candidate; return their number.

    Parameters
    ----------
    compatible : ndarray (c, c) of bool
        See compatible_pairs.
    cursor : ndarray (3,)
        Newest, first and second candidate, initially 2, 0, 1; updated. The newest is c at the end.
    samples : ndarray (t, 3)
        Output, filled from the first row: first, second, newest.
    """
    count = compatible.shape[0]
    newest, first, second = cursor[0], cursor[1], cursor[2]
    earlier = np.empty(count, dtype=np.int64)  # candidates compatible with the newest
    found, steps = 0, 0
    while newest < count and found < samples.shape[0] and steps < _MAX_STEPS:
        known = 0
        for candidate in range(newest):
            if compatible[newest, candidate]:
                earlier[known] = candidate
                known += 1
        steps += newest + 1
        for a in range(known):
            if earlier[a] < first:
                continue
            for b in range(a + 1, known):
                if earlier[a] == first and earlier[b] < second:
                    continue
                steps += 1
                if not compatible[earlier[a], earlier[b]]:
                    continue
                if found == samples.shape[0]:
                    cursor[0], cursor[1], cursor[2] = newest, earlier[a], earlier[b]
                    return found
                samples[found, 0], samples[found, 1] = earlier[a], earlier[b]
                samples[found, 2] = newest
                found += 1
        newest, first, second = newest + 1, 0, 1
    cursor[0], cursor[1], cursor[2] = newest, first, second
    return found


@compiled
def enumerate_compatible_pairs(compatible, cursor, samples):
    """Write the next compatible pairs, ordered by newer candidate; return their number.

    Like enumerate_compatible_triples, but with two columns: older, newer. The cursor (2,) starts
    at 1, 0; its first value is c at the end.
    """
    count = compatible.shape[0]
    newest, first = cursor[0], cursor[1]
    found, steps = 0, 0
    while newest < count and found < samples.shape[0] and steps < _MAX_STEPS:
        steps += 1
        if first >= newest:
            newest, first = newest + 1, 0
            continue
        if compatible[newest, first]:
            samples[found, 0], samples[found, 1] = first, newest
            found += 1
        first += 1
    cursor[0], cursor[1] = newest, first
    return found


def compatible_pairs(scene: Scene) -> NDArray[np.bool_]:
    """Return a symmetric mask (c, c) of the pairs of candidates that may form a sample.

    The two candidates must have different detections and different landmarks. The distance
    between the landmarks in the map must be within the range that their boxes allow.
    """
    depths = _depths(scene)
    compatible = np.zeros((len(scene.pairs), len(scene.pairs)), dtype=np.bool_)
    _compare_near(scene, depths, np.argsort(scene.centers[scene.pairs[:, 1], 0]), compatible)
    return compatible


def _depths(scene: Scene) -> NDArray[np.float64]:
    """Return the distance (c,) [m] at which each landmark would appear as large as its box."""
    xx, xy, xz, yy, yz, zz = scene.shapes[scene.pairs[:, 1]].T
    # the determinant of a shape matrix is the product of the squared semi-axes
    determinant = (xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz))
    radius = np.cbrt(np.sqrt(np.maximum(determinant, 0.0)))
    half = scene.box_ellipses[scene.pairs[:, 0], 2:]
    # the last factor converts depth along the optical axis to distance along the ray
    middle = scene.box_ellipses[scene.pairs[:, 0], :2]
    return np.asarray(radius / np.sqrt(half.prod(axis=1))
                      * np.sqrt(1.0 + (middle * middle).sum(axis=1)))


@compiled
def _compare_near(scene, depths, along_x, compatible):
    """Compare each candidate with its predecessors along the x axis, within its reach.

    In a large map, and in several maps side by side, most predecessors are out of reach.
    """
    pairs, deepest = scene.pairs, 0.0
    for depth in depths:
        deepest = max(deepest, depth)
    for number in range(pairs.shape[0]):
        i = along_x[number]
        reach = FARTHEST * (depths[i] + deepest)
        for before in range(number - 1, -1, -1):
            j = along_x[before]
            if scene.centers[pairs[i, 1], 0] - scene.centers[pairs[j, 1], 0] > reach:
                break
            if pairs[i, 0] == pairs[j, 0] or pairs[i, 1] == pairs[j, 1]:
                continue
            p, q = scene.centers[pairs[i, 1]], scene.centers[pairs[j, 1]]
            apart = sqrt((p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2 + (p[2] - q[2]) ** 2)
            # in a large map, most pairs are too far apart for any camera position
            if apart > FARTHEST * (depths[i] + depths[j]):
                continue
            a, b = scene.bearings[pairs[i, 0]], scene.bearings[pairs[j, 0]]
            cosine = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
            low, high = _distance_range(depths[i], depths[j], cosine)
            if low <= apart <= high:
                compatible[i, j] = compatible[j, i] = True


@compiled
def _distance_range(depth_a, depth_b, cosine):
    """Return the minimum and maximum distance between two points of roughly known depths."""
    near_a, far_a = NEAREST * depth_a, FARTHEST * depth_a
    near_b, far_b = NEAREST * depth_b, FARTHEST * depth_b
    # The squared distance is convex in both depths: the maximum is at a corner, the minimum on an
    # edge.
    high = max(_square(near_a, near_b, cosine), _square(near_a, far_b, cosine),
               _square(far_a, near_b, cosine), _square(far_a, far_b, cosine))
    low = min(_square(near_a, min(max(near_a * cosine, near_b), far_b), cosine),
              _square(far_a, min(max(far_a * cosine, near_b), far_b), cosine),
              _square(min(max(near_b * cosine, near_a), far_a), near_b, cosine),
              _square(min(max(far_b * cosine, near_a), far_a), far_b, cosine))
    return sqrt(max(0.0, low)), sqrt(high)


@compiled
def _square(depth_a, depth_b, cosine):
    return depth_a * depth_a + depth_b * depth_b - 2.0 * depth_a * depth_b * cosine


class Leaders(NamedTuple):
    """The best hypotheses of a search, at distinct places; unused rows have the score -1."""

    scores: NDArray[np.float64]  #: (m,)
    iterations: NDArray[np.int64]  #: (m,): iteration that found each hypothesis, from 1
    samples: NDArray[np.int64]  #: (m, 3): minimal sample of each, as candidate numbers
    #: (m, 3, 3), (m, 3): of camera_from_map
    rotations: NDArray[np.float64]
    translations: NDArray[np.float64]

    @staticmethod
    def none_yet(count: int = MAX_DISTINCT) -> 'Leaders':
        """Allocate storage for a number of leaders, all unused."""
        return Leaders(np.full(count, -1.0), np.zeros(count, dtype=np.int64),
                       np.full((count, 3), -1, dtype=np.int64),
                       np.zeros((count, 3, 3)), np.zeros((count, 3)))

    def ranked(self) -> NDArray[np.int64]:
        """Return the indices of the used rows, best first."""
        order = np.argsort(-self.scores, kind='stable')
        return order[self.scores[order] >= 0.0]


@compiled
def remember(leaders, score, iteration, sample, rotation, translation):
    """Add a hypothesis, unless its place has a better leader; drop worse leaders of that place."""
    scores = leaders.scores
    free = -1
    for row in range(scores.shape[0]):
        if scores[row] < 0.0:
            continue
        # the trace of the rotation between two poses is 1 + 2 cos(angle)
        trace, square = 0.0, 0.0
        for i in range(3):
            center, other = 0.0, 0.0
            for j in range(3):
                trace += rotation[i, j] * leaders.rotations[row, i, j]
                center -= rotation[j, i] * translation[j]
                other -= leaders.rotations[row, j, i] * leaders.translations[row, j]
            square += (center - other) ** 2
        if not (trace >= _PLACE_TRACE and square <= _PLACE_M * _PLACE_M):
            continue
        if scores[row] >= score - _TIE:
            return
        scores[row] = -1.0
        free = row
    if free < 0:
        free = scores.argmin()
    scores[free], leaders.iterations[free], leaders.samples[free] = score, iteration, sample
    leaders.rotations[free], leaders.translations[free] = rotation, translation


class Progress(NamedTuple):
    """Progress of a search."""

    tried: int  #: Number of samples tried
    coverage: float  #: Share of all samples that were tried, 0 to 1
    reach: int = 0  #: Progressive search: all samples among this number of candidates were tried


def search_samples(scene: Scene, samples: NDArray[np.int64], leaders: Leaders,
                   constraint: Constraint | None = None) -> Iterator[Progress]:
    """Try the given minimal samples, a block at a time.

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
    """Try every sample of compatible candidates, starting with the first candidates.

    All samples among the first n candidates precede the samples with candidate n + 1. PROSAC
    draws at random in this order; this search repeats no sample and ends when all were tried.

    Parameters
    ----------
    compatible : ndarray (c, c) of bool
        See compatible_pairs.
    size : int, optional
        Candidates in a sample: three, or two if the constraint's vertical is known (see
        cliploc_ros.core.geometry.minimal_solvers). With two, the third column of the leaders'
        samples is -1.
    """
    count = len(scene.pairs)
    enumerate_samples, least_iou = (
        (enumerate_compatible_triples, _MIN_SAMPLED_IOU) if size == SAMPLE_SIZE
        else (enumerate_compatible_pairs, _MIN_SAMPLED_PAIR_IOU))
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
    """Try blocks of samples of about equal duration; yield the number tried after each block.

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
    """Make the hypotheses of the first `count` samples, and add the best to the leaders."""
    candidates, constraint, targets, sample, poses, overlaps = bench
    floor = leaders.scores.min()  # the score that a hypothesis must exceed to become a leader
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
            floor = leaders.scores.min()
