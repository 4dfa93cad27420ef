# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The relocalizer as a process: requests and answers."""

import time
from dataclasses import replace

import numpy as np
from rclpy.qos import QoSProfile, ReliabilityPolicy
from scene import CAMERA, MAP_FROM_CAMERA, make_room, see_room
from sensor_msgs.msg import Image, RegionOfInterest
from tester import make_frame, transform_of

from cliploc_ros.core.geometry.transforms import pose_error


def test_a_request_is_answered_with_a_pose(relocalizer, tester):
    answer = tester.relocalize(make_frame(stamp_s=12.5))
    assert answer.success
    assert answer.message.startswith('accepted: x 0.3')
    tester.wait(lambda: tester.poses and tester.initial_poses and tester.hypotheses, 'poses')
    pose = tester.poses[0]
    assert pose == tester.initial_poses[0]
    assert (pose.header.frame_id, pose.header.stamp.sec, pose.header.stamp.nanosec) == (
        'map', 12, 500_000_000)
    assert pose_error(transform_of(pose.pose.pose), MAP_FROM_CAMERA) < (0.05, 1.0)
    covariance = np.array(pose.pose.covariance).reshape(6, 6)
    assert np.linalg.eigvalsh(covariance).min() > 0
    assert tester.hypotheses[0].poses[0] == pose.pose.pose


def test_a_region_of_a_binned_sensor_gives_the_same_pose(relocalizer, tester):
    """A pixel is two by two of the sensor's; its first 40 columns and 20 rows are left out."""
    seen = see_room(make_room())
    boxes = np.clip(seen.bboxes_xyxy - [20, 10, 20, 10], 0, [
        CAMERA.width - 20, CAMERA.height - 10] * 2)
    window = make_frame(replace(seen, bboxes_xyxy=boxes))
    pixels = np.frombuffer(window[0].data, np.uint8).reshape(CAMERA.height, CAMERA.width, 3)
    window[0].data = pixels[10:, 20:].tobytes()
    window[0].height, window[0].width = CAMERA.height - 10, CAMERA.width - 20
    window[0].step = 3 * window[0].width
    window[1].height, window[1].width = 2 * CAMERA.height, 2 * CAMERA.width
    window[1].k = (np.diag([2.0, 2.0, 1.0]) @ CAMERA.matrix).ravel()
    window[1].binning_x = window[1].binning_y = 2
    window[1].roi = RegionOfInterest(x_offset=40, y_offset=20, width=2 * CAMERA.width - 40,
                                     height=2 * CAMERA.height - 20, do_rectify=True)
    assert tester.relocalize(window).success
    tester.wait(lambda: tester.poses, 'a pose')
    assert pose_error(transform_of(tester.poses[0].pose.pose), MAP_FROM_CAMERA) < (0.05, 1.0)
    window[1].binning_x = 0
    answer = tester.relocalize(window)
    assert not answer.success
    assert 'binning 1x2' in answer.message


def test_the_navigation_stacks_own_service_wakes_up_too(relocalizer, tester):
    tester.feed_until(tester.ask_reinitialize().done, make_frame())
    tester.wait(lambda: tester.initial_poses, 'an initial pose')


def test_between_requests_nothing_is_listened_to(relocalizer, tester):
    assert tester.relocalize(make_frame()).success
    tester.wait(lambda: tester.listened_to() == 0, 'the subscriptions to end')
    before, start = relocalizer.cpu_s(), time.monotonic()
    tester.wait(lambda: time.monotonic() - start > 2.0, 'two seconds')
    idle = (relocalizer.cpu_s() - before) / (time.monotonic() - start)
    print(f'\nidle between requests: {100 * idle:.1f} % of a core')
    assert idle < 0.05


def test_frames_out_of_order_and_time_going_back(relocalizer, tester):
    for stamp_s in (50.0, 10.0, 3600.0, 0.0):
        assert tester.relocalize(make_frame(stamp_s=stamp_s)).success
    newer, older = make_frame(stamp_s=80.0), make_frame(stamp_s=70.0)
    future = tester.ask()
    tester.feed_until(future.done, [newer[0], older[0], older[1], newer[1], older[2]])
    assert future.result().success
    tester.wait(lambda: tester.poses[-1].header.stamp.sec == 70, 'the older frame')


def test_two_requests_at_once_are_both_answered(relocalizer, tester):
    futures = [tester.ask(), tester.ask(), tester.ask_reinitialize()]
    tester.feed_until(lambda: all(future.done() for future in futures), make_frame())
    assert futures[0].result().success
    assert futures[1].result().success


def test_requests_that_wait_together_reset_the_localizer_once(relocalizer, tester):
    futures = [tester.ask() for _ in range(10)]
    tester.wait(lambda: tester.listened_to() > 0, 'the relocalizer to listen')
    tester.feed_until(lambda: all(future.done() for future in futures), make_frame())
    assert all(future.result().success for future in futures)
    tester.wait(lambda: tester.initial_poses, 'an initial pose')
    # those that came after the frame was taken ask for a newer one, together
    assert len(tester.initial_poses) <= 3


def test_the_camera_may_change_its_qos_between_requests(relocalizer, tester):
    """A camera driver is restarted, first reliable, then best effort."""
    for reliability in (ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT,
                        ReliabilityPolicy.RELIABLE):
        tester.destroy_publisher(tester.images)
        tester.images = tester.create_publisher(
            Image, 'image', QoSProfile(depth=10, reliability=reliability))
        assert tester.relocalize(make_frame()).success
