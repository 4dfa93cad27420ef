# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Faults on a robot: processes die, time jumps, cameras are too fast."""

import signal

import pytest
from tester import Tester, class_matching, make_frame

from demo import ASSETS

pytestmark = pytest.mark.full


def test_a_detector_that_is_killed_and_restarted_while_a_request_waits(start, tester, room_map):
    start('nodes.relocalizer', parameters=class_matching(room_map, timeout_s=60.0)
          ).wait_for_output('ready after')
    tester.connect()
    tester.destroy_publisher(tester.detections)
    try:
        first = start('nodes.detector', parameters={'model': ASSETS / 'yolo.onnx'})
        first.wait_for_output('ready after')
        future = tester.ask()
        tester.wait(lambda: tester.images.get_subscription_count() == 2, 'both to listen')
        first.stop(signal.SIGKILL)
        second = start('nodes.detector', parameters={'model': ASSETS / 'yolo.onnx'})
        stamps = iter(range(1, 100_000))

        def answered():
            tester.publish(make_frame(stamp_s=float(next(stamps)))[:2])
            return future.done()
        tester.wait(answered, 'an answer from the new detector')
        # noise shows no objects, and the answer says so
        assert future.result().message.startswith('refused: ')
        assert second.alive
    finally:
        tester.detections = tester.create_publisher(
            type(make_frame()[2]), 'detections', 10)


def test_two_robots_on_one_network_do_not_hear_each_other(start, room_map, tmp_path):
    other_map = tmp_path / 'other.yaml'
    other_map.write_text(room_map.read_text().replace('frame_id: map', 'frame_id: elsewhere'))
    robots = {}
    for name, path in (('robot_1', room_map), ('robot_2', other_map)):
        start('nodes.relocalizer', '--ros-args', '-r', f'__ns:=/{name}',
              parameters=class_matching(path)).wait_for_output('ready after')
        robots[name] = Tester(f'/{name}')
        robots[name].connect()
    for robot in robots.values():
        assert robot.relocalize(make_frame()).success
        robot.wait(lambda robot=robot: robot.initial_poses, 'an initial pose')
    for name, frame_id in (('robot_1', 'map'), ('robot_2', 'elsewhere')):
        robots[name].spin()
        assert {pose.header.frame_id for pose in robots[name].initial_poses} == {frame_id}
        robots[name].destroy_node()
