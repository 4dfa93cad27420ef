# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The synthetic world: its labels and boxes agree with its images."""

import numpy as np
import pytest

from cliploc_ros.core.geometry import ellipsoid
from cliploc_ros.core.geometry.transforms import invert_transform
from demo.world.appearance import CLASSES
from demo.world.recording import find_boxes
from demo.world.renderer import Light, Renderer
from demo.world.room import make_room
from demo.world.trajectories import CAMERA, draw_views

pytestmark = pytest.mark.full


@pytest.fixture(scope='module')
def room():
    return make_room(3, dict.fromkeys(CLASSES, 8))


@pytest.fixture(scope='module')
def renderer(room):
    # PyTorch's Triton and Mesa's software renderer each load an LLVM; the opposite order crashes
    import torchvision  # noqa: F401

    return Renderer(room, CAMERA, Light())


def test_a_room_is_repeatable_and_its_labels_tell_all_objects_apart(room):
    assert make_room(3, dict.fromkeys(CLASSES, 8)).objects == room.objects
    assert make_room(4).objects != room.objects
    labels = [item.look.label for item in room.objects]
    assert len(set(labels)) == len(labels) == 64
    assert sum(not item.in_map for item in room.objects) == 4
    places = np.array([item.slot.position for item in room.objects])
    distances = np.linalg.norm(places[:, None] - places, axis=-1) + 9 * np.eye(64)
    assert distances.min() > 0.2


def test_boxes_are_where_the_ellipsoids_project(room, renderer):
    """Renderer and core share a camera model: fully visible objects fill their outlines."""
    overlaps = []
    for pose in draw_views(room, 8, np.random.default_rng(0)):
        for seen in find_boxes(room, renderer, pose):
            if seen['visibility'] < 0.9:
                continue
            entry = next(o for o in room.objects if o.name == seen['object']).landmark()
            shape = ellipsoid.shape_matrices(np.array([entry['semi_axes']]),
                                   np.array([entry['orientation']]))
            centers = np.array([entry['center']])
            outline = ellipsoid.project_ellipsoids(invert_transform(pose), centers, shape)
            box = ellipsoid.ellipse_bboxes(ellipsoid.ellipses_in_pixels(outline, CAMERA))[0]
            overlaps.append(ellipsoid.box_ious(box[None], np.array([seen['bbox_xyxy']])).item())
    assert len(overlaps) > 40
    assert np.median(overlaps) > 0.75
    assert np.percentile(overlaps, 5) > 0.5
