# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Nodes inside the test's process, in their own context."""

import time

import pytest
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
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
