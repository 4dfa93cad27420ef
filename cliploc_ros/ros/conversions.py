# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Conversion between messages and values. All fields of messages are validated."""

import importlib
from collections.abc import Callable
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Pose, PoseWithCovarianceStamped, Transform, TransformStamped
from numpy.typing import NDArray
from std_msgs.msg import Header
from vision_msgs import msg as vision

from cliploc_ros.core.geometry.transforms import quaternion_from_transform, transform_from_pose
from cliploc_ros.core.observation import Detections
from cliploc_ros.errors import OptionsError
from cliploc_ros.units import NS_PER_S

_UNIT_TOLERANCE = 0.01
DETECTION_TYPES = ('vision_msgs', 'yolo_msgs')


def stamp_ns(stamp: Time) -> int:
    """Return a message's time stamp in nanoseconds."""
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


def of_camera(camera: str, topic: str) -> str:
    """Return the topic of a camera; a single camera has no name and its topic no prefix."""
    return f'{camera}/{topic}' if camera else topic


def detections_to_msg(detections: Detections, header: Header) -> vision.Detection2DArray:
    """Return detections as a message with the header of their image."""
    msg = vision.Detection2DArray(header=header)
    for box, class_id, score in zip(detections.bboxes_xyxy, detections.class_ids,
                                    detections.scores, strict=True):
        left, top, right, bottom = map(float, box)
        bbox = vision.BoundingBox2D(size_x=right - left, size_y=bottom - top)
        bbox.center.position.x, bbox.center.position.y = (left + right) / 2, (top + bottom) / 2
        hypothesis = vision.ObjectHypothesis(class_id=class_id, score=float(score))
        msg.detections.append(vision.Detection2D(header=header, bbox=bbox, results=[
            vision.ObjectHypothesisWithPose(hypothesis=hypothesis)]))
    return msg


def pose_from_msg(msg: Pose) -> NDArray[np.float64] | None:
    """Return a pose (4, 4); None if it has NaN or its quaternion is not of unit length."""
    p, q = msg.position, msg.orientation
    position, quat_xyzw = np.array([p.x, p.y, p.z]), np.array([q.x, q.y, q.z, q.w])
    if not np.isfinite(position).all() or not abs(
            np.linalg.norm(quat_xyzw) - 1.0) < _UNIT_TOLERANCE:
        return None
    return transform_from_pose(position, quat_xyzw)


def matrix_from_msg(msg: Transform) -> NDArray[np.float64]:
    """Return a transform of tf2 as (4, 4)."""
    t, q = msg.translation, msg.rotation
    return transform_from_pose(np.array([t.x, t.y, t.z]), np.array([q.x, q.y, q.z, q.w]))


def pose_to_msg(parent_from_child: NDArray[np.float64]) -> Pose:
    """Return a pose (4, 4) as a message."""
    pose = Pose()
    pose.position.x, pose.position.y, pose.position.z = map(float, parent_from_child[:3, 3])
    (pose.orientation.x, pose.orientation.y, pose.orientation.z,
     pose.orientation.w) = map(float, quaternion_from_transform(parent_from_child))
    return pose


def transform_msg(header: Header, child_frame: str, parent_from_child: NDArray[np.float64]
                  ) -> TransformStamped:
    """Return a transform (4, 4), child to parent, as a message; the header names the parent."""
    pose = pose_to_msg(parent_from_child)
    msg = TransformStamped(header=Header(stamp=header.stamp, frame_id=header.frame_id),
                           child_frame_id=child_frame)
    p, t = pose.position, msg.transform.translation
    t.x, t.y, t.z, msg.transform.rotation = p.x, p.y, p.z, pose.orientation
    return msg


def pose_with_covariance_msg(header: Header, parent_from_child: NDArray[np.float64],
                             covariance: NDArray[np.float64]) -> PoseWithCovarianceStamped:
    """Return a pose (4, 4) and its covariance (6, 6) in ROS order as a message."""
    msg = PoseWithCovarianceStamped(header=header)
    msg.pose.pose = pose_to_msg(parent_from_child)
    msg.pose.covariance = covariance.ravel()
    return msg


def detection_type(package: str) -> tuple[type, Callable[[Any], vision.Detection2DArray]]:
    """Return the detection message of a package, and its conversion to Detection2DArray.

    The package is `vision_msgs` or `yolo_msgs`. OptionsError: it is not installed.
    """
    if package == 'vision_msgs':
        return vision.Detection2DArray, lambda msg: msg
    try:
        return importlib.import_module('yolo_msgs.msg').DetectionArray, from_yolo_msg
    except ImportError as error:
        raise OptionsError('detections_type: yolo_msgs is not installed: build yolo_ros in this '
                           'workspace and source it, or set vision_msgs') from error


def from_yolo_msg(msg: Any) -> vision.Detection2DArray:
    """Convert a yolo_msgs/DetectionArray: boxes, class names and scores."""
    common = vision.Detection2DArray(header=msg.header)
    for detection in msg.detections:
        size, center = detection.bbox.size, detection.bbox.center
        box = vision.BoundingBox2D(size_x=size.x, size_y=size.y)
        box.center.position.x, box.center.position.y = center.position.x, center.position.y
        box.center.theta = center.theta
        hypothesis = vision.ObjectHypothesis(
            class_id=detection.class_name or str(detection.class_id), score=detection.score)
        common.detections.append(vision.Detection2D(
            header=msg.header, id=detection.id, bbox=box,
            results=[vision.ObjectHypothesisWithPose(hypothesis=hypothesis)]))
    return common
