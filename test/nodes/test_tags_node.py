# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The relocalizer as a process with a map of tags alone: no detector, no keyframes, no CLIP."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from frames import CAMERA, header_of, messages_of
from tag_images import paint_tag
from tester import transform_of

from cliploc_ros.cli.evaluate import main as evaluate
from cliploc_ros.core.geometry.transforms import make_transform, pose_error
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.map_file import write_map
from cliploc_ros.core.map.tags import Tag
from cliploc_ros.core.observation import Detections

TAG = Tag('door', 'tag36h11', 7, 0.3, (1.5, 0.0, 0.0), (0.5, -0.5, -0.5, 0.5))
POSE = make_transform(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.zeros(3)) \
    @ make_transform(cv2.Rodrigues(np.array([0.0, 0.5, 0.0]))[0], np.array([-0.7, 0.0, 0.0]))
NOTHING = Detections(np.empty((0, 4)), (), np.empty(0))


@pytest.mark.skipif(not hasattr(cv2, 'aruco'), reason='this OpenCV has no aruco')
def test_a_map_of_tags_alone_needs_no_detector(start, tester, tmp_path, capsys):
    path = tmp_path / 'map.yaml'
    write_map(path, replace(LandmarkMap.empty('map'), tags=(TAG,)))
    process = start('nodes.relocalizer', parameters={
        'map_file': path, 'detections_type': 'none', 'record_folder': tmp_path / 'cases',
        'timeout_s': 60.0})
    process.wait_for_output('ready after')
    tester.connect()
    header = header_of(100 * 10**9, 'camera_optical_frame')
    pixels = np.full((CAMERA.height, CAMERA.width, 3), 150, np.uint8)
    answer = tester.relocalize(messages_of(NOTHING, header, paint_tag(pixels, TAG, CAMERA, POSE)))
    assert answer.success, answer.message
    assert 'by tag36h11_7;' in answer.message
    assert pose_error(transform_of(tester.poses[0].pose.pose), POSE)[0] < 0.03
    assert tester.trigger('record').success
    case, = (tmp_path / 'cases').iterdir()
    assert evaluate(['--bag', str(case), '--map', str(path)]) == 0
    assert answer.message.rpartition('; ')[0].partition(': ')[2] in capsys.readouterr().out
    assert not tester.relocalize(messages_of(NOTHING, header_of(101 * 10**9, header.frame_id),
                                             pixels)).success
    assert 'detections' not in process.output()
