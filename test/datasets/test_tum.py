# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Reading TUM folders, trajectories, cameras and recorded detections."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cliploc_ros.errors import DatasetError
from cliploc_ros.offline.datasets.intrinsics import PRESETS, find_camera, read_camera
from cliploc_ros.offline.datasets.parsing import parse_stamp_ns, pose_of
from cliploc_ros.offline.datasets.poses import TimedPoses, mount_from_numbers
from cliploc_ros.offline.datasets.tum import read_tum, read_tum_trajectory
from cliploc_ros.offline.datasets.tum_conversion import read_recorded_detections

MS = 1_000_000


@pytest.fixture
def folder(tmp_path):
    """A TUM folder of three placeholder images."""
    path = tmp_path / 'rgbd_dataset_freiburg2_desk'
    (path / 'rgb').mkdir(parents=True)
    lines = ['# color images', '# timestamp filename']
    for stamp in ('1.000001', '1.033', '1.1'):
        (path / 'rgb' / f'{stamp}.png').write_bytes(b'')
        lines.append(f'{stamp} rgb/{stamp}.png')
    (path / 'rgb.txt').write_text('\n'.join(lines) + '\n')
    (path / 'groundtruth.txt').write_text(
        '# timestamp tx ty tz qx qy qz qw\n'
        '1.00 0 0 0 0 0 0 1\n'
        '1.04 4 8 -4 0 0 0.7071 0.7071\n'
    )
    return path


def test_reads_a_folder(folder):
    sequence = read_tum(folder)
    assert sequence.stamps_ns == (1_000_001_000, 1_033_000_000, 1_100_000_000)
    assert [path.name for path in sequence.image_paths] == ['1.000001.png', '1.033.png', '1.1.png']
    assert len(sequence.trajectory) == 2
    assert sequence.every(2).stamps_ns == (1_000_001_000, 1_100_000_000)


def test_poses_between_samples_near_the_ends_and_in_gaps(folder):
    sequence = read_tum(folder)
    pose = sequence.pose_at(1_010 * MS)
    quarter = Rotation.from_euler('z', 22.5, degrees=True).as_matrix()
    np.testing.assert_allclose(pose[:3, :3], quarter, atol=1e-12)
    np.testing.assert_allclose(pose[:3, 3], [1, 2, -1], atol=1e-12)
    np.testing.assert_array_equal(sequence.pose_at(980 * MS), np.eye(4))
    assert sequence.pose_at(980 * MS - 1) is None
    assert sequence.pose_at(1_060 * MS) is not None
    assert sequence.pose_at(1_060 * MS + 1) is None
    (folder / 'groundtruth.txt').write_text('1.00 0 0 0 0 0 0 1\n1.10 1 0 0 0 0 0 1\n')
    gap = read_tum(folder)
    assert gap.pose_at(1_020 * MS) is not None
    assert gap.pose_at(1_050 * MS) is None


@given(st.integers(0, 2**31 * 10**9 - 10**9))
def test_stamps_are_exact(stamp_ns):
    seconds, nanoseconds = divmod(stamp_ns, 10**9)
    assert parse_stamp_ns(f'{seconds}.{nanoseconds:09}', 'here') == stamp_ns


@pytest.mark.parametrize(
    ('name', 'text', 'message'),
    [
    ('rgb.txt', '1.0\n', 'rgb.txt:1'),
    ('rgb.txt', 'one rgb/1.1.png\n', "rgb.txt:1: 'one'"),
    ('rgb.txt', '# x\n\n1.0 rgb/none.png\n', 'rgb.txt:3.*none.png'),
    ('rgb.txt', '1.1 rgb/1.1.png\n1.1 rgb/1.1.png\n', 'rgb.txt:2'),
    ('groundtruth.txt', '1 2 3\n', 'truth.txt:1.*3 fields'),
    ('groundtruth.txt', '1 0 0 0 0 0 0 0\n', 'truth.txt:1.*norm 0'),
    ('groundtruth.txt', '-1 0 0 0 0 0 0 1\n', 'truth.txt:1.* -1')],
)
def test_malformed_files_are_named(folder, name, text, message):
    (folder / name).write_text(text)
    with pytest.raises(DatasetError, match=message):
        read_tum(folder)


# --- cameras -------------------------------------------------------------------------------


def camera_json(path, **changes):
    values = {'width': 640, 'height': 480, 'fx': 500, 'fy': 501.5, 'cx': 320, 'cy': 240}
    values |= {'distortion_model': 'plumb_bob', 'd': [0.1, 0, 0, 0, 0]}
    values |= changes
    path.write_text(json.dumps({name: one for name, one in values.items() if one != 'absent'}))
    return path


def test_camera_from_a_file(tmp_path):
    path = camera_json(tmp_path / 'camera.json')
    camera = read_camera(path)
    assert (camera.fx, camera.fy, camera.distortion) == (500.0, 501.5, (0.1, 0.0, 0.0, 0.0, 0.0))
    assert find_camera(str(path), tmp_path) == (camera, str(path))
    assert find_camera(None, tmp_path) == (camera, str(path))
    assert find_camera('fr2', tmp_path)[0] == PRESETS['fr2']


# --- recorded detections -------------------------------------------------------------------

BOOK = {'class_id': 'book', 'score': 0.5789, 'bbox_xyxy': [173.0, 138.0, 219.5, 208.0]}


def detections_json(path, frames, **more):
    path.write_text(json.dumps({'frames': frames, **more}))
    return path


def test_recorded_detections(tmp_path):
    path = detections_json(
        tmp_path / 'd.json',
        [
            {'timestamp': '1341847980.722988', 'detections': [BOOK, {**BOOK, 'class_id': 'tv'}]},
            {'timestamp': 1341847980.754743, 'detections': []},
        ],
        image_size=[640, 480],
    )
    detections = read_recorded_detections(path, (640, 480))
    assert list(detections) == [1341847980722988000, 1341847980754743000]
    first, second = detections.values()
    np.testing.assert_array_equal(first.bboxes_xyxy, [[173, 138, 219.5, 208]] * 2)
    assert first.class_ids == ('book', 'tv')
    assert list(first.scores) == [0.5789, 0.5789]
    assert second.bboxes_xyxy.shape == (0, 4)


@pytest.mark.parametrize('number', [1e200, 1e308, 1e-320, 2.0])
def test_quaternions_of_any_numbers_are_refused(number, tmp_path):
    """Squares of the largest overflow: no warning says so, and no pose is made of them."""
    sample = [0.0, 0.0, 0.0, number, number, number, number]
    file = tmp_path / 'trajectory.txt'
    file.write_text('1.0 ' + ' '.join(map(str, sample)))
    for read in (lambda: pose_of(sample[:3], sample[3:], 'here'),
                 lambda: mount_from_numbers(sample),
                 lambda: read_tum_trajectory(file),
                 lambda: TimedPoses.from_samples([1], [sample], 'here')):
        with pytest.raises(DatasetError):
            read()
