# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Frames of one camera from its messages as they arrive: waiting for a slow detector."""

import copy
import math
from functools import partial

import pytest
from builtin_interfaces.msg import Time
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header
from vision_msgs.msg import Detection2DArray

from cliploc_ros.ros.inputs.frame_source import FrameSource
from cliploc_ros.ros.parameters import RelocalizerParameters

PERIOD_NS = 33_333_333


def stamped(msg, number):
    found = copy.copy(msg)  # all share the same pixels
    ns = (number + 1) * PERIOD_NS
    found.header = Header(stamp=Time(sec=ns // 10**9, nanosec=ns % 10**9), frame_id='camera')
    return found


@pytest.fixture
def feed(make_node):
    """Feed a camera at 30 Hz whose detections arrive some images late; return its frames."""
    def run(images, late, depth_bytes):
        frames = []
        source = FrameSource(make_node(), RelocalizerParameters(depth_transport='raw'), math.inf,
                             frames.append)
        source.open()
        receive = {name: partial(source._receive, name) for name in source.topics}
        depth = Image(data=bytes(depth_bytes))
        for number in range(images):
            receive['depth'](stamped(depth, number))
            receive['image'](stamped(Image(data=[number % 256]), number))
            receive['camera_info'](stamped(CameraInfo(), number))
            if number >= late:
                receive['detections'](stamped(Detection2DArray(), number - late))
        source.close('the end')
        return frames
    return run


@pytest.mark.parametrize(('late', 'depth_bytes', 'share'), [
    (3, 2 * 1280 * 720, 1.0), (45, 2 * 1280 * 720, 0.45), (45, 4 * 1920 * 1080, 0.1)])
def test_depth_waits_as_long_as_its_image_does(feed, late, depth_bytes, share):
    """More images than fit into memory: some are left out, but not all."""
    frames = feed(3 * late + 30, late, depth_bytes)
    depths = [frame.depth for frame in frames]
    assert len(frames) > 20
    assert sum(depth is not None for depth in depths) >= share * len(frames)
    for frame in frames:
        assert frame.depth is None or frame.depth.header.stamp == frame.image.header.stamp
