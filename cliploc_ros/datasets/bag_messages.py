# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Convert messages of a recording to and from the package's types, without a sourced ROS.

The message objects are those of the rosbags library; their fields have rclpy's names.
"""

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import quaternion_from_transform, transform_from_pose
from cliploc_ros.core.observation import Detections
from cliploc_ros.datasets.bag_types import typestore
from cliploc_ros.units import NS_PER_S

IMAGE = 'sensor_msgs/msg/Image'
COMPRESSED_IMAGE = 'sensor_msgs/msg/CompressedImage'
CAMERA_INFO = 'sensor_msgs/msg/CameraInfo'
DETECTIONS = 'vision_msgs/msg/Detection2DArray'
POSE = 'geometry_msgs/msg/PoseStamped'


class Stamped(Protocol):
    """A message with a std_msgs/Header."""

    header: Any


def stamp_ns(message: Stamped) -> int:
    """Return a message's header stamp [ns]."""
    stamp = message.header.stamp
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


def image_message(stamp: int, frame_id: str, pixels_rgb: NDArray[np.uint8]) -> Any:
    """Make a sensor_msgs/Image.

    Parameters
    ----------
    stamp : int
        Header stamp [ns].
    frame_id : str
        The camera's coordinate frame.
    pixels_rgb : ndarray (height, width, 3) of uint8
        The image, red first.
    """
    height, width, channels = pixels_rgb.shape
    return _type(IMAGE)(
        header=_header(stamp, frame_id),
        height=height,
        width=width,
        encoding='rgb8',
        is_bigendian=0,
        step=width * channels,
        data=np.ascontiguousarray(pixels_rgb).reshape(-1),
    )


def compressed_image_message(stamp: int, frame_id: str, data: bytes, codec: str) -> Any:
    """Make a sensor_msgs/CompressedImage from a file's own bytes.

    Parameters
    ----------
    stamp : int
        Header stamp [ns].
    frame_id : str
        The camera's coordinate frame.
    data : bytes
        The encoded image.
    codec : str
        ``png`` or ``jpeg``.
    """
    return _type(COMPRESSED_IMAGE)(
        header=_header(stamp, frame_id),
        # As image_transport writes it: the image was rgb8, its decoder yields bgr8.
        format=f'rgb8; {codec} compressed bgr8',
        data=np.frombuffer(data, dtype=np.uint8),
    )


def camera_info_message(stamp: int, frame_id: str, camera: Camera) -> Any:
    """Make a sensor_msgs/CameraInfo of an unrectified monocular camera."""
    projection = np.hstack([camera.matrix, np.zeros((3, 1))])
    return _type(CAMERA_INFO)(
        header=_header(stamp, frame_id),
        height=camera.height,
        width=camera.width,
        distortion_model=camera.distortion_model or 'plumb_bob',
        d=np.array(camera.distortion, dtype=np.float64),
        k=camera.matrix.reshape(-1),
        r=np.eye(3).reshape(-1),
        p=projection.reshape(-1),
        binning_x=0,
        binning_y=0,
        roi=_type('sensor_msgs/msg/RegionOfInterest')(
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        ),
    )


def detections_message(stamp: int, frame_id: str, detections: Detections) -> Any:
    """Make a vision_msgs/Detection2DArray; all headers equal the image's."""
    header = _header(stamp, frame_id)
    return _type(DETECTIONS)(
        header=header,
        detections=[
            _detection(header, box_xyxy, class_id, float(score))
            for box_xyxy, class_id, score in zip(
                detections.bboxes_xyxy, detections.class_ids, detections.scores, strict=True
            )
        ],
    )


def pose_message(stamp: int, frame_id: str, map_from_camera: NDArray[np.float64]) -> Any:
    """Make a geometry_msgs/PoseStamped of the camera (4, 4) in the map's coordinate frame."""
    return _type(POSE)(
        header=_header(stamp, frame_id),
        pose=_pose(map_from_camera[:3, 3], quaternion_from_transform(map_from_camera)),
    )


def detections_of(message: Any) -> Detections:
    """Read a vision_msgs/Detection2DArray; the best hypothesis of each detection counts.

    Parameters
    ----------
    message : vision_msgs/Detection2DArray
        As rosbags or rclpy deserializes it.

    Returns
    -------
    Detections
        A detection without hypotheses has class '' and score 0.
    """
    boxes, class_ids, scores = [], [], []
    for detection in message.detections:
        centre, box = detection.bbox.center.position, detection.bbox
        half_x, half_y = box.size_x / 2, box.size_y / 2
        boxes.append([centre.x - half_x, centre.y - half_y, centre.x + half_x, centre.y + half_y])
        guesses = [(result.hypothesis.score, result.hypothesis.class_id)
                   for result in detection.results]
        score, class_id = max(guesses, default=(0.0, ''))
        class_ids.append(class_id)
        scores.append(score)
    return Detections(
        bboxes_xyxy=np.array(boxes, dtype=np.float64).reshape(-1, 4),
        class_ids=tuple(class_ids),
        scores=np.array(scores, dtype=np.float64),
    )


def map_from_camera_of(message: Any) -> NDArray[np.float64]:
    """Read the pose (4, 4) of a geometry_msgs/PoseStamped."""
    position, orientation = message.pose.position, message.pose.orientation
    return transform_from_pose(
        np.array([position.x, position.y, position.z]),
        np.array([orientation.x, orientation.y, orientation.z, orientation.w]),
    )


def _type(name: str) -> Any:
    return typestore().types[name]


def _header(stamp: int, frame_id: str) -> Any:
    time = _type('builtin_interfaces/msg/Time')(sec=stamp // NS_PER_S, nanosec=stamp % NS_PER_S)
    return _type('std_msgs/msg/Header')(stamp=time, frame_id=frame_id)


def _pose(position_xyz: NDArray[np.float64], quat_xyzw: NDArray[np.float64]) -> Any:
    x, y, z, w = (float(value) for value in quat_xyzw)
    return _type('geometry_msgs/msg/Pose')(
        position=_type('geometry_msgs/msg/Point')(*(float(value) for value in position_xyz)),
        orientation=_type('geometry_msgs/msg/Quaternion')(x=x, y=y, z=z, w=w),
    )


def _detection(
    header: Any, box_xyxy: NDArray[np.float64], class_id: str, score: float
) -> Any:
    left, top, right, bottom = (float(value) for value in box_xyxy)
    centre = _type('vision_msgs/msg/Point2D')(x=(left + right) / 2, y=(top + bottom) / 2)
    no_pose = _type('geometry_msgs/msg/PoseWithCovariance')(
        pose=_pose(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])), covariance=np.zeros(36)
    )
    hypothesis = _type('vision_msgs/msg/ObjectHypothesis')(class_id=class_id, score=score)
    return _type('vision_msgs/msg/Detection2D')(
        header=header,
        results=[
            _type('vision_msgs/msg/ObjectHypothesisWithPose')(hypothesis=hypothesis, pose=no_pose)
        ],
        bbox=_type('vision_msgs/msg/BoundingBox2D')(
            center=_type('vision_msgs/msg/Pose2D')(position=centre, theta=0.0),
            size_x=right - left,
            size_y=bottom - top,
        ),
        id='',
    )
