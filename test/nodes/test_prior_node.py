# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Priors of a relocalizer: the topic ~/prior, and its last pose."""



import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from scene import doubled_room, write_map
from tester import RELIABLE, ask_until, make_frame

from cliploc_ros.ros.qos import LATCHED

TWINS = doubled_room(np.array([10.0, 0.0, 0.0])).select(range(21))
# enough on a busy machine as well
SEARCH = {'algorithm': 'auto', 'time_budget_ms': 2000.0}


@pytest.fixture
def twins_map(tmp_path):
    """Return two rooms, 10 m apart along x; the second lacks three objects of the first."""
    path = tmp_path / 'twins.yaml'
    write_map(TWINS, path)
    return path


def at(x_m, frame_id='map', deviation=0.5, yaw_variance=10.0):
    msg = PoseWithCovarianceStamped()
    msg.header.frame_id, msg.pose.pose.position.x = frame_id, x_m
    msg.pose.pose.orientation.w = 1.0
    msg.pose.covariance = np.diag([deviation ** 2] * 2 + [0.0] * 3 + [yaw_variance]).ravel()
    return msg


@pytest.fixture
def tell(tester):
    """Publish on a topic of the relocalizer until it is received and, if given, logged."""
    made = []

    def publish(process, msg, expect='', profile=LATCHED, topic='relocalizer/prior'):
        publisher = tester.create_publisher(type(msg), topic, profile)
        made.append(publisher)
        # ~/prior reaches volatile and transient local subscriptions
        matched = 2 if topic.endswith('prior') and profile is LATCHED else 1
        tester.wait(lambda: publisher.get_subscription_count() >= matched, 'the subscription')
        publisher.publish(msg)
        if expect:
            process.wait_for_output(expect)
    yield publish
    for each in made:
        tester.destroy_publisher(each)


def test_the_topic_decides_between_rooms_that_look_alike(own_relocalizer, tester, tell,
                                                         twins_map):
    process = own_relocalizer(map_file=twins_map, **SEARCH)

    def relocalized(expect):
        return ask_until(tester.relocalize, expect, make_frame()).message
    assert 'kind look_alike' in tester.relocalize(make_frame()).message
    tell(process, at(10.0))  # wrong: the other room has all objects
    assert 'refused' in relocalized('prior')
    tell(process, at(0.0), profile=RELIABLE)
    assert 'x 0.3' in relocalized('accepted')
    for invalid in (at(0.0, deviation=0.0), at(np.nan), at(0.0, deviation=np.nan)):
        seen = process.output().count('~/prior: ')
        tell(process, invalid)
        tester.wait(lambda n=seen: process.output().count('~/prior: ') > n, 'the reason')
        assert 'look_alike' in relocalized('refused')
    tell(process, at(0.0, frame_id='elsewhere'))
    tester.feed_until(lambda: tester.ask() and 'without the prior: '
                      in process.output(), make_frame())
    tell(process, at(0.0))
    relocalized('accepted')
    tell(process, at(0.0, frame_id=''))
    relocalized('refused')
