# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recording queries: detector and CLIP run once, every method then meets the same input."""

from collections.abc import Callable, Iterable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.camera import Camera
from cliploc_ros.core.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.datasets.queries import Queries, QueryFrame
from cliploc_ros.datasets.tum import TumSequence
from cliploc_ros.errors import DatasetError
from cliploc_ros.models.observer import Observer
from cliploc_ros.models.protocols import ObjectDetector

#: The most confident detections of an image that are used, as by the relocalizer node.
MAX_DETECTIONS = 50


def record_queries(sequence: TumSequence, camera: Camera, landmark_map: LandmarkMap,
                   detector: ObjectDetector, observer: Observer,
                   progress: Callable[[Iterable[Any]], Iterable[Any]] = iter) -> Queries:
    """Run detector and CLIP on every image of a sequence that has ground truth.

    Parameters
    ----------
    sequence : TumSequence
    camera : Camera
        Of the images; it must have no distortion, as query files hold undistorted boxes.
    landmark_map : LandmarkMap
        Whose labels the observer compares with.
    detector : ObjectDetector
    observer : Observer
    progress : callable, optional
        Wraps the loop over the images.

    Returns
    -------
    Queries
        Each image is a query of its own. Which landmark a box shows is not known: -1.

    Raises
    ------
    DatasetError
        If an image cannot be read, the camera distorts, or no image has ground truth.
    """
    if any(camera.distortion):
        raise DatasetError('recording queries needs undistorted images: rectify them first')
    frames: list[QueryFrame] = []
    for stamp, path in progress(list(zip(sequence.stamps_ns, sequence.image_paths, strict=True))):
        truth = sequence.pose_at(stamp)
        if truth is None:
            continue
        image = cv2.imread(str(path), cv2.IMREAD_COLOR)
        if image is None:
            raise DatasetError(f'{path} cannot be read as an image')
        image_rgb = np.ascontiguousarray(image[..., ::-1])
        detections = detector.detect(image_rgb).usable(camera.width, camera.height, MAX_DETECTIONS)
        observation = observer.observe(image_rgb, camera, detections, stamp)
        frames.append(_frame(observation, truth, len(frames)))
    if not frames:
        raise DatasetError(f'no image of {sequence.folder} has ground truth within 20 ms')
    return Queries(landmark_map.landmark_ids, (camera.fx, camera.fy, camera.cx, camera.cy),
                   tuple(frames))


def _frame(observation: Observation, truth: NDArray[np.float64], number: int) -> QueryFrame:
    detections = observation.detections
    assert observation.similarities is not None
    return QueryFrame(
        stamp_ns=observation.stamp_ns, bboxes_xyxy=detections.bboxes_xyxy,
        class_ids=detections.class_ids, scores=detections.scores,
        similarities=observation.similarities.astype(np.float64),
        true_landmark=np.full(len(detections), -1, dtype=np.int64), map_from_camera=truth,
        group=number, is_main=True)


def observation_of(frame: QueryFrame, camera: Camera) -> Observation:
    """Return the observation that a query frame recorded; its camera has no distortion."""
    return Observation(camera, Detections(frame.bboxes_xyxy, frame.class_ids, frame.scores),
                       frame.similarities.astype(np.float32), frame.stamp_ns)
