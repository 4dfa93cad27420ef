# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
import pytest
from builtin_interfaces.msg import Time as TimeMsg
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.time import Time

from cliploc_ros.ros.handoff import usable_pose

# x, xy, yx, y and yaw: the elements that AMCL reads
AMCL_READS = [0, 1, 6, 7, 35]


def stamped(seconds=100, covariance=None):
    pose = PoseWithCovarianceStamped()
    pose.header.stamp = TimeMsg(sec=seconds)
    pose.header.frame_id = 'map'
    if covariance is not None:
        pose.pose.covariance = covariance.ravel()
    return pose


def test_a_pose_without_any_scatter_gets_a_centimetre():
    covariance = usable_pose(stamped(), Time()).pose.covariance
    assert [covariance[i] for i in AMCL_READS] == [1e-4, 0.0, 0.0, 1e-4, 1e-5]


@pytest.mark.parametrize(('image_s', 'now_s', 'published_s'), [
    (100, 200, 100), (100, 100, 100), (200, 100, 100), (200, 0, 200), (-5, 100, -5)])
def test_the_stamp_is_the_images_but_not_later_than_now(image_s, now_s, published_s):
    pose = stamped(image_s)
    usable = usable_pose(pose, Time(seconds=now_s))
    assert usable.header.stamp.sec == published_s
    assert usable.header.frame_id == 'map'
    assert pose.header.stamp.sec == image_s, 'the published message is not changed'
