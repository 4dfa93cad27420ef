# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Depth of an RGB-D camera at the relocalizer: correct, wrong, late and missing."""


import numpy as np
import pytest
from scene import MAP_FROM_CAMERA, depth_image, make_room, see_room
from sensor_msgs.msg import Image
from tester import RELIABLE, ask_until, class_matching, make_frame

ROOM = make_room()
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
def cases(tmp_path_factory):
    return tmp_path_factory.mktemp('cases')


@pytest.fixture(scope='module')
def camera(start_shared, tester, room_map, cases):
    """Return a relocalizer with depth; publish depth next to a frame until it answers."""
    process = start_shared('nodes.relocalizer', parameters=class_matching(
        room_map, depth_transport='raw', record_folder=cases, algorithm='auto',
        time_budget_ms=5000.0))  # enough on a busy machine as well
    process.wait_for_output('ready after')
    tester.connect()
    publisher = tester.create_publisher(Image, 'depth', RELIABLE)

    def ask(depth):
        frame, future = make_frame(), tester.ask()

        def publish_all():
            if depth is not None:
                publisher.publish(depth)
            return future.done()
        tester.feed_until(publish_all, frame)
        return future.result()
    yield process, ask
    tester.destroy_publisher(publisher)
    assert 'Traceback' not in process.output()


def test_depth_counts_and_a_recorded_request_keeps_it(camera, tester, cases, room_map, replay):
    _, ask = camera
    answer = ask_until(ask, 'depth of 12', message(make_frame()))
    stored = tester.trigger('record')
    assert stored.success, stored.message
    (case,) = cases.glob('case_*')
    replay(case, room_map, answer)


def test_a_request_never_waits_for_depth(camera):
    """The depth camera is silent, late, or has no depth."""
    _, ask = camera
    for depth in (None, message(make_frame(), late_s=0.5), message(make_frame(), 0.0 * DEPTHS_M)):
        answer = ask(depth)
        assert answer.success, answer.message
        assert 'depth' not in answer.message


@pytest.mark.parametrize(('given', 'said'), [
    ({'encoding': '32FC1', 'frame_id': 'other'}, "'other'"),
    ({'depths_m': 1.7 * DEPTHS_M}, 'no longer used')])
def test_depth_that_cannot_be_right_is_left_out_and_named(camera, given, said):
    process, ask = camera
    for _ in range(30):
        answer = ask(message(make_frame(), **given))
        assert answer.success, answer.message
        assert ', depth of' not in answer.message
        if said in process.output():
            break
    assert process.output().count(said) == 1
