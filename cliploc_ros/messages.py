# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Images, cameras and detections from messages, read by rclpy or by rosbags.

No field of a message is assumed valid.
"""

import math
import re
import struct
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry import depth
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.camera_faults import Fault, calibration_faults, check_faults
from cliploc_ros.core.observation import Detections, SeenTags
from cliploc_ros.errors import CameraError, ImageError, OptionsError

# Offsets of red, green and blue in each pixel, and the bytes per pixel.
_CHANNELS = {'rgb8': ((0, 1, 2), 3), 'bgr8': ((2, 1, 0), 3), '8UC3': ((2, 1, 0), 3),
             'rgba8': ((0, 1, 2), 4), 'bgra8': ((2, 1, 0), 4), '8UC4': ((2, 1, 0), 4),
             'mono8': ((0, 0, 0), 1), '8UC1': ((0, 0, 0), 1)}
# Limits the memory of an image to 200 MB: a small file may declare any size.
_MAX_PIXELS = 2**26
_DEPTH_TYPES = {'16UC1': np.uint16, 'mono16': np.uint16, '32FC1': np.float32}
# Header of compressedDepth: format, and the two parameters of inverse depth.
_DEPTH_HEADER = struct.Struct('<iff')
# Tolerance of the aspect ratio, for a depth image that is a rounded fraction of the colour image.
_SAME_ASPECT = 0.02
_PNG, _JPEG = b'\x89PNG\r\n\x1a\n', b'\xff\xd8'
# JPEG markers that are followed by the image size.
_JPEG_SIZES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
# Baselines of a stereo pair [m]: poses are off, and the unit is certainly wrong.
_BASELINE_M, _MOST_BASELINE_M = 0.02, 3.0
# Names of the second camera of a stereo pair in those of coordinate frames.
_SECOND = re.compile('(?<!up)right|second|infra_?2|bottom|(^|[_/])r([_/]|$)', re.IGNORECASE)
#: Messages of sensor_msgs, of the classes of rclpy or of rosbags
type ImageMessage = Any
type CompressedImageMessage = Any
type CameraInfoMessage = Any


def image_from_msg(msg: ImageMessage | CompressedImageMessage) -> NDArray[np.uint8]:
    """Return an image (h, w, 3) uint8, RGB.

    ImageError: a field is invalid; the message names it.
    """
    if hasattr(msg, 'format'):
        return _decoded(msg)
    if msg.encoding not in _CHANNELS:
        raise ImageError(f"image encoding '{msg.encoding}' is not one of {', '.join(_CHANNELS)}")
    order, channels = _CHANNELS[msg.encoding]
    pixels = _rows(msg, msg.width * channels).reshape(msg.height, msg.width, channels)
    return np.ascontiguousarray(pixels[:, :, order])


def _rows(msg: ImageMessage, used: int) -> NDArray[np.uint8]:
    """Return the rows (h, used) of an image [bytes]. ImageError: a field is invalid."""
    check_size(msg.width, msg.height)
    if msg.step < used:
        raise ImageError(f'image step {msg.step} is shorter than a row of {msg.width} '
                         f'{msg.encoding} pixels')
    if len(msg.data) < msg.step * msg.height:
        raise ImageError(f'image data has {len(msg.data)} bytes, but {msg.height} rows of '
                         f'{msg.step} bytes are {msg.step * msg.height}')
    rows = np.frombuffer(msg.data, dtype=np.uint8, count=msg.step * msg.height)
    return rows.reshape(msg.height, msg.step)[:, :used]


def _decoded(msg: CompressedImageMessage) -> NDArray[np.uint8]:
    data = bytes(msg.data)
    check_size(*declared_size(data, msg.format))
    # EXIF orientation is ignored: the intrinsics belong to the image as the sensor took it.
    image = _unpacked(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION,
                      f"compressed image ('{msg.format}')")
    if image is None:
        raise ImageError(f"compressed image ('{msg.format}', {len(data)} bytes) does not decode")
    # 'rgb8; jpeg compressed bgr8': the last word is the encoding of the compressed pixels. With
    # rgb8, compressed_image_transport has swapped red and blue.
    _, _, packed = msg.format.partition('compressed')
    return np.ascontiguousarray(image if packed.strip().startswith('rgb') else image[:, :, ::-1])


def _unpacked(data: bytes, flags: int, what: str) -> NDArray[Any] | None:
    """Decode a JPEG or PNG; ImageError: OpenCV raises, and the message names what it is."""
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise ImageError(f'{what} does not decode: {error.err}') from error


def declared_size(data: bytes, stated_format: str) -> tuple[int, int]:
    """Read the width and height of a JPEG or PNG from its header.

    ImageError: the data is neither JPEG nor PNG.
    """
    if data.startswith(_PNG) and len(data) >= 24:
        return int.from_bytes(data[16:20]), int.from_bytes(data[20:24])
    at = 2 if data.startswith(_JPEG) else len(data)
    while at + 9 <= len(data) and data[at] == 0xFF:
        if data[at + 1] in _JPEG_SIZES:
            return int.from_bytes(data[at + 7:at + 9]), int.from_bytes(data[at + 5:at + 7])
        at += 2 + int.from_bytes(data[at + 2:at + 4])
    raise ImageError(f"compressed image ('{stated_format}', {len(data)} bytes) does not decode: "
                     'it is not a JPEG or PNG, or it is cut off')


def depth_counts_from_msg(msg: ImageMessage | CompressedImageMessage) -> NDArray[np.generic]:
    """Return the pixels (h, w) of a depth image, uint16 or float32, as recorded.

    The encoding is 16UC1, mono16 or 32FC1; 0 or NaN means no depth. ImageError: a field is
    invalid.
    """
    if hasattr(msg, 'format'):
        return _decode_depth_png(msg)
    dtype = _depth_type(msg.encoding).newbyteorder('>' if getattr(msg, 'is_bigendian', 0) else '<')
    pixels = np.ascontiguousarray(_rows(msg, msg.width * dtype.itemsize)).view(dtype)
    return pixels.astype(dtype.newbyteorder('='))


def _depth_type(encoding: str) -> np.dtype[Any]:
    if encoding not in _DEPTH_TYPES:
        raise ImageError(f"depth encoding '{encoding}' is not one of {', '.join(_DEPTH_TYPES)}")
    return np.dtype(_DEPTH_TYPES[encoding])


def _decode_depth_png(msg: CompressedImageMessage) -> NDArray[np.generic]:
    encoding, _, transport = (part.strip() for part in msg.format.partition(';'))
    if not transport.startswith('compressedDepth') or transport.endswith('rvl'):
        raise ImageError(f"depth format '{msg.format}' is not 'ENCODING; compressedDepth png': "
                         'record the compressedDepth topic, as PNG')
    is_inverse = _depth_type(encoding) == np.float32
    data = bytes(msg.data)
    png = data[_DEPTH_HEADER.size:]
    check_size(*declared_size(png, msg.format))
    values = _unpacked(png, cv2.IMREAD_UNCHANGED, f"depth image ('{msg.format}')")
    if values is None or values.dtype != np.uint16 or values.ndim != 2:
        raise ImageError(f"depth image ('{msg.format}', {len(data)} bytes) is not a 16-bit PNG "
                         'with one channel')
    if not is_inverse:
        return values
    _, a, b = _DEPTH_HEADER.unpack_from(data)
    with np.errstate(divide='ignore', invalid='ignore', over='ignore'):
        depths = np.float32(a) / (values.astype(np.float32) - np.float32(b))
    depths[values == 0] = np.nan
    return depths


def check_size(width: int, height: int) -> None:
    """Raise ImageError for an image that is empty or implausibly large."""
    if not (width > 0 and height > 0 and width * height <= _MAX_PIXELS):
        raise ImageError(f'image size {width}x{height} must have 1 to {_MAX_PIXELS} pixels')


def camera_from_msg(msg: CameraInfoMessage, image_size: tuple[int, int], rectified: bool
                    ) -> Camera:
    """Return the camera that took an image.

    K and P describe the whole sensor (REP 104), the returned camera describes the image. Region of
    interest and binning shift and scale the pixels, as in image_geometry, but not the distortion.
    ``roi.do_rectify`` is ignored, as in image_geometry: the region is the same in a rectified
    image.

    Parameters
    ----------
    image_size : tuple of int
        Width and height of the image [px].
    rectified : bool
        The image is rectified: use P and no distortion.

    Raises
    ------
    CameraError
        The values are invalid, or they are for another image size.
    """
    _check_image_size(msg, image_size)
    name, matrix = ('P', _left_of_p(msg)) if rectified else ('K', np.reshape(msg.k, (3, 3)))
    distortion = () if rectified else tuple(map(float, msg.d))
    columns, rows = _binning(msg)
    (fx, _, cx), (_, fy, cy), _ = matrix.tolist()
    try:
        return Camera(*image_size, fx / columns, fy / rows, (cx - msg.roi.x_offset) / columns,
                      (cy - msg.roi.y_offset) / rows,
                      '' if rectified else msg.distortion_model, distortion)
    except CameraError as error:
        raise CameraError(f'camera_info: {name}: {error}') from error


def camera_from_frame(msg: CameraInfoMessage) -> NDArray[np.float64]:
    """Return the pose (4, 4) of the message's coordinate frame in the camera's optical centre.

    P of the second camera of a stereo pair projects points of the first camera's frame, and the
    messages of both cameras name this frame (REP 104, image_geometry). Some drivers name a frame
    of the second camera instead; by such a name, the camera is in its frame.
    """
    pose, p = np.eye(4), np.reshape(msg.p, (3, 4))
    if np.isfinite(p).all() and p[0, 0] > 0.0 and p[1, 1] > 0.0 \
            and not _SECOND.search(msg.header.frame_id):
        pose[:2, 3] = p[0, 3] / p[0, 0], p[1, 3] / p[1, 1]
    return pose


def faults_of_camera_info(msg: CameraInfoMessage, camera: Camera, rectified: bool) -> list[Fault]:
    """Return contradictory or implausible fields of a message, certain faults first.

    `camera` is the result of camera_from_msg for this message.
    """
    (columns, rows), roi = _binning(msg), msg.roi
    # check the whole sensor: the principal point of a region of interest may be anywhere
    sensor = replace(
        camera, width=msg.width or roi.x_offset + (roi.width or columns * camera.width),
        height=msg.height or roi.y_offset + (roi.height or rows * camera.height),
        fx=columns * camera.fx, fy=rows * camera.fy, cx=columns * camera.cx + roi.x_offset,
        cy=rows * camera.cy + roi.y_offset)
    k, r, p = (np.reshape(matrix, (3, -1)) for matrix in (msg.k, msg.r, msg.p))
    beside_m, frame = float(np.linalg.norm(p[:2, 3])) / max(p[0, 0], 1e-6), msg.header.frame_id
    beside = [Fault(
        f'P is that of the second camera of a stereo pair, {beside_m:.2g} m beside the first: '
        f"'{frame}' is taken for the frame of the {'second' if _SECOND.search(frame) else 'first'}"
        '; if it is the other, set P[3] and P[7] to 0, or correct frame_id',
        beside_m > _MOST_BASELINE_M)] if beside_m > _BASELINE_M else []
    return [fault._replace(text=f'camera_info: {fault.text}')
            for fault in [*calibration_faults(sensor, k, r, p, rectified), *beside]]


def faults_of_headers(image: str, camera_info: str, detections: str = '') -> list[Fault]:
    """Return faults of messages whose coordinate frame differs from that of their image.

    An empty name is unknown and never a fault. Boxes in another frame are certainly wrong. For
    camera_info it is only a suspicion, because some simulators and drivers name its frame
    differently.
    """
    return [Fault(f"the coordinate frame of {what} is '{other}', that of the image is '{image}': "
                  "publish it with the image's header, or remap it if it is of another camera",
                  is_certain)
            for what, other, is_certain in (('detections', detections, True),
                                            ('camera_info', camera_info, False))
            if other and image and other.strip('/') != image.strip('/')]


def faults_of_rectified(image_topic: str, rectified: bool, msg: CameraInfoMessage) -> list[Fault]:
    """Return a fault if the topic's name contradicts the parameter `rectified`; else nothing.

    There is no fault if raw and rectified images are the same by the camera_info `msg`. If they
    differ, the topic names of image_proc (image_rect, image_rect_color) make the fault certain.
    """
    name = image_topic.removesuffix('/compressed')
    # a whole word: /rectangle/image is not rectified
    rect = re.search('(/image)?[/_]rect(if(y|ied))?(?![a-z])(?!.*raw)', name)
    sounds = 'raw' if name.endswith('/image_raw') else 'rectified' if rect else ''
    is_same = msg.distortion_model != 'equidistant' and not any(msg.d) and \
        np.array_equal(_left_of_p(msg), np.reshape(msg.k, (3, 3)))
    if is_same or sounds != ('raw' if rectified else 'rectified'):
        return []
    return [Fault(f'by its name, {image_topic} is {sounds}, but the parameter rectified is '
                  f'{str(rectified).lower()}: poses would be wrong by the distortion of the lens',
                  bool(rect and rect[1]))]


def _left_of_p(msg: CameraInfoMessage) -> NDArray[np.float64]:
    return np.reshape(msg.p, (3, 4))[:, :3]


def _binning(msg: CameraInfoMessage) -> tuple[int, int]:
    """Return the columns and rows of the sensor that form one pixel; 0 in the message means 1."""
    return max(msg.binning_x, 1), max(msg.binning_y, 1)


def _check_image_size(msg: CameraInfoMessage, image_size: tuple[int, int]) -> None:
    """Raise CameraError unless the image has the size that camera_info states.

    In the message, width or height 0 means any size, and a region of size 0 the whole sensor.
    """
    roi, (columns, rows) = msg.roi, _binning(msg)
    for pixels, whole, offset, given, binning in (
            (image_size[0], msg.width, roi.x_offset, roi.width, columns),
            (image_size[1], msg.height, roi.y_offset, roi.height, rows)):
        region = given or whole - offset
        # The image may or may not include a last bin that is incomplete.
        if (whole and offset + region > whole) or (
                (whole or given) and abs(pixels * binning - region) >= binning):
            break
    else:
        return
    sensor = f'{msg.width}x{msg.height} px'
    if max(columns, rows, roi.x_offset + 1, roi.y_offset + 1) > 1 or roi.width or roi.height:
        sensor += (f', binning {columns}x{rows} and roi {roi.width}x{roi.height} at '
                   f'({roi.x_offset}, {roi.y_offset})')
    raise CameraError(f'camera_info is for {sensor}, but the image has {image_size[0]}x'
                      f'{image_size[1]}: scale the intrinsics with the image')


def detections_from_msg(msg: Any, class_map: Mapping[str, str] | None = None) -> Detections:
    """Return the detections of a vision_msgs/Detection2DArray, each with its most confident class.

    A detection without a class gets the empty name, which no landmark has.

    Parameters
    ----------
    class_map : mapping, optional
        The map's names of some of the detector's classes, see parse_class_map.
    """
    names, classes, scores, boxes = class_map or {}, [], [], []
    for detection in msg.detections:
        hypotheses = [(result.hypothesis.score, result.hypothesis.class_id)
                      for result in detection.results]
        # of equal scores, the first; NaN counts as lowest
        score, name = max(hypotheses, default=(0.0, ''), key=lambda pair: (
            -math.inf if math.isnan(pair[0]) else pair[0]))
        classes.append(names.get(name, name))
        scores.append(score)
        box, center = detection.bbox, detection.bbox.center
        boxes.append((center.position.x, center.position.y, center.theta, box.size_x, box.size_y))
    x, y, theta, size_x, size_y = np.array(boxes, dtype=np.float64).reshape(-1, 5).T
    # A rotated box is replaced by the upright box around it. With theta 0 the sizes stay exactly
    # equal. An infinite angle gives a box of NaN, which is dropped later.
    with np.errstate(invalid='ignore'):
        cosine, sine = np.abs(np.cos(theta)), np.abs(np.sin(theta))
    width, height = size_x * cosine + size_y * sine, size_x * sine + size_y * cosine
    return Detections(
        np.stack([x - width / 2, y - height / 2, x + width / 2, y + height / 2], axis=1),
        tuple(classes), np.array(scores, dtype=np.float64))


def tags_from_msg(msg: Any) -> SeenTags:
    """Return the tags of an apriltag_msgs/AprilTagDetectionArray.

    AprilTag starts at the lower left corner and goes the other way round; the centre of its first
    pixel is at (.5, .5). A tag that is seen twice is left out: one is a copy.
    """
    names = [f'{tag.family}_{tag.id}' for tag in msg.detections]
    corners = np.array([[(corner.x, corner.y) for corner in tag.corners]
                        for tag in msg.detections]).reshape(-1, 4, 2)[:, ::-1] - 0.5
    kept = [row for row, name in enumerate(names)
            if names.count(name) == 1 and np.isfinite(corners[row]).all()]
    return SeenTags(tuple(names[row] for row in kept), corners[kept])


def parse_class_map(text: str) -> dict[str, str]:
    """Parse the parameter class_map: the map's name for each class that the detector renames.

    OptionsError: a pair does not have the form theirs=ours, or a name occurs twice.
    """
    found: dict[str, str] = {}
    for pair in filter(None, map(str.strip, text.split(','))):
        theirs, sign, ours = (part.strip() for part in pair.partition('='))
        if not (theirs and sign and ours):
            raise OptionsError(f"class_map: '{pair}' is not of the form theirs=ours")
        if theirs in found:
            raise OptionsError(f"class_map: '{theirs}' occurs twice")
        found[theirs] = ours
    return found


def depths_from_msg(msg: Any, image_frame: str, camera: Camera, bboxes_xyxy: NDArray[np.float64],
                    camera_info: Any = None,
                    color_from_depth: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    """Return the depths (n,) of boxes (n, 4) from a depth image, NaN without depth [m].

    Parameters
    ----------
    msg : sensor_msgs/Image or CompressedImage
        The depth image.
    image_frame : str
        The coordinate frame of the colour image. A depth image in another coordinate frame is not
        registered.
    camera : Camera
        Camera of the colour image.
    camera_info : sensor_msgs/CameraInfo, optional
        camera_info of a depth camera that is not registered.
    color_from_depth : ndarray (4, 4), optional
        Pose of that depth camera in the colour camera's frame.

    Raises
    ------
    CliplocError
        The message is invalid, or does not belong to the image.
    """
    depths_m = depth.depth_from_counts(depth_counts_from_msg(msg), None, 'depth')
    height, width = depths_m.shape
    own = None
    if msg.header.frame_id != image_frame:
        if camera_info is None or color_from_depth is None:
            raise ImageError(
                f"depth is in the coordinate frame '{msg.header.frame_id}', the image in "
                f"'{image_frame}', and {'tf' if camera_info else 'depth_camera_info'} is missing: "
                'publish it, or depth registered to the image')
        seen_by = camera_from_msg(camera_info, (width, height), False)
        check_faults(faults_of_camera_info(camera_info, seen_by, False))
        if not seen_by.is_pinhole:
            raise ImageError('depth is not rectified according to its camera_info: publish '
                             'rectified depth')
        own = depth.DepthCamera(seen_by.fx, seen_by.fy, seen_by.cx, seen_by.cy, color_from_depth)
    elif abs(width * camera.height / (height * camera.width) - 1.0) > _SAME_ASPECT:
        raise ImageError(f'depth has {width}x{height} px, the image {camera.width}x'
                         f'{camera.height}: publish depth registered to the image')
    image = depth.DepthImage(depths_m, own)
    depths = depth.depths_of_boxes(image, camera, bboxes_xyxy)[0].astype(np.float64)
    known, (least, greatest) = depths[np.isfinite(depths)], depth.PLAUSIBLE_DEPTH_M
    if len(known) and not least < np.median(known) < greatest:
        raise ImageError(f'the median depth of the boxes is {np.median(known):.3g} m: publish '
                         '16UC1 in millimetres, 32FC1 in metres')
    return depths
