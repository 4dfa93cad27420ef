# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Garbage on the wire at full rate: the node lives on, believes nothing of it, and then works."""

import os

import numpy as np
import pytest
from rclpy.serialization import serialize_message
from tester import make_frame
from vision_msgs.msg import BoundingBox2D, Detection2D, ObjectHypothesis, ObjectHypothesisWithPose

pytestmark = pytest.mark.full

CASES = int(os.environ.get('CLIPLOC_FUZZ_CASES', '300'))


def garble(frame, rng):
    """Put random bits into one field of each message."""
    image, info, detections = frame

    def numbers(count):
        return np.frombuffer(rng.bytes(8 * count), dtype=np.float64).tolist()

    def box():
        found = BoundingBox2D(size_x=numbers(1)[0], size_y=numbers(1)[0])
        found.center.position.x, found.center.theta = numbers(2)
        return found

    for message, changes in (
            (image, {'width': lambda: int(rng.integers(2**32)), 'encoding': lambda: 'rgb16',
                     'step': lambda: int(rng.integers(2**32)), 'data': lambda: rng.bytes(50)}),
            (info, {'k': lambda: numbers(9), 'd': lambda: numbers(int(rng.integers(15))),
                    'distortion_model': lambda: 'equidistant',
                    'height': lambda: int(rng.integers(2**32))}),
            (detections, {'detections': lambda: [Detection2D(bbox=box(), results=[
                ObjectHypothesisWithPose(hypothesis=ObjectHypothesis(
                    class_id='abc'[rng.integers(3)], score=numbers(1)[0]))])
                for _ in range(rng.integers(60))]})):
        name = list(changes)[rng.integers(len(changes))]
        setattr(message, name, changes[name]())


def test_garbage_at_full_rate(own_relocalizer, tester):
    process = own_relocalizer(fresh=True, mode='continuous')
    tester.wait(lambda: tester.images.get_subscription_count(), 'the node to listen')
    rng = np.random.default_rng(0)
    heard = None
    for number in range(CASES):
        frame = make_frame(stamp_s=100.0 + 0.01 * number)
        garble(frame, rng)
        tester.publish(frame)
        tester.spin()
        heard = process.memory_mib() if number == CASES // 2 else heard
    assert process.alive, process.output()
    assert not tester.poses
    grown = process.memory_mib() - heard
    print(f'\n{CASES} frames of garbage; memory {grown:+.1f} MiB over the second half')
    assert grown < 10.0
    for text in ('Traceback', 'internal error', 'Warning:'):
        assert text not in process.output()
    tester.feed_until(lambda: tester.poses, make_frame(stamp_s=10_000.0), 'a pose')


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
