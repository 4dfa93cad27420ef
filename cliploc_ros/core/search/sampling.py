# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Minimal samples: PROSAC, RANSAC, and the enumeration of all samples.

A sample is three candidates with three different detections and three different landmarks.
"""

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.kernels.compiled import compiled

SAMPLE_SIZE = 3
# An enumeration returns after so many steps of some nanoseconds each, even without a sample.
_MAX_STEPS = 500_000
# A draw without a valid sample in this many attempts is skipped (its row is -1): the first
# candidates of PROSAC may not have any.
_MAX_ATTEMPTS = 100


def prosac_growth(candidate_count: int, iterations: int) -> NDArray[np.int64]:
    """Return T'_3 .. T'_N (N - 2,): PROSAC's last iteration with each size of its candidate set.

    Chum and Matas, "Matching with PROSAC", CVPR 2005, Eqs. 3 to 5, for N >= 3 candidates. T_N,
    after which PROSAC becomes RANSAC, is the number of iterations: with the textbook's 200,000 a
    search of 500 never leaves its first five candidates.
    """
    sizes = np.arange(SAMPLE_SIZE, candidate_count)
    drawn = iterations * np.prod([(SAMPLE_SIZE - i) / (candidate_count - i)
                                  for i in range(SAMPLE_SIZE)])
    expected = drawn * np.cumprod(np.concatenate(
        [[1.0], (sizes + 1) / (sizes + 1 - SAMPLE_SIZE)]))
    # The tolerance keeps whole numbers from being rounded up because of their last digit.
    steps = np.ceil(np.diff(expected) - 1e-9).astype(np.int64)
    return 1 + np.concatenate([[0], np.cumsum(steps)])


def draw_ransac(pairs: NDArray[np.int64], iterations: int, rng: np.random.Generator
                ) -> NDArray[np.int64]:
    """Return samples (iterations, 3) of uniformly drawn candidates; rows of -1 are skipped.

    Parameters
    ----------
    pairs : ndarray (c, 2)
        Detection and landmark of each candidate.
    """
    samples = np.full((iterations, SAMPLE_SIZE), -1, dtype=np.int64)
    if len(pairs) >= SAMPLE_SIZE:
        # the whole set from the first iteration on
        growth = np.zeros(len(pairs) - SAMPLE_SIZE + 1, dtype=np.int64)
        _draw(np.ascontiguousarray(pairs), growth, rng, samples)
    return samples


def draw_prosac(pairs: NDArray[np.int64], iterations: int, rng: np.random.Generator
                ) -> NDArray[np.int64]:
    """Return samples (iterations, 3) as PROSAC draws them; rows of -1 are skipped.

    Parameters
    ----------
    pairs : ndarray (c, 2)
        Detection and landmark of each candidate, in order of preference.
    """
    samples = np.full((iterations, SAMPLE_SIZE), -1, dtype=np.int64)
    if len(pairs) >= SAMPLE_SIZE:
        growth = prosac_growth(len(pairs), iterations)
        _draw(np.ascontiguousarray(pairs), growth, rng, samples)
    return samples


@compiled
def _draw(pairs, growth, rng, samples):
    """Fill samples: u_n and two of the n - 1 before it while t <= T'_n, then three of all."""
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
        The next sample, at first 0, 1, 2; updated. Its first value is c - 2 at the end.
    samples : ndarray (t, 3)
        Filled from the first row on.
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
    """Return whether two candidates share a detection or a landmark."""
    return pairs[a, 0] == pairs[b, 0] or pairs[a, 1] == pairs[b, 1]


@compiled
def enumerate_compatible_triples(compatible, cursor, samples):
    """Write the next samples of compatible candidates, by their newest; return their number.

    Parameters
    ----------
    compatible : ndarray (c, c) of bool
        See cliploc_ros.core.search.compatibility.
    cursor : ndarray (3,)
        Newest, first and second candidate, at first 2, 0, 1; updated. The newest is c at the end.
    samples : ndarray (t, 3)
        Filled from the first row on: first, second, newest.
    """
    count = compatible.shape[0]
    newest, first, second = cursor[0], cursor[1], cursor[2]
    earlier = np.empty(count, dtype=np.int64)
    found, steps = 0, 0
    while newest < count and found < samples.shape[0] and steps < _MAX_STEPS:
        known = _compatible_before(compatible, newest, earlier)
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
def _compatible_before(compatible, newest, earlier):
    """Write the candidates before the newest one that are compatible; return their number."""
    known = 0
    for candidate in range(newest):
        if compatible[newest, candidate]:
            earlier[known] = candidate
            known += 1
    return known


@compiled
def enumerate_compatible_pairs(compatible, cursor, samples):
    """Write the next pairs of compatible candidates, by their newer; return their number.

    As enumerate_compatible_triples does, into two columns: older, newer. The cursor (2,) is at
    first 1, 0, and its first value is c at the end.
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
