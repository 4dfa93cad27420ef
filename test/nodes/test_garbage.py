# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Garbage on the wire at full rate: the node lives on, believes nothing of it, and then works."""

import os

import numpy as np
import pytest
from rclpy.serialization import serialize_message
from tester import make_frame

pytestmark = pytest.mark.full

CASES = int(os.environ.get('CLIPLOC_FUZZ_CASES', '300'))


def damage(message, rng):
    """Return the bytes of a message, cut short or with random bytes near the front."""
    data = bytearray(serialize_message(message))
    if rng.random() < 0.3:
        del data[rng.integers(1, len(data)):]
    data[rng.integers(min(200, len(data)))] = rng.integers(256)
    return bytes(data)


def test_damaged_bytes(own_relocalizer, tester):
    process = own_relocalizer(fresh=True, mode='continuous')
    tester.wait(lambda: tester.images.get_subscription_count(), 'the node to listen')
    rng = np.random.default_rng(0)
    for number in range(CASES):
        frame = make_frame(stamp_s=100.0 + 0.01 * number)
        for publisher, message in zip((tester.images, tester.infos, tester.detections), frame,
                                      strict=True):
            publisher.publish(damage(message, rng))
        tester.spin()
    assert process.alive, process.output()
    assert 'cannot be read' in process.output()
    for text in ('Traceback', 'internal error'):
        assert text not in process.output()
    # some are whole enough for a pose
    tester.feed_until(lambda: any(pose.header.stamp.sec == 10_000 for pose in tester.poses),
                      make_frame(stamp_s=10_000.0), 'a pose of a whole frame')
