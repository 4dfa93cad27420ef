# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A robot that drives: looks that are joined, and a simulation that is reset on the way."""

import re
from itertools import count

import numpy as np
import pytest
from frames import stamp
from processes import wait_for
from rosgraph_msgs.msg import Clock
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from tester import RELIABLE, ask_until, transform_of
from watched import MOUNT, TICK_S, Robot

from cliploc_ros.core.geometry.transforms import pose_error


@pytest.fixture
def robot(tester):
    robot = Robot(tester)
    robot.has_localizer = False
    yield robot
    robot.close()


def ask(tester, robot):
    """Request a pose while the robot drives; return the answer."""
    future = tester.ask()
    wait_for(future.done, 'an answer', work=robot.step)
    return future.result()


# Boxes per image: one fewer than min_inliers.
BOXES = 3


def test_a_robot_that_sees_too_little_in_each_image_wakes_up(own_relocalizer, tester, robot):
    own_relocalizer(base_frame='base_link', base_from_camera=MOUNT, algorithm='auto',
                    min_inliers=BOXES + 1, timeout_s=20.0)
    truths, turns = {}, count()
    robot.speed_m_s = 0.08
    robot.sees = lambda seen: seen.select(
        np.unique((next(turns) + 4 * np.arange(BOXES)) % len(seen)))
    robot.on_tick = lambda now_s, _, odom_from_base: truths.update(
        {now_s: robot.start @ odom_from_base})
    # otherwise the first frames of a request have no odometry on a busy machine
    tester.wait(robot._odom.get_subscription_count, 'the subscription of odometry')
    answer = ask_until(ask, 'accepted: ', tester, robot)
    assert re.search(r' in \d+ images; ', answer.message), 'several are localized together'
    tester.wait(lambda: tester.poses, 'the pose')
    stamp, found = tester.poses[-1].header.stamp, transform_of(tester.poses[-1].pose.pose)
    truth = truths[min(truths, key=lambda at_s: abs(at_s - stamp.sec - 1e-9 * stamp.nanosec))]
    error = np.r_[truth[:3, 3] - found[:3, 3],
                  Rotation.from_matrix(truth[:3, :3] @ found[:3, :3].T).as_rotvec()]
    covariance = np.array(tester.poses[-1].pose.covariance).reshape(6, 6)
    assert np.linalg.norm(error[:3]) < 0.05 and np.linalg.norm(error[3:]) < np.radians(1.0)
    assert error @ np.linalg.solve(covariance, error) < chi2.ppf(0.95, 6)
    # no look has verified the camera
    assert np.sqrt(np.diag(covariance)[:3]).max() < 1.5


def test_the_first_request_after_a_reset_is_right(own_relocalizer, tester, robot):
    """The odometry of a simulation begins at a different place in each run."""
    process = own_relocalizer(
        base_from_camera=MOUNT, base_frame='base_link', algorithm='auto', use_sim_time=True,
        timeout_s=20.0)
    clock, times_s = tester.create_publisher(Clock, '/clock', RELIABLE), [100.0]

    def tick(now_s, *_):
        clock.publish(Clock(clock=stamp(now_s)))
        times_s.append(round(now_s + TICK_S, 6))
    robot.clock, robot.on_tick = lambda: times_s[-1], tick
    for _ in range(20):
        robot.step()
    robot.speed_m_s = 0.0
    for is_reset in (False, True):
        if is_reset:
            robot.carry(0.4)
            times_s.append(times_s[-1] - 5.0)
            clock.publish(Clock(clock=stamp(times_s[-1])))
        answer = ask(tester, robot)
        assert answer.success, answer.message
        tester.wait(lambda: tester.poses, 'the pose')
        error_m, error_deg = pose_error(transform_of(tester.poses[-1].pose.pose),
                                        robot.map_from_base)
        assert error_m < 0.05 and error_deg < 1.0, (error_m, error_deg)
        tester.forget()
    tester.destroy_publisher(clock)
    assert 'jumped back' in process.output()
    assert process.alive and 'Traceback' not in process.output()
