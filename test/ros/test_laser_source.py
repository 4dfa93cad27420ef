# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The scan nearest to an image, moved by odometry, and its grid; invalid ones are named."""

import numpy as np
import pytest
from frames import header_of, stamp
from nav_msgs.msg import OccupancyGrid, Odometry
from scene import level
from sensor_msgs.msg import LaserScan

from cliploc_ros.messages import grid_from_msg
from cliploc_ros.ros.inputs.robot_state import RobotStateSource
from cliploc_ros.ros.parameters import RelocalizerParameters

CAMERA = [0.2, 0.0, 1.0, -0.5, 0.5, -0.5, 0.5]
PARAMETERS = RelocalizerParameters(
    scan='scan', base_frame='base', base_from_camera=CAMERA, tf_timeout_s=0.0,
    base_from_laser=[0.1, 0.0, 0.3, 0.0, 0.0, 1.0, 0.0])  # looks back
BASE_FROM_CAMERA = level(0.2)


def scan_of(seconds=50.0, **fields):
    return LaserScan(header=header_of(round(seconds * 1e9), 'laser'), **{
        'angle_min': -1.5, 'angle_max': 1.5, 'angle_increment': 0.1, 'range_min': 0.1,
        'range_max': 8.0, 'ranges': [2.0] * 31} | fields)


def grid_of(frame_id='map', width=3, resolution=0.05, w=1.0):
    msg = OccupancyGrid(header=header_of(0, frame_id), data=[100, 0, -1, 0, 0, 0])
    msg.info.width, msg.info.height, msg.info.resolution = width, 2, resolution
    msg.info.origin.orientation.w = w
    return msg


@pytest.fixture
def robot(make_node):
    """Return the inputs of a robot with a grid, which drives ahead by 1 m/s."""
    source = RobotStateSource(make_node())
    source.laser.use(lambda: grid_from_msg(grid_of()))
    for seconds in np.arange(49.0, 50.5, 0.05):
        msg = Odometry(header=header_of(round(seconds * 1e9), 'odom'), child_frame_id='base')
        msg.pose.pose.position.x = seconds
        msg.pose.pose.orientation.w = 1.0
        source.odometry.take(msg)
    return source


def state_of(robot, seconds=50.0, frame_ids=('map',)):
    return robot.at(header_of(round(seconds * 1e9), 'camera'), PARAMETERS, frame_ids=frame_ids)


def test_the_nearest_scan_is_moved_by_odometry(robot):
    """As in REP 117, inf is no echo, and NaN, -inf and ranges below range_min are invalid."""
    ranges = [*[2.0] * 26, np.inf, 8.0, np.nan, -np.inf, 0.05]
    for seconds in (49.3, 49.7, 50.4):
        robot.laser.take(scan_of(seconds, ranges=ranges if seconds == 49.7 else [3.0] * 31))
    state = state_of(robot)
    np.testing.assert_allclose(state.scan.ranges, [*[2.0] * 26, np.inf, np.inf, *[np.nan] * 3])
    np.testing.assert_allclose(state.scan.angles, np.linspace(-1.5, 1.5, 31), atol=1e-6)
    np.testing.assert_allclose(  # 0.3 m back, by 1 m/s
        BASE_FROM_CAMERA @ state.scan.camera_from_laser,
        [[-1, 0, 0, -0.2], [0, -1, 0, 0], [0, 0, 1, 0.3], [0, 0, 0, 1]], atol=1e-6)
    assert state.grid.cells.tolist() == [[100, 0, -1], [0, 0, 0]]
    assert robot.at(header_of(50 * 10**9, 'camera'), PARAMETERS).scan is None  # not asked for
    assert state_of(robot, 50.85).scan is None and 'odometry' in robot.problems['scan']
    assert state_of(robot, 50.45).scan is not None and 'scan' not in robot.problems
    robot.forget()
    assert state_of(robot).scan is None and 'no scan within 0.5 s' in robot.problems['scan']


@pytest.mark.parametrize(('fields', 'named'), [
    ({'angle_increment': 0.0}, 'angle_increment 0 '), ({'angle_increment': np.nan}, 'nan rad'),
    ({'angle_max': np.inf}, 'inf'), ({'ranges': [2.0] * 25}, '25 ranges'),
    ({'ranges': []}, 'has 0 '),
    ({'angle_min': -150.0, 'angle_max': 150.0, 'angle_increment': 10.0}, '10 rad'),
    ({'range_max': np.nan}, 'nan m'), ({'range_min': -1.0}, '-1 to'),
    ({'range_max': 0.1}, '0.1 m'), ({'ranges': [-2.0] * 31}, ' 0 valid'),
    ({'ranges': [np.nan] * 31}, ' 0 valid')])
def test_an_invalid_scan_is_left_out_and_named(robot, fields, named):
    robot.laser.take(scan_of(**fields))
    assert state_of(robot).scan is None
    assert named in robot.problems['scan']


@pytest.mark.parametrize(('fields', 'named'), [
    ({'resolution': 0.0}, 'resolution'), ({'resolution': np.nan}, 'resolution'),
    ({'width': 4}, '4 x 2'),
    ({'w': 0.0}, 'quaternion'), ({'frame_id': 'floor_2'}, "in frame 'floor_2', the map in 'map'")])
def test_an_invalid_grid_replaces_a_valid_one_and_is_named(robot, fields, named):
    robot.laser.take(scan_of())
    robot.laser.use(lambda: grid_from_msg(grid_of(**fields)))
    assert state_of(robot).scan is None and named in robot.problems['scan']
    robot.laser.use(lambda: grid_from_msg(grid_of()))
    assert state_of(robot).scan is not None


def test_a_fast_laser_fills_no_memory_and_a_jump_back_forgets_its_scans(robot):
    for number in range(500):
        robot.laser.take(scan_of(50.0 + 0.025 * number, intensities=[1.0] * 31))
    oldest, *others = robot.laser.scans
    assert (oldest.header.stamp, len(others)) == (stamp(52.5), 399) and not oldest.intensities
    robot.laser.take(scan_of(60.0))
    assert len(robot.laser.scans) == 1
