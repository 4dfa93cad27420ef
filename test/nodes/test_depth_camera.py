# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Depth of an RGB-D camera at the relocalizer: correct, wrong, late and missing."""


import numpy as np
import pytest
from scene import MAP_FROM_CAMERA, depth_image, make_room, see_room
from sensor_msgs.msg import CompressedImage, Image
from tester import RELIABLE, ask_until, make_frame

ROOM = make_room()
# Enough on a busy machine as well.
SEARCH = {'algorithm': 'auto', 'time_budget_ms': 5000.0}
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


@pytest.fixture
def depth_camera(tester):
    """Publishes depth next to a frame, as a camera would, until the answer arrives."""
    raw = tester.create_publisher(Image, 'depth', RELIABLE)
    small = tester.create_publisher(CompressedImage, 'depth/compressedDepth', RELIABLE)

    def ask(depth):
        frame, future = make_frame(), tester.ask()

        def publish_all():
            if depth is not None:
                (raw if isinstance(depth, Image) else small).publish(depth)
            return future.done()
        tester.feed_until(publish_all, frame)
        return future.result()
    yield ask
    tester.destroy_publisher(raw)
    tester.destroy_publisher(small)


def test_depth_counts_and_a_recorded_request_keeps_it(own_relocalizer, tester, depth_camera,
                                                      room_map, tmp_path, replay):
    own_relocalizer(depth_transport='raw', record_folder=tmp_path, **SEARCH)
    answer = ask_until(depth_camera, 'depth of 12', message(make_frame()))
    stored = tester.trigger('record')
    assert stored.success, stored.message
    (case,) = tmp_path.glob('case_*')
    replay(case, room_map, answer)


@pytest.mark.parametrize(('given', 'said'), [
    ({'encoding': '32FC1', 'frame_id': 'other'}, "'other'"),
    ({'depths_m': 1.7 * DEPTHS_M}, 'no longer used')])
def test_depth_that_cannot_be_right_is_left_out_and_named(own_relocalizer, depth_camera, given,
                                                          said):
    process = own_relocalizer(depth_transport='raw', **SEARCH)
    for _ in range(30):
        answer = depth_camera(message(make_frame(), **given))
        assert answer.success, answer.message
        assert ', depth of' not in answer.message
        if said in process.output():
            break
    assert process.output().count(said) == 1


def test_a_request_never_waits_for_depth(own_relocalizer, depth_camera):
    """The depth camera is silent, late, or has no depth."""
    process = own_relocalizer(depth_transport='raw', **SEARCH)
    for depth in (None, message(make_frame(), late_s=0.5), message(make_frame(), 0.0 * DEPTHS_M)):
        answer = depth_camera(depth)
        assert answer.success, answer.message
        assert 'depth' not in answer.message
    assert 'Traceback' not in process.output()
