# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Every bad input is named in the answer, and the node keeps running."""

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from processes import wait_for
from scene import MAP_FROM_CAMERA, make_room, see_room
from std_msgs.msg import Header
from tester import make_frame, transform_of

from cliploc_ros.core.geometry.transforms import make_transform, pose_error
from cliploc_ros.core.observation import Detections
from cliploc_ros.ros.conversions import detections_to_msg


def of_unknown_encoding(image, info, detections):
    image.encoding = 'yuv422'


def bad_boxes(boxes, class_id='a'):
    def change(image, info, detections):
        rows = np.array(boxes, dtype=np.float64).reshape(-1, 4)
        detections.detections = detections_to_msg(
            Detections(rows, (class_id,) * len(rows), np.full(len(rows), 0.5)),
            detections.header).detections
    return change


def of_another_camera(image, info, detections):
    detections.header = Header(stamp=image.header.stamp, frame_id='left_optical_frame')


MANY_BOXES = np.random.default_rng(0).uniform((0, 0, 200, 200), (200, 200, 400, 400), (2000, 4))
# One fault of each cause, and the quote in the answer. test/ros has all of them.
BAD_FRAMES = {
    'encoding': (of_unknown_encoding, 'yuv422'),
    'boxes of another camera': (of_another_camera, 'left_optical_frame'),
    'unknown classes': (bad_boxes([[10, 10, 50, 50]] * 5, 'zebra'), 'zebra'),
    'thousands of boxes': (bad_boxes(MANY_BOXES), 'kind '),
}


def refusal(tester, frame):
    """Return the answer to a bad frame, though a good frame may still be in transit."""
    answer = tester.relocalize(frame)
    return tester.relocalize(frame) if answer.success else answer


@pytest.mark.parametrize('name', BAD_FRAMES)
def test_bad_frames(relocalizer, tester, name):
    change, reason = BAD_FRAMES[name]
    # frames of one stamp with different boxes would be another fault
    first_s = 1000.0 + 10.0 * [*BAD_FRAMES].index(name)
    frame = make_frame(stamp_s=first_s)
    change(*frame)
    answer = refusal(tester, frame)
    assert not answer.success
    assert reason in answer.message, answer.message
    assert 'internal error' not in answer.message
    assert tester.relocalize(make_frame(stamp_s=first_s + 1.0)).success


def test_what_strangers_write_is_quoted_in_a_line(relocalizer, tester):
    """Answer, log and diagnostics must not multiply a message of a megabyte."""
    frame = make_frame()
    frame[0].encoding = '[FATAL] all is lost\n' * 50_000
    answer = refusal(tester, frame)
    assert not answer.success
    assert answer.message.startswith('image encoding ')
    assert 'bgra8' in answer.message
    assert len(answer.message) < 1000
    assert '\n' not in answer.message
    tester.wait(lambda: 'image encoding' in relocalizer.output(), 'the log')
    assert max(map(len, relocalizer.output().splitlines())) < 2000
    assert not [line for line in relocalizer.output().splitlines() if line.startswith('[FATAL]')]


@pytest.mark.parametrize(('topics', 'reason'), [
    (('camera_info', 'detections'), 'no image'),
    (('image', 'camera_info', 'later detections'), 'never match')])
def test_a_request_without_fresh_frames(relocalizer, tester, topics, reason):
    image, info, detections = make_frame(stamp_s=5.0)
    messages = {'image': image, 'camera_info': info, 'detections': detections,
                'later detections': make_frame(stamp_s=5.001)[2]}
    assert tester.set_parameter('timeout_s', 1.0).successful
    answer = tester.relocalize([messages[topic] for topic in topics])
    assert tester.set_parameter('timeout_s', 10.0).successful
    assert not answer.success
    assert 'no new frame' in answer.message and reason in answer.message
    assert tester.relocalize(make_frame(stamp_s=6.0)).success


# ---- stamps of images

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
