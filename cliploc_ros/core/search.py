# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The search: hypotheses from minimal samples, and the best of them at distinct places."""

from collections.abc import Iterator
from math import comb
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.compiled import compiled
from cliploc_ros.core.scoring import Scene, Workspace, sample_pose, verify

MAX_DISTINCT = 8
# Hypotheses nearer than this to a better one are the same place, seen twice.
DISTINCT_DISTANCE_M = 0.5
DISTINCT_ANGLE_DEG = 20.0
# 1 + 2 cos(angle) is the trace of a rotation.
_DISTINCT_TRACE = 1.0 + 2.0 * np.cos(np.radians(DISTINCT_ANGLE_DEG))


#: A sample whose own three pairs overlap less than this in sum is not verified, where every
#: sample is tried: a better one of the same place comes.
MIN_SAMPLED_IOU = 0.9
# A block of either search takes a few milliseconds, so that time limits hold.
_SAMPLES_A_BLOCK = 100
_WORK_A_BLOCK = 100_000
# trying a hypothesis against passing over a sample that is not valid
_WORK_A_HYPOTHESIS = 100


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


def search_samples(scene: Scene, samples: NDArray[np.int64], leaders: Leaders
                   ) -> Iterator[Progress]:
    """Try given minimal samples, a block at a time.

    Parameters
    ----------
    scene : Scene
    samples : ndarray (t, 3) of int
        Candidate numbers; rows of -1 are left out.
    leaders : Leaders
        Changed in place.

    Yields
    ------
    Progress
        After each block; the caller may stop there.
    """
    workspace = Workspace.allocate(len(scene.bearings))
    tried = 0
    for start in range(0, len(samples), _SAMPLES_A_BLOCK):
        stop = min(start + _SAMPLES_A_BLOCK, len(samples))
        tried += _search_samples(scene, samples, start, stop, leaders, workspace)
        yield Progress(tried, stop / len(samples))


def search_exhaustively(scene: Scene, leaders: Leaders) -> Iterator[Progress]:
    """Try every valid sample, a block at a time. Nothing is stored.

    Parameters
    ----------
    scene : Scene
    leaders : Leaders
        Changed in place.

    Yields
    ------
    Progress
        After each block; the caller may stop there.
    """
    workspace = Workspace.allocate(len(scene.bearings))
    count = len(scene.pairs)
    cursor = np.array([0, 1, 2], dtype=np.int64)
    tried = 0
    while cursor[0] < count - 2:
        tried += _search_from(scene, cursor, tried, leaders, workspace)
        first, second, third = (int(row) for row in cursor)
        left = (comb(max(0, count - first - 1), 3) + comb(max(0, count - second - 1), 2)
                + max(0, count - third)) if first < count - 2 else 0
        yield Progress(tried, 1.0 - left / comb(count, 3))


def search_progressively(scene: Scene, compatible: NDArray[np.bool_], leaders: Leaders
                         ) -> Iterator[Progress]:
    """Try every sample of compatible candidates, those of the first candidates first.

    All samples among the first n candidates are tried before one with the next: what PROSAC draws
    at random, without repetition, and to the end where there is time.

    Parameters
    ----------
    scene : Scene
    compatible : ndarray (c, c) of bool
        See cliploc_ros.core.compatibility.
    leaders : Leaders
        Changed in place.

    Yields
    ------
    Progress
        After each block; the caller may stop there.
    """
    workspace = Workspace.allocate(len(scene.bearings))
    count = len(scene.pairs)
    cursor = np.array([2, 0, 1], dtype=np.int64)  # newest, first, second
    tried = 0
    while cursor[0] < count:
        tried += _search_progressively(scene, compatible, cursor, tried, leaders, workspace)
        done = comb(int(cursor[0]), 3) if cursor[0] < count else comb(count, 3)
        yield Progress(tried, done / max(comb(count, 3), 1), min(int(cursor[0]), count))


@compiled
def _search_progressively(scene, compatible, cursor, tried_before, leaders, workspace):
    """Try the samples from a cursor on, for a bounded time; move the cursor behind them."""
    count = scene.pairs.shape[0]
    sample = np.empty(3, dtype=np.int64)
    newest, first, second = cursor[0], cursor[1], cursor[2]
    tried, work = 0, 0
    while newest < count and work < _WORK_A_BLOCK:
        if first >= newest - 1:
            newest, first, second = newest + 1, 0, 1
            continue
        work += 1
        if second >= newest or not compatible[newest, first]:
            first += 1
            second = first + 1
            continue
        if compatible[newest, second] and compatible[first, second]:
            sample[0], sample[1], sample[2] = first, second, newest
            tried += 1
            work += _WORK_A_HYPOTHESIS
            if _try_sample(scene, sample, tried_before + tried, MIN_SAMPLED_IOU, leaders,
                           workspace):
                work += scene.potential_landmarks.shape[0]
        second += 1
    cursor[0], cursor[1], cursor[2] = newest, first, second
    return tried


@compiled
def _search_samples(scene, samples, start, stop, leaders, workspace):
    tried = 0
    for t in range(start, stop):
        if samples[t, 0] >= 0:
            tried += 1
            _try_sample(scene, samples[t], t + 1, 0.0, leaders, workspace)
    return tried


@compiled
def _search_from(scene, cursor, tried_before, leaders, workspace):
    """Try the valid samples from a cursor on, for a bounded time; move the cursor behind them."""
    pairs = scene.pairs
    count = pairs.shape[0]
    sample = np.empty(3, dtype=np.int64)
    first, second, third = cursor[0], cursor[1], cursor[2]
    tried, work = 0, 0
    while first < count - 2 and work < _WORK_A_BLOCK:
        if second >= count - 1:
            first += 1
            second, third = first + 1, first + 2
            continue
        work += 1
        if third >= count or _clash(pairs, first, second):
            second += 1
            third = second + 1
            continue
        if not (_clash(pairs, first, third) or _clash(pairs, second, third)):
            sample[0], sample[1], sample[2] = first, second, third
            tried += 1
            work += _WORK_A_HYPOTHESIS + scene.potential_landmarks.shape[0]
            _try_sample(scene, sample, tried_before + tried, 0.0, leaders, workspace)
        third += 1
    cursor[0], cursor[1], cursor[2] = first, second, third
    return tried


@compiled
def _clash(pairs, a, b):
    """Tell whether two candidates share a detection or a landmark."""
    return pairs[a, 0] == pairs[b, 0] or pairs[a, 1] == pairs[b, 1]


@compiled
def _try_sample(scene, sample, iteration, least_iou, leaders, workspace):
    """Make the hypothesis of one sample, and remember it if it leads; tell if it was verified."""
    solution, total = sample_pose(scene, sample, workspace)
    if solution < 0 or total < least_iou:
        return False
    rotation, translation = workspace.rotations[solution], workspace.translations[solution]
    score = verify(scene, rotation, translation, workspace)
    if score > np.min(leaders.scores):
        _remember(score, iteration, sample, rotation, translation, leaders)
    return True


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
        if leaders.scores[row] >= score:
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
