# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The relocalizer as a process: inputs, modes, frames, floods and shutdown."""

import os
import signal
from types import SimpleNamespace as Fields

import cv2
import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CompressedImage
from tester import class_matching, make_frame

from cliploc_ros.ros.conversions import from_yolo_msg


def test_compressed_images(own_relocalizer, tester):
    own_relocalizer(image_transport='compressed')
    image, info, detections = make_frame()
    data = cv2.imencode('.jpg', np.zeros((480, 640, 3), dtype=np.uint8))[1].tobytes()
    good = CompressedImage(header=image.header, format='jpeg', data=data)
    assert tester.relocalize((good, info, detections)).success
    for broken in (b'', b'not a picture', data[:100]):
        bad = CompressedImage(header=image.header, format='jpeg', data=broken)
        answer = tester.relocalize((bad, info, detections))
        assert not answer.success
        assert 'does not decode' in answer.message
    assert tester.relocalize((good, info, detections)).success


def test_continuous_mode_publishes_without_being_asked(own_relocalizer, tester):
    process = own_relocalizer(mode='continuous')
    for stamp_s in (2, 1):
        tester.feed_until(
            lambda s=stamp_s: tester.poses and tester.poses[-1].header.stamp.sec == s,
            make_frame(stamp_s=float(stamp_s)), 'a pose')
    assert not tester.initial_poses  # a running localizer is never reset without a request
    assert tester.relocalize(make_frame(stamp_s=3.0)).success
    tester.wait(lambda: tester.initial_poses, 'an initial pose')
    assert process.stop()[0] == 0


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_request_is_answered_when_its_node_is_told_to_stop(own_relocalizer, tester, number):
    process = own_relocalizer(timeout_s=30.0)
    future = tester.ask()
    tester.wait(tester.listened_to, 'the request to wait for images')
    process.send(number)
    answer = tester.answer(future)
    assert not answer.success and 'shutting down' in answer.message
    tester.wait(lambda: not process.alive, 'its end')
    assert process.stop()[0] == 0
    assert 'internal error' not in process.output() and 'Traceback' not in process.output()


# ---- yolo_msgs
def test_all_that_counts_is_kept():
    """Detections with the fields of a yolo_msgs/DetectionArray."""
    expected, made = make_frame()[2], []
    for given in expected.detections:
        guess, box = given.results[0].hypothesis, given.bbox
        made.append(Fields(class_id=0, class_name=guess.class_id, score=guess.score, id='',
                           bbox=Fields(center=Fields(position=box.center.position, theta=0.0),
                                       size=Fields(x=box.size_x, y=box.size_y))))
    found = from_yolo_msg(Fields(header=expected.header, detections=made))
    assert deserialize_message(serialize_message(found), type(expected)) == expected


def test_without_yolo_msgs_the_node_says_so(start, tester, room_map, tmp_path):
    (tmp_path / 'yolo_msgs.py').write_text("raise ImportError('not here')")
    process = start('nodes.relocalizer', parameters=class_matching(
        room_map, detections_type='yolo_msgs'), PYTHONPATH=os.pathsep.join(
            [str(tmp_path), os.environ.get('PYTHONPATH', '')]))
    process.wait_for_output('[ERROR]')
    tester.connect()
    assert 'yolo_msgs' in process.output()
    assert not tester.answer(tester.ask()).success
    assert 'Traceback' not in process.output()
