# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Garbage in every field of every message gives a clear error, and no pose."""

import garbage
import numpy as np
import pytest
from hypothesis import given
from scene import make_room, write_map

from cliploc_ros.errors import CliplocError
from cliploc_ros.ros.frame_localizer import load_localizer
from cliploc_ros.ros.inputs.frame_source import Frame
from cliploc_ros.ros.inputs.robot_state import KnownBefore, RobotState
from cliploc_ros.ros.node.diagnostics import StageTimes
from cliploc_ros.ros.parameters import RelocalizerParameters


@pytest.fixture(scope='module')
def values(tmp_path_factory):
    path = tmp_path_factory.mktemp('fuzz') / 'room.yaml'
    write_map(make_room(), path)
    return RelocalizerParameters(map_file=str(path), matching='class')


@pytest.fixture(scope='module')
def localizer(values):
    return load_localizer(None, values)  # a map from a file needs no node


def localize(localizer, values, image, info, found):
    frame = Frame(*(garbage.stamped(msg, 100) for msg in (image, info, found)), 0.0, 0.0)
    try:
        return localizer.localize(frame, values, KnownBefore(RobotState(np.eye(4))),
                                  StageTimes('waiting', 0.0)).found
    except CliplocError as error:
        assert str(error).strip()
        return None


@given(garbage.images() | garbage.compressed_images(), garbage.infos(), garbage.detections())
@garbage.CASES
def test_images_raw_and_compressed(localizer, values, image, info, found):
    result = localize(localizer, values, image, info, found)
    assert result is None or not result.accepted


@given(garbage.likely_detections())
@garbage.CASES
def test_likely_boxes(localizer, values, found):
    result = localize(localizer, values, garbage.sound_image(), garbage.sound_info(), found)
    assert result is not None and not result.accepted
