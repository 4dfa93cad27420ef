# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Depth of an RGB-D camera at the relocalizer: correct, wrong, late and missing."""

from itertools import count

import numpy as np
import pytest
from scene import MAP_FROM_CAMERA, depth_image, make_room, see_room
from sensor_msgs.msg import Image
from tester import RELIABLE, ask_until, class_matching, make_frame

ROOM, STAMPS_S = make_room(), count(100.0, 10.0)
DEPTHS_M = depth_image(ROOM, MAP_FROM_CAMERA, see_room(ROOM).bboxes_xyxy)


def message(frame, depths_m=DEPTHS_M, encoding='16UC1', frame_id=None, late_s=0.0):
    header = frame[0].header
    pixels = (1000.0 * depths_m).astype(np.uint16) if encoding == '16UC1' else depths_m
    msg = Image(height=pixels.shape[0], width=pixels.shape[1], encoding=encoding,
                step=pixels.strides[0])
    msg.header.frame_id = header.frame_id if frame_id is None else frame_id
    msg.header.stamp.sec = header.stamp.sec
    msg.header.stamp.nanosec = header.stamp.nanosec + round(late_s * 1e9)
    msg.data = pixels.tobytes()
    return msg


@pytest.fixture(scope='module')
def process(start_shared, tester, room_map):
    """Start a relocalizer with enough time for its search on a busy machine, too."""
    process = start_shared('nodes.relocalizer', parameters=class_matching(
        room_map, depth_transport='raw', algorithm='auto', time_budget_ms=5000.0))
    process.wait_for_output('ready after')
    tester.connect()
    return process


@pytest.fixture
def depth_camera(process, tester):
    """Publishes depth next to a frame, as a camera would, until the answer arrives."""
    publisher = tester.create_publisher(Image, 'depth', RELIABLE)
    assert tester.trigger('reload_map').success  # which forgets the scale of depth

    stamp_s = next(STAMPS_S)  # no depth of the test before is that of its images

    def ask(given):
        frame, future = make_frame(stamp_s=stamp_s), tester.ask()

        def publish_all():
            if given is not None:
                publisher.publish(message(frame, **given))
            return future.done()
        tester.feed_until(publish_all, frame)
        return future.result()
    yield ask
    tester.destroy_publisher(publisher)


def test_depth_counts(depth_camera):
    ask_until(depth_camera, 'depth of 12', {})


@pytest.mark.parametrize(('given', 'said'), [
    ({'encoding': '32FC1', 'frame_id': 'other'}, "'other'"),
    ({'depths_m': 1.7 * DEPTHS_M}, 'no longer used')])
def test_depth_that_cannot_be_right_is_left_out_and_named(process, depth_camera, given, said):
    for _ in range(30):
        answer = depth_camera(given)
        assert answer.success, answer.message
        assert ', depth of' not in answer.message
        if said in process.output():
            break
    assert process.output().count(said) == 1


def test_a_request_never_waits_for_depth(process, depth_camera):
    """The depth camera is silent, late, or has no depth."""
    for given in (None, {'late_s': 0.5}, {'depths_m': 0.0 * DEPTHS_M}):
        answer = depth_camera(given)
        assert answer.success, answer.message
        assert 'depth' not in answer.message
    assert 'Traceback' not in process.output()
