# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A filter that takes each of successive answers for an independent measurement."""

import numpy as np
import pytest

from studies.covariance.continuous import COVARIANCES, walk_squares

pytestmark = pytest.mark.full


def test_a_filter_of_a_walk_is_consistent():
    """Images of simulated rooms, one after the other, as in continuous mode."""
    squares = np.concatenate([walk_squares('room', seed) for seed in (0, 1, 2)])
    assert len(squares) >= 15
    within = dict(zip(COVARIANCES, (squares < 20.06).mean(axis=0), strict=True))
    print(f'\n{len(squares)} states within 3 sigma: {within}')
    assert within['for a filter'] >= 0.95
    assert within['for a filter'] >= within['their own']
