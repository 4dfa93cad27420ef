# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The synthetic world: its labels and boxes agree with its images."""

import json

import numpy as np
import pytest

from cliploc_ros.core.geometry import ellipsoid
from cliploc_ros.core.geometry.transforms import invert_transform, transform_from_pose
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.offline.datasets.parsing import find_camera
from cliploc_ros.offline.datasets.tum import read_tum
from demo import ASSETS
from demo.truth import read_frames
from demo.world.appearance import CLASSES
from demo.world.recording import find_boxes, record, write_true_map
from demo.world.renderer import Light, Renderer
from demo.world.room import make_room
from demo.world.trajectories import CAMERA, draw_views, query_walk, rig_mounts, rig_walk

pytestmark = pytest.mark.full


@pytest.fixture(scope='module')
def room():
    return make_room(3, dict.fromkeys(CLASSES, 8))


@pytest.fixture(scope='module')
def renderer(room):
    return Renderer(room, CAMERA, Light())


def test_a_room_is_repeatable_and_its_labels_tell_all_objects_apart(room):
    again = make_room(3, dict.fromkeys(CLASSES, 8))
    assert again.objects == room.objects
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
            overlaps.append(_iou(box, np.array(seen['bbox_xyxy'])))
    print(f'{len(overlaps)} whole objects: box IoU median {np.median(overlaps):.2f}, '
          f'least {min(overlaps):.2f}')
    assert len(overlaps) > 40
    assert np.median(overlaps) > 0.75
    assert np.percentile(overlaps, 5) > 0.5


def test_what_is_recorded_is_a_tum_folder_and_repeatable(room, renderer, tmp_path):
    poses = query_walk(12)[:2]
    for name in ('a', 'b'):
        record(tmp_path / name, room, renderer, poses, seed=5, rate_hz=2.0)
    write_true_map(tmp_path / 'a' / 'map.yaml', room)
    sequence = read_tum(tmp_path / 'a')
    assert np.diff(sequence.stamps_ns).tolist() == [500_000_000]
    for stamp, pose in zip(sequence.stamps_ns, poses, strict=True):
        np.testing.assert_allclose(sequence.pose_at(stamp), pose, atol=1e-5)
    assert find_camera(None, tmp_path / 'a')[0] == CAMERA
    first, second = ((tmp_path / name / 'truth.json').read_text() for name in ('a', 'b'))
    assert first == second
    for file in (tmp_path / 'a' / 'rgb').iterdir():
        assert file.read_bytes() == (tmp_path / 'b' / 'rgb' / file.name).read_bytes()
    landmark_map = LandmarkMap.from_file(tmp_path / 'a' / 'map.yaml')
    assert len(landmark_map) == 60
    known = {item['id']: item for item in json.loads(first)['objects']}
    for name, center, label in zip(landmark_map.landmark_ids, landmark_map.centers,
                                   landmark_map.labels, strict=True):
        np.testing.assert_allclose(center, known[name]['center'], atol=1e-4)
        assert label == known[name]['label']
    frames = list(read_frames(tmp_path / 'a'))
    assert len(frames) == 2
    assert all(box.visibility >= 0.3 for frame in frames for box in frame.boxes)


def _iou(a, b):
    low, high = np.maximum(a[:2], b[:2]), np.minimum(a[2:], b[2:])
    shared = np.prod(np.clip(high - low, 0, None))
    return shared / (np.prod(a[2:] - a[:2]) + np.prod(b[2:] - b[:2]) - shared)


def test_the_shipped_rig_is_where_its_walk_and_mounts_say():
    mounts = json.loads((ASSETS / 'rig' / 'mounts.json').read_text())
    assert list(mounts) == list(rig_mounts())
    for name, expected in rig_mounts().items():
        mount = transform_from_pose(np.array(mounts[name][:3]), np.array(mounts[name][3:]))
        np.testing.assert_allclose(mount, expected, atol=1e-9)
        sequence = read_tum(ASSETS / 'rig' / name)
        poses = [sequence.pose_at(stamp) for stamp in sequence.stamps_ns]
        np.testing.assert_allclose(poses, rig_walk() @ mount, atol=1e-5)
    # left of the front camera is minus x, and y is down
    assert rig_mounts()['left'][0, 2] == pytest.approx(-1.0)
