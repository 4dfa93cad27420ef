# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which frames are asked about together."""

import numpy as np
import pytest
from scene import CAMERA, make_room, see_room
from scipy.spatial.transform import Rotation

from cliploc_ros.core.acceptance.confidence import Support
from cliploc_ros.core.geometry.transforms import make_transform
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.relocalization import Hypothesis, Relocalization
from cliploc_ros.ros.frame_window import FrameWindow

SEEN = see_room(make_room())
NOTHING = SEEN.select(np.array([], dtype=np.int64))


def frame(seconds, degrees=0.0, metres=0.0, detections=SEEN):
    turn = Rotation.from_euler('z', degrees, degrees=True).as_matrix()
    return Observation(CAMERA, detections, stamp_ns=round(seconds * 1e9),
                       odom_from_camera=make_transform(turn, np.array([metres, 0.0, 0.0])))


def join(window, observation, run=0, limit=5, length_s=5.0):
    return [one.observation.stamp_ns / 1e9
            for one in window.join(observation, run, limit, length_s)]


@pytest.fixture
def window():
    return FrameWindow()


def test_a_camera_that_stands_is_asked_about_once(window):
    for number in range(20):
        assert join(window, frame(number / 10, degrees=0.1 * number)) == [number / 10]


@pytest.mark.parametrize('step', [{'degrees': 4.0}, {'metres': 0.06}])
def test_a_camera_that_moves_shows_something_new(window, step):
    for number in range(3):
        found = join(window, frame(number, **{name: number * size
                                              for name, size in step.items()}))
    assert found == [0.0, 1.0, 2.0]


def test_a_camera_that_creeps_gets_away(window):
    for number in range(31):
        found = join(window, frame(number / 10, degrees=0.4 * number))
    # each as far from the one before as a new one must be
    assert found == [0.7, 1.5, 2.3, 3.0]


def test_of_too_many_those_stay_that_show_most(window):
    for number in range(31):
        found = join(window, frame(number / 10, degrees=6.0 * number))
        assert len(window) <= 5
    assert found[0] == 0.0 and found[-1] == 3.0
    assert np.diff(found).max() <= 1.6, 'all of the way'


def test_the_newest_is_always_asked_about(window):
    for number in range(10):
        for limit in (5, 2, 1, 3):
            found = join(window, frame(number + limit / 10, 10.0 * number), limit=limit)
            assert found[-1] == number + limit / 10 and len(found) <= limit


def test_old_frames_go(window):
    for number in range(4):
        join(window, frame(number, 10.0 * number))
    assert join(window, frame(7.5, 90.0)) == [3.0, 7.5]
    assert join(window, frame(60.0, 0.0)) == [60.0]


def test_time_that_goes_back_begins_anew(window):
    for number in range(4):
        join(window, frame(100 + number, 10.0 * number))
    assert join(window, frame(3.0, 50.0)) == [3.0]
    assert join(window, frame(3.0, 90.0)) == [3.0], 'the same again'


def test_another_run_of_odometry_begins_anew(window):
    for number in range(4):
        join(window, frame(number, 10.0 * number), run=1)
    assert join(window, frame(4.0, 50.0), run=2) == [4.0]
    assert join(window, frame(5.0, 90.0), run=2) == [4.0, 5.0]


def test_what_showed_nothing_is_not_kept(window):
    join(window, frame(0.0, 0.0))
    assert join(window, frame(1.0, 10.0, detections=NOTHING)) == [0.0, 1.0]
    assert join(window, frame(2.0, 20.0)) == [0.0, 2.0]


def test_what_was_found_is_kept_until_it_is_of_no_use(window):
    for number in range(3):
        window.join(frame(number, 10.0 * number), 0, 5, 5.0)[-1].searched = f'search {number}'
    frames = window.join(frame(3.0, 30.0), 0, 5, 5.0)
    assert [one.searched for one in frames] == ['search 0', 'search 1', 'search 2', None]
    window.forget_searches()
    assert not any(one.searched for one in frames)


def found(x_m, accepted=True, yaw_deg=0.0):
    """A pose of the camera by the last frame."""
    pose = make_transform(Rotation.from_euler('z', yaw_deg, degrees=True).as_matrix(),
                          np.array([x_m, 0.0, 0.0]))
    return Relocalization(accepted, '' if accepted else 'unsure',
                          (Hypothesis(pose, 3.0, 0.995 if accepted else 0.5, Support()),))


def look(window, seconds, result, run=0, **frame_arguments):
    """Whether a result is believed after those before."""
    join(window, frame(seconds, **frame_arguments), run)
    return window.judge(result).accepted


def test_the_first_look_is_believed(window):
    assert look(window, 0.0, found(0.0))
    assert look(window, 0.1, found(0.1))


def test_one_look_of_many_does_not_mislead(window):
    for number in range(6):
        assert not look(window, number / 10, found(2.0 * number, accepted=False))
    join(window, frame(0.7))
    result = window.judge(found(3.1))
    assert not result.accepted and result.hypotheses
    assert result.reason.startswith('unsure: only 1 of the last 7 images lead to this pose')
    assert not look(window, 0.8, found(3.1, yaw_deg=30.0)), 'turned otherwise'


def test_what_most_looks_lead_to_is_believed(window):
    assert not look(window, 0.0, found(9.0, accepted=False))
    assert not look(window, 0.1, found(1.0, accepted=False))
    # two of three, of which one was not sure of it
    assert look(window, 0.2, found(1.2))


def test_looks_that_find_nothing_do_not_count(window):
    assert not look(window, 0.0, Relocalization(False, 'no pose'))
    assert not look(window, 0.1, found(9.0, accepted=False))
    assert not look(window, 0.2, Relocalization(False, 'nothing'), detections=NOTHING)
    assert not look(window, 0.3, found(1.0)), 'the look before is not forgotten'


@pytest.mark.parametrize(('turned_deg', 'driven_m'), [(0.0, 0.0), (10.0, 0.0), (10.0, 0.8)])
def test_looks_are_carried_by_odometry(window, turned_deg, driven_m):
    """Of a robot that turned to and fro, odometry agrees with what is found or does not."""
    for number in range(10):
        degrees, metres = number % 2 * turned_deg, number * driven_m
        right = found(metres, number % 2 == 1, yaw_deg=degrees)
        assert look(window, number / 10, right, degrees=degrees, metres=metres) == number % 2
    stuck = [look(window, 1.0 + number / 10, found(0.0), degrees=4.0 * number, metres=number)
             for number in range(1, 10)]
    assert not any(stuck), 'poses that do not move though the robot does'


def test_looks_of_another_run_or_time_do_not_count(window):
    for number in range(3):
        assert not look(window, number, found(9.0, accepted=False))
    assert look(window, 3.0, found(1.0), run=1)
    assert not look(window, 4.0, found(5.0), run=1)
    assert look(window, 9.5, found(5.0), run=1), 'too old'
    assert look(window, 2.0, found(3.0), run=1), 'time went back'


def test_what_was_in_the_way_is_forgotten_in_time(window):
    for number in range(100):
        assert not look(window, number / 10, found(9.0, accepted=False))
    believed = [look(window, 10.0 + number / 10, found(1.0)) for number in range(15)]
    assert believed == [False] * 10 + [True] * 5
