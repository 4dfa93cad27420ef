# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Refit given maps to a simulated walk, and find overlapping landmarks."""

from dataclasses import replace

import numpy as np
import pytest
from scene import map_of
from scipy.spatial.transform import Rotation
from walk import CLASSES, join_maps, make_table, merged, see, see_rows, walk_around

from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.errors import MappingError
from cliploc_ros.offline.mapping.building import build_map, refit_map
from cliploc_ros.offline.mapping.check.checking import check_map
from cliploc_ros.offline.mapping.check.findings import find_map_overlaps, hear_witness
from cliploc_ros.offline.mapping.options import CheckOptions
from cliploc_ros.offline.mapping.update.updating import update_map
from cliploc_ros.offline.mapping.views import make_views

NINE = make_table()
BOXES = see(NINE, walk_around(), noise_px=1.0, missed=0.2)


def disturb(table, sigma_m=0.05, stretch=1.3, seed=0):
    """Return a map as from another system: shifted, too large, with different class names."""
    rng = np.random.default_rng(seed)
    details = tuple(LandmarkDetails(class_weights=((name, 0.9), ('vase', 0.1)), source='theirs')
                    for name in table.class_ids)
    return replace(table, centers=table.centers + rng.normal(0.0, sigma_m, (len(table), 3)),
                   semi_axes=table.semi_axes * stretch, details=details,
                   labels=tuple(f'label {row}' for row in range(len(table))))


def errors_m(found, table):
    return np.linalg.norm(found.centers - table.centers, axis=1)


def test_landmarks_move_to_where_the_boxes_are():
    given = disturb(NINE)
    refit = refit_map(BOXES, given)
    found = refit.landmark_map
    assert refit.reasons == (None,) * len(NINE)
    assert (found.landmark_ids, found.labels, found.class_ids) == (
        given.landmark_ids, given.labels, given.class_ids)
    for before, after in zip(given.details, found.details, strict=True):
        assert (after.class_weights, after.source) == (before.class_weights, 'theirs')
        assert after.support > 20 and 0.0 < after.position_sigma < 0.02
    assert np.median(errors_m(given, NINE)) > 0.05
    assert errors_m(refit.landmark_map, NINE).max() < 0.01
    assert np.sort(refit.landmark_map.semi_axes) == pytest.approx(np.sort(NINE.semi_axes),
                                                                  abs=0.02)
    assert refit.explained > 0.99 > refit.explained_before
    assert refit.iou > 0.9 > 0.7 > refit.iou_before


def test_only_chosen_landmarks_move():
    given = disturb(NINE)
    chosen = np.arange(len(NINE)) == 4
    found = refit_map(BOXES, given, chosen).landmark_map
    assert (found.centers[~chosen] == given.centers[~chosen]).all()
    assert (found.quats_xyzw[~chosen] == given.quats_xyzw[~chosen]).all()
    assert [detail.support is None for detail in found.details] == (~chosen).tolist()
    assert errors_m(found, NINE)[4] < 0.01


def test_a_landmark_without_boxes_stays_and_gets_a_reason():
    given = disturb(NINE)
    ghosts = given.select([0, 1, 2])
    ghosts = replace(ghosts, class_ids=('book', 'book', 'lamp'), details=(LandmarkDetails(),) * 3,
                     centers=np.array([[0.2, -0.3, 1.2], [60.0, 0.0, 40.0], [0.0, 0.0, 2.0]]))
    refit = refit_map(BOXES, join_maps(given, ghosts))
    assert refit.reasons[:9] == (None,) * 9
    for reason, named in zip(refit.reasons[9:], ('no box', 'in no image', 'lamp'), strict=True):
        assert named in reason
    assert (refit.landmark_map.centers[9:] == ghosts.centers).all()
    assert errors_m(refit.landmark_map.select(range(9)), NINE).max() < 0.01


def test_one_side_is_not_enough():
    boxes = see(NINE, walk_around(frames=12, turn_deg=12.0))
    with pytest.raises(MappingError, match='one side only'):
        refit_map(boxes, NINE)
    refit = refit_map(boxes, NINE, np.arange(len(NINE)) < 8)
    assert ['one side' in str(reason) for reason in refit.reasons] == [True] * 8 + [False]


@pytest.mark.parametrize(('turn_deg', 'shift_m', 'scale'), [
    (0, 0.8, 1), (45, 0, 1), (0, 0, 0.5)])
def test_a_map_in_another_coordinate_frame_is_refused(turn_deg, shift_m, scale):
    turn = Rotation.from_euler('z', turn_deg, degrees=True)
    elsewhere = replace(
        NINE, centers=turn.apply(NINE.centers * scale) + np.array([shift_m, 0.0, 0.0]),
        semi_axes=NINE.semi_axes * scale,
        quats_xyzw=(turn * Rotation.from_quat(NINE.quats_xyzw)).as_quat())
    with pytest.raises(MappingError, match='coordinate frame'):
        refit_map(BOXES, elsewhere)


def test_a_map_of_other_classes_is_refused():
    foreign = replace(NINE, class_ids=('tvmonitor',) * len(NINE))
    with pytest.raises(MappingError, match=r'tvmonitor; .*: book, bottle'):
        refit_map(BOXES, foreign)


def test_a_landmark_does_not_become_a_distant_object():
    """A landmark behind an object, seen from the front, overlaps the object's boxes."""
    eight = NINE.select([0, 2, 3, 4, 5, 6, 7, 8])
    boxes = see(eight, walk_around(turn_deg=50.0))
    stray = replace(eight.select([3]), centers=eight.centers[[3]] + [-0.6, -0.25, -0.15],
                    semi_axes=np.full((1, 3), 0.2))
    refit = refit_map(boxes, join_maps(eight.select([0, 1, 2, 4, 5, 6, 7]), stray))
    assert refit.reasons[:-1] == (None,) * 7
    assert 'another object' in refit.reasons[-1]
    assert (refit.landmark_map.centers[-1] == stray.centers[0]).all()


POSES = walk_around()
FRAMES = np.arange(len(POSES))
BOOK, BOTTLE, CUP = CLASSES
ALWAYS = FRAMES >= 0
# Each object: class, centre and semi-axes [m], and the frames with its box.
CHAIR = BOOK, (0.0, 0.0, 0.8), (0.25, 0.25, 0.4)
BACK = BOTTLE, (0.0, 0.0, 1.0), (0.2, 0.2, 0.2)
TABLE = BOOK, (0.0, 0.0, 0.6), (0.5, 0.4, 0.3)
LEFT = BOOK, (-0.1, 0.0, 0.8), (0.1, 0.1, 0.3)
RIGHT = BOOK, (0.1, 0.0, 0.8), (0.2, 0.1, 0.1)
# .27 m apart on the line of sight of frames 0 to 3 and 31 to 38: their boxes overlap there
NEAR = BOOK, (0.135, 0.0, 0.8), (0.2, 0.2, 0.3)
FAR = BOOK, (-0.135, 0.0, 0.8), (0.2, 0.2, 0.3)
IN_LINE = (FRAMES < 4) | ((FRAMES > 30) & (FRAMES < 39))
CUP_ON_TABLE = CUP, (0.1, 0.0, 0.85), (0.06, 0.06, 0.08)


def make_map(*things):
    """Return the map of some objects: class, centre and semi-axes of each."""
    return map_of(*zip(*things, strict=True))


def watch(*things):
    """Return simulated detections of some objects: class, centre, axes, frames with a box."""
    parts = [see(make_map(thing[:3]), POSES, noise_px=1.0, seed=row)
             for row, thing in enumerate(things)]
    return merged(*(part.select_boxes(frames[part.frames])
                    for part, (*_, frames) in zip(parts, things, strict=True)))


def under(name, thing):
    """Return an object under another name."""
    return (name, *thing[1:])


QUICK = CheckOptions(relocalizer=RelocalizerOptions(iterations=300), frames=6, max_positions=4,
                     headings=2, spacing_m=2.0)
# Simulated detections, and the class weights of the expected landmarks.
SCENES = {
    'two names at once': ([(*CHAIR, ALWAYS), (*under(CUP, CHAIR), ALWAYS)],
                          [{BOOK: 0.5, CUP: 0.5}]),
    'two names in turn': ([(*CHAIR, FRAMES % 3 > 0), (*under(CUP, CHAIR), FRAMES % 3 == 0)],
                          [{BOOK: 2 / 3, CUP: 1 / 3}]),
    'a part, at times': ([(*CHAIR, ALWAYS), (*BACK, FRAMES % 5 == 0)], [{BOOK: 1.0}]),
    'a cup on a table': ([(*TABLE, ALWAYS), (*CUP_ON_TABLE, ALWAYS)], [{BOOK: 1.0}, {CUP: 1.0}]),
    'side by side': ([(*LEFT, ALWAYS), (*RIGHT, ALWAYS)], [{BOOK: 1.0}, {BOOK: 1.0}]),
    'apart from 6 viewpoints, else one behind the other': (
        [(*NEAR, ALWAYS), (*FAR, IN_LINE | (FRAMES // 6 == 3))], [{BOOK: 1.0}, {BOOK: 1.0}]),
}


@pytest.mark.parametrize(('things', 'expected'), SCENES.values(), ids=SCENES)
def test_what_the_images_show_at_once_is_two(things, expected):
    """Two objects overlap. The whole comes before its part."""
    detections, pair = watch(*things), make_map(*(thing[:3] for thing in things))
    (overlap,) = overlaps_of(pair, detections)
    assert overlap.is_duplicate == (len(expected) == 1)
    built = build_map(detections).landmark_map
    assert len(built) == len(expected)
    # the whole, not its part
    for thing, weights in zip(things, expected, strict=False):
        row = np.linalg.norm(built.centers - thing[1], axis=1).argmin()
        assert np.sort(built.semi_axes[row]) == pytest.approx(np.sort(thing[2]), abs=0.02)
        assert dict(built.details[row].class_weights or {built.class_ids[row]: 1.0}
                    ) == pytest.approx(weights, abs=0.15)
    assert not any(pair.is_duplicate for pair in overlaps_of(built, detections))


def test_one_object_whose_boxes_split_at_times_is_one():
    """A detector gives a chair two boxes; in 4 of 60 frames they are its upper and lower half."""
    is_split = FRAMES // 4 == 5
    halves = [(BOOK, (0.0, 0.0, height), (0.25, 0.25, 0.2)) for height in (0.6, 1.0)]
    seen = watch((*CHAIR, ~is_split), (*CHAIR, ~is_split), *((*half, is_split) for half in halves))
    assert build_map(seen).landmark_map.centers == pytest.approx(np.array([CHAIR[1]]), abs=0.02)


def overlaps_of(landmark_map, detections=None):
    """Return the overlapping landmarks, with or without a recording."""
    if detections is None:
        return find_map_overlaps(landmark_map, None, None)
    views = make_views(detections)
    return find_map_overlaps(landmark_map, hear_witness(
        views, landmark_map, detections.class_names), views)


def doubled_room():
    """Return a room, and its map with the bottle also mapped as a cup."""
    room = make_table(6)
    return room, join_maps(room, replace(room.select([1]), class_ids=(CUP,), labels=('mug',)))


def test_a_refit_and_an_update_join_doubles():
    room, doubled = doubled_room()
    seen, rows = see_rows(room, POSES, noise_px=1.0)
    # the bottle is detected as a cup in every other image
    classes = seen.classes.copy()
    classes[(rows == 1) & (seen.frames % 2 == 0)] = CLASSES.index(CUP)
    seen = replace(seen, classes=classes)
    refit = refit_map(seen, doubled)
    assert refit.part_of[1] == refit.part_of[6] and len(set(refit.part_of)) == 6
    updated = update_map(doubled, seen)
    assert updated.landmark_map.landmark_ids == room.landmark_ids
    assert updated.shown.max() == 5 and updated.first_new == 6
    for joined, row in ((refit.landmark_map, refit.part_of[1]), (updated.landmark_map, 1)):
        assert dict(joined.details[row].class_weights) == {BOTTLE: 0.5, CUP: 0.5}
        assert dict(joined.details[row].labels) == {BOTTLE: 0.5, 'mug': 0.5}
        assert np.linalg.norm(joined.centers[row] - room.centers[1]) < 0.01


def test_a_map_made_by_hand_is_judged_by_its_classes():
    room, doubled = doubled_room()
    assert overlaps_of(room) == []
    assert [(pair.first, pair.second, pair.is_duplicate) for pair in overlaps_of(doubled)] == [
        (1, 6, False)]
    named = replace(doubled, class_ids=(*doubled.class_ids[:6], BOTTLE))
    assert [pair.is_duplicate for pair in overlaps_of(named)] == [True]
    assert check_map(named, options=QUICK).duplicates == 1
    # boxes of other objects have no information on it
    elsewhere = see(room.select([0, 2, 3, 4, 5]), POSES)
    assert [pair.is_duplicate for pair in overlaps_of(doubled, elsewhere)] == [False]
    assert (refit_map(elsewhere, doubled).part_of == np.arange(7)).all()
