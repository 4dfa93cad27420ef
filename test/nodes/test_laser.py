# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Scans and the grid of map_server at a relocalizer: used, replaced at run time, and wrong."""

from dataclasses import replace

import numpy as np
import pytest
from diagnostic_msgs.srv import SelfTest
from frames import header_of, messages_of
from nav_msgs.msg import OccupancyGrid
from processes import wait_for
from rclpy.qos import qos_profile_sensor_data
from scene import level, make_room, see_room, write_map
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import LaserScan
from tester import PIXELS, transform_of

from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.ros.qos import LATCHED

SIDE_M, ORIGIN = 0.05, (-3.0, -4.0)
AXES = level(z=0.0)[:3, :3]  # of the room, whose z axis lies
ROOM = make_room()
ROOM = replace(ROOM, centers=ROOM.centers @ AXES.T, quats_xyzw=(
    Rotation.from_matrix(AXES) * Rotation.from_quat(ROOM.quats_xyzw)).as_quat())
MAP_FROM_BASE = level(-0.5, 0.3, 5.0, 0.0) @ np.linalg.inv(level(z=0.0))
ANGLES = np.linspace(-np.pi, np.pi, 720, endpoint=False)
MOUNTS = {'base_from_camera': '[0.0, 0.0, 0.4, -0.5, 0.5, -0.5, 0.5]',
          'base_from_laser': '[0.1, 0.0, 0.2, 0.0, 0.0, 0.0, 1.0]'}


def cells(size=(160, 240)):
    """Return a room with a pillar and half a wall."""
    found = np.zeros(size, np.int8)
    found[[0, -1]] = found[:, [0, -1]] = found[20:60, 150] = found[120:130, 40:60] = 100
    return found


def grid_of(cells, resolution=SIDE_M, frame_id='map', origin=ORIGIN):
    msg = OccupancyGrid(header=header_of(0, frame_id), data=cells.ravel().tobytes())
    msg.info.height, msg.info.width = cells.shape
    msg.info.resolution, msg.info.origin.orientation.w = resolution, 1.0
    msg.info.origin.position.x, msg.info.origin.position.y = origin
    return msg


def scan_of(at_s, cells=cells(), **fields):  # noqa: B008
    """Return the scan at MAP_FROM_BASE, by small steps along each beam."""
    x, y = (MAP_FROM_BASE @ [0.1, 0.0, 0.2, 1.0])[:2] - ORIGIN
    yaw, ways = np.arctan2(MAP_FROM_BASE[1, 0], MAP_FROM_BASE[0, 0]), np.arange(0, 20.0, 0.02)
    rows, columns = (np.clip((start + ways[:, None] * turn(yaw + ANGLES)) / SIDE_M, 0, most - 1)
                     .astype(int) for start, turn, most in zip(
                         (y, x), (np.sin, np.cos), cells.shape, strict=True))
    return LaserScan(header=header_of(round(at_s * 1e9), 'laser'), **{
        'angle_min': ANGLES[0], 'angle_max': ANGLES[-1], 'angle_increment': ANGLES[1] - ANGLES[0],
        'range_min': 0.05, 'range_max': 15.0,
        'ranges': ways[(cells[rows, columns] == 100).argmax(axis=0)].tolist()} | fields)


@pytest.fixture
def laser(own_relocalizer, tester, tmp_path):
    """Return a function that starts a relocalizer, and one that asks it while a laser scans."""
    write_map(ROOM, tmp_path / 'level.yaml')
    scans = tester.create_publisher(LaserScan, 'scan', qos_profile_sensor_data)
    frame_s = [100.0]

    def ask(**fields):
        """Return the fields of the answer for a robot at MAP_FROM_BASE, and its message."""
        frame_s[0] += 1.0
        seen = see_room(ROOM, MAP_FROM_BASE @ level(z=0.4))
        frame = messages_of(seen, header_of(round(frame_s[0] * 1e9), 'camera'), PIXELS)
        scan = scan_of(frame_s[0] + 0.03, **fields)
        future = client.call_async(SelfTest.Request())

        def scanned():
            scans.publish(scan)
            return future.done()
        tester.feed_until(scanned, frame)
        assert future.result().passed == b'\x01', future.result().status[0].message
        return {field.key: field.value for field in future.result().status[0].values} | {
            'message': future.result().status[0].message}

    def begin(**parameters):
        return own_relocalizer(map_file=tmp_path / 'level.yaml', scan='scan', base_frame='base',
                               algorithm='auto', time_budget_ms=300.0,
                               timeout_s=60.0, **MOUNTS, **parameters)
    client = tester.create_client(SelfTest, 'relocalizer/relocalize_fields')
    yield begin, ask
    tester.destroy_client(client)
    tester.destroy_publisher(scans)


def test_scans_are_compared_with_the_newest_grid(laser, tester):
    begin, ask = laser
    process = begin()

    def ask_until(text, **fields):
        wait_for(lambda: text in ask(**fields)['scan'], text)
    ask_until('no grid: nobody publishes /map')
    server = tester.create_publisher(OccupancyGrid, 'map', LATCHED)
    large = np.pad(cells(), ((0, 3840), (0, 3760)), constant_values=-1)
    for grid in (cells(), large):
        server.publish(grid_of(grid))
        ask_until('rank 1 of 2,000')
        assert pose_error(transform_of(tester.poses[-1].pose.pose), MAP_FROM_BASE)[0] < 0.05
        for wrong, named in (({'resolution': 0.0}, 'grid: '), (
                {'frame_id': 'floor_2'}, "in frame 'floor_2', the map in 'map'")):
            server.publish(grid_of(cells(), **wrong))
            ask_until(named)
    server.publish(grid_of(cells()))
    ask_until('angle_increment 0 rad', angle_increment=0.0)
    ask_until('beams explained')
    assert ', scan ' in ask()['message']
    tester.wait(lambda: 'localizing without the scan' in process.output(), 'the log')
    assert 'Traceback' not in process.output()
    tester.destroy_publisher(server)
