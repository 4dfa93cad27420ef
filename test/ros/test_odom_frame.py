# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
import sys

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from std_msgs.msg import Header

from cliploc_ros.core.geometry.transforms import transform_from_pose
from cliploc_ros.errors import OptionsError
from cliploc_ros.ros.inputs.coordinate_frames import BaseFrame, FrameError
from cliploc_ros.ros.outputs.map_to_odom import OdomFrame, transform_msg
from cliploc_ros.ros.parameter_tables import RELOCALIZER, relocalizer_options

VALUES = {row.name: row.default for row in RELOCALIZER} | {
    'publish_tf': True, 'base_frame': 'base_link', 'tf_timeout_s': 5.0}
STAMP = Time(sec=100)
QUARTER_LEFT = [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]


def test_a_transform_in_numbers():
    header = Header(frame_id='map', stamp=STAMP)
    msg = transform_msg(header, 'odom', transform_from_pose(np.array([1.0, 2.0, 3.0]),
                                                            np.array(QUARTER_LEFT)))
    t, q = msg.transform.translation, msg.transform.rotation
    assert (msg.header, msg.child_frame_id, (t.x, t.y, t.z)) == (header, 'odom', (1.0, 2.0, 3.0))
    np.testing.assert_allclose([q.x, q.y, q.z, q.w], QUARTER_LEFT)


def test_a_robot_is_needed():
    assert relocalizer_options(VALUES)
    with pytest.raises(OptionsError, match='publish_tf: needs the parameter base_frame'):
        relocalizer_options(VALUES | {'base_frame': ''})


@pytest.fixture
def odom_frame(make_node):
    node = make_node()
    base = BaseFrame(node)
    return node, base, OdomFrame(node, base)


def test_closed_it_does_nothing(odom_frame):
    _, _, frame = odom_frame
    frame.update(Header(frame_id='map', stamp=STAMP), np.eye(4), VALUES)
    frame.close()


def test_without_tf2_the_missing_package_is_named(odom_frame, monkeypatch):
    monkeypatch.setitem(sys.modules, 'tf2_ros', None)  # as where it is not installed
    with pytest.raises(FrameError, match='publish_tf is set, but tf2_ros is not installed'):
        odom_frame[2].open()


@pytest.mark.needs('tf2_ros')
def test_odom_is_tied_to_the_map(odom_frame, spin_until):
    node, base, frame = odom_frame
    from tf2_msgs.msg import TFMessage
    from tf2_ros import TransformBroadcaster
    base.listen()
    frame.open()
    broadcaster, heard = TransformBroadcaster(node), []
    odom_from_base = transform_from_pose(np.array([1.0, 0.0, 0.0]), np.array(QUARTER_LEFT))
    moving = transform_msg(Header(frame_id='odom', stamp=STAMP), 'base_link', odom_from_base)
    node.create_subscription(
        TFMessage, '/tf', lambda msg: heard.extend(
            one for one in msg.transforms if one.header.frame_id == 'map'), 10)

    def known():
        try:
            return base.lookup('base_link', 'odom', STAMP, 0.0) is not None
        except FrameError:
            return False
    spin_until([node], known, 'the transform', lambda: broadcaster.sendTransform(moving))
    map_from_base = transform_from_pose(np.array([5.0, 5.0, 0.0]), np.array(QUARTER_LEFT))
    frame.update(Header(frame_id='map', stamp=STAMP), map_from_base, VALUES)
    spin_until([node], lambda: heard, 'map -> odom')
    t = heard[0].transform.translation
    # the same heading in both, so that odom lies a metre behind, along its own x
    np.testing.assert_allclose([t.x, t.y, t.z], [4.0, 5.0, 0.0], atol=1e-9)
    assert heard[0].child_frame_id == 'odom'
    frame.close()
