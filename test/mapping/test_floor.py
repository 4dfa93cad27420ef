# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A simulated floor: what mapping finds of it, and that far landmarks are passed over safely."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.offline.mapping.association import find_overlaps, ious_with
from cliploc_ros.offline.mapping.building import build_map
from cliploc_ros.offline.mapping.landmarks import landmarks_of_map
from cliploc_ros.offline.mapping.pose_noise import _sample
from cliploc_ros.offline.mapping.views import make_views
from studies.speed.floors import CLASS_NAMES, Floor, SeenFloor, make_floor, see_floor


@dataclass(frozen=True)
class Comparison:
    """A built map next to the true one."""

    #: True objects that enough frames show, those of them that were found, those that were not,
    #: and landmarks that are no object or an object a second time
    visible: int
    found: int
    missed: int
    false: int
    #: (found,): distances of the centres of what was found [m]
    center_errors_m: NDArray[np.float64]


def compare_maps(built: LandmarkMap, seen: SeenFloor, floor: Floor, min_frames: int = 10
                 ) -> Comparison:
    """Compare a built map with the truth.

    A landmark and an object of one class belong together if they are nearest to each other and
    nearer than the object's greatest semi-axis.
    """
    true_map = floor.landmark_map
    counts = np.bincount(seen.true_landmarks[seen.true_landmarks >= 0],
                         minlength=len(true_map.centers))
    errors = np.full(len(true_map.centers), np.inf)
    for name in set(built.class_ids) & set(true_map.class_ids):
        ours = np.nonzero([one == name for one in built.class_ids])[0]
        theirs = np.nonzero([one == name for one in true_map.class_ids])[0]
        _, nearest = cKDTree(true_map.centers[theirs]).query(built.centers[ours])
        distances, back = cKDTree(built.centers[ours]).query(true_map.centers[theirs])
        mutual = nearest[back] == np.arange(len(theirs))
        near = distances < true_map.semi_axes[theirs].max(axis=1)
        errors[theirs] = np.where(mutual & near, distances, np.inf)
    found, visible = np.isfinite(errors), counts >= min_frames
    return Comparison(int(visible.sum()), int((found & visible).sum()),
                      int((visible & ~found).sum()), len(built.centers) - int(found.sum()),
                      errors[found])


@pytest.fixture(scope='module')
def floor():
    return make_floor(150)


@pytest.fixture(scope='module')
def seen(floor):
    return see_floor(floor, 1080)


def test_mapping_finds_the_objects_of_a_floor(floor, seen):
    built = build_map(seen.detections).landmark_map
    against = compare_maps(built, seen, floor)
    print(f'{against.found} of {against.visible} objects found, {against.false} false, centre '
          f'error {100 * np.median(against.center_errors_m):.2f} cm')
    assert against.found + against.missed == against.visible > 100
    assert against.found >= 0.9 * against.visible
    assert against.false <= 2
    assert np.median(against.center_errors_m) < 0.005


def test_far_landmarks_are_passed_over_without_a_loss(floor, seen):
    views = make_views(seen.detections)
    landmarks = landmarks_of_map(floor.landmark_map, CLASS_NAMES)
    landmarks.classes[7] = -1  # of a class that the recording does not know
    found = find_overlaps(views, landmarks, 0.2)
    expected = [
        (row, number) for number in range(len(landmarks.centers))
        for row in np.nonzero((views.classes == landmarks.classes[number]) & (ious_with(
            views, np.arange(len(views.classes)), landmarks.centers[number],
            landmarks.bases[number]) > 0.2))[0]]
    assert list(zip(found.boxes.tolist(), found.landmarks.tolist(), strict=True)) == sorted(
        expected)
    assert len(expected) > 1000


def test_pose_errors_of_a_long_recording_are_estimated_from_a_part_of_it(seen):
    far = np.tile(np.eye(4), (8000, 1, 1))
    far[:, 0, 3] = np.arange(8000)
    long = replace(seen.detections, map_from_camera=far, stamps_s=np.arange(8000.0),
                   frame_offsets=np.zeros(8001, dtype=np.int64), classes=np.empty(0, np.int64),
                   bboxes_xyxy=np.empty((0, 4)), scores=np.empty(0))
    frames, rows = _sample(make_views(long))
    assert (len(frames), len(rows)) == (200, 0)
    assert 2900 < np.ptp(frames) < 3000
    assert abs(frames.mean() - 4000) < 10


def test_no_landmarks_and_no_boxes(seen):
    views = make_views(seen.detections)
    none = landmarks_of_map(make_floor(1).landmark_map, ())
    assert none.classes.tolist() == [-1]
    assert len(find_overlaps(views, none, 0.2).boxes) == 0
    assert len(find_overlaps(views.between(0, 0), none, 0.2).boxes) == 0
