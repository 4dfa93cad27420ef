# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Any localizer is found by what it takes and shows: success, silence, another place, death."""

from contextlib import nullcontext

import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from stand_ins import KINDS, Buffer, StandIn
from test_hand_over import Robot, robot  # noqa: F401 - a fixture

from cliploc_ros.ros.handoff import NoLocalizerError


@pytest.fixture
def start(robot: Robot, make_node):  # noqa: F811
    """Start a localizer, and look for it."""
    transforms = robot.handoff._transforms
    transforms._buffer = Buffer()

    def run(name):
        def tell(placed, is_static):
            for listener in transforms.listeners:
                listener(placed, is_static)
        localizer = StandIn(make_node, KINDS[name], tell)
        robot.executor.add_node(localizer.node)
        return localizer
    robot.open('auto')
    yield run
    robot.handoff.close()


def withheld(robot, named, timeout_s=1.7):  # noqa: F811
    with pytest.raises(NoLocalizerError, match=named) if named else nullcontext():
        robot.hand_over(timeout_s)


@pytest.mark.parametrize('name', KINDS)
def test_any_localizer_confirms_the_pose_that_it_takes(robot, make_node, start, name):  # noqa: F811
    topic = KINDS[name].shows
    localizer = start(name)
    robot.wait(lambda: not robot.handoff.localizer.missing(), 'the localizer')
    assert robot.handoff.localizer.pose_topic == (f'/{topic}' if topic else '')
    make_node('rosbag2_recorder').create_subscription(
        PoseWithCovarianceStamped, 'initialpose', print, 10)
    withheld(robot, '', 5.0)
    localizer.off_m = 2.0
    withheld(robot, r'differs from it by 2\.00 m')
    localizer.has_scans = False
    withheld(robot, f'no message on {f"/{topic}" if topic else "tf from the map"} since')
    localizer.has_scans, localizer.off_m = True, 0.0
    others = [one for one in KINDS if bool(KINDS[one].shows) is bool(topic)
              and KINDS[one].node != KINDS[name].node]
    other = start(others[0])
    robot.wait(robot.handoff.localizer.missing, 'the second localizer')
    count = len(localizer.given)
    withheld(robot, f'several localizers.*/{KINDS[others[0]].node}.*stop all but one', 0.7)
    assert len(localizer.given) == count and not other.given
    for node in (localizer.node, other.node):
        robot.executor.remove_node(node)
        node.destroy_node()
    robot.wait(robot.handoff.localizer.missing, 'their end')
    withheld(robot, 'nobody subscribes|no subscriber of', 0.7)
