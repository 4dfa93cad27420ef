# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Every bad input is named in the answer, and the node lives on."""

import numpy as np
import pytest
from std_msgs.msg import Header
from tester import make_frame

from cliploc_ros.core.observation import Detections
from cliploc_ros.ros.conversions import detections_to_msg

NAN, INF = float('nan'), float('inf')


def bad_image(**changes):
    def change(image, info, detections):
        for name, value in changes.items():
            setattr(image, name, value)
    return change


def bad_info(**changes):
    def change(image, info, detections):
        for name, value in changes.items():
            setattr(info, name, value)
    return change


def bad_boxes(boxes, class_id='a'):
    def change(image, info, detections):
        rows = np.array(boxes, dtype=np.float64).reshape(-1, 4)
        detections.detections = detections_to_msg(
            Detections(rows, (class_id,) * len(rows), np.full(len(rows), 0.5)),
            detections.header).detections
    return change


def of_another_camera(image, info, detections):
    detections.header = Header(stamp=image.header.stamp, frame_id='left_optical_frame')


def without_scores(image, info, detections):
    for one in detections.detections:
        one.results[0].hypothesis.score = NAN


def of_numbers(image, info, detections):
    for one in detections.detections:
        one.results[0].hypothesis.class_id = str(ord(one.results[0].hypothesis.class_id))


MANY_BOXES = np.random.default_rng(0).uniform((0, 0, 200, 200), (200, 200, 400, 400), (5000, 4))
BAD_FRAMES = {
    'unknown encoding': (bad_image(encoding='yuv422'), "encoding 'yuv422' is none of"),
    'no width': (bad_image(width=0), 'image size 0x480'),
    'no size': (bad_image(width=0, height=0, data=b''), 'image size 0x0'),
    'huge size': (bad_image(width=2**31, height=2**31), 'image size'),
    'short step': (bad_image(step=10), 'step 10 is shorter'),
    'long step': (bad_image(step=2**31), 'but 480 rows'),
    'short data': (bad_image(data=b'123'), 'image data has 3 bytes'),
    'zero K': (bad_info(k=np.zeros(9)), 'camera_info: K: fx=0'),
    'NaN in K': (bad_info(k=np.full(9, np.nan)), 'camera_info: K: fx=nan'),
    'K of another size': (bad_info(width=320, height=240), 'camera_info is for 320x240'),
    'unknown lens': (bad_info(distortion_model='mystery', d=[0.1]), "'mystery' is none of"),
    'too few coefficients': (bad_info(d=[0.1, 0.2]), '4 or 5 coefficients'),
    'infinite coefficient': (bad_info(d=[INF] * 5), 'not finite'),
    'K of twice the size': (bad_info(k=[1000.0, 0.0, 640.0, 0.0, 1000.0, 480.0, 0.0, 0.0, 1.0]),
                            'of an image of 1280x960 px'),
    'focal length of twice the size': (bad_info(
        k=[1000.0, 0.0, 320.0, 0.0, 1000.0, 240.0, 0.0, 0.0, 1.0]), 'of another resolution'),
    'turned K': (bad_info(k=[500.0, 0.0, 0.0, 0.0, 500.0, 0.0, 320.0, 240.0, 1.0]), 'transposed'),
    'focal length in sizes': (bad_info(k=[0.8, 0.0, 320.0, 0.0, 1.0, 240.0, 0.0, 0.0, 1.0],
                                       p=np.zeros(12)), 'degrees wide'),
    'unknown fisheye': (bad_info(distortion_model='fisheye', d=[0.0] * 4), "'fisheye' is none of"),
    'fisheye without coefficients': (bad_info(distortion_model='equidistant', d=[]),
                                     '4 coefficients, not 0'),
    'boxes of another camera': (of_another_camera, "'left_optical_frame'"),
    'scores that are none': (without_scores, 'none of its 12 scores is a number'),
    'classes that are numbers': (of_numbers, '97, 98, 99, which are numbers; the map has a, b, c'),
    'normalized boxes': (bad_boxes([[0.1, 0.1, 0.3, 0.2]] * 5), 'publish pixels of the image'),
    'no boxes': (bad_boxes([]), '0 detections'),
    'NaN boxes': (bad_boxes([[NAN] * 4] * 5), '0 detections'),
    'inverted boxes': (bad_boxes([[50, 50, 10, 10]] * 5), '0 detections'),
    'boxes outside': (bad_boxes([[900, 900, 950, 950]] * 5), '0 detections'),
    'infinite boxes': (bad_boxes([[-1e308, 0, 1e308, 9]] * 5), '0 detections'),
    'unknown classes': (bad_boxes([[10, 10, 50, 50]] * 5, 'zebra'), 'correspondence candidates'),
    'two boxes': (bad_boxes([[10, 10, 50, 50], [70, 10, 90, 50]]), '2 detections'),
    'thousands of boxes': (bad_boxes(MANY_BOXES), 'refused'),
}


def refusal(tester, frame):
    """Return the answer to a bad frame; a good one of the test before may still be on its way."""
    answer = tester.relocalize(frame)
    return tester.relocalize(frame) if answer.success else answer


@pytest.mark.parametrize('name', BAD_FRAMES)
def test_bad_frames(relocalizer, tester, name):
    change, reason = BAD_FRAMES[name]
    frame = make_frame()
    change(*frame)
    answer = refusal(tester, frame)
    assert not answer.success
    assert reason in answer.message, answer.message
    assert 'internal error' not in answer.message
    assert tester.relocalize(make_frame(stamp_s=101.0)).success


def test_what_strangers_write_is_quoted_in_a_line(relocalizer, tester):
    """Answer, log and diagnostics: a message of a megabyte must not become many."""
    frame = make_frame()
    frame[0].encoding = '[FATAL] all is lost\n' * 50_000
    answer = refusal(tester, frame)
    assert not answer.success
    assert answer.message.startswith("image encoding '[FATAL] all is lost ")
    assert 'bgra8' in answer.message
    assert len(answer.message) < 1000
    assert '\n' not in answer.message
    tester.wait(lambda: 'image encoding' in relocalizer.output(), 'the log')
    assert max(map(len, relocalizer.output().splitlines())) < 2000
    assert not [line for line in relocalizer.output().splitlines() if line.startswith('[FATAL]')]


@pytest.mark.parametrize(('topics', 'reason'), [
    ((), 'no image'),
    (('camera_info', 'detections'), 'no image'),
    (('image', 'detections'), 'no camera_info'),
    (('image', 'camera_info'), 'no detections'),
    (('image', 'camera_info', 'detections of another image'), 'stamps never match'),
])
def test_a_request_without_fresh_frames(relocalizer, tester, topics, reason):
    image, info, detections = make_frame(stamp_s=5.0)
    messages = {'image': image, 'camera_info': info, 'detections': detections,
                'detections of another image': make_frame(stamp_s=5.001)[2]}
    assert tester.set_parameter('timeout_s', 1.5).successful
    answer = tester.relocalize([messages[topic] for topic in topics])
    assert tester.set_parameter('timeout_s', 10.0).successful
    assert not answer.success
    assert 'no fresh frame within 1.5 s' in answer.message
    assert reason in answer.message
    assert tester.relocalize(make_frame(stamp_s=6.0)).success


def test_parameters_change_at_run_time(relocalizer, tester):
    assert tester.set_parameter('min_inliers', 13).successful
    answer = tester.relocalize(make_frame())
    assert not answer.success
    assert '12 objects matched < 13' in answer.message
    assert tester.set_parameter('min_inliers', 4).successful
    assert tester.relocalize(make_frame()).success
