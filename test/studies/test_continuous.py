# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A filter that takes each of successive answers for an independent measurement."""

import numpy as np
import pytest

from cliploc_ros.core.localizer import succeed
from studies.covariance.continuous import COVARIANCES, Filter, walk_squares

pytestmark = pytest.mark.full

OWN = np.diag([0.04, 0.01, 0.02, 0.001, 0.002, 0.003])
HERE = np.eye(4)


def test_a_filter_of_a_standing_robot_stays_as_certain_as_one_answer():
    known, fused = None, None
    for _ in range(300):
        given, known = succeed(known, HERE, HERE, OWN)
        fused = Filter(HERE, given, HERE) if fused is None else fused.updated(HERE, given)
    assert np.linalg.eigvalsh(fused.covariance - 0.95 * OWN).min() > 0.0
    np.testing.assert_allclose(known.covariance, fused.covariance, rtol=1e-6, atol=1e-12)


def test_a_filter_of_a_walk_is_consistent():
    """Images of simulated rooms, one after the other, as in continuous mode."""
    squares = np.concatenate([walk_squares('room', seed) for seed in (0, 1, 2)])
    assert len(squares) >= 15
    within = dict(zip(COVARIANCES, (squares < 20.06).mean(axis=0), strict=True))
    print(f'\n{len(squares)} states within 3 sigma: {within}')
    assert within['for a filter'] >= 0.95
    assert within['for a filter'] >= within['their own']
