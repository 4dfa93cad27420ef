# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Landmarks that stand in one another: one thing, or two that the images show at once."""

import re
from dataclasses import replace

import numpy as np
import pytest
from walk import CLASSES, join_maps, make_table, see, see_rows, walk_around

from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.offline.mapping.building import build_map
from cliploc_ros.offline.mapping.check.checking import check_map
from cliploc_ros.offline.mapping.check.landmark_faults import find_map_overlaps, hear_witness
from cliploc_ros.offline.mapping.options import CheckOptions
from cliploc_ros.offline.mapping.refit import refit_map
from cliploc_ros.offline.mapping.update.updating import update_map
from cliploc_ros.offline.mapping.views import make_views

POSES = walk_around()
FRAMES = np.arange(len(POSES))
BOOK, BOTTLE, CUP = CLASSES
ALWAYS = FRAMES >= 0
# Each: class, centre and semi-axes [m], and the frames that have its box.
CHAIR = BOOK, (0.0, 0.0, 0.8), (0.25, 0.25, 0.4)
BACK = BOTTLE, (0.0, 0.0, 1.0), (0.2, 0.2, 0.2)
TABLE = BOOK, (0.0, 0.0, 0.6), (0.5, 0.4, 0.3)
LEFT = BOOK, (-0.1, 0.0, 0.8), (0.1, 0.1, 0.3)
RIGHT = BOOK, (0.1, 0.0, 0.8), (0.2, 0.1, 0.1)
CUP_ON_TABLE = CUP, (0.1, 0.0, 0.85), (0.06, 0.06, 0.08)


def make_map(*things):
    """Return the map of some things: class, centre and semi-axes of each."""
    classes, centers, axes = zip(*things, strict=True)
    return LandmarkMap('map', tuple(f'thing_{row}' for row in range(len(things))), classes,
                       classes, np.array(centers), np.array(axes),
                       np.tile([0.0, 0.0, 0.0, 1.0], (len(things), 1)))


def watch(*things, noise_px=1.0):
    """Return what a detector sees of some things: class, centre, axes, frames with a box."""
    parts = [see(make_map(one[:3]), POSES, noise_px, seed=row)
             for row, one in enumerate(things)]
    parts = [one.select_boxes(frames[one.frames])
             for one, (*_, frames) in zip(parts, things, strict=True)]
    frames = np.concatenate([one.frames for one in parts])
    order = np.argsort(frames, kind='stable')
    columns = {name: np.concatenate([getattr(one, name) for one in parts])[order]
               for name in ('bboxes_xyxy', 'classes', 'scores')}
    return replace(parts[0], frame_offsets=np.searchsorted(frames[order], np.arange(
        len(POSES) + 1)), **columns)


def under(name, thing):
    """Return a thing under another name."""
    return (name, *thing[1:])


DOUBLES = {'thing_1', 'thing_1_b'}
QUICK = CheckOptions(relocalizer=RelocalizerOptions(iterations=300), frames=6, max_positions=4,
                     headings=2, spacing_m=2.0)
# What the detector sees, and the class weights of the landmarks that it is.
SCENES = {
    'two names at once': ([(*CHAIR, ALWAYS), (*under(CUP, CHAIR), ALWAYS)],
                          [{BOOK: 0.5, CUP: 0.5}]),
    'two names in turn': ([(*CHAIR, FRAMES % 3 > 0), (*under(CUP, CHAIR), FRAMES % 3 == 0)],
                          [{BOOK: 2 / 3, CUP: 1 / 3}]),
    'a part, at times': ([(*CHAIR, ALWAYS), (*BACK, FRAMES % 5 == 0)], [{BOOK: 1.0}]),
    'a part or the whole': ([(*CHAIR, FRAMES % 5 > 1), (*BACK, FRAMES % 5 <= 1)], [{BOOK: 1.0}]),
    'a part of the same class': ([(*CHAIR, ALWAYS), (*under(BOOK, BACK), FRAMES % 5 == 0)],
                                 [{BOOK: 1.0}]),
    'a cup on a table': ([(*TABLE, ALWAYS), (*CUP_ON_TABLE, ALWAYS)], [{BOOK: 1.0}, {CUP: 1.0}]),
    'side by side': ([(*LEFT, ALWAYS), (*RIGHT, ALWAYS)], [{BOOK: 1.0}, {BOOK: 1.0}]),
    'side by side, two names': ([(*LEFT, ALWAYS), (*under(CUP, RIGHT), ALWAYS)],
                                [{BOOK: 1.0}, {CUP: 1.0}]),
}


@pytest.mark.parametrize(('things', 'expected'), SCENES.values(), ids=SCENES)
def test_what_the_images_show_at_once_is_two(things, expected):
    """Of two things that stand in one another. A whole comes before its part."""
    detections, pair = watch(*things), make_map(*(one[:3] for one in things))
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
    assert not any(one.is_duplicate for one in overlaps_of(built, detections))


def overlaps_of(landmark_map, detections=None):
    """Return which landmarks stand in one another, with or without a recording."""
    if detections is None:
        return find_map_overlaps(landmark_map, None, None)
    views = make_views(detections)
    return find_map_overlaps(landmark_map, hear_witness(
        views, landmark_map, detections.class_names), views)


def doubled_room():
    """Return a room, and the map of it that has its bottle as a cup, too."""
    room = make_table(6)
    return room, join_maps(room, replace(room.select([1]), class_ids=(CUP,), labels=('mug',)))


def test_the_check_counts_and_names_doubles_of_two_classes():
    room, doubled = doubled_room()
    report = check_map(doubled, see(room, POSES), options=QUICK)
    assert report.duplicates == 1
    first, second = report.landmarks[:2]
    assert {first.landmark_id, second.landmark_id} == DOUBLES
    assert first.overlaps == ((second.landmark_id, 0.0),)
    assert any(set(re.findall(r'\w+', advice)) >= DOUBLES for advice in report.advice)


def test_a_refit_and_an_update_join_doubles():
    room, doubled = doubled_room()
    seen, rows = see_rows(room, POSES, noise_px=1.0)
    # the bottle is called a cup in every other image
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
    assert [(one.first, one.second, one.is_duplicate) for one in overlaps_of(doubled)] == [
        (1, 6, False)]
    named = replace(doubled, class_ids=(*doubled.class_ids[:6], BOTTLE))
    assert [one.is_duplicate for one in overlaps_of(named)] == [True]
    assert check_map(named, options=QUICK).duplicates == 1
    # boxes of other things tell nothing of it
    elsewhere = see(room.select([0, 2, 3, 4, 5]), POSES)
    assert [one.is_duplicate for one in overlaps_of(doubled, elsewhere)] == [False]
    assert (refit_map(elsewhere, doubled).part_of == np.arange(7)).all()
