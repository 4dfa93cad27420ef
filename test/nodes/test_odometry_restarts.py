# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""map -> odom of a relocalizer whose odometry restarts: it ends until the next accepted pose."""

import time

import numpy as np
import pytest
from nav_msgs.msg import Odometry
from processes import wait_for
from scene import MAP_FROM_CAMERA, make_room, see_room
from scipy.spatial.transform import Rotation
from std_msgs.msg import Header
from tester import RELIABLE, make_frame
from watched import BASE_FROM_CAMERA, MOUNT, stamp

from cliploc_ros.core.geometry.transforms import invert_transform, make_transform, pose_error
from cliploc_ros.ros.conversions import pose_to_msg
from cliploc_ros.ros.outputs.map_to_odom import transform_msg

pytestmark = pytest.mark.needs('tf2_ros')
ROOM = make_room()
MAP_FROM_BASE = MAP_FROM_CAMERA @ invert_transform(BASE_FROM_CAMERA)


def ahead(metres):
    return make_transform(np.eye(3), np.array([metres, 0.0, 0.0]))


class Wheels:
    """A robot that stands or drives slowly, its odometry on /odom and /tf, and its camera."""

    def __init__(self, tester, rate_hz, fills_twist):
        from tf2_ros import Buffer, TransformBroadcaster, TransformListener
        self._tester, self._period_s, self._fills_twist = tester, 1.0 / rate_hz, fills_twist
        self._odom = tester.create_publisher(Odometry, 'odom', RELIABLE)
        self._broadcaster, self._buffer = TransformBroadcaster(tester), Buffer()
        self._listener = TransformListener(self._buffer, tester)
        #: The truth (4, 4), and where odometry began in it.
        self.map_from_base, self.map_from_odom = MAP_FROM_BASE, MAP_FROM_BASE @ ahead(-2.0)
        self.speed_m_s, self.broadcasts = 0.0, []
        send = self._buffer.set_transform

        def hear(transform, authority):
            if transform.header.frame_id == 'map':
                self.broadcasts.append(transform_of_tf(transform))
            send(transform, authority)
        self._buffer.set_transform = hear

    def close(self):
        self._listener.unregister()
        self._tester.destroy_publisher(self._odom)

    def step(self):
        """Go on for a period of odometry, with an image at its end."""
        until = time.monotonic() + self._period_s
        self.map_from_base = self.map_from_base @ ahead(self.speed_m_s * self._period_s)
        odom_from_base = invert_transform(self.map_from_odom) @ self.map_from_base
        now_s = time.time()
        header = Header(frame_id='odom', stamp=stamp(now_s))
        odometry = Odometry(header=header, child_frame_id='base_link')
        odometry.pose.pose = pose_to_msg(odom_from_base)
        odometry.twist.twist.linear.x = self.speed_m_s * self._fills_twist
        self._odom.publish(odometry)
        self._broadcaster.sendTransform(transform_msg(header, 'base_link', odom_from_base))
        seen = see_room(ROOM, self.map_from_base @ BASE_FROM_CAMERA)
        self._tester.publish(make_frame(seen, now_s - 0.5 * self._period_s
                                        if not self.speed_m_s else now_s))
        while time.monotonic() < until:
            self._tester.spin()

    def ask(self):
        """Ask, and go on until there is an answer; return it."""
        future = self._tester.ask()
        wait_for(future.done, 'an answer', work=self.step)
        return future.result()

    def error_m(self):
        """Return how far the newest broadcast map -> odom leads from the truth."""
        return pose_error(self.broadcasts[-1], self.map_from_odom)[0]


def transform_of_tf(msg):
    t, q = msg.transform.translation, msg.transform.rotation
    return make_transform(Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(),
                          np.array([t.x, t.y, t.z]))


@pytest.fixture(scope='module')
def publishing(start_shared, tester, room_map):
    process = start_shared('nodes.relocalizer', parameters={
        'map_file': room_map, 'matching': 'class', 'algorithm': 'bf', 'base_frame': 'base_link',
        'base_from_camera': MOUNT, 'publish_tf': True, 'require_localizer': False})
    process.wait_for_output('ready after')
    tester.connect()
    yield process
    assert 'Traceback' not in process.output()


@pytest.mark.parametrize(('rate_hz', 'gap_s', 'fills_twist'), [(5, 0.4, False), (20, 0.15, True)])
def test_a_restart_ends_the_broadcast_until_the_next_pose(publishing, tester, rate_hz, gap_s,
                                                          fills_twist):
    wheels = Wheels(tester, rate_hz, fills_twist)
    for origin_m in (0.0, -2.3):  # after the first restart it is as right as before
        answer = wheels.ask()
        assert answer.success, answer.message
        wait_for(lambda: wheels.broadcasts, 'map -> odom', work=wheels.step)
        assert wheels.error_m() < 0.01
        wheels.speed_m_s = 0.3
        for _ in range(rate_hz):
            wheels.step()
        assert wheels.error_m() < 0.01, 'it goes on while the robot drives'
        wheels.speed_m_s = 0.0
        time.sleep(gap_s)
        wheels.map_from_odom = wheels.map_from_base @ ahead(origin_m)
        for _ in range(rate_hz):
            wheels.step()
        wheels.broadcasts.clear()
        for _ in range(rate_hz):
            wheels.step()
        assert not wheels.broadcasts
    wheels.close()
