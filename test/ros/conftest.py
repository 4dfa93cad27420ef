# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Nodes inside the test's process, in their own context."""

import threading
import time
from contextlib import suppress

import pytest
from handing_over import Robot
from nav_msgs.msg import Odometry
from rclpy.context import Context
from rclpy.exceptions import InvalidHandle
from rclpy.executors import MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.node import Node

# Time limit of a wait. Only a failing test takes this long.
PATIENCE_S = 60.0


@pytest.fixture(scope='module')
def context():
    """Create a context; rclpy's default one belongs to the tests of the nodes."""
    own = Context()
    own.init()
    yield own
    own.try_shutdown()


@pytest.fixture
def make_node(context):
    """Create nodes that are destroyed at the end of the test, with keywords of rclpy's Node."""
    made = []

    def make(name='node_under_test', **keywords):
        made.append(Node(name, context=context, **keywords))
        return made[-1]
    yield make
    for node in made:
        node.destroy_node()


@pytest.fixture
def wait():
    """Wait until a condition holds; fail at the time limit."""
    def wait_for(condition, what, work=lambda: time.sleep(0.002)):
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < deadline, f'waited {PATIENCE_S:g} s for {what}'
            work()
    return wait_for


@pytest.fixture
def spin_until(context, make_node, wait):
    """Execute the callbacks of nodes until a condition holds."""
    executor = SingleThreadedExecutor(context=context)

    def spin(nodes, condition, what, work=lambda: None):
        def step():
            work()
            executor.spin_once(timeout_sec=0.01)
        for node in nodes:
            executor.add_node(node)
        wait(condition, what, step)
    yield spin
    executor.shutdown()


@pytest.fixture
def robot(context, make_node, wait):
    robot = Robot(make_node, wait)
    executor = MultiThreadedExecutor(4, context=context)
    for node in (robot.node, robot.localizer.node):
        executor.add_node(node)

    def spin():
        with suppress(InvalidHandle):  # the shutdown below may happen while it waits
            executor.spin()
    spinning = threading.Thread(target=spin)
    spinning.start()
    yield robot
    robot.localizer.may_answer.set()
    executor.shutdown()
    spinning.join()


@pytest.fixture
def wheels(robot, make_node):
    """Create a silent publisher of odometry that the robot subscribes to."""
    wheels = make_node('wheels').create_publisher(Odometry, 'odom', 10)
    robot.odometry.open()
    robot.wait(lambda: wheels.get_subscription_count() and robot.odometry.is_published,
               'the discovery of the odometry')
    yield wheels
    robot.odometry.close()
