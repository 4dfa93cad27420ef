# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Real nodes as processes, and a node in the test that talks to them over the wire."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseArray, PoseWithCovarianceStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from scene import CAMERA, make_room, see_room, write_map
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header
from std_srvs.srv import Empty, Trigger
from vision_msgs.msg import Detection2DArray

from cliploc_ros.ros.conversions import detections_to_msg

PROJECT = Path(__file__).resolve().parents[2]
# How long a test waits for what must come; only failures take so long.
PATIENCE_S = 60.0
RELIABLE = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)


class Process:
    """A module of the package in its own process, with its output in a file."""

    def __init__(self, module, arguments, log, **environment):
        self.log = log
        with log.open('w') as output:
            self._popen = subprocess.Popen(
                [sys.executable, '-m', f'cliploc_ros.{module}', *map(str, arguments)],
                stdout=output, stderr=subprocess.STDOUT, cwd=PROJECT,
                env=os.environ | environment)

    @property
    def alive(self):
        return self._popen.poll() is None

    def output(self):
        return self.log.read_text()

    def wait_for_output(self, text):
        wait_for(lambda: text in self.output() or not self.alive,
                 f'{text!r} in the output:\n{self.output()[-2000:]}')
        assert text in self.output(), self.output()[-2000:]

    def memory_mib(self, field='VmRSS'):
        """Resident memory now, or with VmHWM at its peak [MiB]."""
        status = Path(f'/proc/{self._popen.pid}/status').read_text()
        return int(status.split(f'{field}:')[1].split()[0]) / 1024

    def cpu_s(self):
        """Processor time used so far [s]."""
        fields = Path(f'/proc/{self._popen.pid}/stat').read_text().rsplit(')', 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')

    def stop(self, signal_number=signal.SIGINT):
        """Signal the process; return its exit code and how long it took to end [s]."""
        start = time.monotonic()
        if self.alive:
            self._popen.send_signal(signal_number)
        try:
            code = self._popen.wait(20)
        except subprocess.TimeoutExpired:
            self._popen.kill()
            code = self._popen.wait()
        return code, time.monotonic() - start


def wait_for(condition, what, patience_s=PATIENCE_S, work=lambda: time.sleep(0.02)):
    """Wait until a condition holds; fail after a time limit."""
    deadline = time.monotonic() + patience_s
    while not condition():
        assert time.monotonic() < deadline, f'waited {patience_s:g} s for {what}'
        work()


class Tester(Node):
    """Publishes frames, asks for poses, and keeps what the relocalizer publishes."""

    def __init__(self):
        super().__init__('tester')
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self)
        self.images = self.create_publisher(Image, 'image', RELIABLE)
        self.compressed = self.create_publisher(CompressedImage, 'image/compressed', RELIABLE)
        self.infos = self.create_publisher(CameraInfo, 'camera_info', RELIABLE)
        self.detections = self.create_publisher(Detection2DArray, 'detections', RELIABLE)
        self.poses, self.initial_poses, self.hypotheses = [], [], []
        for message, topic, kept in (
                (PoseWithCovarianceStamped, 'relocalizer/pose', self.poses),
                (PoseWithCovarianceStamped, 'initialpose', self.initial_poses),
                (PoseArray, 'relocalizer/hypotheses', self.hypotheses)):
            self.create_subscription(message, topic, kept.append, RELIABLE)
        self._relocalize = self.create_client(Trigger, 'relocalizer/relocalize')
        self._reinitialize = self.create_client(Empty, 'reinitialize_global_localization')

    def spin(self):
        self._executor.spin_once(timeout_sec=0.02)

    def wait(self, condition, what, patience_s=PATIENCE_S):
        wait_for(condition, what, patience_s, self.spin)

    def connect(self):
        """Wait until the relocalizer answers, and hears what it publishes."""
        self.wait(self._relocalize.service_is_ready, 'the service relocalize')
        self.wait(self._reinitialize.service_is_ready, 'the service reinitialize')
        self.wait(lambda: self.count_publishers('/relocalizer/pose') > 0, 'the publisher of poses')

    def ask(self):
        """Send a wake-up request; return its future."""
        return self._relocalize.call_async(Trigger.Request())

    def ask_reinitialize(self):
        return self._reinitialize.call_async(Empty.Request())

    def answer(self, future):
        self.wait(future.done, 'an answer')
        return future.result()

    def wait_until_heard(self):
        """Wait until the relocalizer listens to frames."""
        self.wait(lambda: min(self.infos.get_subscription_count(),
                              self.detections.get_subscription_count(),
                              self.images.get_subscription_count()
                              + self.compressed.get_subscription_count()) > 0,
                  'the relocalizer to listen')

    def publish(self, frame):
        image, info, detections = frame
        (self.compressed if isinstance(image, CompressedImage) else self.images).publish(image)
        self.infos.publish(info)
        self.detections.publish(detections)

    def relocalize(self, frame):
        """Ask, publish one frame when asked for it, and return the answer."""
        future = self.ask()
        self.wait_until_heard()
        self.publish(frame)
        return self.answer(future)


def make_frame(detections=None, stamp_s=100.0):
    """The messages of one frame of the simulated room, all of one stamp."""
    seconds = int(stamp_s)
    header = Header(frame_id='camera_optical_frame',
                    stamp=Time(sec=seconds, nanosec=round((stamp_s - seconds) * 1e9)))
    image = Image(header=header, height=CAMERA.height, width=CAMERA.width, encoding='rgb8',
                  step=3 * CAMERA.width)
    image.data = np.random.default_rng(0).integers(
        0, 256, 3 * CAMERA.width * CAMERA.height, dtype=np.uint8).tobytes()
    info = CameraInfo(header=header, width=CAMERA.width, height=CAMERA.height,
                      k=CAMERA.matrix.ravel(), distortion_model='plumb_bob', d=[0.0] * 5,
                      p=np.c_[CAMERA.matrix, np.zeros(3)].ravel())
    return image, info, detections_to_msg(detections or see_room(make_room()), header)


@pytest.fixture(scope='session')
def ros():
    rclpy.init()
    yield
    rclpy.try_shutdown()


@pytest.fixture
def tester(ros):
    node = Tester()
    yield node
    node.destroy_node()


@pytest.fixture(scope='session')
def room_map(tmp_path_factory):
    path = tmp_path_factory.mktemp('room') / 'map.yaml'
    write_map(make_room(), path)
    return path


@pytest.fixture
def start(tmp_path):
    """Start modules of the package as processes; all are ended with the test."""
    started = []

    def run(module, *arguments, parameters=None, **environment):
        ros_arguments = ['--ros-args'] if parameters is not None else []
        for name, value in (parameters or {}).items():
            ros_arguments += ['-p', f'{name}:={value}']
        process = Process(module, [*arguments, *ros_arguments],
                          tmp_path / f'{module}_{len(started)}.log', **environment)
        started.append(process)
        return process
    yield run
    for process in started:
        process.stop(signal.SIGKILL)


@pytest.fixture
def relocalizer(start, tester, room_map):
    """A relocalizer that matches classes in the simulated room, ready to be asked."""
    process = start('nodes.relocalizer', parameters={
        'map_file': room_map, 'matching': 'class', 'algorithm': 'bf', 'timeout_s': 5.0})
    process.wait_for_output('ready after')
    tester.connect()
    return process
