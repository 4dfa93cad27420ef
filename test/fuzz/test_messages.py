# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Garbage in every field of every message gives a clear error, and no pose."""

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from hypothesis import given
from hypothesis import strategies as st
from scene import CAMERA, make_room, write_map
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header
from test_damaged_files import CASES, number
from vision_msgs.msg import (
    BoundingBox2D,
    Detection2D,
    Detection2DArray,
    ObjectHypothesis,
    ObjectHypothesisWithPose,
    Point2D,
    Pose2D,
)

from cliploc_ros.errors import CliplocError
from cliploc_ros.messages import _CHANNELS
from cliploc_ros.ros.frame_localizer import load_localizer
from cliploc_ros.ros.inputs.frame_source import Frame
from cliploc_ros.ros.inputs.robot_state import KnownBefore, RobotState
from cliploc_ros.ros.node.diagnostics import StageTimes
from cliploc_ros.ros.parameters import RelocalizerParameters

uint32 = st.integers(0, 2**32 - 1)
small = st.integers(0, 700)
name = st.one_of(st.sampled_from(['a', 'b', 'c', '']), st.text(max_size=20))
SIZE = CAMERA.width * CAMERA.height
INFO = {'width': CAMERA.width, 'height': CAMERA.height, 'k': CAMERA.matrix.ravel().tolist(),
        'p': [*CAMERA.matrix[0], 0.0, *CAMERA.matrix[1], 0.0, *CAMERA.matrix[2], 0.0]}


def or_sound(sound, strategy):
    """Draw mostly valid values, so that code after the first check is reached too."""
    return st.one_of(st.just(sound), st.just(sound), strategy)


def sound_image():
    return Image(width=CAMERA.width, height=CAMERA.height, step=CAMERA.width, encoding='mono8',
                 data=bytes(SIZE))


def images():
    return st.builds(
        Image, width=or_sound(CAMERA.width, st.one_of(small, uint32)),
        height=or_sound(CAMERA.height, st.one_of(small, uint32)),
        step=or_sound(CAMERA.width, st.one_of(small, uint32)),
        encoding=or_sound('mono8', st.one_of(st.sampled_from(sorted(_CHANNELS)),
                                             st.text(max_size=10))),
        is_bigendian=st.integers(0, 255),
        data=or_sound(bytes(SIZE), st.one_of(st.binary(max_size=100), st.just(bytes(3 * SIZE)))))


def compressed_images():
    starts = st.sampled_from([b'', b'\xff\xd8\xff\xc0\x00\x11\x08', b'\x89PNG\r\n\x1a\n',
                              b'\xff\xd8\xff\xe0\x00\x02', b'GIF89a'])
    return st.builds(CompressedImage, format=st.text(max_size=10),
                     data=st.builds(bytes.__add__, starts, st.binary(max_size=200)))


def infos():
    numbers = {field: or_sound(INFO[field], st.lists(number, min_size=size, max_size=size))
               for field, size in (('k', 9), ('p', 12))}
    return st.builds(
        CameraInfo, width=or_sound(CAMERA.width, uint32), height=or_sound(CAMERA.height, uint32),
        d=or_sound([], st.lists(number, max_size=14)),
        distortion_model=st.one_of(st.sampled_from(['', 'plumb_bob', 'rational_polynomial',
                                                    'equidistant']), st.text(max_size=10)),
        binning_x=uint32, binning_y=uint32, **numbers)


def boxes():
    center = st.builds(Pose2D, position=st.builds(Point2D, x=number, y=number),
                       theta=or_sound(0.0, number))
    return st.builds(BoundingBox2D, center=center, size_x=number, size_y=number)


def detections(most=40):
    hypothesis = st.builds(ObjectHypothesis, class_id=name, score=number)
    result = st.builds(ObjectHypothesisWithPose, hypothesis=hypothesis)
    detection = st.builds(Detection2D, bbox=boxes(), results=st.lists(result, max_size=3), id=name)
    return st.builds(Detection2DArray, detections=st.lists(detection, max_size=most))


def likely_detections():
    """Draw meaningless boxes with valid classes and sizes within the image."""
    hypothesis = st.builds(ObjectHypothesis, class_id=st.sampled_from('abc'),
                           score=st.floats(0.1, 1.0))
    box = st.builds(
        BoundingBox2D,
        center=st.builds(Pose2D, position=st.builds(Point2D, x=st.floats(0, CAMERA.width),
                                                    y=st.floats(0, CAMERA.height))),
        size_x=st.floats(3, 200), size_y=st.floats(3, 200))
    detection = st.builds(Detection2D, bbox=box, results=st.builds(
        lambda one: [ObjectHypothesisWithPose(hypothesis=one)], hypothesis))
    return st.builds(Detection2DArray, detections=st.lists(detection, min_size=3, max_size=20))


def stamped(msg, nanoseconds):
    """Set a stamp on the message; pairing accepts no message without one."""
    msg.header = Header(frame_id='camera', stamp=Time(sec=nanoseconds // 10**9,
                                                      nanosec=nanoseconds % 10**9))
    return msg


@pytest.fixture(scope='module')
def loaded(tmp_path_factory):
    path = tmp_path_factory.mktemp('fuzz') / 'room.yaml'
    write_map(make_room(), path)
    values = RelocalizerParameters(map_file=str(path), matching='class')
    return load_localizer(None, values), values  # a map from a file needs no node


def localize(localizer, values, image, info, found):
    frame = Frame(*(stamped(msg, 100) for msg in (image, info, found)), 0.0, 0.0)
    try:
        return localizer.localize(frame, values, KnownBefore(RobotState(np.eye(4))),
                                  StageTimes('waiting', 0.0)).found
    except CliplocError as error:
        assert str(error).strip()
        return None


@given(images() | compressed_images(), infos(), detections())
@CASES
def test_images_raw_and_compressed(loaded, image, info, found):
    result = localize(*loaded, image, info, found)
    assert result is None or not result.accepted


@given(likely_detections())
@CASES
def test_likely_boxes(loaded, found):
    result = localize(*loaded, sound_image(),
                      CameraInfo(d=[], distortion_model='plumb_bob', **INFO), found)
    assert result is not None and not result.accepted
