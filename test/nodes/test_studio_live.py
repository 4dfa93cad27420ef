# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The studio's live view: real nodes, and the page in a real browser."""

import threading
from contextlib import contextmanager

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from processes import wait_for
from tester import RELIABLE, make_frame

from cliploc_ros.offline.studio.live import LiveError, follow_relocalizer


@pytest.fixture
def live(ros):
    with follow_relocalizer('relocalizer') as live:
        yield live


@contextmanager
def in_a_thread(action):
    """Run a function in a thread; yield the list that receives its result or error."""
    outcome = []

    def run():
        try:
            outcome.append(action())
        except LiveError as error:
            outcome.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    yield outcome
    thread.join(60.0)


def test_without_a_relocalizer(live):
    for request in (live.relocalize, live.reload_map):
        with pytest.raises(LiveError, match='/relocalizer'):
            request()


def test_answers_one_request_at_a_time(live, own_relocalizer, tester):
    own_relocalizer()
    wait_for(lambda: '12 landmarks' in live.state.values.get('map', ''), 'diagnostics')
    assert live.state.is_heard and live.state.base_frame == ''
    with in_a_thread(live.relocalize) as outcome:
        wait_for(lambda: live._turn.locked(), 'the request')
        with pytest.raises(LiveError, match='another request is waiting'):
            live.relocalize()
        tester.feed_until(lambda: outcome, make_frame(stamp_s=31.5))
    assert outcome[0].startswith('accepted: x 0.3')
    wait_for(lambda: live.state.pose is not None and live.state.is_current, 'the pose')
    assert live.state.pose.frame_id == 'map' and live.state.pose.stamp_s == 31.5
    assert np.linalg.eigvalsh(live.state.pose.covariance).min() > 0
    assert live.reload_map().startswith('loaded: 12 ')


def test_invalid_poses_are_left_out(live, tester):
    publisher = tester.create_publisher(PoseWithCovarianceStamped, 'relocalizer/pose', RELIABLE)
    msg = PoseWithCovarianceStamped()
    msg.header.frame_id = 'map'
    msg.pose.pose.orientation.w = 1.0
    publisher_matched = lambda: publisher.get_subscription_count() >= 2  # noqa: E731
    tester.wait(publisher_matched, 'discovery')
    for change in ('position.x', 'orientation.w'):
        part, name = change.split('.')
        old = getattr(getattr(msg.pose.pose, part), name)
        setattr(getattr(msg.pose.pose, part), name, float('nan'))
        publisher.publish(msg)
        setattr(getattr(msg.pose.pose, part), name, old)
    msg.pose.pose.position.y = 2.5
    publisher.publish(msg)
    wait_for(lambda: live.state.pose is not None, 'the valid pose')
    assert live.state.pose.map_from_body[1, 3] == 2.5
    tester.destroy_publisher(publisher)
