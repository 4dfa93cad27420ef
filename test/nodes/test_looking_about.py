# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A robot that looks around until it is localized: frames joined by real odometry messages."""


import numpy as np
import pytest
from nav_msgs.msg import Odometry
from processes import wait_for
from scene import CAMERA, MAP_FROM_CAMERA, boxes_of, make_room
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from std_msgs.msg import Header
from tester import RELIABLE, make_frame, transform_of
from watched import BASE_FROM_CAMERA, MOUNT, stamp

from cliploc_ros.core.geometry.transforms import invert_transform, make_transform
from cliploc_ros.core.observation import Detections
from cliploc_ros.ros.conversions import pose_to_msg

ROOM = make_room()
MAP_FROM_BASE = MAP_FROM_CAMERA @ invert_transform(BASE_FROM_CAMERA)
ODOM_FROM_MAP = make_transform(Rotation.from_euler('z', 70, degrees=True).as_matrix(),
                               np.array([3.0, -4.0, 1.0]))
START_S = 100.0
# Boxes per view, nearest to its middle: one fewer than min_inliers.
BOXES = 3
PARAMETERS = {'base_frame': 'base_link', 'base_from_camera': MOUNT, 'algorithm': 'auto',
              'min_inliers': BOXES + 1, 'timeout_s': 20.0, 'max_turn_rad_s': 1.0}


def turned(yaw_deg):
    """Return the pose of the robot's base after a turn on the spot."""
    turn = Rotation.from_euler('z', yaw_deg, degrees=True).as_matrix()
    return MAP_FROM_BASE @ make_transform(turn, np.zeros(3))


def look(yaw_deg, stamp_s):
    """Return the messages of a frame of a robot that has turned."""
    map_from_camera = turned(yaw_deg) @ BASE_FROM_CAMERA
    ahead = (ROOM.centers - map_from_camera[:3, 3]) @ map_from_camera[:3, 2]
    in_front = np.nonzero(ahead > 1.0)[0]
    boxes = boxes_of(ROOM, map_from_camera)[in_front]
    aside = np.abs(0.5 * (boxes[:, 0] + boxes[:, 2]) - CAMERA.cx)
    middle = np.sort(np.argsort(aside)[:BOXES])
    return make_frame(Detections(boxes[middle], tuple(ROOM.class_ids[in_front[row]]
                                                      for row in middle),
                                 np.full(len(middle), 0.9)), stamp_s)


def swept(now_s, turn_deg_s):
    """Return the yaw of a robot that looks to and fro over 48 degrees."""
    return abs((turn_deg_s * (now_s - START_S) + 48.0) % 96.0 - 48.0) - 24.0


class Robot:
    """Publishes its odometry continuously, and turns on the spot during requests."""

    def __init__(self, tester):
        self._tester = tester
        self._odom = tester.create_publisher(Odometry, 'odom', RELIABLE)
        self._now_s = START_S

    def close(self):
        self._tester.destroy_publisher(self._odom)

    def step(self, turn_deg_s, change):
        """Turn for 0.12 s, with an image between two messages of odometry."""
        for tick in range(6):
            odometry = Odometry(child_frame_id='base_link', header=Header(
                frame_id='odom', stamp=stamp(self._now_s)))
            odometry.pose.pose = pose_to_msg(ODOM_FROM_MAP
                                             @ turned(swept(self._now_s, turn_deg_s)))
            change(odometry, self._now_s)
            self._odom.publish(odometry)
            self._now_s = START_S + 0.02 * round((self._now_s - START_S) / 0.02 + 1)
            if tick == 2:
                stamp_s = self._now_s - 0.01
                self._tester.publish(look(swept(stamp_s, turn_deg_s), stamp_s))
        for _ in range(8):
            self._tester.spin()

    def ask(self, turn_deg_s, change=lambda odometry, now_s: None):
        """Request a pose, and turn until the answer arrives; return it."""
        future = self._tester.ask()
        wait_for(future.done, 'an answer', work=lambda: self.step(turn_deg_s, change))
        return future.result()


@pytest.fixture
def robot(tester):
    robot = Robot(tester)
    # otherwise the first frames of a request have no odometry on a busy machine
    tester.wait(robot._odom.get_subscription_count, 'the subscription of odometry')
    yield robot
    robot.close()


@pytest.fixture(scope='module')
def looking(start_shared, tester, room_map):
    """Return a relocalizer for the robot's camera, ready for requests."""
    process = start_shared('nodes.relocalizer', parameters={
        'map_file': room_map, 'matching': 'class', **PARAMETERS})
    process.wait_for_output('ready after')
    tester.connect()
    yield process
    assert process.alive and 'Traceback' not in process.output()


def error_of(pose, turn_deg_s):
    """Return the error of a published pose: x, y, z [m] and about the map's axes [rad]."""
    stamp_s = pose.header.stamp.sec + 1e-9 * pose.header.stamp.nanosec
    found, truth = transform_of(pose.pose.pose), turned(swept(stamp_s, turn_deg_s))
    return np.r_[truth[:3, 3] - found[:3, 3],
                 Rotation.from_matrix(truth[:3, :3] @ found[:3, :3].T).as_rotvec()]


def test_a_robot_that_turns_wakes_up(looking, tester, robot):
    answer = robot.ask(turn_deg_s=20.0)
    assert answer.success, answer.message
    assert ' frames in ' in answer.message
    tester.wait(lambda: tester.poses and tester.initial_poses, 'the pose')
    error = error_of(tester.poses[-1], 20.0)
    covariance = np.array(tester.poses[-1].pose.covariance).reshape(6, 6)
    print(f'\n{answer.message}: {np.linalg.norm(error[:3]):.4f} m, '
          f'{np.degrees(np.linalg.norm(error[3:])):.3f} deg')
    assert np.linalg.norm(error[:3]) < 0.05 and np.linalg.norm(error[3:]) < np.radians(1.0)
    assert error @ np.linalg.solve(covariance, error) < chi2.ppf(0.95, 6)
    assert np.sqrt(np.diag(covariance)[:3]).max() < 0.5
