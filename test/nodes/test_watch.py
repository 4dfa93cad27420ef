# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The watch of a localizer that is correct, kidnapped, silent or broken, with real nodes."""

import signal
from dataclasses import replace

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from frames import stamp
from processes import wait_for
from scene import make_room, write_map
from std_msgs.msg import Bool, Header, String
from tester import class_matching, transform_of
from watched import MOUNT, Robot

from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.ros.conversions import transform_msg
from cliploc_ros.ros.qos import LATCHED

PERIOD_S = 1.0


class Watched:
    """The published output of a watch, while its robot drives."""

    def __init__(self, tester, process):
        self.tester, self.robot, self.process = tester, Robot(tester), process
        self._begin = len(process.output())
        #: One report of each look.
        self.states, self.flags, self.values, self.message = [], [], {}, ''
        self._heard = [
            tester.create_subscription(String, 'relocalizer/localization_state',
                                       lambda msg: self.states.append(msg.data), LATCHED),
            tester.create_subscription(Bool, 'relocalizer/localized',
                                       lambda msg: self.flags.append(msg.data), LATCHED),
            tester.create_subscription(DiagnosticArray, '/diagnostics', self._take, 10)]

    def output(self):
        """Return the relocalizer's output since the start of the test."""
        return self.process.output()[self._begin:]

    def _take(self, msg):
        self.message = msg.status[0].message
        self.values = {value.key: value.value for value in msg.status[0].values}

    def close(self):
        self.robot.close()
        for subscription in self._heard:
            self.tester.destroy_subscription(subscription)
        print(self.output())
        assert self.process.alive and 'Traceback' not in self.output()

    def until(self, condition, what):
        try:
            wait_for(condition, what, 60.0, self.robot.step)
        finally:
            print(what, self.states[-8:], self.values.get('watch reason'))

    def until_state(self, state):
        """Drive until a state is published; return the number of looks."""
        before = len(self.states)
        self.until(lambda: state in self.states[before:], state)
        return 1 + self.states[before:].index(state)

    def kidnap(self):
        """Kidnap the robot by 3 m, and drive until it is lost.

        In eight tries, with looks .3 m apart after eight agreeing looks, it took 4 to 11 looks.
        Earlier reports do not count as looks at the other place.
        """
        self.robot.carry(3.0)
        assert self.until_state('uncertain') <= 3 and self.until_state('lost') <= 12

    def looks(self, count):
        """Drive for some looks; return their states."""
        before = len(self.states)
        self.until(lambda: len(self.states) >= before + count, f'{count} looks')
        return self.states[before:]

    def until_reason(self, text):
        """Drive until the diagnostics state a reason; the robot is never lost meanwhile."""
        before = len(self.states)
        self.until(lambda: text in self.values.get('watch reason', ''), f'the reason {text!r}')
        assert 'lost' not in self.states[before:]


def parameters(room_map, **others):
    return class_matching(room_map, base_frame='base_link', base_from_camera=MOUNT,
                          watch_period_s=PERIOD_S, **others)


@pytest.fixture(scope='module')
def watching(start_shared, tester, room_map):
    """Return a relocalizer that watches a localizer by its topic."""
    tester.localizer.is_on = False
    process = start_shared('nodes.relocalizer', parameters=parameters(room_map, watch='amcl_pose'))
    process.wait_for_output('ready after')
    tester.connect()
    yield process
    tester.localizer.is_on = True


@pytest.fixture
def watched(watching, tester):
    """A robot in the room, whose localizer is watched from now on."""
    watched = Watched(tester, watching)
    assert tester.set_parameter('on_lost', 'report').successful
    assert tester.trigger('reload_map').success  # drops the verdict of the test before
    tester.wait(lambda: watched.states and watched.states[-1] == 'uncertain', 'the end')
    yield watched
    watched.close()


@pytest.mark.full
def test_a_kidnapped_robot_is_reported_and_on_demand_relocalized_once_it_stands(watched, tester):
    watched.until_state('localized')
    assert set(watched.looks(10)) == {'localized'}
    assert watched.flags[-1] is True
    assert float(watched.values['watch probability']) > 0.9
    assert int(watched.values['watch looks']) > 5
    assert 'expected' in watched.values['watch matched']
    watched.kidnap()
    assert watched.flags[-1] is False
    assert tester.set_parameter('on_lost', 'relocalize').successful
    watched.looks(3)
    assert watched.values['on lost'].startswith(
        ('the robot moves', 'the robot has just')), 'nothing is done'
    assert tester.set_parameter('on_lost', 'report').successful
    watched.robot.speed_m_s = 0.0
    watched.until(lambda: watched.values.get('on lost') == 'the robot is at rest', 'rest')
    watched.looks(3)
    assert 'watch: lost' in watched.message and 'relocalizing' not in watched.output()
    assert not tester.poses and not tester.initial_poses
    assert tester.set_parameter('on_lost', 'relocalize').successful
    watched.until(lambda: tester.poses, 'a request')
    error_m, error_deg = pose_error(transform_of(tester.poses[-1].pose.pose),
                                    watched.robot.map_from_base)
    assert error_m < 0.05 and error_deg < 1.0
    watched.until_state('localized')
    watched.robot.speed_m_s = 0.2
    assert set(watched.looks(5)) == {'localized'}
    assert watched.output().count('relocalizing') == 1


def test_a_localizer_that_started_again_without_a_pose_is_woken_up(watched, tester):
    """As AMCL with use_respawn: it advertises and subscribes again, and waits for a pose."""
    assert tester.set_parameter('on_lost', 'relocalize').successful
    watched.until_state('localized')
    watched.robot.speed_m_s, watched.robot.has_localizer = 0.0, False
    watched.looks(1)  # the start takes time; the previous pose is still received
    tester.localizer.start_again()
    watched.until(lambda: tester.poses, 'a request')
    watched.until_state('localized')
    assert 'the localizer has no pose' in watched.output()


def test_a_map_of_another_frame_ends_the_verdict_of_the_one_before(watched, tester, room_map,
                                                                   tmp_path):
    """No image arrives meanwhile: the verdict is dropped with its map, not at the next look."""
    watched.until_state('localized')
    write_map(replace(make_room(), frame_id='elsewhere'), tmp_path / 'elsewhere.yaml')
    assert tester.set_parameter('map_file', str(tmp_path / 'elsewhere.yaml')).successful
    assert tester.trigger('reload_map').success
    tester.wait(lambda: 'a map was loaded' in watched.values['watch reason'], 'the end')
    assert watched.states[-1] == 'uncertain'
    watched.until_reason("the localizer's pose is in frame 'map'")
    assert 'internal error' not in watched.output()
    assert tester.set_parameter('map_file', str(room_map)).successful


def test_a_dead_localizer_is_logged_once_however_long_it_is_dead(watched):
    """Its age in the message grows with each look."""
    watched.until_state('localized')
    watched.robot.has_localizer = watched.robot.has_odom = False
    watched.until_reason('s older than the image')
    watched.looks(2)
    assert watched.output().count('s older than the image') == 1
    watched.robot.has_localizer = watched.robot.has_odom = True
    watched.until_state('localized')
    assert watched.output().count('watch: localized') == 2, 'changes are logged'


@pytest.mark.full
def test_wake_up_goes_on_and_wakes_a_lost_robot_up_again(watched, start):
    """The robot continues to drive, and nothing is done until it stands."""
    watched.robot.speed_m_s = 0.0
    process = start('cli.wake_up', '--watch', '--turn-deg', 0)
    watched.until(lambda: 'look 1 ' in process.output(), 'a look')
    watched.robot.speed_m_s = 0.3
    watched.until(lambda: 'watch: localized' in process.output(), 'localized')
    watched.robot.carry(3.0)
    watched.until(lambda: ' moves at 0.' in process.output(), 'lost')
    assert process.output().count('accepted: ') == 1
    watched.robot.speed_m_s = 0.0
    watched.until(lambda: process.output().count('accepted: ') == 2, 'another wake-up')
    said = process.output().count('watch: localized')
    watched.until(lambda: process.output().count('watch: localized') > said, 'localized')
    assert process.stop(signal.SIGTERM)[0] == 130


@pytest.mark.needs('tf2_ros')
def test_a_localizer_by_tf_is_right_kidnapped_and_silent(watching, own_relocalizer, tester,
                                                         room_map):
    from tf2_msgs.msg import TFMessage
    publisher = tester.create_publisher(TFMessage, '/tf', 100)

    def send(now_s, map_from_odom, odom_from_base):
        publisher.publish(TFMessage(transforms=[
            transform_msg(Header(frame_id=parent, stamp=stamp(now_s)), child, pose)
            for parent, child, pose in (('map', 'odom', map_from_odom),
                                        ('odom', 'base_link', odom_from_base))]))
    watching.stop()
    watched = Watched(tester, own_relocalizer(**parameters(room_map, watch='tf')))
    watched.robot.on_tick, watched.robot.has_localizer = send, False
    watched.until_state('localized')
    watched.kidnap()
    watched.robot.on_tick = lambda *_: None
    watched.until_reason("no transform from 'base_link' to 'map'")
    watched.close()
    tester.destroy_publisher(publisher)
