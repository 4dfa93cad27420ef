# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the check of a map finds, on a simulated walk whose landmarks are known."""

import re
from dataclasses import replace

import numpy as np
import pytest
from walk import make_table, see, walk_around

from cliploc_ros.core.landmark_map import LandmarkMap
from cliploc_ros.mapping.check_page import check_page
from cliploc_ros.mapping.checking import check_map, cross_validate
from cliploc_ros.mapping.options import MappingOptions

TABLE = make_table()


def repeat(table: LandmarkMap, rows, ids) -> LandmarkMap:
    """Return a map of some landmarks, under other names."""
    return replace(table, landmark_ids=tuple(ids), labels=tuple(table.labels[i] for i in rows),
                   class_ids=tuple(table.class_ids[i] for i in rows),
                   centers=table.centers[list(rows)], semi_axes=table.semi_axes[list(rows)],
                   quats_xyzw=table.quats_xyzw[list(rows)])


def test_a_true_map_is_good():
    checked = check_map(TABLE, see(TABLE, walk_around()))
    assert checked.explained == 1.0
    assert checked.median_iou > 0.999
    assert checked.localizable == 1.0
    assert checked.advice == ()
    assert all(one.problems == () for one in checked.landmarks)
    assert all(one.support > 0 and one.offset_m < 1e-3 for one in checked.landmarks)


def test_doubles_are_found_without_observations():
    rows = [0, 1, 2, 3, 0]
    checked = check_map(repeat(TABLE, rows, ['a', 'b', 'c', 'd', 'a_again']))
    assert checked.explained is None
    assert [one.overlaps for one in checked.landmarks] == [('a_again',), (), (), (), ('a',)]
    assert 'probably one object' in checked.landmarks[0].problems[0]
    assert checked.advice == ('2 landmarks lie in another one of their class: merge them, as '
                              'doubles cause false accepts',)


def test_moved_and_missing_landmarks_are_named():
    centers = TABLE.centers.copy()
    centers[4] += (0.0, 0.0, 3.0)
    checked = check_map(replace(TABLE, centers=centers), see(TABLE, walk_around()))
    assert [bool(one.problems) for one in checked.landmarks] == [False] * 4 + [True] + [False] * 4
    assert checked.landmarks[4].support == 0
    assert 'no frame shows it' in checked.landmarks[4].problems[0]
    assert checked.explained == pytest.approx(8 / 9, abs=0.03)
    assert checked.advice == ('1 of 9 landmarks are not where the recording shows them: build '
                              'the map again',)


def test_a_thin_landmark_is_named():
    semi_axes = TABLE.semi_axes.copy()
    semi_axes[1] = (0.1, 0.1, 0.001)
    (problem,) = check_map(replace(TABLE, semi_axes=semi_axes)).landmarks[1].problems
    assert problem == '0.010 times as thick as long; fit it again'


def test_weak_stretches_of_a_recording_become_advice():
    poses = walk_around(frames=60)
    detections = see(TABLE, poses)
    # from 4 to 6 s nothing is detected
    kept = np.ones(len(detections.classes), dtype=bool)
    kept[np.isin(detections.frames, np.arange(20, 31))] = False
    counts = np.bincount(detections.frames[kept], minlength=60)
    empty = replace(detections, frame_offsets=np.cumsum([0, *counts]),
                    bboxes_xyxy=detections.bboxes_xyxy[kept], classes=detections.classes[kept],
                    scores=detections.scores[kept])
    checked = check_map(TABLE, empty)
    (span,) = checked.weak_spans
    assert (span.start_s, span.end_s, span.frames, span.most_landmarks) == (
        pytest.approx(4.0), pytest.approx(6.0), 11, 0)
    assert checked.localizable == pytest.approx(49 / 60)
    assert checked.advice == ('record this side: 11 frames from 4.0 to 6.0 s see at most 0 '
                              'landmarks',)


@pytest.mark.parametrize(('shift_px', 'advice'), [
    ((8.0, 0.0), r'boxes lie \+8.0 px right of and \+0.0 px below'),
    ((0.0, -6.0), r'boxes lie \+0.0 px right of and -6.0 px below'),
])
def test_a_wrong_principal_point_is_noticed(shift_px, advice):
    detections = see(TABLE, walk_around())
    shifted = replace(detections, bboxes_xyxy=detections.bboxes_xyxy + np.tile(shift_px, 2))
    (text,) = check_map(TABLE, shifted).advice
    assert re.match(advice, text)


def test_cross_validation_explains_what_maps_did_not_see():
    detections = see(TABLE, walk_around(frames=120), noise_px=2.0)
    explained, iou = cross_validate(detections, MappingOptions(), parts=3)
    assert explained > 0.98
    assert 0.85 < iou < 0.99


def test_page_names_every_landmark_and_escapes_names():
    named = repeat(TABLE, range(9), ['<b>cup</b>', *TABLE.landmark_ids[1:]])
    detections = see(TABLE, walk_around())
    page = check_page(named, check_map(named, detections), detections.map_from_camera[:, :3, 3])
    assert all(landmark_id in page for landmark_id in named.landmark_ids[1:])
    assert '<b>cup' not in page
    assert '&lt;b&gt;cup' in page
    assert page.count('<circle') == len(named) + len(detections)
