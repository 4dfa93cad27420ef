# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A pose is handed over only if odometry shows that the robot has not moved since its image."""

from concurrent.futures import ThreadPoolExecutor

import pytest
from handing_over import ONE_HZ, TEN_HZ, stand, tell

from cliploc_ros.ros.handoff import HandOffError


@pytest.fixture
def listening(robot, wheels):
    """Return a robot whose localizer receives poses."""
    robot.localizer.subscribe()
    robot.meet()
    return robot


def is_withheld(robot, timeout_s=10.0):
    """Hand a pose over; return the reason why it is withheld, or ''."""
    try:
        robot.hand_over(timeout_s)
    except HandOffError as error:
        assert not robot.localizer.poses
        return str(error)
    robot.wait(lambda: robot.localizer.poses, 'the pose')
    return ''


@pytest.mark.parametrize('moments_s', [ONE_HZ, TEN_HZ, (0.0, 0.5, 2.5)])
@pytest.mark.parametrize('speeds', [{'speed_m_s': 0.5}, {'twist_m_s': 0.5}])
def test_a_robot_that_drives_gets_no_pose_however_slow_its_odometry(listening, wheels, moments_s,
                                                                    speeds):
    """Motion shows in poses without a twist, or in a twist with constant poses."""
    tell(listening, wheels, moments_s, **speeds)
    assert 'moves at 0.50 m/s' in is_withheld(listening)


@pytest.mark.parametrize(('moments_s', 'timeout_s'), [(ONE_HZ, 10.0), (TEN_HZ, 10.0),
                                                      (TEN_HZ, -1.0)])
def test_a_robot_at_rest_gets_its_pose_however_slow_its_odometry(listening, wheels, moments_s,
                                                                 timeout_s):
    """A source of twists only looks the same at rest. Late odometry will do."""
    tell(listening, wheels, moments_s)
    assert listening.hand_over(timeout_s) < 1.5, 'two messages at 1 Hz are enough'
    listening.wait(lambda: listening.localizer.poses, 'the pose')


@pytest.mark.parametrize(('x_m', 'rad_per_m', 'has_moved'), [
    (0.12, 0.0, True), (-0.12, 0.0, True), (0.01, 10.0, True), (0.08, 0.8, False)])
def test_a_robot_that_has_moved_since_its_image_gets_no_pose(listening, wheels, x_m, rad_per_m,
                                                             has_moved):
    """The robot stopped half a second before the hand-over."""
    stand(listening, wheels, {tick / 10: min(1.0, tick / 5) * x_m for tick in range(11)},
          rad_per_m=rad_per_m)
    assert ('has moved' in is_withheld(listening)) == has_moved


@pytest.mark.parametrize('places', [
    {-0.5: 0.0, 0.5: 1.0, 1.5: 1.0}, {-1.5: 0.0, 0.5: 0.2, 1.5: 0.2}, {-0.5: 0.0, 0.6: 1.0,
                                                                     0.8: 1.0, 1.0: 1.0}])
def test_slow_odometry_tells_that_the_robot_has_moved_since_its_image(listening, wheels, places):
    """It was between two places when the image was taken, and stands now."""
    stand(listening, wheels, places)
    assert 'has moved' in is_withheld(listening)


@pytest.mark.parametrize(('x_m', 'has_moved'), [(1.0, True), (0.0, False)])
def test_an_image_newer_than_odometry_waits_for_it(listening, wheels, x_m, has_moved):
    stand(listening, wheels, {-2.0: 0.0, -1.0: 0.0})
    with ThreadPoolExecutor(1) as pool:
        handing_over = pool.submit(is_withheld, listening)
        listening.wait(lambda: listening.odometry._heard._waiters, 'a wait for odometry')
        stand(listening, wheels, {0.3: x_m})
        assert ('has moved by 1.00 m' in handing_over.result()) == has_moved


@pytest.mark.parametrize(('places', 'named'), [
    # older than the image, newer, or with a gap around it
    *((dict.fromkeys(moments_s, 0.0), 'does not cover') for moments_s in (
        (-4.0, -3.5, -3.0), (1.0, 2.0), (-4.0, 0.5, 1.0))),
    # the stamp is constant, or the poses are too far apart; the twist is empty
    ({7.0: 0.0}, 'the speed is unknown'), ({0.0: 0.0, 10.0: 0.0}, 'the speed is unknown'),
    ({0.0: 0.0, 10.0: 5.0}, 'the speed is unknown')])
def test_odometry_that_does_not_tell_of_rest_withholds_the_pose(listening, wheels, places, named):
    for _ in range(3 if len(places) == 1 else 1):
        stand(listening, wheels, places)
    assert named in is_withheld(listening, 2.5)
