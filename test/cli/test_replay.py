# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Test the executables tum_to_bag and replay with real recordings, processes and nodes."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections import defaultdict
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rig_bag import camera_messages, odometry_message, tf_messages, write_messages
from rosbags.interfaces import QosDurability, QosHistory, QosReliability
from rosbags.rosbag2 import StoragePlugin, Writer
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image
from vision_msgs.msg import Detection2DArray

from cliploc_ros.cli.tum_to_bag import main
from cliploc_ros.messages import image_from_msg
from cliploc_ros.offline.datasets import bag_messages, tum
from cliploc_ros.offline.datasets.bags import LATCHED_QOS, RELIABLE_QOS, BagReader, BagWriter
from cliploc_ros.offline.datasets.parsing import PRESETS
from cliploc_ros.offline.replay import with_stands

PROJECT = Path(__file__).resolve().parents[2]
TIMEOUT_S = 120.0  # only to stop hangs, on a machine under load
SIZE, STAMPS = (64, 48), [f'{100 + index / 10:.6f}' for index in range(4)]
START_NS = 1_700_000_000_123_456_789
MS = 1_000_000
# As `ros2 bag record` writes it: discovery reports neither history nor depth.
RECORDED_QOS = RELIABLE_QOS._replace(history=QosHistory.UNKNOWN, depth=0)
CLASSES = {'/image': Image, '/camera_info': CameraInfo, '/detections': Detection2DArray,
           '/ground_truth': PoseStamped}


def wait_until(condition):
    """Wait for a condition; fail at the time limit."""
    deadline = time.monotonic() + TIMEOUT_S
    while not condition():
        assert time.monotonic() < deadline, f'still waiting after {TIMEOUT_S} s'
        time.sleep(0.005)


def command(module: str, *args: object) -> list[str]:
    return [sys.executable, '-m', f'cliploc_ros.cli.{module}', *map(str, args)]


def run(*args: object) -> subprocess.CompletedProcess:
    """Run replay until it ends."""
    return subprocess.run(command('replay', *args), cwd=PROJECT, text=True, capture_output=True,
                          timeout=TIMEOUT_S)


@pytest.fixture
def sequence(tmp_path):
    """Write a small TUM folder, with ground truth for all images but the first."""
    folder, random = tmp_path / 'sequence', np.random.default_rng(0)
    (folder / 'rgb').mkdir(parents=True)
    for stamp in STAMPS:
        assert cv2.imwrite(str(folder / f'rgb/{stamp}.png'),
                           random.integers(0, 256, (SIZE[1], SIZE[0], 3), dtype=np.uint8))
    (folder / 'rgb.txt').write_text(''.join(f'{stamp} rgb/{stamp}.png\n' for stamp in STAMPS))
    (folder / 'groundtruth.txt').write_text(
        ''.join(f'{100.1 + index / 100:.2f} {index} 0 0 0 0 0 1\n' for index in range(200)))
    (folder / 'camera.json').write_text(json.dumps(
        {'width': SIZE[0], 'height': SIZE[1], 'fx': 50, 'fy': 51, 'cx': 32, 'cy': 24}))
    box = {'class_id': 'cup', 'score': 0.75, 'bbox_xyxy': [1, 2, 30.5, 40]}
    (folder / 'detections.json').write_text(json.dumps({'image_size': SIZE, 'frames': [
        {'timestamp': stamp, 'detections': [box] * (index % 3)}
        for index, stamp in enumerate(STAMPS)]}))
    return folder


def write_poses(path, offsets_ms, topics=None):
    """Write a recording of poses at offsets [ms] on topics with their QoS."""
    topics = topics or {'/pose': RECORDED_QOS}
    with BagWriter(path, 'mcap') as bag:
        for name, qos in topics.items():
            bag.add_topic(name, bag_messages.POSE, qos)
        for offset in offsets_ms:
            stamp = START_NS + round(offset * MS)
            message = bag_messages.pose_message(stamp, 'world', np.eye(4))
            for name in topics:
                bag.write(name, stamp, message)
    return path


class Listener:
    """A node in a thread that stores the serialized messages of topics."""

    def __init__(self, context):
        self.received = defaultdict(list)
        self.node = Node(f'listener_{os.getpid()}', context=context)
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(self.node)

    def listen(self, topic, message_class=PoseStamped, qos=100):
        self.node.create_subscription(message_class, topic, self.received[topic].append, qos,
                                      raw=True)
        self._executor.wake()

    def spin(self):
        with suppress(ExternalShutdownException):
            self._executor.spin()


@pytest.fixture
def listener():
    context = Context()
    rclpy.init(context=context)
    listener = Listener(context)
    thread = threading.Thread(target=listener.spin)
    thread.start()
    yield listener
    listener._executor.shutdown()
    thread.join()
    listener.node.destroy_node()
    rclpy.shutdown(context=context)


@pytest.fixture
def start():
    """Start an executable in a separate process; kill it at the end if it is still running."""
    processes = []

    def start_process(module, *args):
        processes.append(subprocess.Popen(
            command(module, *args), cwd=PROJECT, text=True, stdout=subprocess.PIPE,
            stderr=subprocess.PIPE))
        return processes[-1]
    yield start_process
    for process in processes:
        process.kill()
        process.communicate()


def offset_ms(data):
    """Return the stamp of a received pose relative to the recording's start [ms]."""
    return (bag_messages.stamp_ns(deserialize_message(data, PoseStamped)) - START_NS) / MS


def test_real_frames_arrive_byte_identical(shared_data, tmp_path, listener):
    folder, bag, expected = shared_data / 'tum_fr3_office', tmp_path / 'bag', defaultdict(list)
    detections = tum.read_recorded_detections(folder / 'detections.json')
    tum.convert_tum(tum.read_tum(folder), PRESETS['fr3'], bag, tum.ConversionOptions(), detections)
    with BagReader(bag) as reader:
        for message in reader.messages():
            expected[message.topic].append(message.data)
    for topic in expected:
        listener.listen(topic, CLASSES[topic])
    done = run(bag, '--rate', 16, '--wait-for-subscribers')
    assert done.returncode == 0, done.stderr
    wait_until(lambda: all(len(listener.received[topic]) == len(expected[topic])
                           for topic in expected))
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
        '/map': (LATCHED_QOS, ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL)}
    topics = {name: qos for name, (qos, *_) in offered.items()}
    bag = write_poses(tmp_path / 'bag', [0, 600_000], topics)
    process = start('replay', bag)
    assert any('replaying' in line for line in process.stdout)  # DDS may print first
    endpoints = listener.node.get_publishers_info_by_topic
    wait_until(lambda: all(endpoints(name) for name in offered))
    for name, (_, reliability, durability) in offered.items():
        (endpoint,) = endpoints(name)
        assert endpoint.qos_profile.reliability == reliability, name
        assert endpoint.qos_profile.durability == durability, name
    # The first message has been sent; a late subscriber still receives the latched messages.
    late = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    listener.listen('/map', qos=late)
    listener.listen('/latched', qos=late)
    wait_until(lambda: listener.received['/map'] and listener.received['/latched'])
    assert offset_ms(listener.received['/map'][0]) == 0


def test_clock_runs_with_the_messages(tmp_path, listener):
    bag = write_poses(tmp_path / 'bag', range(0, 2001, 100))
    listener.listen('/clock', Clock)
    listener.listen('/pose')
    done = run(bag, '--clock', 100, '--rate', 2, '--wait-for-subscribers')
    assert done.returncode == 0, done.stderr
    wait_until(lambda: len(listener.received['/pose']) == 21)
    clocks = [deserialize_message(data, Clock).clock for data in listener.received['/clock']]
    stamps_ns = np.array([clock.sec * 10**9 + clock.nanosec for clock in clocks])
    assert np.diff(stamps_ns).min() == 20 * MS
    assert stamps_ns[0] >= START_NS and stamps_ns[-1] <= START_NS + 2000 * MS
    # 1 s of real time at 100 Hz; replay skips the ticks that it misses under load.
    assert 50 <= len(stamps_ns) <= 101
    assert set(np.diff(stamps_ns) % (20 * MS)) == {0}


def test_names_selection_and_a_start_offset_that_sends_what_is_latched_first(tmp_path, listener):
    topics = dict.fromkeys(('/a', '/c', '/d'), RECORDED_QOS) | {'/map': LATCHED_QOS}
    bag = write_poses(tmp_path / 'bag', [0, 100, 5000, 5050], topics)
    for name in ('/x/a', '/c', '/d', '/a', '/map'):
        listener.listen(name)
    listener.listen('/renamed', qos=QoSProfile(
        depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL))
    done = run(bag, '--topics', 'a', '/map', '/d', '--exclude', '/d', '--remap', 'a:=x/a',
               '--start-offset', 4.9, '--wait-for-subscribers', '/a', '/map',
               '--ros-args', '-r', '/map:=/renamed', '-r', '__node:=player')
    assert done.returncode == 0, done.stderr
    wait_until(lambda: len(listener.received['/x/a']) + len(listener.received['/renamed']) == 6)
    assert {name: [*map(offset_ms, got)] for name, got in listener.received.items() if got} == {
        '/x/a': [5000, 5050], '/renamed': [0, 100, 5000, 5050]}


def test_a_robot_stands_on_its_way(tmp_path):
    recorded, second, end = [], 1000 * MS, 5200 * MS
    for tick in range(81):
        at, pose = START_NS + tick * second // 20, np.eye(4)
        pose[0, 3] = 0.025 * tick
        recorded += [odometry_message(at, pose), *tf_messages([(at, pose)], 'odom', 'base')]
        if not tick % 2:
            recorded += camera_messages(at, np.zeros((2, 2, 3), np.uint8), PRESETS['fr3'])
            recorded.append((at, *tf_messages([(at + second, np.eye(4))], 'map', 'odom')[0][1:]))
    bag, stamps, positions = write_messages(tmp_path / 'bag', recorded), defaultdict(list), {}
    with BagReader(bag) as reader:
        played = [*with_stands(reader.messages(), reader.topics, 1.0)]
        for message in played:
            one = reader.deserialize(message)
            for part in getattr(one, 'transforms', [one]):
                stamps[message.topic, getattr(part, 'child_frame_id', '')].append(
                    bag_messages.stamp_ns(part) - START_NS)
            if message.topic == '/odom':
                positions[stamps['/odom', 'base_footprint'][-1]] = one
    assert [message.stamp_ns for message in played] == sorted(
        message.stamp_ns for message in played)
    assert all((np.diff(times) > 0).all() for times in stamps.values())
    # only the image that the stand begins with loses its camera_info
    assert {*stamps['/image', '']} - {*stamps['/camera_info', '']} == {3 * second}
    assert stamps['/tf', 'odom'][-1] - second == stamps['/odom', 'base_footprint'][-1] == end
    standing = [(one.pose.pose.position.x, one.twist.twist.linear.x)
                for at, one in positions.items() if 3 * second < at <= 4 * second]
    assert standing == [(pytest.approx(1.5), 0.0)] * 5
    assert positions[end].twist.twist.linear.x == 0.5
    note = 'the robot of /odom drives'
    assert note in run(bag, '--rate', 100).stdout
    assert note not in run(bag, '--rate', 100, '--stand', 1).stdout


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_signal_ends_a_long_pause(tmp_path, start, listener, number):
    bag = write_poses(tmp_path / 'bag', [0, 600_000])
    listener.listen('/pose')
    process = start('replay', bag, '--wait-for-subscribers')
    wait_until(lambda: listener.received['/pose'])
    begin = time.monotonic()
    process.send_signal(number)
    output, errors = process.communicate(timeout=10)
    assert process.returncode == 0 and time.monotonic() - begin < 2, errors
    assert 'published 1 ' in output and 'Traceback' not in errors


def assert_refused(done, *messages):
    assert done.returncode == 1
    *before, line = done.stderr.splitlines()
    assert all('[rcl]' in line for line in before)  # rcl logs the error too
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
    done = run(tmp_path / 'bag')
    assert done.returncode == 0, done.stderr
    assert 'published 1 ' in done.stdout
    assert_refused(run(tmp_path / 'bag', '--topics', '/odd'), '/odd needs')


def test_bad_recordings_are_refused(tmp_path):
    assert_refused(run(tmp_path / 'none'), 'none: no such recording')
    with BagWriter(tmp_path / 'empty') as bag:
        bag.add_topic('/pose', bag_messages.POSE)
    assert_refused(run(tmp_path / 'empty'), 'empty: holds no messages')


# Prints 'received' at the third message.
SUBSCRIBER = """
import rclpy
from geometry_msgs.msg import PoseStamped
rclpy.init()
node = rclpy.create_node('subscriber')
received = []
node.create_subscription(PoseStamped, '/pose', received.append, 10)
print('ready', flush=True)
while len(received) < 3:
    rclpy.spin_once(node, timeout_sec=0.1)
print('received', flush=True)
"""


@pytest.fixture
def subscriber():
    """Start a reliable subscriber of /pose in a separate process."""
    process = subprocess.Popen([sys.executable, '-c', SUBSCRIBER], stdout=subprocess.PIPE,
                               text=True)
    assert process.stdout.readline() == 'ready\n'
    yield process
    process.kill()
    process.communicate()


def play_to_a_stopped(subscriber, start, tmp_path, *args):
    """Publish three messages, the last two while the subscriber's process is stopped."""
    bag = write_poses(tmp_path / 'bag', [0, 1000, 1050])
    replay = start('replay', bag, '--wait-for-subscribers', *args)
    assert any('replaying' in line for line in replay.stdout)
    subscriber.send_signal(signal.SIGSTOP)
    assert 'published 3 ' in replay.stdout.readline()
    return replay


def test_replay_waits_until_its_messages_have_arrived(subscriber, start, tmp_path):
    replay = play_to_a_stopped(subscriber, start, tmp_path)
    with pytest.raises(subprocess.TimeoutExpired):
        replay.wait(2.0)
    subscriber.send_signal(signal.SIGCONT)
    assert subscriber.stdout.readline() == 'received\n'
    _, errors = replay.communicate(timeout=TIMEOUT_S)
    assert (replay.returncode, errors) == (0, '')


def test_replay_names_topics_without_acknowledgement(subscriber, start, tmp_path):
    replay = play_to_a_stopped(subscriber, start, tmp_path, '--wait-for-all-acked', 0.5)
    _, errors = replay.communicate(timeout=TIMEOUT_S)
    assert replay.returncode == 0
    assert errors.startswith('warning: ') and '/pose' in errors and '0.5 s' in errors


def read_all(bag):
    """Return the deserialized messages by topic, after checking their stamps."""
    by_topic = defaultdict(list)
    with BagReader(bag) as reader:
        for raw in reader.messages():
            by_topic[raw.topic].append(reader.deserialize(raw))
            assert bag_messages.stamp_ns(by_topic[raw.topic][-1]) == raw.stamp_ns
    return by_topic


@pytest.mark.parametrize(('storage', 'form'), [('sqlite3', 'raw'), ('mcap', 'compressed')])
def test_small_sequence_round_trip(sequence, tmp_path, run_here, storage, form):
    done = run_here(main, sequence, tmp_path / 'bag', '--storage', storage, f'--{form}',
                    '--detections', sequence / 'detections.json', '--prefix', 'front/camera')
    assert done.returncode == 0, done.stderr
    assert '4 images, 3 ground' in done.stdout and '1 images have no' in done.stdout
    topics = read_all(tmp_path / 'bag')
    images = '/front/camera/image' + ('/compressed' if form == 'compressed' else '')
    assert list(topics) == [images, *(f'/front/camera/{name}' for name in (
        'camera_info', 'detections', 'ground_truth'))]
    stamps = [round(float(stamp) * 10) * 100_000_000 for stamp in STAMPS]
    for name in list(topics)[:3]:
        assert [bag_messages.stamp_ns(message) for message in topics[name]] == stamps
        assert {topic.header.frame_id for topic in topics[name]} == {'camera_optical_frame'}
    for message, stamp in zip(topics[images], STAMPS, strict=True):
        file = sequence / f'rgb/{stamp}.png'
        np.testing.assert_array_equal(image_from_msg(message), cv2.imread(str(file))[:, :, ::-1])
        if form == 'compressed':
            assert message.format == 'rgb8; png compressed bgr8'
            assert message.data.tobytes() == file.read_bytes()
    assert [len(topic.detections) for topic in topics['/front/camera/detections']] == [0, 1, 2, 0]
    (pose, *_) = topics['/front/camera/ground_truth']
    assert pose.header.frame_id == 'world'
    assert (bag_messages.stamp_ns(pose), pose.pose.position.x) == (stamps[1], 0)


def test_accelerations_become_an_imu(sequence, tmp_path, run_here):
    (sequence / 'accelerometer.txt').write_text('# t a\n1.25 0.5 7 -5\n1.5 0.25 8 -6\n')
    done = run_here(main, sequence, tmp_path / 'bag', '--every', 3)
    assert done.returncode == 0, done.stderr
    assert '2 images' in done.stdout and '2 accelerations' in done.stdout
    first, second = read_all(tmp_path / 'bag')['/imu']
    assert bag_messages.stamp_ns(first) == 1_250_000_000
    assert first.header.frame_id == 'imu'
    assert first.orientation_covariance[0] == first.angular_velocity_covariance[0] == -1
    one = second.linear_acceleration
    assert (one.x, one.y, one.z) == (0.25, 8.0, -6.0)
    (sequence / 'accelerometer.txt').write_text('1.25 0.5 nan -5\n')
    done = run_here(main, sequence, tmp_path / 'other')
    assert 'accelerometer.txt:1' in done.stderr
    assert not (tmp_path / 'other').exists()
