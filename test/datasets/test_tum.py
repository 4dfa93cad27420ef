# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""TUM folders, trajectories, cameras, recorded detections, RGB-D folders and depth."""

import json

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cliploc_ros.errors import DatasetError
from cliploc_ros.offline.datasets import tum
from cliploc_ros.offline.datasets.bag_frames import BagTopics
from cliploc_ros.offline.datasets.folders import read_folder, rgbd_frames
from cliploc_ros.offline.datasets.frames import DepthFormat, FolderOptions
from cliploc_ros.offline.datasets.images import open_images
from cliploc_ros.offline.datasets.parsing import pose_of, read_numbers
from cliploc_ros.offline.datasets.poses import TimedPoses, mount_from_numbers

MS = 1_000_000


@pytest.fixture
def sequence_folder(tmp_path):
    """Write a TUM sequence folder of three placeholder images."""
    path = tmp_path / 'rgbd_dataset_freiburg2_desk'
    (path / 'rgb').mkdir(parents=True)
    lines = ['# color images', '# timestamp filename']
    for stamp in ('1.000001', '1.033', '1.1'):
        (path / 'rgb' / f'{stamp}.png').write_bytes(b'')
        lines.append(f'{stamp} rgb/{stamp}.png')
    (path / 'rgb.txt').write_text('\n'.join(lines) + '\n')
    (path / 'groundtruth.txt').write_text(
        '# timestamp tx ty tz qx qy qz qw\n1.00 0 0 0 0 0 0 1\n1.04 4 8 -4 0 0 0.7071 0.7071\n')
    return path


def test_poses_between_samples_near_the_ends_and_in_gaps(sequence_folder):
    sequence = tum.read_tum(sequence_folder)
    pose = sequence.pose_at(1_010 * MS)
    quarter = Rotation.from_euler('z', 22.5, degrees=True).as_matrix()
    np.testing.assert_allclose(pose[:3, :3], quarter, atol=1e-12)
    np.testing.assert_allclose(pose[:3, 3], [1, 2, -1], atol=1e-12)
    np.testing.assert_array_equal(sequence.pose_at(980 * MS), np.eye(4))
    assert sequence.pose_at(980 * MS - 1) is None
    assert sequence.pose_at(1_060 * MS) is not None
    assert sequence.pose_at(1_060 * MS + 1) is None
    (sequence_folder / 'groundtruth.txt').write_text('1.00 0 0 0 0 0 0 1\n1.10 1 0 0 0 0 0 1\n')
    gap = tum.read_tum(sequence_folder)
    assert gap.pose_at(1_020 * MS) is not None and gap.pose_at(1_050 * MS) is None


@pytest.mark.parametrize(('name', 'text', 'message'), [
    ('rgb.txt', 'one rgb/1.1.png\n', "rgb.txt:1: 'one'"),
    ('rgb.txt', '# x\n\n1.0 rgb/none.png\n', 'rgb.txt:3.*none.png'),
    ('rgb.txt', '1.1 rgb/1.1.png\n1.1 rgb/1.1.png\n', 'rgb.txt:2'),
    ('groundtruth.txt', '1 0 0 0 0 0 0 0\n', 'truth.txt:1.*norm 0'),
    ('groundtruth.txt', '-1 0 0 0 0 0 0 1\n', 'truth.txt:1.* -1')])
def test_malformed_files_are_named(sequence_folder, name, text, message):
    (sequence_folder / name).write_text(text)
    with pytest.raises(DatasetError, match=message):
        tum.read_tum(sequence_folder)


@pytest.mark.parametrize(('truth', 'message'), [
    (None, 'groundtruth.txt is missing; give a `trajectory`'),
    ('9000 0 0 0 0 0 0 1\n', 'different clocks')])
def test_images_alone_need_no_poses(sequence_folder, truth, message):
    """The studio shows the images of a map that was built with a separate trajectory."""
    for path in (sequence_folder / 'rgb').iterdir():
        cv2.imwrite(str(path), np.full((480, 640, 3), 7, dtype=np.uint8))
    poses = sequence_folder / 'groundtruth.txt'
    poses.unlink() if truth is None else poses.write_text(truth)
    assert (open_images(sequence_folder, BagTopics()).near(1.033)[200:300, 300:400] == 7).all()
    for layout in ('', 'tum'):
        with pytest.raises(DatasetError, match=message):
            read_folder(sequence_folder, FolderOptions(layout=layout))


def test_an_empty_cell_is_no_cell_of_another_column(tmp_path):
    path = tmp_path / 'table.csv'
    for line in ('1.0, 2,3 ,4', '1.0,2,3,4,', '1.0 2 3 4', '1.0\t2,3 4'):
        path.write_text(f'# comment\n{line}\n')
        assert read_numbers(path, 'a b c d') == [[1.0, 2.0, 3.0, 4.0]]
    for line in ('1.0,2,,4,5', ',1.0,2,3,4', '1.0,2, ,3,4', '1.0,2,3,4,,', ','):
        path.write_text(f'# comment\n{line}\n')
        with pytest.raises(DatasetError, match=r'table\.csv:2: a cell between its'):
            read_numbers(path, 'a b c d')
    path.write_text('1.0,2,three,4\n')
    with pytest.raises(DatasetError, match=r"table\.csv:1: 'three' is not a number"):
        read_numbers(path, 'a b c d')


# --- recorded detections -------------------------------------------------------------------
BOOK = {'class_id': 'book', 'score': 0.5789, 'bbox_xyxy': [173.0, 138.0, 219.5, 208.0]}


def test_recorded_detections(tmp_path):
    path = tmp_path / 'd.json'
    path.write_text(json.dumps({'image_size': [640, 480], 'frames': [
        {'timestamp': '1341847980.722988', 'detections': [BOOK, {**BOOK, 'class_id': 'tv'}]},
        {'timestamp': 1341847980.754743, 'detections': []}]}))
    detections = tum.read_recorded_detections(path, (640, 480))
    assert list(detections) == [1341847980722988000, 1341847980754743000], 'exact stamps'
    first, second = detections.values()
    np.testing.assert_array_equal(first.bboxes_xyxy, [[173, 138, 219.5, 208]] * 2)
    assert first.class_ids == ('book', 'tv') and list(first.scores) == [0.5789, 0.5789]
    assert second.bboxes_xyxy.shape == (0, 4)


@pytest.mark.parametrize(('frame', 'message'), [
    ({}, "frame 0: field 'timestamp' is missing"),
    ({'timestamp': True}, "field 'timestamp' is 'True', neither"),
    ({'timestamp': 1, 'detections': [{**BOOK, 'bbox_xyxy': [True, 0, 5, 6]}]}, 'bbox_xyxy is'),
    ({'timestamp': 1, 'detections': [{**BOOK, 'score': True}]}, 'score is True')])
def test_booleans_and_missing_fields_are_refused(tmp_path, frame, message):
    path = tmp_path / 'd.json'
    path.write_text(json.dumps({'frames': [{'detections': [], **frame}]}))
    with pytest.raises(DatasetError, match=message):
        tum.read_recorded_detections(path)


@pytest.mark.parametrize('number', [1e308, 1e-320, 2.0])
def test_quaternions_of_any_numbers_are_refused(number, tmp_path):
    """Squares of the largest values overflow: there is no warning, and no pose."""
    sample = [0.0, 0.0, 0.0, number, number, number, number]
    file = tmp_path / 'trajectory.txt'
    file.write_text('1.0 ' + ' '.join(map(str, sample)))
    for read in (lambda: pose_of(sample[:3], sample[3:], 'here'),
                 lambda: mount_from_numbers(sample),
                 lambda: tum.read_tum_trajectory(file),
                 lambda: TimedPoses.from_samples([1], [sample], 'here')):
        with pytest.raises(DatasetError):
            read()


NO_OPTIONS = FolderOptions()


def write_scene(folder, poses, depth_mm=2000):
    """Write a 7-Scenes folder: every 10th frame, black images, flat depth."""
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
    # the poses are those of the depth camera; the colour camera is 25 mm beside it
    np.testing.assert_allclose(first.map_from_camera[:3, 3], [1.025, 0.0, 0.0])
    assert second.map_from_camera is None and third.map_from_camera is None
    assert second.stamp_ns == 333_333_333
    assert np.nanmax(first.depth.depths_m) == pytest.approx(2.0)
    assert first.camera.fx == 525.0


def test_what_is_no_pose_of_seven_scenes(tmp_path):
    write_scene(tmp_path, [np.eye(4)])
    path = tmp_path / 'frame-000000.pose.txt'
    path.write_text('# of the depth camera\n1 0 0 0 # x\n0 1 0 0\n0 0 1 0\n0 0 0 1\n')
    assert next(rgbd_frames(tmp_path, NO_OPTIONS).read()).map_from_camera is not None
    path.write_text('1 0 0 1e300\n0 1 0 0\n0 0 1 0\n0 0 0 1\n')
    with pytest.raises(DatasetError, match=r'color\.jpg is 1e\+300 m from the origin'):
        rgbd_frames(tmp_path, NO_OPTIONS)
    path.write_text('1 0 0 0\n0 1 0\n')
    with pytest.raises(DatasetError, match=r'pose\.txt: is not a 4x4 matrix'):
        rgbd_frames(tmp_path, NO_OPTIONS)


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
    # the images may be crops of larger ones: a note reports it
    (tmp_path / 'camera.json').write_text(
        '{"width": 640, "height": 480, "fx": 1000, "fy": 1000, "cx": 640, "cy": 480}')
    assert rgbd_frames(tmp_path, FolderOptions('fr3')).notes[1:] == (
        '1 of 2 images have no depth image taken with them',)
    note, = rgbd_frames(tmp_path, NO_OPTIONS).notes[2:]
    assert '1280x960 px' in note
    millimetres = FolderOptions('fr3', depth=DepthFormat(unit_m=1e-3))
    assert next(rgbd_frames(tmp_path, millimetres).read()).depth.depths_m[1, 1] == 5.0
