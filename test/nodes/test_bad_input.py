# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Every bad input is named in the answer, and the node keeps running."""

from itertools import count

import numpy as np
import pytest
from processes import wait_for
from std_msgs.msg import Header
from tester import make_frame

from cliploc_ros.core.observation import Detections
from cliploc_ros.ros.conversions import detections_to_msg


def of_unknown_encoding(image, info, detections):
    image.encoding = 'yuv422'


def bad_boxes(boxes, class_id='a'):
    def change(image, info, detections):
        rows = np.array(boxes, dtype=np.float64).reshape(-1, 4)
        detections.detections = detections_to_msg(
            Detections(rows, (class_id,) * len(rows), np.full(len(rows), 0.5)),
            detections.header).detections
    return change


def of_another_camera(image, info, detections):
    detections.header = Header(stamp=image.header.stamp, frame_id='left_optical_frame')


MANY_BOXES = np.random.default_rng(0).uniform((0, 0, 200, 200), (200, 200, 400, 400), (2000, 4))
# One fault of each cause, and the quote in the answer. test/ros has all of them.
BAD_FRAMES = {
    'encoding': (of_unknown_encoding, 'yuv422'),
    'boxes of another camera': (of_another_camera, 'left_optical_frame'),
    'unknown classes': (bad_boxes([[10, 10, 50, 50]] * 5, 'zebra'), 'zebra'),
    'thousands of boxes': (bad_boxes(MANY_BOXES), 'kind '),
}


def refusal(tester, frame):
    """Return the answer to a bad frame, though a good frame may still be in transit."""
    answer = tester.relocalize(frame)
    return tester.relocalize(frame) if answer.success else answer


@pytest.mark.parametrize('name', BAD_FRAMES)
def test_bad_frames(relocalizer, tester, name):
    change, reason = BAD_FRAMES[name]
    # frames of one stamp with different boxes would be another fault
    first_s = 1000.0 + 10.0 * [*BAD_FRAMES].index(name)
    frame = make_frame(stamp_s=first_s)
    change(*frame)
    answer = refusal(tester, frame)
    assert not answer.success
    assert reason in answer.message, answer.message
    assert 'internal error' not in answer.message
    assert tester.relocalize(make_frame(stamp_s=first_s + 1.0)).success


def test_what_strangers_write_is_quoted_in_a_line(relocalizer, tester):
    """Answer, log and diagnostics must not multiply a message of a megabyte."""
    frame = make_frame()
    frame[0].encoding = '[FATAL] all is lost\n' * 50_000
    answer = refusal(tester, frame)
    assert not answer.success and answer.message.startswith('image encoding ')
    assert 'bgra8' in answer.message and len(answer.message) < 1000
    assert '\n' not in answer.message
    tester.wait(lambda: 'image encoding' in relocalizer.output(), 'the log')
    assert max(map(len, relocalizer.output().splitlines())) < 2000
    assert not [line for line in relocalizer.output().splitlines() if line.startswith('[FATAL]')]


@pytest.mark.parametrize(('topics', 'reason'), [
    (('camera_info', 'detections'), 'no image'),
    (('image', 'camera_info', 'later detections'), 'never match')])
def test_a_request_without_fresh_frames(relocalizer, tester, topics, reason):
    image, info, detections = make_frame(stamp_s=5.0)
    messages = {'image': image, 'camera_info': info, 'detections': detections,
                'later detections': make_frame(stamp_s=5.001)[2]}
    assert tester.set_parameter('timeout_s', 1.0).successful
    answer = tester.relocalize([messages[topic] for topic in topics])
    assert tester.set_parameter('timeout_s', 10.0).successful
    assert not answer.success and 'no new frame' in answer.message and reason in answer.message
    assert tester.relocalize(make_frame(stamp_s=6.0)).success


# ---- stamps of images

def test_stamps_that_name_no_image_pair_nothing(relocalizer, tester):
    """Stamps in whole seconds; test/ros has the others. A calibration needs no stamp."""
    assert tester.set_parameter('timeout_s', 2.0).successful
    future, numbers, noise = tester.ask(), count(), np.random.default_rng(1)

    def work():
        image, info, boxes = make_frame(stamp_s=1000.0 + next(numbers) // 10)
        image.data = noise.integers(0, 256, len(image.data), np.uint8).tobytes()
        boxes.detections[0].bbox.size_x += noise.random()
        tester.publish((image, info, boxes))
        for _ in range(3):
            tester.spin()
    wait_for(future.done, 'an answer', work=work)
    assert tester.set_parameter('timeout_s', 10.0).successful
    answer = future.result()
    assert not (answer.success or tester.poses or tester.initial_poses)
    assert 'for several of them' in answer.message and 'must copy' in answer.message
    image, info, boxes = make_frame(stamp_s=2000.0)
    info.header = Header(frame_id=image.header.frame_id)
    answer = tester.relocalize((image, info, boxes))
    assert answer.success, answer.message
