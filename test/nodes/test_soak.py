# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Two concurrent requests on a looping recording, repeatedly: each answer is correct."""

import os
from statistics import median_low

import cv2
import numpy as np
import pytest
from scene import CAMERA, MAP_FROM_CAMERA, make_room, see_room
from tester import transform_of

from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.offline.datasets import bag_messages
from cliploc_ros.offline.datasets.bags import BagWriter
from cliploc_ros.ros.conversions import stamp_ns

pytestmark = pytest.mark.full

#: Default number of requests; CLIPLOC_SOAK_REQUESTS=10000 takes ten minutes.
REQUESTS = int(os.environ.get('CLIPLOC_SOAK_REQUESTS', '200'))
#: Growth in the second half. A short run is still warming up: pools of the middleware grow with
#: the first thousand subscriptions.
GROWTH = 0.01 if REQUESTS >= 10_000 else 0.03
#: Threads of the middleware and of Python, and 24 for waiting callbacks, whose pool never shrinks.
MAX_THREADS = 45
FRAMES, PERIOD_NS = 60, 25_000_000


def move_camera(number):
    """Return the true pose (4, 4) of a frame, different for each."""
    moved = MAP_FROM_CAMERA.copy()
    moved[0, 3] += 0.01 * (number - FRAMES / 2)
    return moved


@pytest.fixture(scope='module')
def recording(tmp_path_factory):
    """A loop of frames at 40 Hz; one in four shows too few objects for a pose."""
    path, room = tmp_path_factory.mktemp('soak') / 'round', make_room()
    jpeg = cv2.imencode('.jpg', np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8))[1].tobytes()
    with BagWriter(path) as bag:
        for topic, msgtype in (('/camera_info', bag_messages.CAMERA_INFO),
                               ('/detections', bag_messages.DETECTIONS),
                               ('/image/compressed', bag_messages.COMPRESSED_IMAGE)):
            bag.add_topic(topic, msgtype)
        for number in range(FRAMES):
            stamp, frame = 10**12 + number * PERIOD_NS, 'camera_optical_frame'
            seen = see_room(room, move_camera(number)).select(
                np.arange(2 if number % 4 == 3 else 12))
            bag.write('/camera_info', stamp, bag_messages.camera_info_message(
                stamp, frame, CAMERA))
            bag.write('/image/compressed', stamp, bag_messages.compressed_image_message(
                stamp, frame, jpeg, 'jpeg'))
            bag.write('/detections', stamp, bag_messages.detections_message(stamp, frame, seen))
    return path


@pytest.mark.clock
def test_soak(start, tester, own_relocalizer, recording):
    process, measured, verdicts = own_relocalizer(fresh=True, image_transport='compressed'), [], []
    start('cli.replay', recording, '--loop')
    for _ in range(REQUESTS // 2):
        tester.forget()
        for future in [tester.ask(), tester.ask()]:
            answer = tester.answer(future)
            assert answer.success or answer.message.startswith('refused'), answer.message
            verdicts.append(answer.success)
        for pose in tester.poses:
            number = (stamp_ns(pose.header.stamp) - 10**12) // PERIOD_NS
            assert pose_error(transform_of(pose.pose.pose), move_camera(number))[0] < 0.1
        measured.append((process.memory_mib(), process.descriptors(), process.threads()))
    assert 0 < sum(verdicts) < len(verdicts)
    tenth, half = max(1, len(measured) // 10), len(measured) // 2
    (before_mib, before, _), (after_mib, after, threads) = (
        [median_low(column) for column in zip(*rows, strict=True)]
        for rows in (measured[half:half + tenth], measured[-tenth:]))
    print(f'\n{len(verdicts)} requests, {sum(verdicts)} accepted; 2nd half: {before_mib:.1f} to '
          f'{after_mib:.1f} MiB, {before} to {after} descriptors, {threads} threads')
    assert after_mib < (1 + GROWTH) * before_mib
    assert before == after and threads <= MAX_THREADS
    assert 'Traceback' not in process.output()
