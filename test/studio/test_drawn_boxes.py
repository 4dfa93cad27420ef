# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Landmarks from boxes in two or three views, on real boxes of the shared office."""

import numpy as np
import pytest

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.offline.datasets.observations import load_observations
from cliploc_ros.offline.mapping.association import associate, ious_with
from cliploc_ros.offline.mapping.landmarks import group_boxes, landmarks_of_map
from cliploc_ros.offline.mapping.views import make_views
from cliploc_ros.offline.studio.edits import EditError
from cliploc_ros.offline.studio.new_landmark import fit_boxes

TRIALS_PER_LANDMARK = 2


@pytest.fixture(scope='module')
def office(shared_data):
    folder = shared_data / 'tum_fr3_office'
    detections = load_observations(folder / 'observations.npz')
    views = make_views(detections)
    landmark_map = LandmarkMap.from_file(folder / 'map.yaml')
    landmarks = landmarks_of_map(landmark_map, detections.class_names)
    return detections, views, landmarks, associate(views, landmarks, 0.2)


def draw_triple(directions, rng):
    """Return three rows with directions 25 to 90 degrees apart, or None."""
    for _ in range(200):
        rows = rng.choice(len(directions), 3, replace=False)
        cosines = (directions[rows] @ directions[rows].T)[np.triu_indices(3, 1)]
        angles = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
        if angles.min() >= 25 and angles.max() <= 90:
            return rows
    return None


@pytest.mark.parametrize(('name', 'min_iou', 'least'), [
    ('any box of the detector', 0.2, 0.70),
    ('its boxes that fit the landmark (IoU .8)', 0.8, 0.73)])
def test_three_boxes_make_a_landmark_that_fits_other_views(office, name, min_iou, least):
    """The number refers to the detector's boxes, which have .79 with the map itself."""
    detections, views, landmarks, shown = office
    rng, medians = np.random.default_rng(0), []
    for number, rows in enumerate(group_boxes(shown, len(landmarks.centers))):
        rows = rows[~views.is_open[rows].any(axis=1)]
        if len(rows) < 30:
            continue
        offsets = landmarks.centers[number] - views.centers[views.frames[rows]]
        directions = offsets / np.linalg.norm(offsets, axis=1, keepdims=True)
        drawable = np.nonzero(ious_with(views, rows, landmarks.centers[number],
                                        landmarks.bases[number]) >= min_iou)[0]
        for _ in range(TRIALS_PER_LANDMARK):
            triple = draw_triple(directions[drawable], rng) if len(drawable) > 2 else None
            if triple is None:
                break
            drawn = rows[drawable[triple]]
            fit, warning = fit_boxes(
                3 * detections.cameras, detections.map_from_camera[views.frames[drawn]],
                detections.bboxes_xyxy[drawn])
            assert warning == ''
            medians.append(np.median(ious_with(views, np.setdiff1d(rows, drawn), fit.center,
                                               fit.basis)))
    print(f'three boxes, {name}: {len(medians)} landmarks, median IoU in other views '
          f'{np.median(medians):.3f}, quartiles {np.quantile(medians, [.25, .75]).round(3)}')
    assert len(medians) > 30
    assert np.median(medians) >= least


def test_views_that_look_alike_are_warned_of(office):
    detections, views, landmarks, shown = office
    rows = group_boxes(shown, len(landmarks.centers))[0][:3]
    _, warning = fit_boxes(3 * detections.cameras, detections.map_from_camera[views.frames[rows]],
                           detections.bboxes_xyxy[rows])
    assert 'degrees apart' in warning


@pytest.mark.parametrize(('second', 'distance_m', 'message'), [
    (None, 0.0, 'boxes drawn: 1'), ((300.0, 220.0, 340.0, 260.0), 0.0, 'along one line'),
    ((500.0, 220.0, 540.0, 260.0), 1.0, 'behind a camera')])
def test_what_is_no_object_is_refused(second, distance_m, message):
    camera = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)
    poses = np.array([np.eye(4), np.eye(4)])
    poses[1, 0, 3] = distance_m
    boxes = np.array([(300.0, 220.0, 340.0, 260.0)] + ([] if second is None else [second]))
    with pytest.raises(EditError, match=message):
        fit_boxes([camera] * len(boxes), poses[:len(boxes)], boxes)
