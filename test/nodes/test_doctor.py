# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Run the executable doctor on a robot of real nodes, with each part broken once."""

import re
import shutil
import time
from importlib.util import find_spec

import pytest
import yaml
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from processes import wait_for
from rclpy.qos import qos_profile_system_default
from scene import make_layer, write_map
from test_prior_node import SEARCH, TWINS, at
from tester import class_matching, make_frame

from cliploc_ros.core.keyframes.layer import layer_path, save_layer
from cliploc_ros.errors import OptionsError
from cliploc_ros.ros.clients import check_name
from cliploc_ros.ros.qos import LATCHED

LINE = re.compile('^(.{12}) (pass|fail|not checked|refused) +(.*)$', re.MULTILINE)
WHOLE = {'parameters': 'valid', 'map': '12 landmarks', 'camera': 'it publishes image, ',
         'clock': 'images come', 'tf': '0.50 m above', 'odometry': 'the robot is at rest',
         'localizer': 'amcl_pose', 'input': 'agree', 'pose': 'accepted: x '}
# Upright, and half a metre above the robot.
MOUNT = [0.0, 0.0, 0.5, -0.70710678, 0.0, 0.0, 0.70710678]


class Robot:
    """Publishes the topics of a robot, with a test's faults; it changes frame and odometry."""

    def __init__(self, tester):
        self._tester = tester
        self._odometry = tester.create_publisher(Odometry, 'odom', qos_profile_system_default)
        self.speed_m_s, self.late_s, self.change = 0.0, 0.0, lambda *frame: frame
        self.detection_s = 0.0

    def pass_time(self):
        now = time.time()
        frame = self.change(*make_frame(stamp_s=now - self.late_s))
        self._tester.publish(frame[:2])
        odometry = Odometry(child_frame_id='base_link')
        odometry.header.frame_id = 'odom'
        odometry.header.stamp = make_frame(stamp_s=now)[0].header.stamp
        odometry.twist.twist.linear.x = self.speed_m_s
        self._odometry.publish(odometry)
        time.sleep(self.detection_s)  # for the detector; odometry does not wait for it
        self._tester.publish(frame[2:])
        for _ in range(3):
            self._tester.spin()

    def close(self):
        self._tester.destroy_publisher(self._odometry)


@pytest.fixture
def robot(tester):
    found = Robot(tester)
    yield found
    found.close()


@pytest.fixture
def examine(start, robot, room_map, tmp_path):
    """Run the doctor; return its lines as a dict of (state, text), and its exit code."""
    def run(*arguments, **parameters):
        shutil.copy(room_map, tmp_path / 'map.yaml')
        file = tmp_path / 'robot.yaml'
        given = {**class_matching(str(tmp_path / 'map.yaml'), base_frame='base_link',
                                  base_from_camera=MOUNT), **parameters}
        file.write_text(yaml.safe_dump({'relocalizer': {'ros__parameters': given}}))
        process = start('cli.doctor', '--timeout', 4, *(arguments or ('--params-file', file)))
        wait_for(lambda: not process.alive, 'the end', work=robot.pass_time)
        print(process.output())
        assert 'Traceback' not in process.output()
        return {what.strip(): (state, text) for what, state, text in LINE.findall(
            process.output())}, process.stop()[0]
    return run


def without(number):
    return lambda *frame: [one for row, one in enumerate(frame) if row != number]


def uncalibrated(image, info, detections):
    info.k = [0.0] * 9
    return image, info, detections


def of_another_detector(image, info, detections):
    for detection in detections.detections:
        detection.results[0].hypothesis.class_id = 'zebra'
    return image, info, detections


def test_a_whole_robot_passes_and_nothing_is_handed_over(own_relocalizer, examine, tester):
    """Parameters and topics are those of the running relocalizer."""
    own_relocalizer('--ros-args', '-r', 'odom:=/odom', base_frame='base_link',
                    base_from_camera=MOUNT)
    found, code = examine('--relocalizer', '/relocalizer')
    assert code == 0
    assert re.fullmatch(r'accepted: x 0\.\d+ y .* m in map, heading .* by 12 landmarks; [0-9.]+ s',
                        found['pose'][1])
    assert found['relocalizer'][0] == 'pass'
    for what, text in WHOLE.items():
        assert found[what][0] == 'pass' and text in found[what][1]
    assert {what for what, (state, _) in found.items() if state == 'not checked'} == {'keyframes'}
    assert not tester.initial_poses and not tester.poses


@pytest.mark.parametrize(('fails', 'broken', 'parameters'), [
    ({'parameters': 'k: -3 '}, {}, {'k': -3}),
    ({'map': '/nowhere.yaml: ', 'camera': 'no camera_info on'}, {'change': without(1)},
     {'map_file': '/nowhere.yaml'}),
    ({'keyframes': 'build_map', 'camera': ' /image ', 'localizer': ' nowhere'},
     {'change': without(0)}, {'keyframes_file': '/nowhere.npz', 'localizer_pose': 'nowhere'}),
    ({'camera': ' /detections', 'clock': ' /clock'}, {'change': without(2)},
     {'use_sim_time': True}),
    ({'input': 'K: ', 'odometry': '1.00 m/s', 'pose': ''},
     {'change': uncalibrated, 'speed_m_s': 1.0}, {}),
    ({'clock': 'synchronize', 'input': ''}, {'late_s': 100.0}, {}),  # odometry is newer
    ({'tf' if find_spec('tf2_ros') else 'start': 'base_from_camera', 'pose': ''}, {},
     {'base_from_camera': [0.0] * 7}),
    ({'input': 'zebra.*no message on /imu'}, {'change': of_another_detector},
     {'gravity': 'imu', 'timeout_s': 2.0}),
    ({'input': 'depth_tolerance_s'}, {}, {'depth_transport': 'raw'}),
    ({'pose': 'raise timeout_s'}, {'detection_s': 0.5}, {'timeout_s': 0.1})])
def test_what_is_broken_fails_with_what_to_do(examine, robot, fails, broken, parameters):
    for name, value in broken.items():
        setattr(robot, name, value)
    found, code = examine(**parameters)
    assert code == 1
    failed = {what: text for what, (state, text) in found.items() if state == 'fail'}
    assert failed.keys() <= fails.keys()
    for what, text in fails.items():
        assert re.search(text, failed.get(what, '' if text else 'follows'))


def test_a_prior_decides_for_the_doctor_as_for_the_relocalizer(examine, tester, tmp_path):
    """Of two rooms that look alike."""
    write_map(TWINS, tmp_path / 'twins.yaml')
    save_layer(layer_path(tmp_path / 'twins.yaml'), make_layer(TWINS))
    parameters = {'map_file': str(tmp_path / 'twins.yaml'), 'timeout_s': 3.0, **SEARCH}
    publisher = tester.create_publisher(PoseWithCovarianceStamped, 'relocalizer/prior', LATCHED)
    publisher.publish(at(0.0))
    assert 'accepted' in examine(**parameters)[0]['pose'][1]
    publisher.publish(at(10.0))
    assert examine(**parameters)[0]['pose'][0] == 'refused'
    tester.destroy_publisher(publisher)


def test_a_relocalizer_that_does_not_run_is_named(examine):
    found, code = examine('--relocalizer', 'nobody')
    assert (code, list(found), found['relocalizer'][0]) == (1, ['relocalizer'], 'fail')
    assert '/nobody' in found['relocalizer'][1]


@pytest.mark.parametrize('name', ['', '/a//b', 'a b', '7', '{x}'])
def test_what_is_no_name_of_a_node_is_refused(name):
    with pytest.raises(OptionsError, match='--relocalizer: '):
        check_name(name)
