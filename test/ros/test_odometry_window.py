# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The robot's pose at an instant, from odometry messages in their order of arrival."""

from copy import deepcopy
from itertools import product

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cliploc_ros.ros.inputs.odometry import OdometryWindow

S = 1_000_000_000


def talk(window, seconds, x_m=0.0, y_m=0.0, degrees=0.0):
    """Add a pose; return whether it starts another run."""
    run = window.run
    assert window.add(round(seconds * S), np.array([x_m, y_m, 0.0]),
                      Rotation.from_euler('z', degrees, degrees=True).as_quat())
    return window.run != run


def on_an_arc(seconds, speed_m_s):
    """Return the pose of a robot that drives on an arc: x and y [m], and its heading [deg]."""
    radius_m, angle = speed_m_s / 0.4, 0.4 * seconds
    return np.array([radius_m * np.sin(angle), radius_m * (1.0 - np.cos(angle)),
                     np.degrees(angle)])


def driven(rate_hz, speed_m_s):
    """Return a window of a robot that has driven for 3 s, and the time of its newest pose."""
    window, moments = OdometryWindow(30.0), np.arange(3 * rate_hz) / rate_hz
    for moment in moments:
        assert not talk(window, moment, *on_an_arc(moment, speed_m_s))
    return window, moments[-1]


def test_memory_is_bounded():
    window, crowded = OdometryWindow(2.0), OdometryWindow(1000.0, max_poses=50)
    for moment, one in product(np.arange(0.0, 60.0, 0.1), (window, crowded)):
        talk(one, moment, *on_an_arc(moment, 1.0))
    assert (len(window), len(crowded)) == (21, 50)
    crowded.pose_at(round(59.85 * S))


@pytest.mark.parametrize(('speed_m_s', 'turn_deg_s', 'silence_s', 'x_m', 'degrees', 'restarts'), [
    # it stood: it is at the same place, or its driver restarted within a distance that it could
    # drive
    *((0.0, 0.0, silence_s, *moved) for silence_s in (3.5, 60.0) for moved in (
        (0.0, 0.0, False), (0.08, 4.0, False), (1.0, 0.0, True), (-0.2, 0.0, True),
        (0.0, 8.0, True))),
    # it drove on for 2 s or stopped; its driver restarted at (0, 0), where it did not drive
    *((0.5, 15.0, 2.0, *moved) for moved in (
        (3.5, 30.0, False), (2.6, 0.0, False), (3.2, 15.0, False), (0.0, 0.0, True),
        (5.0, 30.0, True), (3.5, 80.0, True))),
    # its path in a long silence is unknown
    (0.5, 0.0, 4.0, 4.5, 0.0, True)])
def test_where_a_robot_may_be_after_a_silence(speed_m_s, turn_deg_s, silence_s, x_m, degrees,
                                              restarts):
    for period_s in (0.02, 0.1, 1.0) if not speed_m_s else (0.1,):
        window = OdometryWindow(10.0)
        for moment in np.arange(0.0, 5.01, period_s):
            assert not talk(window, moment, speed_m_s * moment,
                            degrees=turn_deg_s * (moment - 5.0))
        assert talk(window, 5.0 + silence_s, x_m, degrees=degrees) == restarts


def test_a_slow_source_that_misses_two_messages_goes_on():
    window = OdometryWindow(30.0)
    assert not any(talk(window, moment, 0.3 * moment)
                   for moment in (0.0, 1.0, 2.0, 3.0, 6.0, 7.0, 9.0))


def test_stamps_that_go_back_bit_by_bit_hold_no_run_together():
    window = OdometryWindow(30.0)
    for tick in range(60):
        talk(window, 100.0 - 0.01 * tick, 0.03 * tick)
    assert window.run >= 5 and len(window) <= 6


@pytest.mark.parametrize('rate_hz', [5, 30])
@pytest.mark.parametrize('speed_m_s', [0.0, 0.3, 1.0])
def test_a_driver_that_restarts_in_a_gap_is_noticed(rate_hz, speed_m_s):
    """At another place or with another heading; a robot that slips and has late stamps goes on."""
    former, newest = driven(rate_hz, speed_m_s)
    for gap_s, moved in product((1 / rate_hz, 0.4), ((-1.2, 0, 0), (0, 0, 90), (0, 0, -90))):
        window = deepcopy(former)
        assert talk(window, newest + gap_s, *on_an_arc(newest + gap_s, speed_m_s) + moved)
        assert len(window) == 1
    for gap_s in (1 / rate_hz, 0.4):
        window = deepcopy(former)
        for moment, moved in ((newest + gap_s, (-0.04, 0, 3)), (newest + 2 * gap_s, (0, 0, 0))):
            assert not talk(window, moment, *on_an_arc(moment, speed_m_s) + moved)


@pytest.mark.parametrize('rate_hz', [5, 50])
def test_a_robot_that_starts_and_stops_does_not_restart(rate_hz):
    """It accelerates at 2 m/s^2."""
    window, place_m = OdometryWindow(30.0), 0.0
    for moment in np.arange(0.0, 12.0, 1 / rate_hz):
        speed_m_s = np.clip(2.0 * min(moment % 4.0 - 1.0, 3.0 - moment % 4.0), 0.0, 1.5)
        place_m += speed_m_s / rate_hz
        talk(window, moment, place_m)
    assert window.run == 0


@pytest.mark.parametrize('rate_hz', [5, 50])
@pytest.mark.parametrize('back_s', [0.25, 0.8, 98.0])
def test_a_clock_set_back_begins_another_run(rate_hz, back_s):
    """Repeated or nearly repeated stamps with other poses, and a simulation that restarts."""
    window, newest = driven(rate_hz, 1.0)
    for moment in newest + np.arange(1, 2 + round(min(back_s, 1.0) * rate_hz)) / rate_hz:
        place = on_an_arc(moment, 1.0)
        talk(window, moment - back_s, *place)
    assert window.run >= 1
    assert window.pose_at(round((moment - back_s) * S))[0, 3] == pytest.approx(place[0])


def test_one_of_two_poses_of_a_stamp_stays():
    window = OdometryWindow(30.0)
    for x_m in (1.0, 1.02, 1.04):  # a filter that corrects its pose
        talk(window, 1.0, x_m)
    assert window.pose_at(S)[0, 3] == 1.0 and window.run == 0
    assert talk(window, 1.0, 1.2)


def test_the_way_is_what_was_driven_not_how_far_it_led():
    window = OdometryWindow(10.0)
    for tick in range(400):  # 40 s there and back, by 2 m at .1 m/s
        talk(window, 0.1 * tick, 0.01 * (200 - abs(tick - 200)))
    assert window.way_at(39 * S) == pytest.approx(3.9, abs=0.05)
    assert window.way_at(35 * S) == pytest.approx(3.5, abs=0.05)
    talk(window, 39.05, 0.1)  # late
    assert window.way_at(39 * S + S // 20) == window.way_at(39 * S)
    talk(window, 40.0)
    assert window.way_at(40 * S) == pytest.approx(4.0, abs=0.05)
    window.clear()
    rng = np.random.default_rng(0)  # visual odometry jitters by millimetres
    for tick in range(50 * 50, 110 * 50):
        talk(window, tick / 50, *rng.normal(0.0, 0.002, 2))
    assert window.way_at(109 * S) < 0.2, 'each run starts at a distance of 0'
