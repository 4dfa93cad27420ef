# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Requests in a real node with a real frame source; the localizer is a function of the test."""

import math
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from itertools import count
from types import SimpleNamespace

import numpy as np
import pytest
import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header
from vision_msgs.msg import Detection2DArray

from cliploc_ros.errors import MapError, StoppedError
from cliploc_ros.ros.answer import Answer, CaseRecorder, Verdict
from cliploc_ros.ros.handoff import HandOff
from cliploc_ros.ros.inputs.coordinate_frames import NoTransformError
from cliploc_ros.ros.inputs.rig import CameraRig
from cliploc_ros.ros.inputs.robot_state import RobotStateSource
from cliploc_ros.ros.inputs.stamps import TimeJumps
from cliploc_ros.ros.node.lifecycle import ManagedNode
from cliploc_ros.ros.parameters import RelocalizerParameters
from cliploc_ros.ros.request import Requests


def set_values(node, **values):
    answer = node.set_parameters_atomically(
        [Parameter(name, value=value) for name, value in values.items()])
    assert answer.successful, answer.reason


class Answering(ManagedNode):
    """A managed node whose map comes from `loads` and whose frames `localize` answers."""

    def __init__(self):
        super().__init__('answering', RelocalizerParameters)
        self.loads = lambda: 'nothing'
        self.localize = lambda frame: Answer(Verdict.REFUSED, 'nothing known',
                                             received_at=frame.received_at)
        self.publish = lambda answer: answer
        self.robot = RobotStateSource(self)
        self.frames = CameraRig(self, RelocalizerParameters())
        pipeline = SimpleNamespace(localize=lambda frame, times, deadline: self.localize(frame),
                                   publish=lambda answer, deadline: self.publish(answer))
        jumps = TimeJumps(self, self.frames.forget)
        self.requests = Requests(self, self.frames, self.robot, jumps, pipeline,
                                 CaseRecorder(False), HandOff(
            self, self.robot.odometry, self.robot.transforms))

    def load(self):
        return self.loads()

    def unload(self):
        pass

    def open(self):
        self.frames.open()

    def close(self):
        self.frames.close('the node was deactivated')

    def examine(self, health):
        pass


@pytest.fixture
def node():
    """A node of the default context, made like ManagedNode, spun in a separate thread."""
    is_first = not rclpy.ok()  # test/nodes has a separate one
    if is_first:
        rclpy.init()
    made = Answering()
    executor = SingleThreadedExecutor()
    executor.add_node(made)
    thread = threading.Thread(target=executor.spin)
    thread.start()
    yield made
    executor.shutdown()
    thread.join()
    made.worker.stop()
    made.destroy_node()
    if is_first:
        rclpy.try_shutdown()


@pytest.fixture
def shoot(node):
    """Publish the three messages of a frame, each time with a new stamp."""
    camera, numbers = rclpy.create_node('camera'), count(1)
    publishers = [camera.create_publisher(kind, topic, 10) for kind, topic in (
        (CameraInfo, 'camera_info'), (Detection2DArray, 'detections'), (Image, 'image'))]

    def run():
        header = Header(stamp=Time(sec=next(numbers)))
        for publisher in publishers:
            publisher.publish(publisher.msg_type(header=header))
        time.sleep(0.02)
    yield run
    camera.destroy_node()


@pytest.fixture
def clients():
    with ThreadPoolExecutor(8) as pool:
        yield pool


def test_a_request_gets_no_image_older_than_itself(node, shoot, clients, wait):
    """The second request arrives while the image of the first is being searched."""
    searched, go_on = [], threading.Event()

    def localize(frame):
        searched.append(frame)
        go_on.wait(10.0)
        return Answer(Verdict.REFUSED, f'image {len(searched)}', received_at=frame.received_at)
    node.localize = localize
    first = clients.submit(node.requests.answer)
    wait(lambda: searched, 'the first search', shoot)
    arrived_at = time.monotonic()
    second, third = clients.submit(node.requests.answer), clients.submit(node.requests.answer)
    wait(lambda: time.monotonic() > arrived_at + 0.1, 'both to wait')
    go_on.set()
    wait(lambda: second.done() and third.done(), 'the answers', shoot)
    assert first.result().received_at < arrived_at <= second.result().received_at
    # requests that wait together share an answer
    assert third.result() is second.result() and len(searched) == 2


def test_an_answer_keeps_to_the_time_out_while_a_search_goes_on(node, shoot, clients, wait):
    """The search ends later; then nothing of it is published. Requests wait concurrently."""
    set_values(node, timeout_s=0.6)
    release, published = threading.Event(), []
    node.localize, node.publish = lambda frame: release.wait(10.0), published.append
    start = time.monotonic()
    request, other = clients.submit(node.requests.answer), clients.submit(node.requests.answer)
    wait(lambda: request.done() and other.done(), 'the answers', shoot)
    took_s = time.monotonic() - start
    release.set()
    node.worker.run(lambda: None)  # after the search
    assert not published and took_s < 1.4
    assert {request.result().verdict, other.result().verdict} <= {Verdict.REFUSED, Verdict.FAILED}
    assert 'time is up: waiting for' in request.result().message + other.result().message


def test_a_start_that_lasts_or_fails_is_retried_by_requests(node, capfd, wait):
    def load_again(loads):
        wait(lambda: node.active, 'the node to be active')
        node.loads = loads
        node.trigger_deactivate()
        node.trigger_cleanup()

    def fail():
        raise MapError('office.yaml: gone')
    set_values(node, timeout_s=0.3)
    release = threading.Event()
    load_again(lambda: str(release.wait(10.0)))
    start = time.monotonic()
    assert 'still loading; retry' in node.requests.answer().message
    assert time.monotonic() - start < 0.9
    release.set()
    load_again(fail)
    for _ in range(3):
        assert 'office.yaml: gone' in node.requests.answer().message
    assert sum('[ERROR]' in line and 'office.yaml' in line
               for line in capfd.readouterr().err.splitlines()) == 1
    node.loads = lambda: 'a map'
    assert 'no new frame' in node.requests.answer().message


def test_a_start_that_is_cancelled_ends_the_wait_for_it(node, clients, wait):
    """The node is destroyed while its start waits: concurrent.futures.wait would never return."""
    wait(lambda: node.active, 'the node to be active')
    node.trigger_deactivate()
    release, former = threading.Event(), node._start
    node._starting.submit(release.wait, 10.0)
    starting = clients.submit(node.bring_up)
    wait(lambda: node._start is not former, 'the start')
    node._starting.shutdown(wait=False, cancel_futures=True)
    with pytest.raises(StoppedError):
        starting.result(10.0)
    release.set()


class LateTransforms:
    """Stands for tf2's buffer, which has no transform before some time; tf2 is not needed."""

    def __init__(self, late_s):
        self._known_at = time.monotonic() + late_s

    def lookup_transform(self, target, source, stamp, timeout):
        if time.monotonic() < self._known_at:
            raise LookupError('extrapolation into the future')
        return TransformStamped()


def test_a_late_mount_is_waited_for_during_half_of_the_time(node, wait):
    wait(lambda: node.active, 'the node to be active')
    set_values(node, base_frame='base_link', tf_timeout_s=0.0)
    parameters, image = node.settings.snapshot(), Header(frame_id='camera')
    node.robot.transforms._buffer = LateTransforms(0.2)
    state = node.robot.at(image, parameters, time.monotonic() + 60.0)
    np.testing.assert_array_equal(state.camera_from_base, np.eye(4))
    node.robot.transforms._buffer, begin = LateTransforms(math.inf), time.monotonic()
    with pytest.raises(NoTransformError, match="'base_link' to 'camera'"):
        node.robot.at(image, parameters, begin + 0.8)
    assert time.monotonic() - begin > 0.35
