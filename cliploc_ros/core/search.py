# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The search: hypotheses from minimal samples, and the best of them at distinct places."""

from collections.abc import Iterator
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
    def none_yet() -> 'Leaders':
        """Return an empty list of leaders."""
        return Leaders(np.full(MAX_DISTINCT, -1.0), np.zeros(MAX_DISTINCT, dtype=np.int64),
                       np.full((MAX_DISTINCT, 3), -1, dtype=np.int64),
                       np.zeros((MAX_DISTINCT, 3, 3)), np.zeros((MAX_DISTINCT, 3)))

    def ranked(self) -> NDArray[np.int64]:
        """Return the used rows, best first."""
        order = np.argsort(-self.scores, kind='stable')
        return order[self.scores[order] >= 0.0]


def search_samples(scene: Scene, samples: NDArray[np.int64], leaders: Leaders) -> int:
    """Try given minimal samples; return how many hypotheses there were.

    Parameters
    ----------
    scene : Scene
    samples : ndarray (t, 3) of int
        Candidate numbers; rows of -1 are left out.
    leaders : Leaders
        Changed in place.
    """
    return _search_samples(scene, samples, leaders, Workspace.allocate(len(scene.bearings)))


def search_exhaustively(scene: Scene, leaders: Leaders) -> Iterator[int]:
    """Try every valid sample, a slice at a time; yield how many hypotheses each slice had.

    Nothing is stored and the caller may stop between slices.
    """
    workspace = Workspace.allocate(len(scene.bearings))
    tried = 0
    for first in range(len(scene.pairs) - 2):
        count = _search_with_first(scene, first, tried, leaders, workspace)
        tried += count
        yield count


@compiled
def _search_samples(scene, samples, leaders, workspace):
    tried = 0
    for t in range(samples.shape[0]):
        if samples[t, 0] >= 0:
            tried += 1
            _try_sample(scene, samples[t], t + 1, leaders, workspace)
    return tried


@compiled
def _search_with_first(scene, first, tried_before, leaders, workspace):
    """Try every valid sample whose lowest candidate number is first."""
    pairs = scene.pairs
    sample = np.empty(3, dtype=np.int64)
    sample[0] = first
    tried = 0
    for second in range(first + 1, pairs.shape[0] - 1):
        if pairs[second, 0] == pairs[first, 0] or pairs[second, 1] == pairs[first, 1]:
            continue
        sample[1] = second
        for third in range(second + 1, pairs.shape[0]):
            if (pairs[third, 0] == pairs[first, 0] or pairs[third, 0] == pairs[second, 0]
                    or pairs[third, 1] == pairs[first, 1]
                    or pairs[third, 1] == pairs[second, 1]):
                continue
            sample[2] = third
            tried += 1
            _try_sample(scene, sample, tried_before + tried, leaders, workspace)
    return tried


@compiled
def _try_sample(scene, sample, iteration, leaders, workspace):
    """Make the hypothesis of one sample, and remember it if it leads."""
    solution = sample_pose(scene, sample, workspace)
    if solution < 0:
        return
    rotation, translation = workspace.rotations[solution], workspace.translations[solution]
    score = verify(scene, rotation, translation, workspace)
    if score > np.min(leaders.scores):
        _remember(score, iteration, sample, rotation, translation, leaders)


@compiled
def _remember(score, iteration, sample, rotation, translation, leaders):
    """Take a hypothesis in, unless a better one leads at its place; drop worse ones there."""
    free = -1
    for row in range(leaders.scores.shape[0]):
        if leaders.scores[row] < 0.0:
            continue
        if not _same_place(rotation, translation, leaders.rotations[row],
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
def _same_place(rotation_a, translation_a, rotation_b, translation_b):
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
