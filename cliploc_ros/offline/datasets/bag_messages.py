# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Make and read messages of recordings, without a ROS installation.

The message objects are from the rosbags library; their fields have the same names as in rclpy.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import quaternion_from_transform
from cliploc_ros.core.observation import Detections
from cliploc_ros.offline.datasets.bags import typestore
from cliploc_ros.units import NS_PER_S

IMAGE = 'sensor_msgs/msg/Image'
COMPRESSED_IMAGE = 'sensor_msgs/msg/CompressedImage'
CAMERA_INFO = 'sensor_msgs/msg/CameraInfo'
DETECTIONS = 'vision_msgs/msg/Detection2DArray'
POSE = 'geometry_msgs/msg/PoseStamped'
IMU = 'sensor_msgs/msg/Imu'
ODOMETRY = 'nav_msgs/msg/Odometry'


def stamp_ns(message: Any) -> int:
    """Return a message's header stamp [ns]."""
    stamp = message.header.stamp
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


def image_message(stamp: int, frame_id: str, pixels_rgb: NDArray[np.uint8]) -> Any:
    """Make a sensor_msgs/Image of pixels (height, width, 3), RGB; the stamp is in ns."""
    height, width, channels = pixels_rgb.shape
    return _make(IMAGE, header=_header(stamp, frame_id), height=height, width=width,
                 encoding='rgb8', is_bigendian=0, step=width * channels,
                 data=np.ascontiguousarray(pixels_rgb).reshape(-1))


def compressed_image_message(stamp: int, frame_id: str, data: bytes, codec: str) -> Any:
    """Make a sensor_msgs/CompressedImage of the bytes of a file; the codec: png or jpeg."""
    # The format as image_transport writes it: the image was rgb8, and decodes to bgr8.
    return _make(COMPRESSED_IMAGE, header=_header(stamp, frame_id),
                 format=f'rgb8; {codec} compressed bgr8', data=np.frombuffer(data, dtype=np.uint8))


def camera_info_message(stamp: int, frame_id: str, camera: Camera) -> Any:
    """Make a sensor_msgs/CameraInfo of an unrectified monocular camera."""
    roi = _make('sensor_msgs/msg/RegionOfInterest', x_offset=0, y_offset=0, height=0, width=0,
                do_rectify=False)
    return _make(CAMERA_INFO, header=_header(stamp, frame_id), height=camera.height,
                 width=camera.width, distortion_model=camera.distortion_model or 'plumb_bob',
                 d=np.array(camera.distortion, dtype=np.float64), k=camera.matrix.reshape(-1),
                 r=np.eye(3).reshape(-1),
                 p=np.hstack([camera.matrix, np.zeros((3, 1))]).reshape(-1),
                 binning_x=0, binning_y=0, roi=roi)


def detections_message(stamp: int, frame_id: str, detections: Detections) -> Any:
    """Make a vision_msgs/Detection2DArray; all its headers equal the header of the image."""
    header = _header(stamp, frame_id)
    no_pose = _make('geometry_msgs/msg/PoseWithCovariance', pose=_pose(np.eye(4)),
                    covariance=np.zeros(36))
    made = []
    for box, class_id, score in zip(detections.bboxes_xyxy.tolist(), detections.class_ids,
                                    detections.scores.tolist(), strict=True):
        left, top, right, bottom = box
        centre = _make('vision_msgs/msg/Point2D', x=(left + right) / 2, y=(top + bottom) / 2)
        hypothesis = _make('vision_msgs/msg/ObjectHypothesis', class_id=class_id, score=score)
        made.append(_make(
            'vision_msgs/msg/Detection2D', header=header, id='',
            results=[_make('vision_msgs/msg/ObjectHypothesisWithPose', hypothesis=hypothesis,
                           pose=no_pose)],
            bbox=_make('vision_msgs/msg/BoundingBox2D', size_x=right - left, size_y=bottom - top,
                       center=_make('vision_msgs/msg/Pose2D', position=centre, theta=0.0))))
    return _make(DETECTIONS, header=header, detections=made)


def pose_message(stamp: int, frame_id: str, map_from_camera: NDArray[np.float64]) -> Any:
    """Make a geometry_msgs/PoseStamped of a camera pose (4, 4); frame_id names the map's frame."""
    return _make(POSE, header=_header(stamp, frame_id), pose=_pose(map_from_camera))


def imu_message(stamp: int, frame_id: str, acceleration: NDArray[np.float64]) -> Any:
    """Make a sensor_msgs/Imu that holds only an acceleration (3,) [m/s^2]."""
    missing = np.zeros(9)
    missing[0] = -1.0  # marks a field that is not measured
    vector = 'geometry_msgs/msg/Vector3'
    x, y, z = acceleration.tolist()
    return _make(IMU, header=_header(stamp, frame_id), orientation=_make(
        'geometry_msgs/msg/Quaternion', x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=missing, angular_velocity=_make(vector, x=0.0, y=0.0, z=0.0),
        angular_velocity_covariance=missing, linear_acceleration=_make(vector, x=x, y=y, z=z),
        linear_acceleration_covariance=np.zeros(9))


def _make(msgtype: str, **fields: Any) -> Any:
    return typestore().types[msgtype](**fields)


def _header(stamp: int, frame_id: str) -> Any:
    time = _make('builtin_interfaces/msg/Time', sec=stamp // NS_PER_S, nanosec=stamp % NS_PER_S)
    return _make('std_msgs/msg/Header', stamp=time, frame_id=frame_id)


def _pose(transform: NDArray[np.float64]) -> Any:
    position = dict(zip('xyz', transform[:3, 3].tolist(), strict=True))
    orientation = dict(zip('xyzw', quaternion_from_transform(transform).tolist(), strict=True))
    return _make('geometry_msgs/msg/Pose',
                 position=_make('geometry_msgs/msg/Point', **position),
                 orientation=_make('geometry_msgs/msg/Quaternion', **orientation))
