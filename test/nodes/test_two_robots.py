# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Several robots on one network, and several cameras on one robot."""


import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from std_srvs.srv import Trigger
from tester import TakingLocalizer, class_matching, make_frame

pytestmark = pytest.mark.full


def test_two_robots_on_one_network_do_not_hear_each_other(start, tester, room_map, tmp_path):
    other_map = tmp_path / 'other.yaml'
    other_map.write_text(room_map.read_text().replace('frame_id: map', 'frame_id: elsewhere'))
    frame = make_frame()
    heard, publishers, subscriptions, clients = {}, {}, [], {}
    for robot, path in (('robot_1', room_map), ('robot_2', other_map)):
        TakingLocalizer(tester, f'/{robot}/')
        start('nodes.relocalizer', '--ros-args', '-r', f'__ns:=/{robot}',
              parameters=class_matching(path)).wait_for_output('ready after')
        heard[robot] = []
        publishers[robot] = [tester.create_publisher(type(message), f'/{robot}/{name}', 10)
                             for message, name in zip(
                                 frame, ('image', 'camera_info', 'detections'), strict=True)]
        subscriptions.append(tester.create_subscription(
            PoseWithCovarianceStamped, f'/{robot}/initialpose', heard[robot].append, 10))
        clients[robot] = tester.create_client(Trigger, f'/{robot}/relocalizer/relocalize')
    try:
        for client in clients.values():
            tester.wait(client.service_is_ready, client.srv_name)
        for asked, silent in (('robot_1', 'robot_2'), ('robot_2', 'robot_1')):
            before = len(heard[silent])
            future = clients[asked].call_async(Trigger.Request())

            def answered(asked=asked, future=future):
                for publisher, message in zip(publishers[asked], frame, strict=True):
                    publisher.publish(message)
                return future.done()
            tester.wait(answered, 'an answer')
            assert future.result().success
            tester.wait(lambda robot=asked: heard[robot], 'an initial pose')
            assert len(heard[silent]) == before
        assert {pose.header.frame_id for pose in heard['robot_1']} == {'map'}
        assert {pose.header.frame_id for pose in heard['robot_2']} == {'elsewhere'}
    finally:
        for publisher in (*publishers['robot_1'], *publishers['robot_2']):
            tester.destroy_publisher(publisher)
        for subscription in subscriptions:
            tester.destroy_subscription(subscription)
        for client in clients.values():
            tester.destroy_client(client)
