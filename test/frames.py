# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The messages of a frame with boxes and pixels, as the nodes receive them."""

import numpy as np
from builtin_interfaces.msg import Time
from scene import CAMERA
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header

from cliploc_ros.ros.conversions import detections_to_msg
from cliploc_ros.ros.inputs.frame_source import Frame


def stamp(seconds):
    return header_of(round(seconds * 1e9)).stamp


def header_of(stamp_ns, frame_id='camera'):
    return Header(frame_id=frame_id, stamp=Time(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9))


def messages_of(detections, header, pixels=None, calibration=CAMERA, info=None):
    """Return image, camera_info and detections of a header.

    `pixels` (h, w) or (h, w, 3), by default black; `info`: other fields of camera_info.
    """
    size = {'width': calibration.width, 'height': calibration.height}
    pixels = np.zeros([*size.values()][::-1], np.uint8) if pixels is None else pixels
    image = Image(header=header, encoding='mono8' if pixels.ndim == 2 else 'rgb8',
                  step=pixels.strides[0], data=pixels.tobytes(), **size)
    return image, CameraInfo(header=header, **{
        **size, 'k': calibration.matrix.ravel(), 'distortion_model': 'plumb_bob', 'd': [0.0] * 5,
        'p': np.c_[calibration.matrix, np.zeros(3)].ravel(), **(info or {})}), detections_to_msg(
            detections, header)


def frame_of(detections, header, pixels=None, calibration=CAMERA, info=None, **fields):
    """Return the frame of such messages; `fields`: other fields of the frame."""
    return Frame(*messages_of(detections, header, pixels, calibration, info),
                 **{'received_at': 0.0, 'detected_at': 0.0, **fields})
