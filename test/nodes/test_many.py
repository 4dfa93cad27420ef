# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Many requests, and several robots on one network."""

import os

from conftest import class_matching, make_frame
from geometry_msgs.msg import PoseWithCovarianceStamped
from std_srvs.srv import Trigger

from cliploc_ros.ros.conversions import stamp_ns

# A soak takes 10,000 and half an hour; the first tenth is for what is loaded when first needed.
REQUESTS = int(os.environ.get('CLIPLOC_SOAK_REQUESTS', '40'))


def test_no_request_is_lost_or_answered_twice_and_memory_stays(own_relocalizer, tester):
    process = own_relocalizer()
    memory_mib, descriptors = [], []
    for number in range(REQUESTS):
        tester.forget()
        assert tester.relocalize(make_frame(stamp_s=float(number))).success
        tester.wait(lambda: tester.initial_poses, 'an initial pose')
        stamps_s = {stamp_ns(pose.header.stamp) // 10**9 for pose in tester.initial_poses}
        assert (len(tester.initial_poses), stamps_s) == (1, {number})
        memory_mib.append(process.memory_mib())
        descriptors.append(process.descriptors())
    warm = REQUESTS // 10
    growth = memory_mib[-1] / memory_mib[warm] - 1
    print(f'\n{REQUESTS} requests: {memory_mib[warm]:.0f} to {memory_mib[-1]:.0f} MiB '
          f'({100 * growth:+.2f} %), {descriptors[warm]} to {descriptors[-1]} file descriptors')
    assert growth < 0.02
    assert descriptors[-1] <= descriptors[warm] + 2


def test_two_robots_on_one_network_do_not_hear_each_other(start, tester, room_map, tmp_path):
    other_map = tmp_path / 'other.yaml'
    other_map.write_text(room_map.read_text().replace('frame_id: map', 'frame_id: elsewhere'))
    frame = make_frame()
    heard, publishers, subscriptions, clients = {}, {}, [], {}
    for robot, path in (('robot_1', room_map), ('robot_2', other_map)):
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
