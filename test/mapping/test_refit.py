# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Given maps fitted to a simulated walk, whose landmarks are known."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from walk import join_maps, make_table, see, walk_around

from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.errors import MappingError
from cliploc_ros.offline.mapping.refit import refit_map


@pytest.fixture(scope='module')
def table():
    return make_table()


@pytest.fixture(scope='module')
def detections(table):
    return see(table, walk_around(), noise_px=1.0, missed=0.2)


def disturb(table, sigma_m=0.05, stretch=1.3, seed=0):
    """Return a map as another system may have it: shifted, too large, with its own words."""
    rng = np.random.default_rng(seed)
    details = tuple(LandmarkDetails(class_weights=((name, 0.9), ('vase', 0.1)), source='theirs')
                    for name in table.class_ids)
    return replace(table, centers=table.centers + rng.normal(0.0, sigma_m, (len(table), 3)),
                   semi_axes=table.semi_axes * stretch, details=details,
                   labels=tuple(f'label {row}' for row in range(len(table))))


def errors_m(found, table):
    return np.linalg.norm(found.centers - table.centers, axis=1)


def test_landmarks_move_to_where_the_boxes_are(table, detections):
    given = disturb(table)
    refit = refit_map(detections, given)
    assert refit.reasons == (None,) * len(table)
    assert np.median(errors_m(given, table)) > 0.05
    assert errors_m(refit.landmark_map, table).max() < 0.01
    assert np.sort(refit.landmark_map.semi_axes) == pytest.approx(np.sort(table.semi_axes),
                                                                  abs=0.02)
    assert refit.explained > 0.99 > refit.explained_before
    assert refit.iou > 0.9 > 0.7 > refit.iou_before


def test_what_the_map_says_of_its_landmarks_stays(table, detections):
    given = disturb(table)
    found = refit_map(detections, given).landmark_map
    assert (found.landmark_ids, found.labels, found.class_ids) == (
        given.landmark_ids, given.labels, given.class_ids)
    for before, after in zip(given.details, found.details, strict=True):
        assert (after.class_weights, after.source) == (before.class_weights, 'theirs')
        assert after.support > 20
        assert 0.5 < after.seen_ratio <= 1.0
        assert after.baseline_deg > 90.0
        assert 0.0 < after.position_sigma < 0.02
        assert after.last_seen > 9.0


def test_only_chosen_landmarks_move(table, detections):
    given = disturb(table)
    chosen = np.arange(len(table)) == 4
    found = refit_map(detections, given, chosen).landmark_map
    assert (found.centers[~chosen] == given.centers[~chosen]).all()
    assert (found.quats_xyzw[~chosen] == given.quats_xyzw[~chosen]).all()
    assert [one.support is None for one in found.details] == (~chosen).tolist()
    assert errors_m(found, table)[4] < 0.01


def test_a_duplicate_is_part_of_the_other(table, detections):
    given = join_maps(disturb(table), disturb(table, seed=1).select([2, 5]))
    refit = refit_map(detections, given)
    assert len(set(refit.part_of)) == len(table)
    for first, second in ((2, 9), (5, 10)):
        assert refit.part_of[first] == refit.part_of[second]
        gone = first if refit.part_of[first] != first else second
        assert given.landmark_ids[first + second - gone] in refit.reasons[gone]
    kept = np.unique(refit.part_of)
    assert errors_m(refit.landmark_map.select(kept), table.select(
        [row if row < 9 else {9: 2, 10: 5}[row] for row in kept])).max() < 0.01


def test_a_landmark_without_boxes_stays_and_gets_a_reason(table, detections):
    given = disturb(table)
    ghosts = given.select([0, 1, 2])
    ghosts = replace(ghosts, class_ids=('book', 'book', 'lamp'), details=(LandmarkDetails(),) * 3,
                     centers=np.array([[0.2, -0.3, 1.2], [60.0, 0.0, 40.0], [0.0, 0.0, 2.0]]))
    refit = refit_map(detections, join_maps(given, ghosts))
    assert refit.reasons[:9] == (None,) * 9
    for reason, named in zip(refit.reasons[9:], ('no box', 'in no image', 'lamp'), strict=True):
        assert named in reason
    assert (refit.landmark_map.centers[9:] == ghosts.centers).all()
    assert errors_m(refit.landmark_map.select(range(9)), table).max() < 0.01


def test_one_side_is_not_enough(table):
    detections = see(table, walk_around(frames=12, turn_deg=12.0))
    with pytest.raises(MappingError, match='one side only'):
        refit_map(detections, table)
    refit = refit_map(detections, table, np.arange(len(table)) < 8)
    assert ['one side' in str(reason) for reason in refit.reasons] == [True] * 8 + [False]


@pytest.mark.parametrize(('turn_deg', 'shift_m', 'scale'), [
    (0, 0.8, 1), (45, 0, 1), (0, 0, 0.5), (0, 3.0, 1)])
def test_a_map_in_another_coordinate_frame_is_refused(table, detections, turn_deg, shift_m, scale):
    turn = Rotation.from_euler('z', turn_deg, degrees=True)
    elsewhere = replace(
        table, centers=turn.apply(table.centers * scale) + np.array([shift_m, 0.0, 0.0]),
        semi_axes=table.semi_axes * scale,
        quats_xyzw=(turn * Rotation.from_quat(table.quats_xyzw)).as_quat())
    with pytest.raises(MappingError, match=r'boxes are|frame\?'):
        refit_map(detections, elsewhere)


def test_a_map_of_other_classes_is_refused(table, detections):
    foreign = replace(table, class_ids=('tvmonitor',) * len(table))
    with pytest.raises(MappingError, match=r'tvmonitor; .*: book, bottle'):
        refit_map(detections, foreign)


def test_a_landmark_does_not_become_a_distant_object(table):
    """A landmark behind an object, seen from the front, overlaps the boxes of the object."""
    table = table.select([0, 2, 3, 4, 5, 6, 7, 8])
    detections = see(table, walk_around(turn_deg=50.0))
    stray = replace(table.select([3]), centers=table.centers[[3]] + [-0.6, -0.25, -0.15],
                    semi_axes=np.full((1, 3), 0.2))
    refit = refit_map(detections, join_maps(table.select([0, 1, 2, 4, 5, 6, 7]), stray))
    assert refit.reasons[:-1] == (None,) * 7
    assert 'another object' in refit.reasons[-1]
    assert (refit.landmark_map.centers[-1] == stray.centers[0]).all()
