# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The relocalizer as a process: requests and answers."""

import re
import subprocess
import sys

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from diagnostic_msgs.srv import SelfTest
from frames import header_of, messages_of
from processes import PROJECT
from scene import CAMERA, MAP_FROM_CAMERA, make_room, rigid, see_room
from tester import PIXELS, make_frame, transform_of

from cliploc_ros.core.geometry import transforms
from cliploc_ros.ros.qos import LATCHED


def test_a_request_is_answered_with_a_pose(relocalizer, tester):
    answer = tester.relocalize(make_frame(stamp_s=12.5))
    assert answer.success and answer.message.startswith('accepted: x 0.3')
    tester.wait(lambda: tester.poses and tester.initial_poses and tester.hypotheses, 'poses')
    pose = tester.poses[0]
    assert pose == tester.initial_poses[0]
    assert (pose.header.frame_id, pose.header.stamp.sec, pose.header.stamp.nanosec) == (
        'map', 12, 500_000_000)
    error_m, error_deg = transforms.pose_error(transform_of(pose.pose.pose), MAP_FROM_CAMERA)
    assert error_m < 0.05 and error_deg < 1.0
    covariance = np.array(pose.pose.covariance).reshape(6, 6)
    assert np.linalg.eigvalsh(covariance).min() > 0
    assert tester.hypotheses[0].poses[0] == pose.pose.pose


def test_an_answer_has_its_pose_and_evidence_in_fields(relocalizer, tester):
    """The documented client; ~/answer gives the same answer to late subscribers."""
    page = (PROJECT / 'doc/interface.md').read_text()
    client = subprocess.Popen(
        [sys.executable, '-c', re.search('```python\n(import rclpy.*?)```', page, re.DOTALL)[1]],
        stdout=subprocess.PIPE, text=True)
    tester.feed_until(lambda: client.poll() is not None, make_frame(stamp_s=12.5))
    verdict, x, y, _ = client.stdout.read().split()
    assert (verdict, client.returncode) == ('accepted', 0)
    heard = []
    subscription = tester.create_subscription(DiagnosticArray, 'relocalizer/answer', heard.append,
                                              LATCHED)
    tester.wait(lambda: heard, 'the last answer')
    (status,), header = heard[-1].status, heard[-1].header
    fields = {value.key: value.value for value in status.values}
    assert (header.frame_id, header.stamp.sec, fields['stamp [s]']) == ('map', 12, '12.500000000')
    pose = tester.poses[-1].pose
    assert [float(x), float(y), float(fields['z [m]'])] == [
        pose.pose.position.x, pose.pose.position.y, pose.pose.position.z]
    assert fields['covariance'].split() == [repr(float(value)) for value in pose.covariance]
    assert (fields['source'], fields['frames'], fields['landmarks']) == ('objects', '1', '12')
    assert 1.0 >= float(fields['confidence']) >= float(fields['confidence needed']) > 0.5
    assert 0.0 < float(fields['position deviation [m]']) < 0.2
    assert re.fullmatch(r'accepted: x [0-9. yz-]+ m in map, heading -?\d+ deg; deviation [0-9.]+ '
                        r'm, [0-9.]+ deg; by 12 landmarks; [0-9.]+ s', status.message)
    assert float(fields['search [ms]']) > 0.0
    ahead = MAP_FROM_CAMERA[:2, 2]
    assert abs(float(fields['heading [deg]']) - np.degrees(np.arctan2(*ahead[::-1]))) < 15.0
    documented = set(re.findall('`([a-z ]+(?: \\[\\w+\\])?|orientation xyzw)`',
                                page.split('### Answers in fields')[1].split('### What')[0]))
    assert {field for field in fields if not field.endswith('[ms]')} <= documented
    refused = tester.call_while(SelfTest, 'relocalizer/relocalize_fields', make_frame(
        see_room(make_room()).select(np.array([0, 1]))))
    fields = {value.key: value.value for value in refused.status[0].values}
    assert (refused.passed, fields['verdict'], fields['kind']) == (
        b'\x00', 'refused', 'too_few_objects')
    assert 'x [m]' not in fields
    tester.wait(lambda: heard[-1].status == refused.status, 'the same answer on the topic')
    assert int(refused.id) == int(fields['answer']) > 1
    tester.destroy_subscription(subscription)


def test_the_mount_moves_the_pose_and_its_covariance(relocalizer, tester):
    assert tester.relocalize(make_frame()).success
    mount = [0.1, 0.0, 1.0, 0.0, 0.6, 0.0, 0.8]
    assert tester.set_parameter('base_from_camera', mount).successful
    assert tester.set_parameter('base_frame', 'base_link').successful
    try:
        answer = tester.call_while(SelfTest, 'relocalizer/relocalize_fields', make_frame())
        tester.wait(lambda: len(tester.poses) == 2, 'the poses of camera and base')
        shown, = (value.value for value in answer.status[0].values if value.key == 'covariance')
        assert [*map(float, shown.split())] == [*tester.poses[1].pose.covariance]
        camera, base = (transform_of(pose.pose.pose) for pose in tester.poses)
        camera_from_base = transforms.invert_transform(
            transforms.transform_from_pose(np.array(mount[:3]), np.array(mount[3:])))
        error_m, error_deg = transforms.pose_error(base, MAP_FROM_CAMERA @ camera_from_base)
        assert error_m < 0.08 and error_deg < 1.0
        of_camera, of_base = (np.array(pose.pose.covariance).reshape(6, 6)
                              for pose in tester.poses)
        moved = transforms.move_covariance(of_camera, base[:3, 3] - camera[:3, 3])
        assert np.abs(moved - of_camera).max() > 1e-6
        np.testing.assert_allclose(of_base, moved, rtol=1e-6, atol=1e-12)
    finally:
        assert tester.set_parameter('base_frame', '').successful


def test_a_refusal_states_one_confidence(relocalizer, tester):
    assert tester.set_parameter('min_confidence', 0.9999).successful
    message = tester.relocalize(make_frame(see_room(make_room()).select(np.arange(5)))).message
    assert tester.set_parameter('min_confidence', 0.9).successful
    assert re.fullmatch(r'refused: confidence 0\.\d+ < 0\.9999; .*; kind \w+; [0-9.]+ s', message)
    assert message.count('confidence') == 1


def test_frames_out_of_order_and_time_going_back(relocalizer, tester):
    for stamp_s in (50.0, 10.0, 3600.0, 0.1):
        assert tester.relocalize(make_frame(stamp_s=stamp_s)).success
    newer, older = make_frame(stamp_s=80.0), make_frame(stamp_s=70.0)
    future = tester.ask()
    tester.feed_until(future.done, [newer[0], older[0], older[1], newer[1], older[2]])
    assert future.result().success
    tester.wait(lambda: tester.poses[-1].header.stamp.sec == 70, 'the older frame')


@pytest.mark.parametrize(('frame_id', 'moved_m'), [('camera', 0.0), ('right_camera', 0.12)])
def test_the_second_camera_of_a_stereo_pair(relocalizer, tester, frame_id, moved_m):
    """P[3] puts it beside the frame of the first camera, unless the frame is its own."""
    seen = see_room(make_room(), MAP_FROM_CAMERA @ rigid((0.12, 0.0, 0.0)))
    p = np.c_[CAMERA.matrix, [-0.12 * CAMERA.fx, 0.0, 0.0]].ravel()
    assert tester.relocalize(messages_of(seen, header_of(10**11, frame_id), PIXELS, info={'p': p})
                             ).success
    tester.wait(lambda: tester.poses, 'the pose')
    assert transforms.pose_error(transform_of(tester.poses[0].pose.pose),
                                 MAP_FROM_CAMERA @ rigid((moved_m, 0.0, 0.0)))[0] < 0.03
