# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Maps from several cameras of one robot, on a simulated drive in a room whose objects are known.

The cameras differ in resolution, lens and place on the robot, and their images interleave.
"""

import re
from dataclasses import replace

import numpy as np
import pytest
from scene import level, map_of, rigid
from scipy.spatial.transform import Rotation
from walk import CAMERA, CLASSES, draw_errors, measure_depth, nearest_errors, see_rows

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.errors import DatasetError, MappingError
from cliploc_ros.offline.datasets.observations import load_observations, save_observations
from cliploc_ros.offline.mapping.building import build_map
from cliploc_ros.offline.mapping.check.checking import check_map
from cliploc_ros.offline.mapping.check.relocalization import sample_frames
from cliploc_ros.offline.mapping.options import CheckOptions, MappingOptions, PoseErrors
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.mapping.update.updating import update_map
from cliploc_ros.offline.mapping.views import make_views, thin_out

#: By name: the camera, and its viewing direction [deg].
RIG = {'front': (CAMERA, 0.0), 'left': (Camera(320, 240, 200.0, 200.0, 160.0, 120.0), 90.0),
       'back': (Camera(800, 600, 450.0, 460.0, 380.0, 310.0), 180.0), 'right': (CAMERA, 270.0)}
_LEVER_M, _STEP_S = 0.3, 0.5
ERRORS = PoseErrors(0.05, 1.5, 3.0)


def mount_of(name):
    return rigid(degrees=RIG[name][1]) @ level(_LEVER_M)


def make_things(count=20):
    """Return objects all around."""
    rng = np.random.default_rng(0)
    angles = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    centers = np.c_[2.6 * np.cos(angles), 2.6 * np.sin(angles), rng.uniform(0.6, 1.4, count)]
    return map_of([CLASSES[row % 3] for row in range(count)], centers,
                  rng.uniform(0.1, 0.2, (count, 3)))


ROOM = make_things()


def robot_at(stamps_s):
    """Return poses of a robot that drives on a circle and also turns relative to it."""
    poses = np.tile(np.eye(4), (len(stamps_s), 1, 1))
    poses[:, :3, :3] = Rotation.from_euler('z', 0.45 * stamps_s[:, None]).as_matrix()
    poses[:, 0, 3] = 1.2 * np.cos(0.15 * stamps_s)
    poses[:, 1, 3] = 1.2 * np.sin(0.15 * stamps_s)
    return poses


def drive(*names, noise_px=2.0, move=lambda stamps_s, poses: poses, seconds=50.0, delay_s=0.03):
    """Return simulated detections and true poses; move returns the given poses of the robot."""
    seen, true, stamps = [], [], []
    for number, name in enumerate(names):
        stamps.append(np.arange(0.0, seconds, _STEP_S) + number * delay_s)
        true.append(robot_at(stamps[-1]) @ mount_of(name))
        camera = RIG[name][0]
        seen.append(see_rows(ROOM, true[-1], noise_px * camera.fx / 500.0, seed=number,
                             camera=camera)[0])
    joined = {key: np.concatenate([getattr(part, key) for part in seen])
              for key in ('bboxes_xyxy', 'classes', 'scores')}
    given = [move(*pair) @ mount_of(name) for *pair, name in zip(
        stamps, map(robot_at, stamps), names, strict=True)]
    counts = np.concatenate([np.diff(part.frame_offsets) for part in seen])
    rows = np.repeat(np.arange(len(names)), list(map(len, seen)))
    stamps, true = np.concatenate(stamps), np.concatenate(true)
    order = np.argsort(stamps, kind='stable')
    return PosedDetections(
        tuple(RIG[name][0] for name in names), np.concatenate(given), stamps,
        np.cumsum([0, *counts]), class_names=CLASSES, camera_rows=rows, camera_names=names,
        **joined).select_frames(order), true[order]


def wandering(seed):
    """Return a function that moves a robot by errors with a correlation time of seconds."""
    times = np.arange(-1.0, 60.0, 0.05)
    errors = draw_errors(times, ERRORS, seed)

    def move(stamps_s, poses):
        now = np.stack([np.interp(stamps_s, times, column) for column in errors.T], axis=1)
        moved = poses.copy()
        moved[:, :3, :3] = Rotation.from_rotvec(now[:, 3:]).as_matrix() @ poses[:, :3, :3]
        moved[:, :3, 3] += now[:, :3]
        return moved
    return move


@pytest.mark.parametrize('odometry', [False, True])
def test_cameras_share_the_errors_of_the_robot(odometry):
    left = {}
    for names in (('front',), tuple(RIG)):
        detections, true = drive(*names, move=wandering(0), seconds=30.0)
        if odometry:
            detections = replace(detections, odom_from_camera=true)
        built = build_map(detections, MappingOptions(pose_errors=ERRORS))
        left[names] = (built.map_from_camera - true)[:, :3, 3].std(axis=0).mean()
    one, four = left.values()
    print(f'\nposes off by: one camera {1e3 * one:.0f} mm, four {1e3 * four:.0f} mm')
    assert four < (1.0 if odometry else 0.6) * one
    if odometry:
        assert any(' 239 of 239 ' in note for note in built.report.notes)


def test_viewpoints_and_samples_are_those_of_each_camera():
    standing = drive(*RIG, seconds=10.0, move=lambda stamps_s, poses: poses[:1].repeat(
        len(poses), axis=0))[0]
    views = make_views(standing)
    assert sorted(np.bincount(views.viewpoints).tolist()) == [20] * 4
    assert np.bincount(views.cameras[thin_out(views, 3)]).tolist() == [3] * 4
    with pytest.raises(MappingError, match='move it around'):
        build_map(standing.select_frames(standing.every(40)))
    moving = drive(*RIG)[0]
    for frames in (moving.every(4), sample_frames(moving, 100)):  # every fourth of four cameras
        assert np.bincount(moving.frame_cameras[frames]).tolist() == [25] * 4
    assert not any('jump' in note for note in build_map(moving).report.notes)


def test_depth_of_each_camera_has_its_own_scale():
    detections = measure_depth(drive('front', 'left')[0], ROOM)
    depths = detections.depths
    assert not build_map(detections).report.notes
    is_left = detections.frame_cameras[detections.frames] == 1
    long = build_map(replace(detections, depths=np.where(is_left, 1.2 * depths, depths)))
    note, = long.report.notes
    assert float(re.search(r' of left is ([\d.]+)', note)[1]) == pytest.approx(1.2, abs=0.02)
    with pytest.raises(DatasetError, match=r' of left is .* wrong unit'):
        build_map(replace(detections, depths=np.where(is_left, 1000.0 * depths, depths)))


def test_the_check_names_the_camera_that_is_off():
    """Its boxes have the focal length of another camera."""
    detections = drive(*RIG)[0]
    cameras = list(detections.cameras)
    cameras[1] = replace(cameras[1], fx=1.05 * cameras[1].fx, fy=1.05 * cameras[1].fy)
    options = CheckOptions(relocalizer=RelocalizerOptions(iterations=300), frames=8,
                           max_positions=1, headings=1)
    right = check_map(ROOM, detections, options=options)
    assert any('front' in note for note in right.notes)
    assert len(right.recording.trials) == 8
    assert not any(correction.is_significant for correction in right.recording.corrections)
    wrong = check_map(ROOM, replace(detections, cameras=tuple(cameras)), options=options)
    advice, = (line for line in wrong.advice if line.startswith('calibrate the camera'))
    assert re.search('fx of left by -[45]', advice)
    assert not any(f' of {name}' in advice for name in ('front', 'back', 'right'))


def test_a_map_is_updated_from_several_cameras():
    now = replace(ROOM, centers=ROOM.centers + np.where(
        np.arange(len(ROOM))[:, None] == 3, [0.0, 0.0, 1.0], 0.0))
    updated = update_map(now, drive(*RIG)[0], MappingOptions(pose_errors=ERRORS))
    assert nearest_errors(updated.landmark_map, ROOM).max() < 0.05
    assert [landmark.landmark_id for landmark in updated.report.moved] == ['thing_3']


def test_one_mount_is_corrected_at_a_time():
    with pytest.raises(MappingError, match='2 cameras'):
        build_map(drive('front', 'left')[0], MappingOptions(refine_mount=True))


@pytest.mark.parametrize(('change', 'message'), [
    ({'camera_rows': np.full(20, 2)}, 'in row 0'),
    ({'camera_rows': np.zeros(20, dtype=int)}, "'left'"),
    ({'camera_names': np.array(['front', 'front'])}, 'repeats an id'),
    ({'camera_intrinsics': np.zeros((2, 4))}, 'fx')])
def test_a_file_that_contradicts_itself_is_refused(tmp_path, change, message):
    path = tmp_path / 'two.npz'
    save_observations(path, drive('front', 'left', seconds=5.0)[0])
    with np.load(path) as arrays:
        wrong = {**arrays, **change}
    np.savez(path, **wrong)
    with pytest.raises(DatasetError, match=message):
        load_observations(path)
