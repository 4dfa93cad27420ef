# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Detections of yolo_ros: yolo_msgs if it is installed, otherwise a clear message."""

import os
from types import SimpleNamespace as Fields

from rclpy.serialization import serialize_message
from tester import class_matching, make_frame

from cliploc_ros.ros.conversions import from_yolo_msg


def as_yolo(msg):
    """Return detections with the fields of a yolo_msgs/DetectionArray."""
    made = []
    for given in msg.detections:
        guess, box = given.results[0].hypothesis, given.bbox
        made.append(Fields(class_id=0, class_name=guess.class_id, score=guess.score, id='',
                           bbox=Fields(center=Fields(position=box.center.position, theta=0.0),
                                       size=Fields(x=box.size_x, y=box.size_y))))
    return Fields(header=msg.header, detections=made)


def test_all_that_counts_is_kept():
    expected = make_frame()[2]
    assert serialize_message(from_yolo_msg(as_yolo(expected))) == serialize_message(expected)


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
