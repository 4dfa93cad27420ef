# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""RGB-D folders, and the depth of boxes."""

import cv2
import numpy as np
import pytest

from cliploc_ros.core.depth_image import (
    DepthCamera,
    DepthImage,
    depth_from_counts,
    depths_of_boxes,
)
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import make_transform
from cliploc_ros.errors import DatasetError
from cliploc_ros.offline.datasets.captures.capture import FolderOptions
from cliploc_ros.offline.datasets.folders import rgbd_frames
from cliploc_ros.offline.datasets.frames import DepthFormat
from cliploc_ros.offline.recording.recorder import check_depth_unit

CAMERA = Camera(640, 480, 525.0, 525.0, 320.0, 240.0)
NO_OPTIONS = FolderOptions()


def write_scene(folder, poses, depth_mm=2000):
    """A 7-Scenes folder: every 10th frame, black images, flat depth."""
    for number, pose in enumerate(poses):
        stem = folder / f'frame-{10 * number:06d}'
        cv2.imwrite(f'{stem}.color.jpg', np.zeros((480, 640, 3), dtype=np.uint8))
        cv2.imwrite(f'{stem}.depth.png', np.full((480, 640), depth_mm, dtype=np.uint16))
        if pose is not None:
            np.savetxt(f'{stem}.pose.txt', pose)
    return folder


def test_seven_scenes(tmp_path):
    pose = np.eye(4)
    pose[0, 3] = 1.0
    lost = np.full((4, 4), np.inf)
    frames = rgbd_frames(write_scene(tmp_path, [pose, lost, None]), NO_OPTIONS)
    first, second, third = frames.read()
    # the poses are the depth camera's, and the colour camera sits 25 mm beside it
    np.testing.assert_allclose(first.map_from_camera[:3, 3], [1.025, 0.0, 0.0])
    assert second.map_from_camera is None and third.map_from_camera is None
    assert second.stamp_ns == 333_333_333
    assert np.nanmax(first.depth.depths_m) == pytest.approx(2.0)
    assert first.camera.fx == 525.0


def test_tum_rgbd(tmp_path):
    for name in ('rgb', 'depth'):
        (tmp_path / name).mkdir()
    counts = np.full((480, 640), 5000, dtype=np.uint16)
    counts[0, 0] = 0
    cv2.imwrite(str(tmp_path / 'depth/a.png'), counts)
    for name in 'ab':
        cv2.imwrite(str(tmp_path / f'rgb/{name}.png'), np.zeros((480, 640, 3), dtype=np.uint8))
    (tmp_path / 'rgb.txt').write_text('1.0 rgb/a.png\n2.0 rgb/b.png\n')
    (tmp_path / 'groundtruth.txt').write_text('1.0 0 0 0 0 0 0 1\n2.0 1 0 0 0 0 0 1\n')
    with pytest.raises(DatasetError, match='`tum`'):
        rgbd_frames(tmp_path, FolderOptions('fr3'))
    (tmp_path / 'depth.txt').write_text('0.985 depth/a.png\n')
    first, second = rgbd_frames(tmp_path, FolderOptions('fr3')).read()
    assert np.isnan(first.depth.depths_m[0, 0]) and first.depth.depths_m[1, 1] == 1.0
    assert second.depth is None
    # the pictures may be cut out of larger ones: a note
    (tmp_path / 'camera.json').write_text(
        '{"width": 640, "height": 480, "fx": 1000, "fy": 1000, "cx": 640, "cy": 480}')
    assert rgbd_frames(tmp_path, FolderOptions('fr3')).notes[1:] == ()
    note, = rgbd_frames(tmp_path, NO_OPTIONS).notes[1:]
    assert '1280x960 px' in note
    millimetres = FolderOptions('fr3', depth=DepthFormat(unit_m=1e-3))
    assert next(rgbd_frames(tmp_path, millimetres).read()).depth.depths_m[1, 1] == 5.0


def test_depth_of_boxes_is_robust():
    depths = np.full((480, 640), 4.0, dtype=np.float32)  # a wall
    depths[100:200, 100:200] = 2.0  # an object, whose box is a little too large
    depths[140:150, 100:200] = np.nan  # a hole
    depths[300:400, 300:400] = np.nan
    found, spreads = depths_of_boxes(DepthImage(depths), CAMERA, np.array([
        [90.0, 90.0, 210.0, 210.0], [305.0, 305.0, 395.0, 395.0], [600.0, 400.0, 700.0, 500.0],
        [120.0, 120.0, 122.0, 122.0]]))
    np.testing.assert_allclose(found, [2.0, np.nan, 4.0, np.nan])
    np.testing.assert_allclose(spreads[[0, 2]], 0.0)


def test_depth_that_is_not_registered():
    own = DepthCamera(585.0, 585.0, 320.0, 240.0, make_transform(
        np.eye(3), np.array([-0.025, 0.0, 0.0])))
    depths = np.full((480, 640), 4.0, dtype=np.float32)
    depths[200:280, 400:480] = 1.0
    # where the colour camera sees it: scaled by .897, shifted by 525 * 25 mm / 1 m = 13 px
    left = 320 + (400 - 320) * 525 / 585 - 13.125
    box = np.array([[left, 204.1, left + 71.8, 275.9]])
    found, spread = depths_of_boxes(DepthImage(depths, own), CAMERA, box)
    np.testing.assert_allclose([found[0], spread[0]], [1.0, 0.0], atol=1e-6)
    # a depth camera on its side, its x axis where the other's y axis is
    aside = DepthCamera(585.0, 585.0, 240.0, 639.0 - 320.0, own.color_from_depth @ make_transform(
        np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3)))
    found, spread = depths_of_boxes(DepthImage(np.rot90(depths), aside), CAMERA, box)
    np.testing.assert_allclose([found[0], spread[0]], [1.0, 0.0], atol=1e-6)
    # taken for registered, the box further left shows the wall
    box = box - [20, 0, 20, 0]
    assert depths_of_boxes(DepthImage(depths), CAMERA, box)[0][0] == 4.0
    assert depths_of_boxes(DepthImage(depths, own), CAMERA, box)[0][0] == 1.0


def test_counts_and_units():
    counts = np.array([[0, 65535, 1500]], dtype=np.uint16)
    np.testing.assert_allclose(depth_from_counts(counts, None, 'x'), [[np.nan, np.nan, 1.5]])
    with pytest.raises(DatasetError, match='16-bit'):
        depth_from_counts(np.zeros((2, 2, 3), dtype=np.uint8), None, 'x')
    check_depth_unit(np.array([2.0, np.nan], dtype=np.float32), 'x')
    check_depth_unit(np.array([np.nan], dtype=np.float32), 'x')
    for median in (2000.0, 0.002):
        with pytest.raises(DatasetError, match=f'{median:g} m.*wrong unit'):
            check_depth_unit(np.full(5, median, dtype=np.float32), 'x')
