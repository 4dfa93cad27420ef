# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Two tables on one floor: far landmarks are passed over safely, a long recording by a part."""

from dataclasses import replace

import numpy as np
import pytest
from walk import CLASSES, join_maps, make_table, see, walk_around

from cliploc_ros.offline.mapping.association import find_overlaps, ious_with
from cliploc_ros.offline.mapping.landmarks import landmarks_of_map
from cliploc_ros.offline.mapping.pose_noise import _sample
from cliploc_ros.offline.mapping.views import make_views

AWAY_M = np.array([12.0, 0.0, 0.0])


@pytest.fixture(scope='module')
def floor():
    """Two tables, 12 m apart."""
    table = make_table()
    return join_maps(table, replace(table, centers=table.centers + AWAY_M))


@pytest.fixture(scope='module')
def seen(floor):
    """A walk around one table, and then around the other."""
    there = walk_around()
    there[:, :3, 3] += AWAY_M
    return see(floor, np.concatenate([walk_around(), there]), noise_px=2.0)


def test_far_landmarks_are_passed_over_without_a_loss(floor, seen):
    views = make_views(seen)
    landmarks = landmarks_of_map(floor, CLASSES)
    landmarks.classes[7] = -1  # of a class that the recording does not know
    found = find_overlaps(views, landmarks, 0.2)
    expected = [
        (row, number) for number in range(len(landmarks.centers))
        for row in np.nonzero((views.classes == landmarks.classes[number]) & (ious_with(
            views, np.arange(len(views.classes)), landmarks.centers[number],
            landmarks.bases[number]) > 0.2))[0]]
    assert list(zip(found.boxes.tolist(), found.landmarks.tolist(), strict=True)) == sorted(
        expected)
    assert len(expected) > 900


def test_pose_errors_of_a_long_recording_are_estimated_from_a_part_of_it(seen):
    far = np.tile(np.eye(4), (8000, 1, 1))
    far[:, 0, 3] = np.arange(8000)
    long = replace(seen, map_from_camera=far, stamps_s=np.arange(8000.0),
                   frame_offsets=np.zeros(8001, dtype=np.int64), classes=np.empty(0, np.int64),
                   bboxes_xyxy=np.empty((0, 4)), scores=np.empty(0))
    frames, rows = _sample(make_views(long))
    assert (len(frames), len(rows)) == (200, 0)
    assert 2900 < np.ptp(frames) < 3000
    assert abs(frames.mean() - 4000) < 10


def test_no_landmarks_and_no_boxes(floor, seen):
    views = make_views(seen)
    none = landmarks_of_map(floor.select([0]), ())
    assert none.classes.tolist() == [-1]
    assert len(find_overlaps(views, none, 0.2).boxes) == 0
    assert len(find_overlaps(views.between(0, 0), none, 0.2).boxes) == 0
