# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A camera that moves on its robot: tf2 is queried, and waited for, at the image's stamp."""

import numpy as np
import pytest
from scene import MAP_FROM_CAMERA
from tester import make_frame, transform_of

from cliploc_ros.core.geometry.transforms import invert_transform, pose_error, transform_from_pose
from cliploc_ros.ros.conversions import transform_msg

pytestmark = pytest.mark.needs('tf2_ros')


def base_from_camera(height_m):
    """Return the mount of a camera on a lift that looks to the side."""
    return transform_from_pose(np.array([0.1, 0.2, height_m]), np.array([0.0, 0.6, 0.0, 0.8]))


@pytest.fixture
def lift(tester):
    """Publish the camera's heights [m] by time [s] to tf2."""
    from tf2_msgs.msg import TFMessage
    publisher = tester.create_publisher(TFMessage, '/tf', 100)

    def tell(heights_m):
        transforms = []
        for at_s, height_m in heights_m.items():
            header = make_frame(stamp_s=at_s)[0].header
            camera, header.frame_id = header.frame_id, 'base_link'
            transforms.append(transform_msg(header, camera, base_from_camera(height_m)))
        publisher.publish(TFMessage(transforms=transforms))
    yield tell
    tester.destroy_publisher(publisher)


def test_the_mount_is_the_one_at_the_images_stamp(own_relocalizer, tester, lift):
    process = own_relocalizer(expect='', base_frame='base_link', tf_timeout_s=0.5)
    frame = make_frame(stamp_s=100.5)
    future = tester.ask()

    def answered():
        lift({100.0: 1.0, 101.0: 2.0, 103.0: 9.0})
        return future.done()
    tester.feed_until(answered, frame)
    assert future.result().success, future.result().message
    tester.wait(lambda: tester.poses and tester.initial_poses, 'the poses')
    truth = MAP_FROM_CAMERA @ invert_transform(base_from_camera(1.5))
    for pose in (tester.poses[0], tester.initial_poses[0]):
        error_m, error_deg = pose_error(transform_of(pose.pose.pose), truth)
        assert error_m < 0.08 and error_deg < 1.0
    assert process.alive
