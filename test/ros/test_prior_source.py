# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Priors of an image: from the topic, and from the file of the last pose."""

import json
import time
from types import SimpleNamespace

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from std_msgs.msg import Header

from cliploc_ros.core.geometry.transforms import make_transform
from cliploc_ros.core.observation import OPTICAL_FROM_BODY
from cliploc_ros.ros.conversions import pose_with_covariance_msg
from cliploc_ros.ros.inputs.coordinate_frames import CoordinateFrames
from cliploc_ros.ros.inputs.prior import PriorSource
from cliploc_ros.ros.node.threads import Worker
from cliploc_ros.ros.parameters import RelocalizerParameters

CAMERA_FROM_BASE = make_transform(OPTICAL_FROM_BODY[:3, :3], np.array([0.0, 0.3, -0.1]))
COVARIANCE = np.diag([0.25, 0.5, 1.0, 2.0, 3.0, 0.1])
COVARIANCE[0, 1] = COVARIANCE[1, 0] = 0.05
COVARIANCE[0, 5] = COVARIANCE[5, 0] = 0.02


def turned(yaw, x=0.0, y=0.0):
    c, s = np.cos(yaw), np.sin(yaw)
    return make_transform(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]),
                          np.array([x, y, 0.2]))


def pose(frame_id='map', at=None, covariance=COVARIANCE):
    return pose_with_covariance_msg(Header(frame_id=frame_id),
                                    turned(0.7, 1.0, -2.0) if at is None else at, covariance)


@pytest.fixture
def source(make_node):
    """A source whose node executes background work at once."""
    node = make_node()
    node.worker = Worker(print)
    yield PriorSource(node, CoordinateFrames(node))
    node.worker.stop()


def region_of(source, map_hash='one', frame_ids=('map',), **changes):
    parameters = RelocalizerParameters(**{'base_frame': 'base_link', 'tf_timeout_s': 0.0,
                                          **changes})
    return source.region(Time(sec=5), parameters, CAMERA_FROM_BASE, frame_ids, map_hash)


def test_a_pose_is_a_region_with_the_covariance_of_x_y_and_yaw(source):
    source.hear(pose('/map'))
    region = region_of(source, prior_probability=0.8)
    assert (region.frame_id, region.probability) == ('map', 0.8)
    np.testing.assert_allclose(region.mean, [1.0, -2.0, 0.7])
    np.testing.assert_allclose(region.covariance, [[0.25, 0.05, 0], [0.05, 0.5, 0], [0, 0, 0.1]])
    np.testing.assert_array_equal(region.camera_from_body, CAMERA_FROM_BASE)


def test_without_a_base_a_region_is_of_the_cameras_body(source):
    level = turned(0.7, 1.0, -2.0)
    for at in (level, level @ np.linalg.inv(OPTICAL_FROM_BODY)):
        source.hear(pose(at=at))
        region = region_of(source, base_frame='')
        np.testing.assert_allclose(region.mean, [1.0, -2.0, 0.7])
        np.testing.assert_array_equal(region.camera_from_body, OPTICAL_FROM_BODY)


def test_a_message_withdraws_the_one_before(source):
    invalid = pose()
    invalid.pose.pose.orientation.w = 5.0
    for other in (pose(''), invalid, pose('elsewhere'), pose(covariance=-COVARIANCE)):
        source.hear(pose())
        assert region_of(source) is not None
        source.hear(other)
        assert region_of(source) is None


def test_the_last_accepted_pose_holds_at_the_next_start_until_another_is_accepted(
        make_node, source, tmp_path):
    file = tmp_path / 'last.json'
    parameters = RelocalizerParameters(last_pose_file=str(file), last_pose_probability=0.6)
    source.keep(pose(), parameters, 'one')
    source._node.worker.run(lambda: None)  # its background writes are complete
    assert json.loads(file.read_text())['map_hash'] == 'one'
    content = file.read_bytes()
    source.keep(pose(at=turned(0.7, 1.001, -2.0)), parameters, 'two')
    source._node.worker.run(lambda: None)
    assert file.read_bytes() == content, 'the robot has not moved'
    source.keep(pose(at=turned(0.7, 2.0, -2.0)), parameters, 'one')
    source._node.settings = SimpleNamespace(snapshot=lambda: parameters)
    for written_at, x_m in ((0.0, 3.0), (time.monotonic(), 9.0)):  # at most once a second
        source._written_at = written_at
        source.follow(pose(at=turned(0.7, x_m, -2.0)))  # a pose of the localizer
    source._node.worker.run(lambda: None)

    node = make_node('next_start')
    woken = PriorSource(node, CoordinateFrames(node))
    woken.open(parameters)
    region = region_of(woken, 'one', last_pose_probability=0.6)
    np.testing.assert_allclose(region.mean, [3.0, -2.0, 0.7])
    assert region.probability == 0.6
    np.testing.assert_allclose(np.diag(region.covariance), [0.25, 0.5, 0.1])
    assert region_of(woken, 'another map') is None
    woken.hear(pose())
    np.testing.assert_allclose(region_of(woken).mean, [1.0, -2.0, 0.7], err_msg='told')
    woken.hear(pose(''))
    node.worker = source._node.worker
    woken.keep(pose(), parameters, 'one')
    assert region_of(woken, 'one') is None
    woken.close()


@pytest.mark.parametrize('content', ['', '{}', '[' * 100_000, '{"map_from_robot": 1}'])
def test_a_file_that_is_none_is_not_used(make_node, tmp_path, content):
    (tmp_path / 'last.json').write_text(content)
    node = make_node()
    source = PriorSource(node, CoordinateFrames(node))
    source.open(RelocalizerParameters(last_pose_file=str(tmp_path / 'last.json')))
    assert region_of(source) is None
    source.close()
