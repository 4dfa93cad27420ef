# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Stamps that do not assign detections to an image are refused, with the cause."""

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from processes import wait_for
from scene import MAP_FROM_CAMERA, make_room, see_room
from std_msgs.msg import Header
from tester import make_frame, transform_of

from cliploc_ros.core.geometry.transforms import make_transform, pose_error

ROOM = make_room()
RATE_HZ, LATE = 10, 2


class Camera:
    """A camera of a robot that drives to and fro, and a detector with a delay of some images.

    `image_stamp` and `info_stamp` return the stamp for the number of an image.
    """

    def __init__(self, image_stamp, info_stamp):
        self._stamps, self._noise = (image_stamp, info_stamp), np.random.default_rng(1)
        self._number = 0

    @staticmethod
    def place(number):
        """Return the camera's pose (4, 4) at an image: half a metre at 1 m/s, and back."""
        move_m = 0.5 - abs(number / RATE_HZ % 2.0 - 1.0)
        return MAP_FROM_CAMERA @ make_transform(np.eye(3), np.array([move_m, 0.0, 0.0]))

    def shoot(self):
        """Return the next image, its calibration, and the boxes of an earlier image."""
        (image, info, _), late = make_frame(), self._number - LATE
        image.data = self._noise.integers(0, 256, len(image.data), np.uint8).tobytes()
        boxes = make_frame(see_room(ROOM, self.place(late)))[2]
        image_stamp, info_stamp = self._stamps
        image.header.stamp = image_stamp(self._number)
        info.header = Header(frame_id=image.header.frame_id, stamp=info_stamp(self._number))
        boxes.header.stamp = image_stamp(late)
        self._number += 1
        return image, info, boxes


def right(number):
    """Return stamps that count the images from 1000 s on."""
    ns = 10**12 + 1234567 + number * 10**9 // RATE_HZ
    return Time(sec=ns // 10**9, nanosec=ns % 10**9)


@pytest.fixture
def ask(tester):
    """Request a pose while a camera runs; return the answer."""
    def asking(camera, timeout_s=10.0):
        assert tester.set_parameter('timeout_s', timeout_s).successful
        future = tester.ask()

        def work():
            tester.publish(camera.shoot())
            for _ in range(3):
                tester.spin()
        wait_for(future.done, 'an answer', work=work)
        return future.result()
    yield asking
    assert tester.set_parameter('timeout_s', 10.0).successful


def test_stamps_that_name_no_image_pair_nothing(relocalizer, tester, ask):
    """Stamps in whole seconds; test/ros has the others."""
    whole = lambda number: Time(sec=right(number).sec)  # noqa: E731
    answer = ask(Camera(whole, whole), 2.0)
    assert not answer.success
    assert 'for several of them' in answer.message and 'must copy' in answer.message
    assert not tester.poses and not tester.initial_poses


def test_late_detections_with_the_stamp_of_their_image_are_right(relocalizer, tester, ask):
    """A calibration without stamp is used for all images."""
    for info_stamp in (right, lambda number: Time()):
        tester.forget()
        answer = ask(Camera(right, info_stamp))
        assert answer.success, answer.message
        tester.wait(lambda: tester.poses, 'the pose')
        stamp = tester.poses[-1].header.stamp
        number = ((stamp.sec - 1000) * 10**9 + stamp.nanosec - 1234567) * RATE_HZ // 10**9
        error_m, error_deg = pose_error(transform_of(tester.poses[-1].pose.pose),
                                        Camera.place(number))
        assert error_m < 0.01 and error_deg < 0.5
