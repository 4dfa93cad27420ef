# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Images of keyframes: stored only on request, small, and undistorted."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.depth import DepthImage
from cliploc_ros.core.keyframes.layer import PIXEL_SCALE, load_layer_of_map, save_layer
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import DatasetError, MappingError
from cliploc_ros.offline.datasets.folders import read_folder
from cliploc_ros.offline.datasets.frames import (
    DepthFormat,
    FolderOptions,
    Frames,
    PosedImage,
    RawFrame,
)
from cliploc_ros.offline.recording.keyframe_layer import (
    LayerOptions,
    build_layer,
    depths_of_points,
)
from demo import ASSETS

WITH_IMAGES = LayerOptions(most_points=200, images=True)


@pytest.fixture(scope='module')
def demo_map():
    return LandmarkMap.from_file(ASSETS / 'map.yaml')


@pytest.fixture(scope='module')
def frame():
    walk = read_folder(ASSETS / 'mapping', FolderOptions(layout='tum'))
    return next(iter(walk.read()))


def wall(frame):
    """Return a recording of the frame, with its image on a wall 2 m away."""
    depth = DepthImage(np.full(frame.image_rgb.shape[:2], 2.0, np.float32), None)
    seen = replace(frame, depth=depth)

    def read_raw(is_wanted):
        if is_wanted(0, seen.stamp_ns, seen.map_from_camera):
            yield RawFrame(0, seen.stamp_ns, seen.map_from_camera,
                           lambda: (seen.image_rgb, seen.camera), lambda: depth)
    return Frames(ASSETS, 1, read_raw)


def test_several_workers_build_the_same_layer(demo_map):
    walk = read_folder(ASSETS / 'mapping', FolderOptions(layout='tum')).select(range(2, 8))
    one, two = (build_layer(walk, demo_map, LayerOptions(0.0, 0.0, 200, workers=workers))
                for workers in (1, 2))
    assert len(one) == 6
    for name in ('map_from_camera', 'offsets', 'pixels', 'points', 'descriptors', 'words'):
        assert getattr(one, name).tobytes() == getattr(two, name).tobytes(), name


def test_at_the_edge_of_a_depth_image_a_pixel_without_depth_has_none(frame):
    depths = np.full((480, 640), 2.0, np.float32)
    depths[:, :320] = np.nan
    found = depths_of_points(DepthImage(depths, None), frame.camera, np.array(
        [[0.0, 0.0], [0.0, 240.0], [200.0, 479.0], [639.0, 0.0], [639.0, 479.0]]))
    np.testing.assert_array_equal(found, [np.nan, np.nan, np.nan, 2.0, 2.0])


@pytest.mark.parametrize(('unit_m', 'jump_m', 'moved', 'expected'), [
    (0.001, 0.6, 1, None),
    (0.0002, 0.0, 0, r'is 0\.2.* triangulated points .*multiply `depth_unit` by 4\.'),
    (0.001, 0.6, 99, r'jump by 0\.(5[6-9]|6[0-4]) m at 1040\.[048]'),
    (None, 0.25, 99, r'jump by 0\.2[3-7] m at 1040\.[048]')])
def test_images_that_contradict_depth_or_poses(shared_data, unit_m, jump_m, moved, expected):
    """Poses of a real room are displaced from the 101st image on; a single one is no jump."""
    options = FolderOptions(layout='rgbd' if unit_m else 'tum', depth=DepthFormat(unit_m))
    frames = read_folder(shared_data / 'rooms/hololens_office', options).select(range(92, 112))

    def read_raw(is_wanted):
        shift = np.zeros((4, 4))
        for raw in frames.read_raw(lambda *_: True):
            shift[0, 3] = jump_m * (100 <= raw.place < 100 + moved)
            if is_wanted(raw.place, raw.stamp_ns, raw.map_from_camera + shift):
                yield replace(raw, map_from_camera=raw.map_from_camera + shift)
    displaced = replace(frames, read_raw=read_raw)
    if expected is None:
        assert len(build_layer(displaced, LandmarkMap.empty('map'))) > 5
        return
    with pytest.raises(DatasetError, match=expected):
        build_layer(displaced, LandmarkMap.empty('map'))


def test_many_images_are_chosen_as_by_comparing_all(frame, demo_map):
    """A comparison of each of 5,000 frames with all chosen ones took 41 minutes."""
    rng, asked, chosen = np.random.default_rng(0), [], []
    poses = np.tile(np.eye(4), (1500, 1, 1))
    poses[:, :3, 3] = rng.uniform(-0.6, 0.6, (1500, 3))
    turns = Rotation.from_euler('zy', rng.uniform(-30, 30, (1500, 2)), degrees=True)
    poses[:, :3, :3] = turns.as_matrix()

    def read_raw(is_wanted):
        asked.extend(number for number, pose in enumerate(poses) if is_wanted(0, 0, pose))
        return iter(())
    with pytest.raises(MappingError, match='no keyframe'):
        build_layer(Frames(ASSETS, 1500, read_raw), demo_map, LayerOptions(0.2, 8.0))
    for number, pose in enumerate(poses):
        near = np.linalg.norm(poses[chosen, :3, 3] - pose[:3, 3], axis=1) < 0.2
        like = np.degrees((turns[chosen].inv() * turns[number]).magnitude()) < 8.0 if chosen \
            else near
        if not (near & like).any():
            chosen.append(number)
    assert asked == chosen and 500 < len(chosen) < 1450


def test_a_stored_image_is_small_and_shows_the_place(frame, demo_map, tmp_path):
    path = tmp_path / 'map.keyframes.npz'
    layer = build_layer(wall(frame), demo_map, WITH_IMAGES)
    save_layer(path, layer)
    image = load_layer_of_map(path, demo_map).image_rgb(0)
    assert max(image.shape[:2]) == 256
    assert layer.images.size < 15_000
    expected = cv2.resize(frame.image_rgb, image.shape[1::-1], interpolation=cv2.INTER_AREA)
    assert np.abs(image.astype(float) - expected).mean() < 8.0


def test_a_stored_image_is_undistorted_as_its_points_are(frame, demo_map):
    camera = frame.camera
    bent = Camera(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy,
                  'plumb_bob', (-0.25, 0.05, 0.0, 0.0, 0.0))
    marked = frame.image_rgb // 2
    at = np.array([camera.width // 6, camera.height // 6])
    cv2.circle(marked, at.tolist(), 12, (255, 255, 255), cv2.FILLED)
    layer = build_layer(wall(PosedImage(1, marked, bent, np.eye(4))), demo_map, WITH_IMAGES)
    image = layer.image_rgb(0)
    scale = camera.width / image.shape[1]
    spot = (np.argwhere(image.mean(axis=2) > 215)[:, ::-1].mean(axis=0) + 0.5) * scale - 0.5
    straight = bent.normalize_points(at[None])[0] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    assert np.linalg.norm(straight - at) > 8.0
    assert np.abs(spot - straight).max() < 3.0
    assert (np.asarray(layer.pixels) / PIXEL_SCALE).max() < 2 * camera.width
