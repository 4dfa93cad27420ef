# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What contradicts itself in the messages of one frame, and in the mount of its camera."""

import math

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.camera_faults import Fault
from cliploc_ros.messages import faults_of_camera_info
from cliploc_ros.ros.inputs.frame_source import Frame
from cliploc_ros.ros.inputs.robot_state import RobotState
from cliploc_ros.ros.parameters import RelocalizerParameters, doubt_of_rectified

# The vertical in the frame of a body that is tilted by less than 45 degrees and rolled by less
# than 17: no optical frame has it, but that of a camera which looks up by more than 72 degrees.
_LEAST_Z, _MOST_Y = 0.7, 0.3


def faults_of_frame(frame: Frame, camera: Camera, parameters: RelocalizerParameters,
                    state: RobotState) -> list[Fault]:
    """Return what contradicts itself in a frame, given its camera and the robot's state."""
    image, up_in_camera = frame.image.header.frame_id, state.up_in_camera
    if up_in_camera is None and parameters.base_frame:
        up_in_camera = state.camera_from_base[:3, 2]
    doubt = doubt_of_rectified(frame.image_topic, parameters, frame.camera_info)
    return [*faults_of_headers(image, frame.camera_info.header.frame_id,
                               frame.detections.header.frame_id),
            *faults_of_camera_info(frame.camera_info, camera, parameters.rectified),
            *([Fault(doubt, False)] if doubt else []),
            *([] if up_in_camera is None else faults_of_axes(image, up_in_camera))]


def faults_of_headers(image: str, camera_info: str, detections: str = '') -> list[Fault]:
    """Return which messages are of another coordinate frame than their image; '' is unknown.

    Boxes of another camera are certainly wrong. Simulators and drivers are known that name
    camera_info and image differently.
    """
    return [Fault(f"{what} is of the coordinate frame '{other}', its image of '{image}': is it of "
                  "another camera? publish it with the image's header", is_certain)
            for what, other, is_certain in (('detections', detections, True),
                                            ('camera_info', camera_info, False))
            if other and image and other.strip('/') != image.strip('/')]


def faults_of_axes(frame_id: str, up_in_camera: NDArray[np.float64]) -> list[Fault]:
    """Return whether the coordinate frame of an image is that of a body, by the vertical in it.

    The axes of a body are x ahead, y left, z up (REP 103), those of a camera x right, y down, z
    ahead. A camera that looks at the ceiling is possible where the name says that it is optical.
    """
    _, y, z = up_in_camera.tolist()
    if z < _LEAST_Z or abs(y) > _MOST_Y:
        return []
    return [Fault(
        f"'{frame_id}' has the axes of a body, x ahead and z up, by its mount: the camera would "
        f'look up by {math.degrees(math.asin(min(1.0, z))):.0f} degrees; publish images in its '
        'optical frame, or correct tf or base_from_camera', 'optical' not in frame_id)]
