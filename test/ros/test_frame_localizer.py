# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From messages to a pose without the node, by class."""

import time
from dataclasses import replace

import numpy as np
import pytest
from frames import frame_of, header_of
from scene import CAMERA, MAP_FROM_CAMERA, make_room, see_room, write_map
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header

from cliploc_ros.core.acceptance.verdict import RefusalKind
from cliploc_ros.core.geometry.transforms import make_transform, pose_error
from cliploc_ros.errors import CameraError
from cliploc_ros.ros.frame_localizer import load_localizer
from cliploc_ros.ros.inputs.odometry import OdometryPlace
from cliploc_ros.ros.inputs.robot_state import KnownBefore, RobotState
from cliploc_ros.ros.node.diagnostics import StageTimes
from cliploc_ros.ros.parameters import RelocalizerParameters


@pytest.fixture
def values(tmp_path):
    """Values of the relocalizer's parameters that need no network."""
    path = tmp_path / 'room.yaml'
    write_map(make_room(), path)
    return RelocalizerParameters(map_file=str(path), matching='class', algorithm='bf')


def make_frame(**info):
    return frame_of(see_room(make_room()), header_of(100 * 10**9), info=info)


@pytest.fixture
def localizer(make_node, values):
    return load_localizer(make_node(), values)


def localize(localizer, frame, values, up_in_camera=None):
    return localizer.localize(frame, values, KnownBefore(RobotState(np.eye(4), up_in_camera)),
                              timer()).found


def timer():
    return StageTimes('waiting', time.monotonic())


def test_a_rectified_image_is_measured_with_p(localizer, values):
    useless = {'k': [0.0] * 9, 'distortion_model': 'plumb_bob', 'd': [0.5] * 5}
    with pytest.raises(CameraError, match='camera_info: K'):
        localize(localizer, make_frame(**useless), values)
    found = localize(localizer, make_frame(**useless), replace(values, rectified=True))
    assert pose_error(found.hypotheses[0].map_from_camera, MAP_FROM_CAMERA)[0] < 0.05


def test_a_mount_of_body_axes_is_refused_where_the_pose_contradicts_it(make_node, values,
                                                                       tmp_path):
    """The room is upright, and not on its back in front of a camera that looks up."""
    assert localize(load_localizer(make_node(), values), make_frame(),
                    replace(values, base_frame='base_link')).accepted
    turn, room = Rotation.from_euler('x', -90.0, degrees=True), make_room()
    write_map(replace(room, centers=turn.apply(room.centers), quats_xyzw=(
        turn * Rotation.from_quat(room.quats_xyzw)).as_quat()), tmp_path / 'room.yaml')
    localizer = load_localizer(make_node(), values)
    values = replace(values, base_frame='base_link')
    found = localize(localizer, make_frame(), values)
    assert found.refusal_kind is RefusalKind.WRONG_MOUNT
    assert "'camera' has the axes of a body" in found.reason


def test_a_robot_on_its_head_is_refused_and_named(make_node, values):
    """A driver turns the image upright, tf says that the camera is upside down."""
    turned = np.diag([1.0, -1.0, -1.0, 1.0])
    for gravity, up in (('none', None), ('base_frame', turned[:3, 2])):
        asked = replace(values, base_frame='base_link', gravity=gravity, algorithm='auto')
        localizer = load_localizer(make_node(), asked)
        known = KnownBefore(RobotState(turned, up))
        found = localizer.localize(make_frame(), asked, known, timer()).found
        assert found.refusal_kind is RefusalKind.WRONG_MOUNT
        report = localizer.look(make_frame(), asked, known.state, 'map', MAP_FROM_CAMERA)
        assert 'tilted by 174 degrees' in report.fault


def test_options_hold_from_the_next_frame_on(localizer, values):
    cameras = localizer.localizer.cameras
    assert localize(localizer, make_frame(), values).accepted
    for changes in ({'min_confidence': 1.0}, {'max_detections': 3}):
        assert not localize(localizer, make_frame(), replace(values, **changes)).accepted
    found = localize(localizer, make_frame(), replace(values, algorithm='ransac'))
    assert localizer.localizer.cameras is cameras, 'evidence about the cameras is kept'
    assert found.accepted and localizer.description.endswith('algorithm ransac')


def test_a_camera_of_another_run_of_odometry_is_left_out_and_named(localizer, values):
    """The images of an instant have one stamp, by which its cameras are recognized."""
    places = [RobotState(np.eye(4), place=OdometryPlace(np.eye(4), run, 0.0)) for run in (1, 1, 2)]
    frames = [replace(make_frame(), camera=name) for name in ('front', 'left', 'back')]
    first = replace(frames[0], left_out=('right',))
    frames[1].image.header = header_of(99_980_000_000)
    found = localizer.localize(first, values, KnownBefore(places[0], list(zip(
        frames[1:], places[1:], strict=True))), timer())
    assert [(frame.camera_name, frame.stamp_ns) for frame in found.query.frames] == [
        ('left', 100_000_000_000), ('front', 100_000_000_000)]
    assert found.left_out == ('right', 'back')


def test_depth_of_another_camera_is_registered(localizer, values, caplog):
    """Depth with half the resolution, 20 cm to the left of the colour camera: a wall at 4 m."""
    height, width = CAMERA.height // 2, CAMERA.width // 2
    left = make_transform(np.eye(3), np.array([-0.2, 0.0, 0.0]))
    depth = Image(header=Header(frame_id='depth'), height=height, width=width, encoding='16UC1',
                  step=2 * width, data=np.full(height * width, 4000, dtype=np.uint16).tobytes())
    info = CameraInfo(k=(np.diag([0.5, 0.5, 1.0]) @ CAMERA.matrix).ravel())

    def depths(info, camera_from_depth):
        frame = replace(make_frame(), depth=depth, depth_camera_info=info)
        state = RobotState(np.eye(4), camera_from_depth=camera_from_depth)
        return localizer.localize(frame, values, KnownBefore(state), timer()).query.newest.depths
    found = depths(info, left)
    known = np.isfinite(found)
    assert known.sum() >= 9  # the others are small
    np.testing.assert_allclose(found[known], 4.0)
    for wrong, pose, said in (
            (None, left, 'and depth_camera_info is missing'),
            (info, None, 'and tf is missing'),
            (CameraInfo(k=info.k, d=[0.1] * 5, distortion_model='plumb_bob'), left, 'rectified'),
            (CameraInfo(k=info.k, width=9, height=9), left, 'camera_info is for 9x9 px')):
        assert depths(wrong, pose) is None
        assert said in caplog.text


def test_heights_and_verticals_reach_the_search(localizer, values):
    values = replace(values, algorithm='auto')
    height = MAP_FROM_CAMERA[2, 3]
    blind = localize(localizer, make_frame(), values)
    upright = localize(localizer, make_frame(), values, MAP_FROM_CAMERA[2, :3])
    assert blind.accepted and upright.accepted
    # a vertical makes tilts certain
    assert np.trace(upright.covariance[3:5, 3:5]) < np.trace(blind.covariance[3:5, 3:5])
    assert not localize(localizer, make_frame(), values, -MAP_FROM_CAMERA[2, :3]).accepted
    values = replace(values, height_range_m=[height + 5.0, height + 6.0])
    assert not localize(localizer, make_frame(), values).accepted
