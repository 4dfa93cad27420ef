# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The executable replay: real recordings, a real process, a real listening node."""

import signal
import time

import numpy as np
import pytest
from executables import MS, RECORDED_QOS, START_NS, run, wait_until, write_poses
from geometry_msgs.msg import PoseStamped
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rosbags.interfaces import QosDurability, QosReliability
from rosbags.rosbag2 import StoragePlugin, Writer
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from vision_msgs.msg import Detection2DArray

from cliploc_ros.offline.datasets import bag_messages
from cliploc_ros.offline.datasets.bags import LATCHED_QOS, BagReader, BagWriter
from cliploc_ros.offline.datasets.intrinsics import PRESETS
from cliploc_ros.offline.datasets.tum import read_tum
from cliploc_ros.offline.datasets.tum_conversion import (
    ConversionOptions,
    convert_tum,
    read_recorded_detections,
)

CLASSES = {
    '/image': Image,
    '/image/compressed': CompressedImage,
    '/camera_info': CameraInfo,
    '/detections': Detection2DArray,
    '/ground_truth': PoseStamped,
}


def recorded(path):
    """Return the serialized messages of a recording by topic."""
    by_topic = {}
    with BagReader(path) as reader:
        for message in reader.messages():
            by_topic.setdefault(message.topic, []).append(message.data)
    return by_topic


def offset_ms(data):
    """Return how long after the recording's start a received pose is [ms]."""
    return (bag_messages.stamp_ns(deserialize_message(data, PoseStamped)) - START_NS) / MS


@pytest.mark.parametrize(
    ('storage', 'form'), [('sqlite3', 'raw'), ('mcap', 'compressed')]
)
def test_real_frames_arrive_byte_identical(shared_data, tmp_path, listener, storage, form):
    folder, bag = shared_data / 'tum_fr3_office', tmp_path / 'bag'
    detections = read_recorded_detections(folder / 'detections.json')
    options = ConversionOptions(storage, form)
    convert_tum(read_tum(folder), PRESETS['fr3'], bag, options, detections)
    expected = recorded(bag)
    for topic in expected:
        listener.listen(topic, CLASSES[topic])
    done = run('replay', bag, '--rate', 16, '--wait-for-subscribers')
    assert done.returncode == 0, done.stderr
    wait_until(lambda: all(len(listener.received[one]) == len(expected[one]) for one in expected))
    for topic, messages in expected.items():
        for received, sent in zip(listener.received[topic], messages, strict=True):
            # RTPS pads a payload to a multiple of four bytes
            assert received[:len(sent)] == sent
            assert len(received) - len(sent) < 4
    assert 'published 67 ' in done.stdout


def test_qos_is_as_recorded(tmp_path, listener, start):
    best_effort = RECORDED_QOS._replace(reliability=QosReliability.BEST_EFFORT)
    latched = RECORDED_QOS._replace(durability=QosDurability.TRANSIENT_LOCAL)
    offered = {
        '/reliable': (RECORDED_QOS, ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE),
        '/sensor': (best_effort, ReliabilityPolicy.BEST_EFFORT, DurabilityPolicy.VOLATILE),
        '/latched': (latched, ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL),
        '/map': (LATCHED_QOS, ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL),
    }
    topics = {name: qos for name, (qos, *_) in offered.items()}
    bag = write_poses(tmp_path / 'bag', [0, 600_000], topics)
    process = start('replay', bag)
    assert 'replaying' in process.stdout.readline()
    endpoints = listener.node.get_publishers_info_by_topic
    wait_until(lambda: all(endpoints(name) for name in offered))
    for name, (_, reliability, durability) in offered.items():
        (endpoint,) = endpoints(name)
        assert endpoint.qos_profile.reliability == reliability, name
        assert endpoint.qos_profile.durability == durability, name
    # The first message is sent; a late subscriber still receives the latched ones.
    late = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    listener.listen('/map', PoseStamped, late)
    listener.listen('/latched', PoseStamped, late)
    wait_until(lambda: listener.received['/map'] and listener.received['/latched'])
    assert offset_ms(listener.received['/map'][0]) == 0


def test_clock_runs_with_the_messages(tmp_path, listener):
    bag = write_poses(tmp_path / 'bag', range(0, 2001, 100))
    listener.listen('/clock', Clock)
    listener.listen('/pose', PoseStamped)
    done = run('replay', bag, '--clock', 100, '--rate', 2, '--wait-for-subscribers')
    assert done.returncode == 0, done.stderr
    wait_until(lambda: len(listener.received['/pose']) == 21)
    clocks = [deserialize_message(data, Clock).clock for data in listener.received['/clock']]
    stamps_ns = np.array([clock.sec * 10**9 + clock.nanosec for clock in clocks])
    assert (np.diff(stamps_ns) > 0).all()
    assert stamps_ns[0] >= START_NS
    assert stamps_ns[-1] <= START_NS + 2000 * MS
    # 1 s of real time at 100 Hz; replay skips the ticks that it misses under load.
    assert 50 <= len(stamps_ns) <= 101
    assert set(np.diff(stamps_ns) % (20 * MS)) == {0}


def test_names_and_selection(tmp_path, listener):
    topics = dict.fromkeys(('/a', '/b', '/c', '/d'), RECORDED_QOS)
    bag = write_poses(tmp_path / 'bag', [0, 20], topics)
    for name in ('/x/a', '/renamed', '/c', '/d', '/a', '/b'):
        listener.listen(name, PoseStamped)
    done = run(
        'replay', bag, '--topics', 'a', '/b', '/d', '--exclude', '/d', '--remap', 'a:=x/a',
        '--wait-for-subscribers', '/a', '/b',
        '--ros-args', '-r', '/b:=/renamed', '-r', '__node:=player',
    )
    assert done.returncode == 0, done.stderr
    wait_until(lambda: len(listener.received['/x/a']) == len(listener.received['/renamed']) == 2)
    assert set(listener.received) == {'/x/a', '/renamed'}


def test_start_offset_sends_what_is_latched_first(tmp_path, listener):
    topics = {'/pose': RECORDED_QOS, '/map': LATCHED_QOS}
    bag = write_poses(tmp_path / 'bag', [0, 100, 5000, 5050], topics)
    latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    listener.listen('/pose', PoseStamped)
    listener.listen('/map', PoseStamped, latched)
    done = run('replay', bag, '--start-offset', 4.9, '--wait-for-subscribers')
    assert done.returncode == 0, done.stderr
    wait_until(lambda: len(listener.received['/map']) + len(listener.received['/pose']) == 6)
    assert [offset_ms(data) for data in listener.received['/pose']] == [5000, 5050]
    assert [offset_ms(data) for data in listener.received['/map']] == [0, 100, 5000, 5050]


def stop(process, number):
    """Signal a process; expect it to end cleanly within 2 s."""
    begin = time.monotonic()
    process.send_signal(number)
    output, errors = process.communicate(timeout=10)
    took_s = time.monotonic() - begin
    assert process.returncode == 0, errors
    assert took_s < 2
    assert 'Traceback' not in errors
    return output


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_signal_ends_a_long_pause(tmp_path, start, listener, number):
    bag = write_poses(tmp_path / 'bag', [0, 600_000])
    listener.listen('/pose', PoseStamped)
    process = start('replay', bag, '--wait-for-subscribers')
    wait_until(lambda: listener.received['/pose'])
    assert 'published 1 ' in stop(process, number)


def assert_refused(done, *messages):
    assert done.returncode == 1
    *before, line = done.stderr.splitlines()
    assert all('[rcl]' in one for one in before)  # rcl logs the error too
    assert line.startswith('error: ')
    for message in messages:
        assert message in line


def test_a_type_that_is_not_installed_is_left_out_with_a_note(tmp_path):
    with Writer(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        for name, msgtype, definition in (('/odd', 'my_msgs/msg/Odd', 'int32 x'),
                                          ('/number', 'std_msgs/msg/Int32', 'int32 data')):
            connection = bag.add_connection(name, msgtype, msgdef=definition, rihs01='unknown',
                                            offered_qos_profiles=[RECORDED_QOS])
            bag.write(connection, START_NS, b'\x00\x01\x00\x00\x01\x00\x00\x00')
    done = run('replay', tmp_path / 'bag')
    assert done.returncode == 0, done.stderr
    assert 'published 1 ' in done.stdout
    assert_refused(run('replay', tmp_path / 'bag', '--topics', '/odd'), '/odd needs')


def test_bad_recordings_are_refused(tmp_path):
    assert_refused(run('replay', tmp_path / 'none'), 'none: no such recording')
    with BagWriter(tmp_path / 'empty') as bag:
        bag.add_topic('/pose', bag_messages.POSE)
    assert_refused(run('replay', tmp_path / 'empty'), 'empty: holds no messages')
