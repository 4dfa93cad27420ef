# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Visualization topics of the relocalizer, for subscribers."""

from contextlib import contextmanager

import numpy as np
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from scene import make_room
from sensor_msgs.msg import Image
from tester import make_frame
from visualization_msgs.msg import Marker, MarkerArray

from cliploc_ros.messages import image_from_msg

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE,
                     durability=DurabilityPolicy.TRANSIENT_LOCAL)


@contextmanager
def looking(tester, message_type, name, profile=10):
    """Collect messages on a topic of the relocalizer, once the publisher knows the subscriber."""
    topic, heard = f'relocalizer/{name}', []
    subscription = tester.create_subscription(message_type, topic, heard.append, profile)
    try:
        yield heard
    finally:
        tester.destroy_subscription(subscription)


def test_whoever_looks_sees_the_map_early_or_late(own_relocalizer, tester, room_map, tmp_path):
    path = tmp_path / 'map.yaml'
    path.write_text(room_map.read_text())
    own_relocalizer(map_file=path)
    labels = set(make_room().labels)
    with looking(tester, MarkerArray, 'landmarks', LATCHED) as early:
        tester.wait(lambda: early, 'the map')
        assert {marker.text for marker in early[0].markers} == labels | {''}
        with looking(tester, MarkerArray, 'landmarks', LATCHED) as late:
            tester.wait(lambda: late, 'the map again')
            assert late[0] == early[0]
        assert len(early) == 1, 'it was published once'
        path.write_text(path.read_text().replace('thing number 0', 'another thing'))
        assert tester.trigger('reload_map').success
        tester.wait(lambda: len(early) == 2, 'the new map')
        assert 'another thing' in {marker.text for marker in early[1].markers}


def test_matches_and_debug_image_of_each_result(own_relocalizer, tester):
    own_relocalizer()
    frame = make_frame(stamp_s=42.0)
    with (looking(tester, MarkerArray, 'matches') as matches,
          looking(tester, Image, 'debug_image') as images):
        tester.wait(lambda: tester.count_subscribers('/relocalizer/debug_image') == 1, 'us')
        assert tester.relocalize(frame).success
        tester.wait(lambda: matches and images, 'the pictures')
        lines, = matches[-1].markers
        assert (lines.type, len(lines.points)) == (Marker.LINE_LIST, 24)
        assert (lines.header.frame_id, lines.header.stamp.sec) == ('map', 42)
        assert images[-1].header == frame[0].header
        drawn, shown = image_from_msg(images[-1]), image_from_msg(frame[0])
        assert drawn.shape[1] == shown.shape[1]
        changed = (drawn[:len(shown)] != shown).any(axis=2).mean()
        assert 0.01 < changed < 0.5
        frame[2].detections = frame[2].detections[:3]
        assert not tester.relocalize(frame).success
        tester.wait(lambda: len(images) > 1, 'the picture of a refusal')
        assert not np.array_equal(image_from_msg(images[-1]), drawn)
