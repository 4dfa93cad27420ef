# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Nav2's grid follows the robot from floor to floor: the order, and failures at each step."""

import random

import pytest
from stand_ins import KINDS, Nav2, StandIn
from test_hand_over import Robot, robot  # noqa: F401 - a fixture

from cliploc_ros.errors import HandOffError, NoLocalizerError

pytestmark = pytest.mark.needs('nav2_msgs')
GRIDS = {f'floor_{number}': f'/maps/{number}.yaml' for number in range(3)}
POSE = 'pose in map'


@pytest.fixture
def nav2(robot: Robot, make_node):  # noqa: F811
    """Start AMCL, map_server and costmaps."""
    robot.amcl = StandIn(make_node, KINDS['amcl'], lambda *_: None)
    nav2 = Nav2(make_node('nav2'))
    for node in (robot.amcl.node, nav2._node):
        robot.executor.add_node(node)
    robot.open('auto')
    robot.wait(lambda: not robot.handoff.localizer.missing(), 'the localizer')
    robot.enter = lambda floor, timeout_s=5.0, **how: robot.hand_over(
        timeout_s, f'floor_{floor}', GRIDS, nomotion_updates=0, **how)
    yield nav2
    nav2.ended.set()
    robot.handoff.close()


def test_fifty_changes_between_three_floors(robot, nav2):  # noqa: F811
    """The grid is loaded, then the costmaps are cleared, then the pose is given, once."""
    floor, expected = 0, []
    for step in range(51):
        robot.enter(floor)
        expected += [str(floor), 'global', 'local', POSE]
        robot.wait(lambda: len(nav2.order) >= len(expected), 'the pose')  # noqa: B023
        assert nav2.order == expected, step
        floor = (floor + random.Random(step).randint(1, 2)) % 3
    robot.enter(floor := int(nav2.order[-4]))
    robot.wait(lambda: nav2.order[-2:] == [POSE] * 2, 'a pose on the loaded floor')
    nav2.load_another()
    robot.wait(lambda: not robot.handoff.floors.loaded, 'the grid of another program')
    robot.enter(floor)
    assert nav2.order[-4:-1] == [str(floor), 'global', 'local']


@pytest.mark.parametrize(('broken', 'named', 'got'), [
    ('result', 'load_map: result 1', '1'), ('1', 'load_map does not answer', '1'),
    ('grid', 'result 0, and no such grid on map', '1'),
    ('global', 'clear_entirely_global_costmap does not answer', '1 global'),
    ('local', 'clear_entirely_local_costmap does not answer', '1 global local')])
def test_what_fails_withholds_the_pose_and_restores_the_grid(robot, nav2, broken, named,  # noqa: F811
                                                             got):
    robot.enter(0)
    robot.wait(lambda: len(nav2.order) == 4, 'the first floor')
    nav2.order.clear()
    nav2.broken = broken
    with pytest.raises(NoLocalizerError, match=rf"{named}.*'floor_0' is requested again"):
        robot.enter(1, 1.5)
    nav2.broken = ''
    nav2.ended.set()
    robot.wait(lambda: nav2.order == [*got.split(), '0'] and (
        robot.handoff.floors.loaded == {'map': 'floor_0'} or broken == 'grid'), 'the former grid')
    robot.enter(1)
    robot.wait(lambda: nav2.order[-4:] == ['1', 'global', 'local', POSE], 'the next request')


def test_a_dead_map_server_or_localizer_and_a_lift(robot, nav2):  # noqa: F811
    """A lift brings the robot to another floor while odometry shows rest."""
    with pytest.raises(HandOffError, match=r'image is 6\.0 s old, and a lift'):
        robot.enter(1, age_s=6.0)
    with pytest.raises(NoLocalizerError, match="'floor_7' has no nav2_map"):
        robot.enter(7)
    assert not nav2.order
    robot.enter(0)
    robot.amcl.off_m = 3.0
    with pytest.raises(NoLocalizerError, match=r"differs .*'floor_0' is requested again"):
        robot.enter(1, 1.5)
    robot.wait(lambda: robot.handoff.floors.loaded == {'map': 'floor_0'}, 'the former grid')
    nav2.kill_map_server()
    count = nav2.order.count(POSE)
    with pytest.raises(NoLocalizerError, match=r'nobody serves .*load_map'):
        robot.enter(2, 1.5)
    assert nav2.order.count(POSE) == count
