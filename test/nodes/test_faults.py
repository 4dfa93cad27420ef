# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Several robots on one network."""

import pytest
from tester import Tester, class_matching, make_frame

pytestmark = pytest.mark.full


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
