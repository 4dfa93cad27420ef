# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Convert the messages of an instant to a query, and check their consistency."""

import logging
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.detector_check import DetectorCheck
from cliploc_ros.core.geometry.camera_faults import Fault, check_faults
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.query import Query
from cliploc_ros.core.relocalizer import Relocalization
from cliploc_ros.errors import CliplocError
from cliploc_ros.messages import (
    camera_from_msg,
    depths_from_msg,
    detections_from_msg,
    faults_of_camera_info,
    faults_of_headers,
    faults_of_rectified,
    image_from_msg,
    parse_class_map,
)
from cliploc_ros.ros.inputs.frame_source import Frame
from cliploc_ros.ros.inputs.robot_state import KnownBefore, RobotState
from cliploc_ros.ros.parameters import RelocalizerParameters

logger = logging.getLogger(__name__)
# The vertical in the frame of a body that is tilted by less than 45 degrees and rolled by less
# than 17. In an optical frame, only a camera that looks up by more than 72 degrees has it there.
_LEAST_Z, _MOST_Y = 0.7, 0.3


class Instants:
    """Converts frames to queries, and checks cameras and detector.

    Parameters
    ----------
    by_class : bool
        Whether the classes of detections are compared with the classes of the map.
    """

    def __init__(self, landmark_map: LandmarkMap, by_class: bool) -> None:
        self._detector = DetectorCheck(landmark_map, by_class)
        self._faults: dict[str, list[Fault]] = {}  # of the newest frame of each camera
        self.notes: list[str] = []  #: All warnings that are no faults, each once

    @property
    def faults(self) -> list[Fault]:
        """Return the faults of the newest frames, their cameras and their detector."""
        return [*(fault._replace(text=f'{name}: {fault.text}' if name else fault.text)
                  for name, faults in self._faults.copy().items() for fault in faults),
                *(fault._replace(text=f'the detector: {fault.text}')
                  for fault in self._detector.faults)]

    def query(self, frame: Frame, parameters: RelocalizerParameters, known: KnownBefore) -> Query:
        """Return the query of an instant, without cameras whose odometry is of another run.

        CliplocError: the frame or the parameters are invalid.
        """
        state, beside, region = known
        # without odometry, the cameras of one instant are linked by their mounts
        run = _run_of(state)
        by_odometry = run is not None or not (frame.camera and beside)
        images, observations = zip(*(
            self._observed(camera_frame, parameters, camera_state, by_odometry)
            for camera_frame, camera_state in (*beside, (frame, state))
            if run == _run_of(camera_state)), strict=True)
        newest = replace(observations[-1], region=region)
        others = (replace(other, stamp_ns=newest.stamp_ns) for other in observations[:-1])
        return Query((*others, newest), images, run, parameters.fuse_frames,
                     parameters.fuse_window_s)

    def check_axes(self, frame: Frame, state: RobotState, map_from_camera: NDArray[np.float64]
                   ) -> None:
        """Raise CameraError if an accepted pose (4, 4) shows that the mount has a body's axes."""
        with self._keeping(frame.camera):
            check_faults(faults_of_axes(frame.image.header.frame_id, state.camera_from_base,
                                        map_from_camera))

    def explained(self, found: Relocalization) -> Relocalization:
        """Return a result; a refusal gets the faults of the newest frames as further reasons."""
        if found.accepted:
            return found
        found = self._detector.explain(found)
        texts = (fault.text for fault in self.faults if not fault.is_certain)
        return replace(found, reason='; '.join([found.reason, *texts]))

    def note(self, text: str) -> None:
        """Log a warning once."""
        if text and text not in self.notes:
            self.notes.append(text)
            logger.warning('%s', text)

    def _observed(self, frame: Frame, parameters: RelocalizerParameters, state: RobotState,
                  by_odometry: bool) -> tuple[NDArray[np.uint8], Observation]:
        """Return the image of a frame and its detections, without crops."""
        with self._keeping(frame.camera):
            image = image_from_msg(frame.image)
            height, width = image.shape[:2]
            camera = camera_from_msg(frame.camera_info, (width, height), parameters.rectified)
            given = detections_from_msg(frame.detections, parse_class_map(parameters.class_map))
            image_frame, info = frame.image.header.frame_id, frame.camera_info
            faults = [
                *faults_of_headers(image_frame, info.header.frame_id,
                                   frame.detections.header.frame_id),
                *faults_of_camera_info(info, camera, parameters.rectified),
                *faults_of_rectified(frame.image_topic, parameters.rectified, info),
                *(faults_of_axes(image_frame, state.camera_from_base)
                  if parameters.base_frame not in ('', image_frame) else [])]
            check_faults(faults)
        self._faults[frame.camera] = faults
        detections = given.usable(camera.width, camera.height, parameters.max_detections)
        self._detector.add(given, detections)
        place, odom_from_camera = state.place, None
        if not by_odometry:
            odom_from_camera = invert_transform(state.camera_from_base)
        elif place is not None:
            odom_from_camera = place.odom_from_frame
        depths = None
        try:
            if frame.depth is not None:
                depths = depths_from_msg(
                    frame.depth, frame.image.header.frame_id, camera, detections.bboxes_xyxy,
                    frame.depth_camera_info, state.camera_from_depth)
            elif parameters.depth_transport != 'none':
                self.note('an image without depth: no depth within depth_tolerance_s '
                          f'({parameters.depth_tolerance_s:g} s) of it: remap depth, start its '
                          'publisher, or set depth_transport to none')
        except CliplocError as error:
            self.note(f'localizing without depth: {error}')
        return image, Observation(
            camera, detections, stamp_ns=frame.stamp_ns,
            camera_name=frame.camera, up_in_camera=state.up_in_camera, depths=depths,
            odom_from_camera=odom_from_camera, odom_way_m=0.0 if place is None else place.way_m)

    @contextmanager
    def _keeping(self, camera: str) -> Iterator[None]:
        """Store a CliplocError of the body as a fault of a camera."""
        try:
            yield
        except CliplocError as error:
            self._faults[camera] = [Fault(str(error), True)]
            raise


def _run_of(state: RobotState) -> int | None:
    return None if state.place is None else state.place.run


def faults_of_axes(frame_id: str, camera_from_base: NDArray[np.float64],
                   map_from_camera: NDArray[np.float64] | None = None) -> list[Fault]:
    """Return a fault if the mount (4, 4) shows that images are in a frame with a body's axes.

    The axes of a body are x ahead, y left, z up (REP 103), those of a camera x right, y down, z
    ahead. A camera that looks at the ceiling has a similar mount, so the fault is a suspicion. It
    is certain if the camera's pose (4, 4) in the map implies that the robot lies on its side.
    """
    _, y, z = up_in_camera = camera_from_base[:3, 2]
    if z < _LEAST_Z or abs(y) > _MOST_Y:
        return []
    return [Fault(
        f"by its mount, '{frame_id}' has the axes of a body, x ahead and z up: the camera would "
        f'look up by {math.degrees(math.asin(min(1.0, z))):.0f} degrees; publish images in the '
        'optical frame, or correct tf or base_from_camera',
        map_from_camera is not None and float(map_from_camera[2, :3] @ up_in_camera) < _LEAST_Z)]
