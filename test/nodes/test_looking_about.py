# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A robot that looks around until it is localized: frames joined by real odometry messages."""

from itertools import count

import numpy as np
from processes import wait_for
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from tester import ask_until, transform_of
from watched import MOUNT, Robot

# Boxes per image: one fewer than min_inliers.
BOXES = 3


def test_a_robot_that_sees_too_little_in_each_image_wakes_up(own_relocalizer, tester):
    own_relocalizer(base_frame='base_link', base_from_camera=MOUNT, algorithm='auto',
                    min_inliers=BOXES + 1, timeout_s=20.0)
    robot, truths, turns = Robot(tester), {}, count()
    robot.speed_m_s, robot.has_localizer = 0.08, False
    robot.sees = lambda seen: seen.select(
        np.unique((next(turns) + 4 * np.arange(BOXES)) % len(seen)))
    robot.on_tick = lambda now_s, _, odom_from_base: truths.update(
        {now_s: robot.start @ odom_from_base})
    # otherwise the first frames of a request have no odometry on a busy machine
    tester.wait(robot._odom.get_subscription_count, 'the subscription of odometry')

    def ask():
        future = tester.ask()
        wait_for(future.done, 'an answer', work=robot.step)
        return future.result()
    answer = ask_until(ask, 'accepted: ')
    assert ' frames, ' in answer.message, 'several are localized together'
    tester.wait(lambda: tester.poses, 'the pose')
    stamp, found = tester.poses[-1].header.stamp, transform_of(tester.poses[-1].pose.pose)
    truth = truths[min(truths, key=lambda at_s: abs(at_s - stamp.sec - 1e-9 * stamp.nanosec))]
    error = np.r_[truth[:3, 3] - found[:3, 3],
                  Rotation.from_matrix(truth[:3, :3] @ found[:3, :3].T).as_rotvec()]
    covariance = np.array(tester.poses[-1].pose.covariance).reshape(6, 6)
    assert np.linalg.norm(error[:3]) < 0.05 and np.linalg.norm(error[3:]) < np.radians(1.0)
    assert error @ np.linalg.solve(covariance, error) < chi2.ppf(0.95, 6)
    assert np.sqrt(np.diag(covariance)[:3]).max() < 1.0
    robot.close()
