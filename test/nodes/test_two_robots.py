# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Several robots on one network, and several cameras on one robot."""

import time

import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from std_srvs.srv import Trigger
from tester import TakingLocalizer, class_matching, make_frame

from cliploc_ros.ros.conversions import stamp_ns

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


def test_two_cameras_of_one_robot_have_one_odometry_and_one_localizer(start, tester, room_map):
    """Each in a namespace of its own, and the robot's names given back (doc/nav2.md)."""
    remaps = [argument for name in ('odom', 'initialpose', 'amcl_pose', 'request_nomotion_update')
              for argument in ('-r', f'{name}:=/{name}')]
    for camera in ('front', 'rear'):
        start('nodes.relocalizer', '--ros-args', '-r', f'__ns:=/{camera}', *remaps,
              parameters=class_matching(room_map)).wait_for_output('ready after')
    publishers = {camera: [tester.create_publisher(type(message), f'/{camera}/{name}', 10)
                           for message, name in zip(
                               make_frame(), ('image', 'camera_info', 'detections'), strict=True)]
                  for camera in ('front', 'rear')}
    odom, odometry = tester.create_publisher(Odometry, '/odom', 10), Odometry()

    def publish_odometry():
        odometry.header.stamp = tester.get_clock().now().to_msg()
        odom.publish(odometry)

    def ask(camera):
        client = tester.create_client(Trigger, f'/{camera}/relocalizer/relocalize')
        tester.wait(client.service_is_ready, client.srv_name)
        future = client.call_async(Trigger.Request())
        frame = make_frame(stamp_s=time.time() + 0.3)  # odometry begins before it

        def answered():
            publish_odometry()
            for publisher, message in zip(publishers[camera], frame, strict=True):
                publisher.publish(message)
            return future.done()
        tester.wait(answered, 'an answer')
        tester.destroy_client(client)
        return future.result()
    try:
        odometry.twist.twist.linear.x = 0.5
        assert [ask(camera).message.split(':')[0] for camera in publishers] == ['withheld'] * 2
        assert not tester.initial_poses
        odometry.twist.twist.linear.x = 0.0
        rests_until = time.monotonic() + 1.0  # what a busy node has heard last may be older
        tester.wait(lambda: publish_odometry() or time.monotonic() > rests_until, 'a second')
        for camera in publishers:
            answer = ask(camera)
            assert answer.success, answer.message
        tester.wait(lambda: len({stamp_ns(pose.header.stamp) for pose in tester.initial_poses})
                    == 2, 'a pose by each camera')
    finally:
        for publisher in (odom, *publishers['front'], *publishers['rear']):
            tester.destroy_publisher(publisher)
