# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Priors of a relocalizer by the topic ~/prior."""

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from scene import doubled_room, write_map
from tester import RELIABLE, ask_until, make_frame

from cliploc_ros.ros.qos import LATCHED

TWINS = doubled_room(np.array([10.0, 0.0, 0.0])).select(range(21))
# Enough on a busy machine as well.
SEARCH = {'algorithm': 'auto', 'time_budget_ms': 2000.0}


def at(x_m, frame_id='map'):
    msg = PoseWithCovarianceStamped()
    msg.header.frame_id, msg.pose.pose.position.x = frame_id, x_m
    msg.pose.pose.orientation.w = 1.0
    msg.pose.covariance = np.diag([0.25, 0.25, 0.0, 0.0, 0.0, 10.0]).ravel()
    return msg


def test_the_topic_decides_between_rooms_that_look_alike(own_relocalizer, tester, tmp_path):
    """They are 10 m apart along x; the second lacks three objects of the first."""
    write_map(TWINS, tmp_path / 'twins.yaml')
    process, publishers = own_relocalizer(map_file=tmp_path / 'twins.yaml', **SEARCH), []

    def relocalized(prior, expect, profile=LATCHED):
        """Publish a prior until it is received; return the answer of a request with a text."""
        publishers.append(tester.create_publisher(type(prior), 'relocalizer/prior', profile))
        # ~/prior reaches volatile and transient local subscriptions
        tester.wait(lambda: publishers[-1].get_subscription_count() >= 1 + (profile is LATCHED),
                    'the subscription')
        publishers[-1].publish(prior)
        return ask_until(tester.relocalize, expect, make_frame()).message
    assert 'kind look_alike' in tester.relocalize(make_frame()).message
    assert 'refused' in relocalized(at(10.0), 'prior')  # wrong: the other room has all objects
    assert 'x 0.3' in relocalized(at(0.0), 'accepted', RELIABLE)
    assert 'look_alike' in relocalized(at(np.nan), 'refused')
    assert 'without the prior: the pose has NaN' in process.output()
    relocalized(at(0.0, frame_id='elsewhere'), 'refused')
    for publisher in publishers:
        tester.destroy_publisher(publisher)
