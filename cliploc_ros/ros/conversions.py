# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Messages to values and back. Nothing here trusts a message."""

import math

import cv2
import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Pose, PoseArray, PoseWithCovarianceStamped
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header
from vision_msgs.msg import (
    BoundingBox2D,
    Detection2D,
    Detection2DArray,
    ObjectHypothesis,
    ObjectHypothesisWithPose,
)

from cliploc_ros.core.camera import Camera
from cliploc_ros.core.observation import Detections
from cliploc_ros.core.transforms import quaternion_from_transform
from cliploc_ros.errors import CameraError, ImageError

# Where red, green and blue stand in each pixel, and how many bytes it has.
_CHANNELS = {'rgb8': ((0, 1, 2), 3), 'bgr8': ((2, 1, 0), 3), '8UC3': ((2, 1, 0), 3),
             'rgba8': ((0, 1, 2), 4), 'bgra8': ((2, 1, 0), 4), '8UC4': ((2, 1, 0), 4),
             'mono8': ((0, 0, 0), 1), '8UC1': ((0, 0, 0), 1)}
# A small file may claim any size: what is decoded is bounded to 200 MB.
_MAX_PIXELS = 2**26
_PNG, _JPEG = b'\x89PNG\r\n\x1a\n', b'\xff\xd8'
# the markers of JPEG that begin a frame, with its size in it
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}


def stamp_ns(stamp: Time) -> int:
    """Return a message's time stamp in nanoseconds."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def image_from_msg(msg: Image | CompressedImage) -> NDArray[np.uint8]:
    """Return an image (h, w, 3) uint8, red first.

    Raises
    ------
    ImageError
        Names what in the message cannot be.
    """
    return _decoded(msg) if isinstance(msg, CompressedImage) else _unpacked(msg)


def _unpacked(msg: Image) -> NDArray[np.uint8]:
    if msg.encoding not in _CHANNELS:
        raise ImageError(f"image encoding '{msg.encoding}' is none of {', '.join(_CHANNELS)}")
    order, channels = _CHANNELS[msg.encoding]
    _check_size(msg.width, msg.height)
    if msg.step < msg.width * channels:
        raise ImageError(f'image step {msg.step} is shorter than a row of {msg.width} '
                         f'{msg.encoding} pixels')
    if len(msg.data) < msg.step * msg.height:
        raise ImageError(f'image data has {len(msg.data)} bytes, but {msg.height} rows of '
                         f'{msg.step} bytes are {msg.step * msg.height}')
    rows = np.frombuffer(msg.data, dtype=np.uint8, count=msg.step * msg.height)
    pixels = rows.reshape(msg.height, msg.step)[:, :msg.width * channels]
    pixels = pixels.reshape(msg.height, msg.width, channels)
    return np.ascontiguousarray(pixels[:, :, order])


def _decoded(msg: CompressedImage) -> NDArray[np.uint8]:
    _check_size(*_declared_size(bytes(msg.data), msg.format))
    data = np.frombuffer(msg.data, dtype=np.uint8)
    try:
        # EXIF may ask to turn the picture, but the intrinsics are those of the sensor.
        image = cv2.imdecode(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as error:
        raise ImageError(f"compressed image ('{msg.format}') does not decode: {error.err}"
                         ) from error
    if image is None:
        raise ImageError(f"compressed image ('{msg.format}', {len(data)} bytes) does not decode")
    return np.ascontiguousarray(image[:, :, ::-1])


def _declared_size(data: bytes, stated_format: str) -> tuple[int, int]:
    """Return width and height that a JPEG or PNG says it has, before it is decoded."""
    if data.startswith(_PNG) and len(data) >= 24:
        return int.from_bytes(data[16:20]), int.from_bytes(data[20:24])
    at = 2 if data.startswith(_JPEG) else len(data)
    while at + 9 <= len(data) and data[at] == 0xFF:
        if data[at + 1] in _JPEG_FRAMES:
            return int.from_bytes(data[at + 7:at + 9]), int.from_bytes(data[at + 5:at + 7])
        at += 2 + int.from_bytes(data[at + 2:at + 4])
    raise ImageError(f"compressed image ('{stated_format}', {len(data)} bytes) does not decode: "
                     'it is no JPEG or PNG, or is cut off')


def _check_size(width: int, height: int) -> None:
    if not (width > 0 and height > 0 and width * height <= _MAX_PIXELS):
        raise ImageError(f'image size {width}x{height} must have 1 to {_MAX_PIXELS} pixels')


def camera_from_msg(msg: CameraInfo, image_size: tuple[int, int], rectified: bool) -> Camera:
    """Return the camera that took an image.

    Parameters
    ----------
    msg : CameraInfo
    image_size : tuple of int
        Width and height of the image [px].
    rectified : bool
        The image is rectified: P holds, and there is no distortion.

    Raises
    ------
    CameraError
        For values that no camera can have, and for the intrinsics of another image size.
    """
    width, height = image_size
    if (msg.width or width, msg.height or height) != image_size:
        raise CameraError(f'camera_info is for {msg.width}x{msg.height} px, but the image has '
                          f'{width}x{height}: scale the intrinsics with the image')
    name, matrix = ('P', msg.p) if rectified else ('K', msg.k)
    fx, fy, cx, cy = (matrix[0], matrix[5], matrix[2], matrix[6]) if rectified else (
        matrix[0], matrix[4], matrix[2], matrix[5])
    distortion = () if rectified else tuple(map(float, msg.d))
    try:
        return Camera(width, height, float(fx), float(fy), float(cx), float(cy),
                      msg.distortion_model, distortion)
    except CameraError as error:
        raise CameraError(f'camera_info: {name}: {error}') from error


def detections_from_msg(msg: Detection2DArray) -> Detections:
    """Return the detections of a message, each with its most confident class.

    A detection without any class keeps the empty name, which no landmark has.
    """
    best = [max((result.hypothesis for result in detection.results),
                key=_confidence, default=ObjectHypothesis())
            for detection in msg.detections]
    boxes = [(box.center.position.x, box.center.position.y, box.center.theta, box.size_x,
              box.size_y) for box in (detection.bbox for detection in msg.detections)]
    x, y, theta, size_x, size_y = np.array(boxes, dtype=np.float64).reshape(-1, 5).T
    # a turned box stands as the upright one around it; with theta 0 the sizes stay to the bit
    cosine, sine = np.abs(np.cos(theta)), np.abs(np.sin(theta))
    width, height = size_x * cosine + size_y * sine, size_x * sine + size_y * cosine
    return Detections(
        np.stack([x - width / 2, y - height / 2, x + width / 2, y + height / 2], axis=1),
        tuple(hypothesis.class_id for hypothesis in best),
        np.array([hypothesis.score for hypothesis in best], dtype=np.float64))


def _confidence(hypothesis: ObjectHypothesis) -> float:
    """Return a score to sort by; NaN comes last."""
    return hypothesis.score if not math.isnan(hypothesis.score) else -math.inf


def detections_to_msg(detections: Detections, header: Header) -> Detection2DArray:
    """Return a message with the header of the image that the detections are of."""
    msg = Detection2DArray(header=header)
    for box, class_id, score in zip(detections.bboxes_xyxy, detections.class_ids,
                                    detections.scores, strict=True):
        left, top, right, bottom = map(float, box)
        bbox = BoundingBox2D(size_x=right - left, size_y=bottom - top)
        bbox.center.position.x, bbox.center.position.y = (left + right) / 2, (top + bottom) / 2
        hypothesis = ObjectHypothesis(class_id=class_id, score=float(score))
        msg.detections.append(Detection2D(
            header=header, bbox=bbox,
            results=[ObjectHypothesisWithPose(hypothesis=hypothesis)]))
    return msg


def pose_to_msg(map_from_frame: NDArray[np.float64]) -> Pose:
    """Return a pose (4, 4) as a message."""
    pose = Pose()
    pose.position.x, pose.position.y, pose.position.z = map(float, map_from_frame[:3, 3])
    (pose.orientation.x, pose.orientation.y, pose.orientation.z,
     pose.orientation.w) = map(float, quaternion_from_transform(map_from_frame))
    return pose


def pose_with_covariance_msg(header: Header, map_from_frame: NDArray[np.float64],
                             covariance: NDArray[np.float64]) -> PoseWithCovarianceStamped:
    """Return a pose (4, 4) and its covariance (6, 6) in ROS order as a message."""
    msg = PoseWithCovarianceStamped(header=header)
    msg.pose.pose = pose_to_msg(map_from_frame)
    msg.pose.covariance = covariance.ravel()
    return msg


def pose_array_msg(header: Header, poses: list[NDArray[np.float64]]) -> PoseArray:
    """Return poses (4, 4) as a message, in their order."""
    return PoseArray(header=header, poses=[pose_to_msg(pose) for pose in poses])
