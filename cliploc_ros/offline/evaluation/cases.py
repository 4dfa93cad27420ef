# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Answer a recorded request again, without ROS: a failure in the field as a test case."""

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.camera_check import CameraCheck
from cliploc_ros.core.geometry.camera_faults import check_faults
from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.core.keyframes.localization import (
    ImageRecognizer,
    KeyframeLocalizer,
    query_features,
)
from cliploc_ros.core.localizer import (
    Localizer,
    by_classes,
    can_do_without_crops,
    recorded_crops,
)
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalization import Relocalization
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.errors import CameraError, CliplocError, DatasetError, OptionsError
from cliploc_ros.messages import (
    camera_from_msg,
    depths_from_msg,
    detections_from_msg,
    faults_of_camera_info,
    image_from_msg,
    parse_class_map,
)
from cliploc_ros.models.observer import Observer
from cliploc_ros.offline.datasets.cases import Case, CaseFrame


def options_of(case: Case) -> RelocalizerOptions:
    """Return the options that a case was recorded with; no clock cuts the search.

    DatasetError: the case does not hold them.
    """
    given = case.report.get('options')
    known = {field.name for field in fields(RelocalizerOptions)}
    try:
        options = {name: value for name, value in given.items() if name in known}  # type: ignore
        options |= {name: tuple(value) for name, value in options.items()
                    if isinstance(value, list)}
        return replace(RelocalizerOptions(**options), time_budget_s=math.inf)
    except (AttributeError, KeyError, TypeError, OptionsError) as error:
        raise DatasetError(f'the options of this case are broken: {error}') from error


def cameras_of(case: Case) -> CameraCheck:
    """Return what looks before the last frame said of its cameras; DatasetError: it is broken.

    Nothing is known of them in cases from before this was recorded.
    """
    try:
        return CameraCheck.of_fields(case.report.get('cameras_before', {}))
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError,
            CameraError) as error:
        raise DatasetError(f'the cameras of this case are broken: {error}') from error


def parameters_of(case: Case) -> Mapping[str, Any]:
    """Return the parameters that a case was recorded with; DatasetError: some are missing."""
    parameters = case.report.get('parameters')
    needed = {'rectified', 'class_map', 'max_detections', 'fuse_frames', 'fuse_window_s'}
    if not isinstance(parameters, dict) or not needed <= parameters.keys():
        raise DatasetError(f'the parameters of this case are broken: it needs {sorted(needed)}')
    return parameters


def replay_case(case: Case, landmark_map: LandmarkMap, observer: Observer | None,
                layer: KeyframeLayer | None = None) -> Relocalization:
    """Answer a case again with a map: as it was recorded, or with another one.

    CliplocError: a message or the report is broken.

    Parameters
    ----------
    observer : Observer, optional
        Compares the crops of a frame with the map, where the options need it.
    layer : KeyframeLayer, optional
        Keyframes of the map.
    """
    options, parameters = options_of(case), parameters_of(case)
    session = Localizer(Relocalizer(landmark_map, options))
    keyframes = None if layer is None else KeyframeLocalizer(layer)
    class_map = parse_class_map(parameters['class_map'])
    found, instants = None, case.instants()
    for number, (*beside, frame) in enumerate(instants, start=1):
        image, observation = _observed(frame, parameters, class_map)
        others = [_observed(one, parameters, class_map)[1] for one in beside]
        if can_do_without_crops(options):
            others = [by_classes(one, len(landmark_map)) for one in others]
        recognizer = None if keyframes is None else ImageRecognizer(
            keyframes, query_features(image), observation.camera)
        if observer is not None:
            observation = replace(observation, similarities=observer.observe(
                image, observation.camera, observation.detections, frame.stamp_ns).similarities)
        # of several cameras without odometry, the robot itself is what links them
        run = 0 if case.report.get('linked', frame.odom_from_camera is not None) else None
        if number == len(instants):
            session.cameras = cameras_of(case)
        found = session.localize(
            observation, run, parameters['fuse_frames'], parameters['fuse_window_s'],
            recorded_crops(observation, options), recognizer,
            [replace(one, stamp_ns=observation.stamp_ns) for one in others])
    assert found is not None  # a case has a frame
    return found


def _observed(frame: CaseFrame, parameters: Mapping[str, Any], class_map: Mapping[str, str]
              ) -> tuple[NDArray[np.uint8], Observation]:
    """Return the image of a frame, and what was detected in it, as the node makes them."""
    image = image_from_msg(frame.message('image'))
    height, width = image.shape[:2]
    info, rectified = frame.message('camera_info'), parameters['rectified']
    camera = camera_from_msg(info, (width, height), rectified)
    check_faults(faults_of_camera_info(info, camera, rectified))
    detections = detections_from_msg(frame.message('detections'), class_map).usable(
        width, height, parameters['max_detections'])
    depths = None
    if frame.depth:
        with suppress(CliplocError):  # the node goes on without depth
            depths = depths_from_msg(
                frame.message('depth'), frame.message('image').header.frame_id, camera,
                detections.bboxes_xyxy, frame.message('depth_camera_info')
                if frame.depth_camera_info else None, frame.camera_from_depth)
    return image, Observation(
        camera, detections, stamp_ns=frame.stamp_ns, camera_name=frame.camera,
        up_in_camera=frame.up_in_camera, odom_from_camera=frame.odom_from_camera, depths=depths)
