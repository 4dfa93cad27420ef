# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Evidence counts once: boxes of one thing, landmarks on one axis, rooms that are out of date."""

from dataclasses import replace

import numpy as np
import pytest
from scene import CAMERA, make_room, see_room

from cliploc_ros.core.acceptance.confidence import Support, one_thing
from cliploc_ros.core.acceptance.look_alikes import lead_over_twin, turned_about_axis
from cliploc_ros.core.geometry.transforms import make_transform
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer

ROOM = make_room()
UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # looks along y, z is up


def together(first, second):
    return Detections(np.concatenate([first.bboxes_xyxy, second.bboxes_xyxy]),
                      first.class_ids + second.class_ids,
                      np.concatenate([first.scores, second.scores]))


def support_of(landmark_map, detections):
    found = Relocalizer(landmark_map, RelocalizerOptions(matching='class')).relocalize(
        [Observation(CAMERA, detections)])
    return found.hypotheses[0].support


def test_boxes_that_overlap_show_one_thing():
    boxes = np.array([[0, 0, 100, 100], [0, 0, 100, 100], [0, 0, 60, 100], [0, 0, 30, 100],
                      [40, 40, 60, 60]], dtype=float)
    np.testing.assert_allclose(one_thing(boxes)[0], [1.0, 1.0, 0.5, 0.0, 0.0])
    assert one_thing(np.empty((0, 4))).shape == (0, 0)


def test_one_thing_under_two_class_names_counts_once():
    """The map has each landmark under a second class, and the image each box."""
    seen = see_room(ROOM)
    renamed = tuple(f'also {name}' for name in ROOM.class_ids)
    both = LandmarkMap('map', (*ROOM.landmark_ids, *(f'{one}_2' for one in ROOM.landmark_ids)),
                       ROOM.labels * 2, ROOM.class_ids + renamed, *(
                           np.tile(one, (2, 1)) for one in (ROOM.centers, ROOM.semi_axes,
                                                            ROOM.quats_xyzw)))
    alone = support_of(ROOM, seen)
    twice = support_of(both, together(seen, replace(seen, class_ids=renamed)))
    assert (twice.inliers, twice.score) == pytest.approx((alone.inliers, alone.score), abs=0.2)
    assert twice.unlabelled == pytest.approx(alone.unlabelled, abs=0.2)


def test_a_second_box_of_an_explained_thing_is_not_unexplained():
    """Its class is another one of the map; a box elsewhere is unexplained."""
    seen = see_room(ROOM)
    again = replace(seen.select(np.arange(1)), class_ids=(ROOM.class_ids[1],))
    elsewhere = replace(again, bboxes_xyxy=np.array([[2.0, 400.0, 60.0, 470.0]]))
    base = support_of(ROOM, seen).unexplained
    assert support_of(ROOM, together(seen, again)).unexplained == pytest.approx(base, abs=0.01)
    assert support_of(ROOM, together(seen, elsewhere)).unexplained == pytest.approx(base + 1.0)
    two = together(elsewhere, elsewhere)
    assert support_of(ROOM, together(seen, two)).unexplained == pytest.approx(base + 1.0)


def arrangement(off_m):
    """Things above each other, every second one beside the axis by a distance [m]."""
    count = 6
    centers = np.c_[off_m * (np.arange(count) % 2) * np.array([1, 1, 1, -1, 1, 1]),
                    np.zeros(count), 0.4 * np.arange(count)]
    names = tuple(f'thing {row}' for row in range(count))
    return LandmarkMap('map', names, names, names, centers,
                       np.tile([0.12, 0.12, 0.15], (count, 1)),
                       np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)))


def test_a_turn_about_an_axis_that_all_objects_share_is_a_rival():
    """Things on one axis fix all but the turn about it; things beside it fix that, too."""
    camera = make_transform(UP, np.array([0.0, -2.5, 1.0]))
    on_axis, spread = arrangement(0.06), arrangement(0.8)
    rows = np.arange(6)
    turned = turned_about_axis(arrangement(0.0), camera, rows)
    away = np.linalg.norm(turned[:, None, :3, 3] - arrangement(0.0).centers, axis=2)
    np.testing.assert_allclose(away, np.tile(away[0], (len(turned), 1)), atol=1e-9)
    assert len(turned) >= 7
    assert len(turned_about_axis(ROOM, camera, np.arange(12))) == 0
    # a camera that is not verified yet lowers the confidence, too
    options = RelocalizerOptions(matching='class', min_confidence=0.75)
    found = [Relocalizer(one, options).relocalize(
        [Observation(CAMERA, see_room(one, camera), up_in_camera=camera[2, :3])])
        for one in (on_axis, spread)]
    assert [one.accepted for one in found] == [False, True]
    assert found[0].evidence.distinct < 0.8
    assert found[1].evidence.distinct > 0.95


def shown(counts, likenesses, first=0):
    """The support of a pose that explains some boxes, from the first one on."""
    rows = {(0, first + row): np.array([count, count, 0.0, likeness, 0.0, 0.0, 0.0])
            for row, (count, likeness) in enumerate(zip(counts, likenesses, strict=True))}
    return Support(inliers=sum(counts), likeness=sum(likenesses), shown=rows)


def test_labels_tell_places_apart_and_what_one_place_lacks_does_not():
    pose = shown([1] * 6, [2.0] * 6)
    assert lead_over_twin(pose, pose) == pytest.approx(0.0)
    # labels of places that are alike err together
    assert 2.0 < lead_over_twin(pose, shown([1] * 6, [0.0] * 6)) < 2.5
    # the twin lacks two of the objects: as much as one place of two that is out of date
    assert 0.0 < lead_over_twin(pose, shown([1] * 4, [2.0] * 4)) < 1.4
    # a pose elsewhere that explains one of them: each of the others counts as its label says
    assert lead_over_twin(pose, shown([1], [2.0])) == pytest.approx(5 * 0.88, abs=0.01)
    # the same, but the landmarks around are alike: what the image shows has moved
    assert lead_over_twin(pose, shown([1], [2.0]), 0.7) < 1.4
