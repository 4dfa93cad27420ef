# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The studio's live view: real nodes, and the page in a real browser."""

from concurrent.futures import ThreadPoolExecutor

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


def test_without_a_relocalizer(live):
    for request in (live.relocalize, live.reload_map):
        with pytest.raises(LiveError, match='/relocalizer'):
            request()


def test_answers_one_request_at_a_time(live, own_relocalizer, tester):
    own_relocalizer()
    wait_for(lambda: '12 landmarks' in live.state.values.get('map', ''), 'diagnostics')
    assert live.state.is_heard and live.state.base_frame == ''
    with ThreadPoolExecutor(1) as pool:
        outcome = pool.submit(live.relocalize)
        wait_for(lambda: live._turn.locked(), 'the request')
        with pytest.raises(LiveError, match='another request is waiting'):
            live.relocalize()
        tester.feed_until(outcome.done, make_frame(stamp_s=31.5))
    assert outcome.result().startswith('accepted: x 0.3')
    wait_for(lambda: live.state.pose is not None and live.state.is_current, 'the pose')
    assert live.state.pose.frame_id == 'map' and live.state.pose.stamp_s == 31.5
    assert np.linalg.eigvalsh(live.state.pose.covariance).min() > 0
    assert live.reload_map().startswith('loaded: 12 ')


def test_invalid_poses_are_left_out(live, tester):
    publisher = tester.create_publisher(PoseWithCovarianceStamped, 'relocalizer/pose', RELIABLE)
    tester.wait(lambda: publisher.get_subscription_count() >= 2, 'discovery')
    for x, y, w in ((np.nan, 0.0, 1.0), (0.0, 0.0, np.nan), (0.0, 2.5, 1.0)):
        msg = PoseWithCovarianceStamped()
        msg.header.frame_id = 'map'
        msg.pose.pose.position.x, msg.pose.pose.position.y = x, y
        msg.pose.pose.orientation.w = w
        publisher.publish(msg)
    wait_for(lambda: live.state.pose is not None, 'the valid pose')
    assert live.state.pose.map_from_body[1, 3] == 2.5
    tester.destroy_publisher(publisher)
