# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Handing a pose over to a running localizer: a robot that stands, moves, or says nothing."""

import time
from itertools import pairwise

import pytest
from nav_msgs.msg import Odometry
from std_srvs.srv import Empty
from tester import make_frame

pytestmark = pytest.mark.full


@pytest.fixture
def updates(tester):
    """Serve what AMCL serves; keep when it was called, and how many poses had come by then."""
    calls = []

    def update(request, response):
        calls.append((time.monotonic(), len(tester.initial_poses)))
        return response
    service = tester.create_service(Empty, 'request_nomotion_update', update)
    yield calls
    tester.destroy_service(service)


@pytest.fixture
def odom(tester):
    publisher = tester.create_publisher(Odometry, 'odom', 10)

    def feed(**speeds):
        """Ask, and publish a frame and odometry until there is an answer."""
        frame = make_frame(stamp_s=time.monotonic() + 0.3)  # odometry begins before it
        odometry = Odometry()
        odometry.header.frame_id, odometry.child_frame_id = 'odom', 'base_link'
        odometry.twist.twist.linear.x = speeds.get('drive', 0.0)
        odometry.twist.twist.angular.z = speeds.get('turn', 0.0)
        future = tester.ask()

        def answered():
            if speeds:
                now_s = time.monotonic()
                odometry.header.stamp = make_frame(stamp_s=now_s)[0].header.stamp
                odometry.pose.pose.position.x = speeds.get('poses', 0.0) * now_s
                publisher.publish(odometry)
            return future.done()
        tester.feed_until(answered, frame)
        return future.result()
    yield feed
    tester.destroy_publisher(publisher)
    ended_s = time.monotonic()
    tester.wait(lambda: time.monotonic() > ended_s + 2.0, 'what was heard to be too old')


def test_a_standing_robot_settles_before_the_answer(relocalizer, tester, updates, odom):
    tester.wait(lambda: tester.count_clients('/request_nomotion_update') == 1, 'the client')
    answer = odom(drive=0.0)
    assert answer.success
    assert len(updates) == 10, relocalizer.output()
    gaps_s = [later[0] - earlier[0] for earlier, later in pairwise(updates)]
    assert min(gaps_s) > 0.1, 'a scan lies between them'
    assert len(tester.initial_poses) == 1
    assert all(poses == 1 for _, poses in updates[1:]), 'the pose comes first'


@pytest.mark.parametrize('speeds', [{'drive': 0.5}, {'drive': -0.5}, {'turn': 1.0},
                                    {'drive': float('nan')}, {'poses': 0.5}])
def test_a_moving_robot_is_not_reset(relocalizer, tester, updates, odom, speeds):
    answer = odom(**speeds)
    assert not answer.success
    assert answer.message.startswith('withheld: the robot moves at ')
    assert 'accepted: x 0.3' in answer.message
    tester.wait(lambda: tester.poses, 'the pose itself')
    assert not tester.initial_poses
    assert not updates
