# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What happens on a robot all the same: processes die, time jumps, cameras are fast."""

import array
import os
import signal
import time

import numpy as np
import pytest
from geometry_msgs.msg import PoseArray
from processes import PROJECT
from tester import class_matching, make_frame

from cliploc_ros.ros.conversions import stamp_ns

pytestmark = pytest.mark.full

ASSETS = PROJECT / 'cliploc_ros/demo/assets'
# How long the fast camera runs [s]; a minute shows more than a test run has time for.
FAST_CAMERA_S = float(os.environ.get('CLIPLOC_FAST_CAMERA_S', '8'))


def test_a_detector_that_is_killed_and_restarted_while_a_request_waits(start, tester, room_map):
    start('nodes.relocalizer', parameters=class_matching(room_map, timeout_s=60.0)
          ).wait_for_output('ready after')
    tester.connect()
    tester.destroy_publisher(tester.detections)
    try:
        first = start('nodes.detector', parameters={'model': ASSETS / 'yolo.pt'})
        first.wait_for_output('ready after')
        future = tester.ask()
        tester.wait(lambda: tester.images.get_subscription_count() == 2, 'both to listen')
        first.stop(signal.SIGKILL)
        second = start('nodes.detector', parameters={'model': ASSETS / 'yolo.pt'})
        stamps = iter(range(1, 100_000))

        def answered():
            tester.publish(make_frame(stamp_s=float(next(stamps)))[:2])
            return future.done()
        tester.wait(answered, 'an answer from the new detector')
        # noise shows nothing, and that is what is said
        assert future.result().message.startswith('refused: ')
        assert second.alive
    finally:
        tester.detections = tester.create_publisher(
            type(make_frame()[2]), 'detections', 10)


@pytest.fixture
def fast_frame():
    """A frame of 1920 x 1080 that shows the room; a function that dates it."""
    image, info, detections = make_frame()
    scale, left = 1080 / image.height, (1920 - image.width * 1080 / image.height) / 2
    image.width, image.height, image.step = 1920, 1080, 1920 * 3
    image.data = array.array('B', bytes(image.step * image.height))
    info.width, info.height = 1920, 1080
    info.k = np.array(info.k) * np.repeat([scale, scale, 1.0], 3)
    info.k[2] += left
    info.p = np.insert(np.reshape(info.k, (3, 3)), 3, 0.0, axis=1).ravel()
    for detection in detections.detections:
        box = detection.bbox
        box.center.position.x = scale * box.center.position.x + left
        box.center.position.y *= scale
        box.size_x, box.size_y = scale * box.size_x, scale * box.size_y

    def at(now_ns):
        for message in (image, info, detections):
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(now_ns, 10**9)
        # An image right behind a small message may push it out of what DDS shares with readers.
        return image, info, detections
    return at


@pytest.mark.clock
def test_a_fast_camera_leaves_no_backlog(own_relocalizer, tester, fast_frame):
    process = own_relocalizer(fresh=True, mode='continuous')
    latencies_s, memory_mib = [], []
    subscription = tester.create_subscription(
        PoseArray, 'relocalizer/hypotheses', lambda msg: latencies_s.append(
            (time.time_ns() - stamp_ns(msg.header.stamp)) / 1e9), 10)
    start = time.monotonic()
    while len(latencies_s) < 5:
        assert time.monotonic() - start < 60, process.output()
        tester.publish(fast_frame(time.time_ns()))
        tester.spin()
    latencies_s.clear()
    start, sent = time.monotonic(), 0
    while (elapsed_s := time.monotonic() - start) < FAST_CAMERA_S:
        if elapsed_s >= sent / 30:
            tester.publish(fast_frame(time.time_ns()))
            sent += 1
        tester.spin()
        memory_mib.append(process.memory_mib())
    tester.destroy_subscription(subscription)
    half = len(memory_mib) // 2
    growth = max(memory_mib[half:]) / max(memory_mib[:half]) - 1
    print(f'\n1080p at {sent / elapsed_s:.0f} Hz for {elapsed_s:.0f} s: '
          f'{len(latencies_s)} results, latency median {1e3 * np.median(latencies_s):.0f} ms, p99 '
          f'{1e3 * np.percentile(latencies_s, 99):.0f} ms; memory {min(memory_mib):.0f} to '
          f'{max(memory_mib):.0f} MiB, {100 * growth:+.1f} % in the second half')
    assert len(latencies_s) > 2 * FAST_CAMERA_S
    # a backlog would grow with the time; the newest frame is never old
    assert np.percentile(latencies_s[len(latencies_s) // 2:], 90) < 1.0
    assert growth < 0.1
    assert process.stop()[0] == 0
