# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The message types of detections: vision_msgs, and yolo_msgs where that is installed."""

import importlib
from collections.abc import Callable
from typing import Any, NamedTuple

from vision_msgs.msg import (
    BoundingBox2D,
    Detection2D,
    Detection2DArray,
    ObjectHypothesis,
    ObjectHypothesisWithPose,
)

from cliploc_ros.errors import OptionsError

DETECTION_TYPES = ('vision_msgs', 'yolo_msgs')


class DetectionType(NamedTuple):
    """A message type, and what makes a vision_msgs/Detection2DArray of it."""

    message_type: type
    converted: Callable[[Any], Detection2DArray]


def detection_type(package: str) -> DetectionType:
    """Return the message type of a package.

    Raises
    ------
    OptionsError
        The package is not installed.
    """
    if package == 'vision_msgs':
        return DetectionType(Detection2DArray, lambda msg: msg)
    try:
        message_type = importlib.import_module('yolo_msgs.msg').DetectionArray
    except ImportError as error:
        raise OptionsError('detections_type: yolo_msgs is not installed: build yolo_ros in this '
                           'workspace and source it, or set vision_msgs') from error
    return DetectionType(message_type, from_yolo_msg)


def from_yolo_msg(msg: Any) -> Detection2DArray:
    """Return a yolo_msgs/DetectionArray as the common type: boxes, class names and scores."""
    return Detection2DArray(header=msg.header, detections=[
        Detection2D(header=msg.header, id=one.id, bbox=_box(one.bbox), results=[
            ObjectHypothesisWithPose(hypothesis=ObjectHypothesis(
                class_id=one.class_name or str(one.class_id), score=one.score))])
        for one in msg.detections])


def _box(bbox: Any) -> BoundingBox2D:
    box = BoundingBox2D(size_x=bbox.size.x, size_y=bbox.size.y)
    box.center.position.x = bbox.center.position.x
    box.center.position.y = bbox.center.position.y
    box.center.theta = bbox.center.theta
    return box
