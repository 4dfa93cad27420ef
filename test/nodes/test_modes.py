# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The relocalizer as a process: inputs, modes, frames, floods and shutdown."""

import signal

import cv2
import numpy as np
import pytest
from scene import MAP_FROM_CAMERA
from sensor_msgs.msg import CompressedImage
from tester import make_frame, transform_of

from cliploc_ros.core.geometry.transforms import (
    invert_transform,
    move_covariance,
    pose_error,
    transform_from_pose,
)


def test_compressed_images(own_relocalizer, tester):
    own_relocalizer(image_transport='compressed')
    image, info, detections = make_frame()
    data = cv2.imencode('.jpg', np.zeros((480, 640, 3), dtype=np.uint8))[1].tobytes()
    good = CompressedImage(header=image.header, format='jpeg', data=data)
    assert tester.relocalize((good, info, detections)).success
    for broken in (b'', b'not a picture', data[:100]):
        bad = CompressedImage(header=image.header, format='jpeg', data=broken)
        answer = tester.relocalize((bad, info, detections))
        assert not answer.success
        assert 'does not decode' in answer.message
    assert tester.relocalize((good, info, detections)).success


def test_continuous_mode_publishes_without_being_asked(own_relocalizer, tester):
    process = own_relocalizer(mode='continuous')
    for stamp_s in (1, 2, 1):
        tester.feed_until(
            lambda s=stamp_s: tester.poses and tester.poses[-1].header.stamp.sec == s,
            make_frame(stamp_s=float(stamp_s)), 'a pose')
    assert not tester.initial_poses  # a running localizer is never reset without a request
    assert tester.relocalize(make_frame(stamp_s=3.0)).success
    tester.wait(lambda: tester.initial_poses, 'an initial pose')
    assert process.stop()[0] == 0


def test_the_mount_moves_the_pose_and_its_covariance(own_relocalizer, tester):
    own_relocalizer()
    assert tester.relocalize(make_frame()).success
    mount = [0.1, 0.0, 1.0, 0.0, 0.6, 0.0, 0.8]
    assert tester.set_parameter('base_from_camera', mount).successful
    assert tester.set_parameter('base_frame', 'base_link').successful
    assert tester.relocalize(make_frame()).success
    tester.wait(lambda: len(tester.poses) == 2, 'the poses of camera and base')
    camera, base = (transform_of(pose.pose.pose) for pose in tester.poses)
    camera_from_base = invert_transform(
        transform_from_pose(np.array(mount[:3]), np.array(mount[3:])))
    assert pose_error(base, MAP_FROM_CAMERA @ camera_from_base) < (0.08, 1.0)
    of_camera, of_base = (np.array(pose.pose.covariance).reshape(6, 6) for pose in tester.poses)
    moved = move_covariance(of_camera, base[:3, 3] - camera[:3, 3])
    assert np.abs(moved - of_camera).max() > 1e-6
    np.testing.assert_allclose(of_base, moved, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_request_is_answered_when_its_node_is_told_to_stop(own_relocalizer, tester, number):
    process = own_relocalizer(timeout_s=30.0)
    future = tester.ask()
    tester.wait(tester.listened_to, 'the request to wait for images')
    process.send(number)
    answer = tester.answer(future)
    assert not answer.success and 'shutting down' in answer.message
    tester.wait(lambda: not process.alive, 'its end')
    assert process.stop()[0] == 0
    assert 'internal error' not in process.output() and 'Traceback' not in process.output()
