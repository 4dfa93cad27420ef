# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Find camera axes from the images, and the vertical from the tilt of the cameras."""

import itertools

import numpy as np
import pytest
from capture_folders import FLIP, shots_of, write_colmap, write_nerf
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.transforms import invert_transform, make_transform
from cliploc_ros.errors import DatasetError
from cliploc_ros.offline.datasets import agreement
from cliploc_ros.offline.datasets.folders import AXES, check_axes, find_layout, read_folder
from cliploc_ros.offline.datasets.frames import FolderOptions
from cliploc_ros.offline.mapping.tilt import find_vertical

pytestmark = pytest.mark.needs('pycolmap')
# of a camera in a body with x forward, y left, z up
ROS_FROM_CAMERA = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]])
STORED = {'opencv': lambda pose: pose, 'opengl': lambda pose: pose @ FLIP,
          'opencv-inverse': invert_transform,
          'opengl-inverse': lambda pose: invert_transform(pose @ FLIP),
          'ros': lambda pose: pose @ ROS_FROM_CAMERA}


@pytest.fixture(scope='module')
def shots():
    return shots_of()


@pytest.mark.parametrize('folder', ['seven_scenes_kitchen', 'rooms/hololens_office'])
def test_real_images_tell_the_axes(folder, shared_data, monkeypatch):
    """Real poses pass; each wrong choice of axes is detected, and the correct one named."""
    folder = shared_data / folder
    capture = find_layout(folder).read(folder, FolderOptions())
    extract, known = agreement.extract, {}

    def once(image, *more):  # since that takes most of the time
        key = image.tobytes()
        if key not in known:
            known[key] = extract(image, *more)
        return known[key]
    monkeypatch.setattr(agreement, 'extract', once)
    for stored_as, given in itertools.product(AXES, AXES):
        stored = [file._replace(pose=STORED[stored_as](file.pose)) for file in capture.files
                  if file.pose is not None]
        if given == stored_as:
            assert check_axes(stored, given, folder) == ''
            continue
        with pytest.raises(DatasetError, match=f'poses as {given} .*`axes` {stored_as}$'):
            check_axes(stored, given, folder)


def test_the_option_mends_it(shots, tmp_path):
    folder = write_nerf(tmp_path, [shot._replace(pose=shot.pose @ FLIP) for shot in shots])
    with pytest.raises(DatasetError, match='`axes` opencv'):
        read_folder(folder, FolderOptions(scale=1.0))
    found = next(read_folder(folder, FolderOptions(scale=1.0, axes='opencv')).read())
    np.testing.assert_allclose(found.map_from_camera, shots[0].pose, atol=1e-9)


@pytest.mark.parametrize('angles_deg', [(120.0, 0.0, 30.0), (1.0, -1.0, 100.0)])
def test_levelled_by_the_tilt_of_the_cameras(angles_deg, shots, tmp_path):
    world = make_transform(Rotation.from_euler('xyz', angles_deg, degrees=True).as_matrix(),
                           np.array([1.0, 2.0, 3.0]))
    folder = write_colmap(tmp_path, shots, world=world)
    plain = read_folder(folder, FolderOptions(scale=1.0))
    up = world[:3, 2]
    tilt_deg = np.degrees(np.arccos(up[2]))
    assert any('--level corrects it' in note for note in plain.notes) == (tilt_deg > 5.0 + 1.0)
    frames = read_folder(folder, FolderOptions(scale=1.0, level=True))
    note, = (note for note in frames.notes if note.startswith('levelled'))
    found_deg = float(note.split(' was ')[1].split()[0])
    assert found_deg == pytest.approx(tilt_deg, abs=3.0)
    for raw, shot in zip(frames.read_raw(lambda *_: True), shots, strict=True):
        # the camera's tilt is that of the room, whose z axis is up
        down, true_down = raw.map_from_camera[2, :3], shot.pose[2, :3]
        assert np.degrees(np.arccos(np.clip(down @ true_down, -1, 1))) < 3.0


def test_cameras_that_do_not_tell_the_vertical(shots, tmp_path):
    poses = np.array([shot.pose for shot in shots])
    assert np.degrees(np.arccos(find_vertical(poses)[2])) < 3.0
    assert find_vertical(np.tile(poses[:1], (9, 1, 1))) is None, 'never turns'
    on_its_side = poses @ make_transform(Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix(),
                                         np.zeros(3))
    assert find_vertical(on_its_side) is None
    folder = write_colmap(tmp_path, [shot._replace(pose=poses[0]) for shot in shots])
    with pytest.raises(DatasetError, match='the vertical'):
        read_folder(folder, FolderOptions(scale=1.0, level=True))
