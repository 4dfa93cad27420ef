# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Faults on a robot: processes die, time jumps, cameras are too fast."""

import signal

import pytest
from processes import PROJECT
from tester import class_matching, make_frame

pytestmark = pytest.mark.full

ASSETS = PROJECT / 'demo/assets'


def test_a_detector_that_is_killed_and_restarted_while_a_request_waits(start, tester, room_map):
    start('nodes.relocalizer', parameters=class_matching(room_map, timeout_s=60.0)
          ).wait_for_output('ready after')
    tester.connect()
    tester.destroy_publisher(tester.detections)
    try:
        first = start('nodes.detector', parameters={'model': ASSETS / 'yolo.onnx'})
        first.wait_for_output('ready after')
        future = tester.ask()
        tester.wait(lambda: tester.images.get_subscription_count() == 2, 'both to listen')
        first.stop(signal.SIGKILL)
        second = start('nodes.detector', parameters={'model': ASSETS / 'yolo.onnx'})
        stamps = iter(range(1, 100_000))

        def answered():
            tester.publish(make_frame(stamp_s=float(next(stamps)))[:2])
            return future.done()
        tester.wait(answered, 'an answer from the new detector')
        # noise shows no objects, and the answer says so
        assert future.result().message.startswith('refused: ')
        assert second.alive
    finally:
        tester.detections = tester.create_publisher(
            type(make_frame()[2]), 'detections', 10)
