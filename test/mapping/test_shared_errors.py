# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The errors of poses that neighbouring landmarks have in common."""

import numpy as np
import pytest

from cliploc_ros.mapping.options import PoseErrors
from cliploc_ros.mapping.pose_noise import _BENDING, shared_by_neighbours
from cliploc_ros.mapping.views import Views
from studies.speed.pose_errors import draw_errors


def views_of(stamps_s, frames):
    """Views of some boxes; shared errors depend on nothing but their frames."""
    count, boxes = len(stamps_s), len(frames)
    nothing = np.zeros((boxes, 4))
    return Views(np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)), stamps_s,
                 np.arange(count), np.ones(count), np.searchsorted(frames, np.arange(count + 1)),
                 frames, np.zeros(boxes, int), nothing, nothing, nothing > 0, np.zeros(4),
                 np.zeros(boxes), np.zeros(boxes))


@pytest.mark.parametrize('correlation_s', [0.0, 3.0, 200.0])
def test_the_mean_error_of_the_poses_stays(correlation_s):
    errors, stamps = PoseErrors(0.05, 1.0, correlation_s), np.arange(0.0, 60.0, 0.7)
    kind, rng = 'correlated' if correlation_s else 'independent', np.random.default_rng(0)
    means = [draw_errors(kind, stamps, errors, rng).mean(axis=0) for _ in range(300)]
    frames = np.arange(len(stamps))
    shared = shared_by_neighbours(views_of(stamps, frames), np.zeros(len(frames), int), 1, errors)
    measured = np.std(means, axis=0).reshape(2, 3).mean(axis=1) * [1.0, np.degrees(1.0)]
    np.testing.assert_allclose(shared[0], _BENDING * measured, rtol=0.1)


def test_neighbours_are_what_some_frame_shows_together():
    """Three rooms: landmarks 0 and 1, 1 and 2 are seen together; 3 is seen alone, and briefly."""
    frames = np.repeat(np.arange(100), 2)
    shown = np.concatenate([np.tile([0, 1], 40), np.tile([1, 2], 50), np.tile([3, -1], 10)])
    errors = PoseErrors(0.1, 2.0, 0.0)
    found = shared_by_neighbours(views_of(np.arange(100.0), frames), shown, 5, errors)
    np.testing.assert_allclose(found[:4, 0] / (_BENDING * 0.1),
                               np.array([90, 90, 90, 10]) ** -0.5)
    np.testing.assert_allclose(found[:, 1], 20.0 * found[:, 0])
    # never seen: as far off as a single pose
    assert found[4, 0] == pytest.approx(_BENDING * 0.1)
