# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Two concurrent requests on a looping recording, repeatedly: each answer is correct."""

import os
from itertools import count
from statistics import median_low

import cv2
import numpy as np
import pytest
from processes import wait_for
from scene import CAMERA, MAP_FROM_CAMERA, make_room, see_room
from sensor_msgs.msg import CompressedImage
from tester import make_frame, transform_of

from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.ros.conversions import stamp_ns

pytestmark = pytest.mark.full

#: Default number of requests.
REQUESTS = int(os.environ.get('CLIPLOC_SOAK_REQUESTS', '100'))
#: Growth in the second half. A short run is still warming up: pools of the middleware grow with
#: the first thousand subscriptions.
GROWTH = 0.01 if REQUESTS >= 10_000 else 0.015
#: Threads of the middleware and of Python, and 24 for waiting callbacks, whose pool never shrinks.
MAX_THREADS = 45
FRAMES, PERIOD_S = 60, 0.025


def move_camera(number):
    """Return the true pose (4, 4) of a frame, different for each."""
    moved = MAP_FROM_CAMERA.copy()
    moved[0, 3] += 0.01 * (number % FRAMES - FRAMES / 2)
    return moved


def test_soak(tester, own_relocalizer):
    """A loop of frames; one in four shows too few objects for a pose."""
    process, measured, verdicts = own_relocalizer(fresh=True, image_transport='compressed'), [], []
    jpeg = cv2.imencode('.jpg', np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8))[1].tobytes()
    room, numbers = make_room(), count()

    def shoot():
        number = next(numbers)
        seen = see_room(room, move_camera(number)).select(np.arange(2 if number % 4 == 3 else 12))
        image, info, detections = make_frame(seen, 1000.0 + number * PERIOD_S)
        tester.publish((CompressedImage(header=image.header, format='jpeg', data=jpeg), info,
                        detections))
        tester.spin()
    for _ in range(REQUESTS // 2):
        tester.forget()
        futures = [tester.ask(), tester.ask()]
        wait_for(lambda asked=futures: all(one.done() for one in asked), 'answers', work=shoot)
        for answer in (future.result() for future in futures):
            assert answer.success or answer.message.startswith('refused'), answer.message
            verdicts.append(answer.success)
        for pose in tester.poses:
            number = round((stamp_ns(pose.header.stamp) / 1e9 - 1000.0) / PERIOD_S)
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
