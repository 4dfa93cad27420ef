# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What contradicts itself in the messages of one frame, and in the mount of its camera."""

import math

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.camera_faults import Fault
from cliploc_ros.messages import (
    faults_of_camera_info,
    faults_of_headers,
    faults_of_rectified,
)
from cliploc_ros.ros.inputs.frame_source import Frame
from cliploc_ros.ros.inputs.robot_state import RobotState
from cliploc_ros.ros.parameters import RelocalizerParameters

# The vertical in the frame of a body that is tilted by less than 45 degrees and rolled by less
# than 17: no optical frame has it, but that of a camera which looks up by more than 72 degrees.
_LEAST_Z, _MOST_Y = 0.7, 0.3


def faults_of_frame(frame: Frame, camera: Camera, parameters: RelocalizerParameters,
                    state: RobotState) -> list[Fault]:
    """Return what contradicts itself in a frame, given its camera and the robot's state."""
    image, info = frame.image.header.frame_id, frame.camera_info
    return [*faults_of_headers(image, info.header.frame_id, frame.detections.header.frame_id),
            *faults_of_camera_info(info, camera, parameters.rectified),
            *faults_of_rectified(frame.image_topic, parameters.rectified, info),
            *(faults_of_axes(image, state.camera_from_base)
              if parameters.base_frame not in ('', image) else [])]


def faults_of_axes(frame_id: str, camera_from_base: NDArray[np.float64],
                   map_from_camera: NDArray[np.float64] | None = None) -> list[Fault]:
    """Return whether the coordinate frame of an image is that of a body, by its mount (4, 4).

    The axes of a body are x ahead, y left, z up (REP 103), those of a camera x right, y down, z
    ahead. A camera may look at the ceiling. It does not where its pose (4, 4) in the map, which
    objects show, would have the robot lie on its side.
    """
    _, y, z = up_in_camera = camera_from_base[:3, 2]
    if z < _LEAST_Z or abs(y) > _MOST_Y:
        return []
    return [Fault(
        f"'{frame_id}' has the axes of a body, x ahead and z up, by its mount: the camera would "
        f'look up by {math.degrees(math.asin(min(1.0, z))):.0f} degrees; publish images in its '
        'optical frame, or correct tf or base_from_camera',
        map_from_camera is not None and float(map_from_camera[2, :3] @ up_in_camera) < _LEAST_Z)]
