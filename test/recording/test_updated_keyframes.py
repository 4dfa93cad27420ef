# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Update the keyframes of a map: of a simulated room, and with build_map of real images."""

from dataclasses import replace

import numpy as np
import pytest
from scene import CAMERA, ROOM, make_layer, rigid

from cliploc_ros.errors import MappingError
from cliploc_ros.offline.mapping.landmarks import Landmarks
from cliploc_ros.offline.recording.joining import join_layers
from cliploc_ros.offline.recording.updating import check_belongs, update_layer

WALL = 600
#: Points of a wall 3 m in front of the cameras, and their looks.
POINTS = np.random.default_rng(3).uniform((-4.0, -1.2, 2.8), (4.0, 1.2, 3.2), (WALL, 3))
LOOKS = np.random.default_rng(4).integers(0, 120, (WALL, 128)).astype(np.uint8)
NOTHING = Landmarks.none()


def layer_of(xs, points=POINTS, looks=LOOKS):
    """Return a layer of keyframes at some x, with the points that each of them sees."""
    one, parts = make_layer(ROOM, 1, 1), []
    for x in xs:
        inside = points - (x, 0.0, 0.0)
        pixels = CAMERA.project_normalized(inside[:, :2] / inside[:, 2:])
        rows = np.nonzero(((pixels > 0) & (pixels < (CAMERA.width, CAMERA.height))).all(axis=1))[0]
        parts.append(replace(
            one, map_from_camera=rigid((x, 0.0, 0.0), 'y', 0.0)[None],
            offsets=np.array([0, len(rows)]), points=inside[rows].astype(np.float32),
            pixels=np.zeros((len(rows), 2), np.uint16), words=np.zeros(len(rows), np.uint16),
            descriptors=looks[rows]))
    return join_layers(parts)


OLD = layer_of(np.arange(-2.0, 2.1, 0.5))


def fates(updated, name):
    return [row for row, fate in enumerate(updated.fates) if fate.fate == name]


def test_a_room_without_change_keeps_all_and_gets_what_it_lacks():
    updated = update_layer(OLD, layer_of([-1.7, 0.1, 1.2]), NOTHING)
    assert updated.removed is None
    assert fates(updated, 'confirmed') == [*range(len(OLD))]
    half = OLD.select(np.arange(len(OLD)) < 4)
    updated = update_layer(half, layer_of([-1.7, 1.2]), NOTHING)
    assert fates(updated, 'added') == [4]
    assert updated.layer.map_from_camera[:, 0, 3] == pytest.approx([-2.0, -1.5, -1.0, -0.5, 1.2])
    assert 'added' in updated.line() and '0 points removed' in updated.line()


def test_points_that_moved_go_and_their_keyframes_with_them():
    moved = POINTS + np.where(POINTS[:, :1] < 0.0, (0.0, 0.0, 1.0), 0.0)
    stale = layer_of(np.arange(-3.0, 3.1, 0.5), moved)
    updated = update_layer(stale, layer_of(np.arange(-3.0, 3.1, 0.25)), NOTHING)
    assert {0, 1, 2} <= set(fates(updated, 'retired')) <= set(range(6))
    assert {8, 9, 10, 11, 12} <= set(fates(updated, 'confirmed'))
    every = np.concatenate([updated.layer.points_in_map(row) for row in range(len(updated.layer))])
    assert (every[:, 2] > 3.5).mean() < 0.02
    assert len(fates(updated, 'added')) >= 6
    went = np.concatenate([updated.removed.points_in_map(row)
                           for row in range(len(updated.removed))])
    assert (went[:, 2] > 3.5).mean() > 0.95


def test_points_on_objects_that_are_gone_go_without_images():
    gone = Landmarks(np.array([[0.0, 0.0, 3.0]]), 0.6 * np.eye(3)[None], np.array([0]))
    updated = update_layer(OLD, None, gone)
    every = np.concatenate([updated.layer.points_in_map(row) for row in range(len(OLD))])
    assert np.linalg.norm(every - (0.0, 0.0, 3.0), axis=1).min() > 0.59
    assert fates(updated, 'retired') == [] and updated.removed is not None
    assert len(updated.layer.points) + len(updated.removed.points) == len(OLD.points)


def test_another_room_does_not_belong():
    other = layer_of(np.arange(-2.0, 2.1, 0.5), looks=LOOKS[::-1])
    with pytest.raises(MappingError, match='does not belong'):
        check_belongs(update_layer(OLD, other, NOTHING))
    check_belongs(update_layer(OLD, layer_of([0.0]), NOTHING))


