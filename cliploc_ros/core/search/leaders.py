# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The best hypotheses of a search, each at a place of its own."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.tolerances import SAME_PLACE
from cliploc_ros.core.kernels.compiled import compiled

MAX_DISTINCT = 8
# Plain numbers, for the kernels.
_PLACE_M, _PLACE_TRACE = SAME_PLACE.distance_m, SAME_PLACE.least_trace
# Scores nearer than this differ by rounding only: the hypothesis found first stays.
_TIE = 1e-9


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
        """Return room for so many leaders, all unused."""
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
    """Return whether two camera_from_map poses are within the distinct distance and angle."""
    return are_near(rotation_a, translation_a, rotation_b, translation_b, _PLACE_M,
                    _PLACE_TRACE)


@compiled
def are_near(rotation_a, translation_a, rotation_b, translation_b, distance_m, least_trace):
    """Return whether two camera_from_map poses differ by at most a distance and an angle.

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
    return trace >= least_trace and square <= distance_m * distance_m
