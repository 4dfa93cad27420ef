# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Two clients ask again and again about a looping recording; every answer is judged."""

import os
import re
import time
from bisect import bisect_left
from collections import Counter, defaultdict
from dataclasses import dataclass
from operator import itemgetter
from statistics import median_low

import cv2
import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from processes import PATIENCE_S, wait_for
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from scene import CAMERA, MAP_FROM_CAMERA, make_room, see_room
from sensor_msgs.msg import CameraInfo
from std_srvs.srv import Trigger
from tester import RELIABLE, TakingLocalizer, transform_of

from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.datasets.bag_messages import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    DETECTIONS,
    camera_info_message,
    compressed_image_message,
    detections_message,
)
from cliploc_ros.datasets.bags import BagWriter
from cliploc_ros.ros.conversions import stamp_ns

pytestmark = pytest.mark.full

#: So many by default; CLIPLOC_SOAK_REQUESTS=10000 asks for more, in ten minutes.
REQUESTS = int(os.environ.get('CLIPLOC_SOAK_REQUESTS', '200'))
#: Over the second half. A short run is still warming up there: pools of the middleware grow with
#: the first thousand subscriptions.
GROWTH = 0.01 if REQUESTS >= 10_000 else 0.03
#: Those of the middleware and of Python, and 24 for callbacks that may wait: that pool only grows.
MAX_THREADS = 45
SAMPLES = 100
FRAMES, PERIOD_NS = 60, 25_000_000
# A frame that was under way when the request was sent may be taken; one of the last request, or
# of the last round of the recording (1.5 s), may not.
UNDER_WAY_NS = 100_000_000


def move_camera(number):
    """Return the true pose (4, 4) of a frame: each stands elsewhere."""
    moved = MAP_FROM_CAMERA.copy()
    moved[0, 3] += 0.01 * (number - FRAMES / 2)
    return moved


@pytest.fixture(scope='module')
def recording(tmp_path_factory):
    """A round of frames at 40 Hz; one in four shows too few objects to answer from."""
    path, room = tmp_path_factory.mktemp('soak') / 'round', make_room()
    jpeg = cv2.imencode('.jpg', np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8))[1].tobytes()
    with BagWriter(path) as bag:
        for topic, message_type in (('/camera_info', CAMERA_INFO), ('/detections', DETECTIONS),
                                    ('/image/compressed', COMPRESSED_IMAGE)):
            bag.add_topic(topic, message_type)
        for number in range(FRAMES):
            stamp, frame = 10**12 + number * PERIOD_NS, 'camera_optical_frame'
            seen = see_room(room, move_camera(number))
            seen = seen.select(np.arange(2)) if number % 4 == 3 else seen
            bag.write('/camera_info', stamp, camera_info_message(stamp, frame, CAMERA))
            bag.write('/image/compressed', stamp,
                      compressed_image_message(stamp, frame, jpeg, 'jpeg'))
            bag.write('/detections', stamp, detections_message(stamp, frame, seen))
    return path


@dataclass
class Request:
    """One request and what came of it; times are those of the wall [ns]."""

    sent_ns: int
    answered_ns: int = 0
    success: bool = False
    message: str = ''


class Client:
    """Asks in a node of its own, the next request when the last one is answered."""

    def __init__(self, number, executor, wanted):
        self.node = Node(f'soak_client_{number}')
        executor.add_node(self.node)
        self.requests, self.answers = [], Counter()
        self._wanted = wanted
        self._client = self.node.create_client(Trigger, 'relocalizer/relocalize')
        # rclpy drops what it waits for no longer: a second answer would go unnoticed
        self._lookup, self._client.get_pending_request = (
            self._client.get_pending_request, self._count)
        self.ready = self._client.service_is_ready

    def _count(self, sequence_number):
        self.answers[sequence_number] += 1
        return self._lookup(sequence_number)

    @property
    def done(self):
        return len(self.requests) == self._wanted and self.requests[-1].answered_ns > 0

    def ask(self):
        request = Request(time.time_ns())
        self.requests.append(request)
        self._client.call_async(Trigger.Request()).add_done_callback(
            lambda future: self._take(request, future.result()))

    def _take(self, request, answer):
        request.answered_ns = time.time_ns()
        request.success, request.message = answer.success, answer.message
        if len(self.requests) < self._wanted:
            self.ask()


class Witness:
    """Hears when each frame was published; a localizer that keeps every pose that it was told."""

    def __init__(self, executor):
        self.node = Node('soak_witness')
        executor.add_node(self.node)
        self.published_ns, self.poses = defaultdict(list), []
        self.localizer = TakingLocalizer(self.node)
        self.node.create_subscription(CameraInfo, 'camera_info', self._hear, RELIABLE)
        self.node.create_subscription(PoseWithCovarianceStamped, 'initialpose',
                                      lambda msg, info: self.poses.append(
                                          (info['source_timestamp'], msg)), RELIABLE)

    def told_between(self, begin_ns, end_ns):
        first, last = (bisect_left(self.poses, at, key=itemgetter(0)) for at in (begin_ns, end_ns))
        return self.poses[first:last]

    def _hear(self, msg, info):
        self.published_ns[stamp_ns(msg.header.stamp)].append(info['source_timestamp'])


class Meter:
    """Takes figures of a process now and then."""

    def __init__(self, process):
        self._process = process
        self.rows = []

    def take(self):
        self.rows.append((self._process.memory_mib(), self._process.descriptors(),
                          self._process.threads()))

    def ends(self):
        """Return the medians [MiB, descriptors, threads] where the second half begins and ends."""
        tenth, half = len(self.rows) // 10, len(self.rows) // 2
        return [[median_low(column) for column in zip(*rows, strict=True)]
                for rows in (self.rows[half:half + tenth], self.rows[-tenth:])]


def judge(request, witness):
    """Return how old the frame of a successful answer was when it was asked for [ns].

    The pose that a localizer was told must be the one of the answer, and true for its frame.
    """
    x, y, z = map(float, re.match(r'accepted: x (\S+) y (\S+) z (\S+) m', request.message)
                  .groups())
    for told_ns, pose in witness.told_between(request.sent_ns, request.answered_ns):
        position = pose.pose.pose.position
        if np.allclose((position.x, position.y, position.z), (x, y, z), atol=0.0051):
            stamp = stamp_ns(pose.header.stamp)
            number = (stamp - 10**12) // PERIOD_NS
            assert pose_error(transform_of(pose.pose.pose), move_camera(number))[0] < 0.1
            shown_ns = max(at for at in witness.published_ns[stamp] if at < told_ns)
            return request.sent_ns - shown_ns
    raise AssertionError(f'no pose was published for: {request.message}')


@pytest.mark.clock
def test_soak(start, ros, own_relocalizer, recording):
    process = own_relocalizer(fresh=True, image_transport='compressed')
    executor = SingleThreadedExecutor()
    witness = Witness(executor)
    clients = [Client(number, executor, REQUESTS // 2) for number in range(2)]
    start('cli.replay', recording, '--loop')

    def spin():
        executor.spin_once(timeout_sec=0.02)

    wait_for(lambda: all(client.ready() for client in clients) and witness.published_ns,
             'services and frames', work=spin)
    meter, begin = Meter(process), time.monotonic()
    for client in clients:
        client.ask()
    for target in np.linspace(0, 2 * (REQUESTS // 2), SAMPLES + 1)[1:]:
        wait_for(lambda wanted=target: sum(client.answers.total() for client in clients)
                 >= wanted, f'{target:.0f} answers', PATIENCE_S + REQUESTS, spin)
        meter.take()
    elapsed_s = time.monotonic() - begin
    # second answers, and poses, that are still on their way
    end = time.monotonic() + 2.0
    wait_for(lambda: time.monotonic() > end, 'stragglers', work=spin)
    for node in (witness.node, *(client.node for client in clients)):
        node.destroy_node()

    report(clients, witness, meter, elapsed_s)
    for client in clients:
        assert client.done
        assert set(client.answers.values()) == {1}, 'lost or answered twice'
        assert len(client.answers) == len(client.requests)
    requests = [request for client in clients for request in client.requests]
    told = [request for request in requests if request.success]
    assert max(judge(request, witness) for request in told) < UNDER_WAY_NS
    # a frame, a search, and the frame that came meanwhile: 50 ms; where messages wake the executor
    # until another thread has taken them, it is half a second
    assert np.median([request.answered_ns - request.sent_ns for request in requests]) < 200e6
    for request in requests:
        assert request.success or request.message.startswith('refused'), request.message
    assert 0 < len(witness.poses) <= len(told) < len(requests)
    (before_mib, before, _), (after_mib, after, threads) = meter.ends()
    assert after_mib < (1 + GROWTH) * before_mib
    assert before == after, 'file descriptors'
    assert threads <= MAX_THREADS
    assert 'Traceback' not in process.output()


def report(clients, witness, meter, elapsed_s):
    requests = [request for client in clients for request in client.requests]
    told = [request for request in requests if request.success]
    ages_ms = [judge(request, witness) / 1e6 for request in told]
    waits_ms = [(request.answered_ns - request.sent_ns) / 1e6 for request in requests]
    (before_mib, *before), (after_mib, *after) = meter.ends()
    print(f'\n{len(requests)} requests in {elapsed_s:.0f} s, {len(told)} with success, '
          f'{len(witness.poses)} poses told; answered after {np.median(waits_ms):.0f} ms '
          f'(p99 {np.percentile(waits_ms, 99):.0f}, worst {max(waits_ms):.0f})')
    print(f'oldest frame taken: published {max(ages_ms):.1f} ms before its request was sent')
    print(f'second half: {before_mib:.1f} to {after_mib:.1f} MiB '
          f'({100 * (after_mib / before_mib - 1):+.2f} %), descriptors and threads '
          f'{before} to {after}')
    worst = max(requests, key=lambda request: request.answered_ns - request.sent_ns)
    print(f'worst: {worst.message}')
    print('MiB by tenths of the run: ' + ', '.join(f'{row[0]:.1f}' for row in meter.rows[::10]))
