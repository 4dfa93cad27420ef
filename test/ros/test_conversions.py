# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
import io

import numpy as np
import PIL.Image
import pytest
from builtin_interfaces.msg import Time
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, RegionOfInterest
from std_msgs.msg import Header
from vision_msgs import msg as vision

from cliploc_ros.core.observation import Detections
from cliploc_ros.errors import ImageError
from cliploc_ros.messages import camera_from_msg, detections_from_msg, image_from_msg
from cliploc_ros.ros.conversions import detections_to_msg

HEADER = Header(frame_id='camera', stamp=Time(sec=12, nanosec=34))
# Two rows of three pixels, red first.
PIXELS = np.array([[[1, 2, 3], [4, 5, 6], [7, 8, 9]],
                   [[250, 251, 252], [253, 254, 255], [0, 128, 64]]], dtype=np.uint8)
# The channels in the order of each encoding; None: a byte that is not used.
ENCODINGS = {'rgb8': (0, 1, 2), 'bgr8': (2, 1, 0), '8UC3': (2, 1, 0),
             'rgba8': (0, 1, 2, None), 'bgra8': (2, 1, 0, None), '8UC4': (2, 1, 0, None)}


def image_msg(encoding, padding=0):
    rows = [[77 if channel is None else int(pixel[channel]) for pixel in row
             for channel in ENCODINGS[encoding]] for row in PIXELS]
    data = b''.join(bytes(row) + bytes([99] * padding) for row in rows)
    return Image(header=HEADER, height=len(rows), width=3, encoding=encoding,
                 step=len(rows[0]) + padding, data=data)


@pytest.mark.parametrize('padding', [0, 5])
@pytest.mark.parametrize('encoding', ENCODINGS)
def test_colour_images(encoding, padding):
    msg = image_msg(encoding, padding)
    image = image_from_msg(msg)
    np.testing.assert_array_equal(image, PIXELS)
    assert image.dtype == np.uint8 and image.flags.c_contiguous


@pytest.mark.parametrize(('changes', 'message'), [
    ({'encoding': 'bayer_rggb8'}, "'bayer_rggb8' is not one of"), ({'width': 0}, 'size 0x2'),
    ({'width': 2**32 - 1, 'height': 2**32 - 1}, 'size 4294967295x'), ({'step': 8}, 'step 8 is'),
    ({'data': b'\0' * 17}, '17 bytes, but 2 rows')])
def test_images_that_cannot_be(changes, message):
    msg = image_msg('rgb8')
    for name, value in changes.items():
        setattr(msg, name, value)
    with pytest.raises(ImageError, match=message):
        image_from_msg(msg)


@pytest.mark.parametrize('extension', ['png', 'jpeg'])
def test_a_small_file_that_claims_a_huge_size_is_not_decoded(extension):
    red = np.full((8, 16, 3), (10, 20, 230), dtype=np.uint8)
    file, exif = io.BytesIO(), PIL.Image.Exif()
    exif[0x0112] = 3  # upside down, for viewing: the intrinsics are those of the sensor
    red[:4, :8] = 255
    PIL.Image.fromarray(red[..., ::-1]).save(file, extension, exif=exif)
    data = bytearray(file.getvalue())
    image = image_from_msg(CompressedImage(format=extension, data=bytes(data)))
    assert image.shape == (8, 16, 3)
    np.testing.assert_allclose(image[7, 15], [230, 20, 10], atol=8, err_msg='red first')
    assert image[1, 2].min() > 200
    if extension == 'png':
        data[16:24] = (60_000).to_bytes(4) * 2
    else:
        frame = data.index(b'\xff\xc0')
        data[frame + 5:frame + 9] = (60_000).to_bytes(2) * 2
    with pytest.raises(ImageError, match='60000x60000'):
        image_from_msg(CompressedImage(format=extension, data=bytes(data)))


def camera_info(**changes):
    fields = {'width': 640, 'height': 480, 'distortion_model': 'plumb_bob',
              'd': [0.1, -0.2, 0.001, 0.002, 0.0],
              'k': [500.0, 0.0, 320.0, 0.0, 510.0, 240.0, 0.0, 0.0, 1.0],
              'p': [400.0, 0.0, 300.0, -48.0, 0.0, 410.0, 200.0, 0.0, 0.0, 0.0, 1.0, 0.0]}
    return CameraInfo(header=HEADER, **(fields | changes))


def test_a_raw_image_has_k_and_distortion_and_a_rectified_one_p():
    camera = camera_from_msg(camera_info(), (640, 480), rectified=False)
    assert (camera.width, camera.height) == (640, 480)
    assert camera.matrix.tolist() == [[500, 0, 320], [0, 510, 240], [0, 0, 1]]
    assert (camera.distortion_model, camera.distortion) == (
        'plumb_bob', (0.1, -0.2, 0.001, 0.002, 0.0))
    for model in ('plumb_bob', 'of my own'):
        camera = camera_from_msg(camera_info(distortion_model=model), (640, 480), rectified=True)
        assert camera.matrix.tolist() == [[400, 0, 300], [0, 410, 200], [0, 0, 1]]
        assert camera.distortion == ()


SENSOR = {'width': 1280, 'height': 961,
          'k': [1000.0, 0.0, 641.0, 0.0, 1020.0, 482.0, 0.0, 0.0, 1.0],
          'p': [800.0, 0.0, 601.0, -96.0, 0.0, 820.0, 402.0, 0.0, 0.0, 0.0, 1.0, 0.0]}


def region(**changes):
    return RegionOfInterest(**({'x_offset': 200, 'y_offset': 100, 'width': 400,
                                'height': 300} | changes))


@pytest.mark.parametrize(('changes', 'size', 'k', 'p'), [
    ({'binning_x': 2, 'binning_y': 2}, (640, 480), (500, 510, 320.5, 241), (400, 410, 300.5, 201)),
    ({'roi': region(do_rectify=True), 'binning_x': 1, 'binning_y': 2}, (400, 150),
     (1000, 510, 441, 191), (800, 410, 401, 151))])
def test_binning_and_a_region_of_interest(changes, size, k, p):
    """For every image, a pixel of the sensor is the same ray through the same lens."""
    info = camera_info(**SENSOR | changes)
    raw, rectified = (camera_from_msg(info, size, is_rectified) for is_rectified in (False, True))
    assert (raw.width, raw.height) == size and (raw.fx, raw.fy, raw.cx, raw.cy) == k
    assert (rectified.fx, rectified.fy, rectified.cx, rectified.cy) == p
    whole = camera_from_msg(camera_info(**SENSOR), (1280, 961), rectified=False)
    on_sensor = np.array([[210.0, 110.0], [590.0, 390.0]])
    in_image = (on_sensor - [info.roi.x_offset, info.roi.y_offset]) / [
        info.binning_x or 1, info.binning_y or 1]
    np.testing.assert_allclose(raw.normalize_points(in_image), whole.normalize_points(on_sensor),
                               rtol=0, atol=1e-9)


COORDINATES = st.floats(-1e5, 1e5)
DETECTIONS = st.lists(st.tuples(
    st.tuples(COORDINATES, COORDINATES, COORDINATES, COORDINATES),
    st.text(st.characters(codec='utf-8', exclude_characters='\0'), max_size=20),
    st.floats(0.0, 1.0)), max_size=8)


@given(DETECTIONS)
def test_detections_come_back_over_the_wire(found):
    boxes = np.array([box for box, _, _ in found], dtype=np.float64).reshape(-1, 4)
    sent = Detections(boxes, tuple(name for _, name, _ in found),
                      np.array([score for _, _, score in found], dtype=np.float64))
    msg = deserialize_message(serialize_message(detections_to_msg(sent, HEADER)),
                              vision.Detection2DArray)
    assert msg.header == HEADER
    assert all(detection.header == HEADER for detection in msg.detections)
    received = detections_from_msg(msg)
    np.testing.assert_allclose(received.bboxes_xyxy, sent.bboxes_xyxy, rtol=0, atol=1e-9)
    assert received.class_ids == sent.class_ids
    np.testing.assert_array_equal(received.scores, sent.scores)
    for detection in msg.detections:
        detection.bbox.center.theta = np.pi / 2  # the upright box around a turned one
    for turned, (left, top, right, bottom) in zip(detections_from_msg(msg).bboxes_xyxy, boxes,
                                                  strict=True):
        x, y = (left + right) / 2, (top + bottom) / 2
        half_x, half_y = (bottom - top) / 2, (right - left) / 2
        assert turned == pytest.approx([x - half_x, y - half_y, x + half_x, y + half_y], abs=1e-6)


def classified(*hypotheses):
    return vision.Detection2D(results=[
        vision.ObjectHypothesisWithPose(hypothesis=vision.ObjectHypothesis(
            class_id=class_id, score=score)) for class_id, score in hypotheses])


def test_the_most_confident_class_counts():
    nan = float('nan')  # does not hide another class
    msg = vision.Detection2DArray(detections=[
        classified(('cup', 0.2), ('vase', 0.7), ('bowl', 0.1)), classified(),
        classified(('chair', 0.5)), classified(('cup', 0.9), ('vase', nan)),
        classified(('vase', nan), ('cup', 0.9))])
    received = detections_from_msg(msg)
    assert received.class_ids == ('vase', '', 'chair', 'cup', 'cup')
    assert received.scores.tolist() == [0.7, 0.0, 0.5, 0.9, 0.9]
