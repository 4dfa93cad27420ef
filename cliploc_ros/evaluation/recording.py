# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recording queries: detector and CLIP run once, so every method gets the same input."""

import hashlib
import json
import logging
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Detections
from cliploc_ros.datasets.frames import Frame, Frames
from cliploc_ros.datasets.queries import Queries, QueryFrame, load_queries, save_queries
from cliploc_ros.errors import DatasetError
from cliploc_ros.models.clip_encoder import load_encoder
from cliploc_ros.models.clip_weights import ClipOptions
from cliploc_ros.models.observer import Observer
from cliploc_ros.models.protocols import ObjectDetector
from cliploc_ros.models.yolo_detector import YoloDetector, YoloOptions
from cliploc_ros.units import NS_PER_S

logger = logging.getLogger(__name__)

#: The most detections of an image that are used, as in the relocalizer node.
MAX_DETECTIONS = 50
Progress = Callable[[Iterable[Frame]], Iterable[Frame]]


def record_queries(frames: Frames, landmark_map: LandmarkMap, detector: ObjectDetector,
                   observer: Observer, progress: Progress = iter) -> Queries:
    """Run detector and CLIP on every image that has ground truth.

    Parameters
    ----------
    frames : Frames
    landmark_map : LandmarkMap
        The observer compares crops with its labels.
    detector : ObjectDetector
    observer : Observer
    progress : callable, optional
        Wraps the loop over the images.

    Returns
    -------
    Queries
        Each image is a query. The true landmark of a box is unknown: -1. Boxes are undistorted.

    Raises
    ------
    DatasetError
        An image cannot be read, no image has ground truth, or the camera changes.
    """
    recorded: list[QueryFrame] = []
    camera: Camera | None = None
    for frame in progress(frames.read()):
        if frame.map_from_camera is None:
            continue
        if camera not in (None, frame.camera):
            raise DatasetError(f'{frames.source}: the camera changes at '
                               f'{frame.stamp_ns / NS_PER_S:.6f}, but a query file has one camera')
        camera = frame.camera
        recorded.append(_record(frame, detector, observer, len(recorded)))
    if camera is None:
        raise DatasetError(f'no image of {frames.source} has ground truth within 20 ms')
    return Queries(landmark_map.landmark_ids, (camera.fx, camera.fy, camera.cx, camera.cy),
                   tuple(recorded))


def _record(frame: Frame, detector: ObjectDetector, observer: Observer, number: int) -> QueryFrame:
    camera = frame.camera
    start = time.perf_counter()
    detections = detector.detect(frame.image_rgb).usable(camera.width, camera.height,
                                                         MAX_DETECTIONS)
    detected = time.perf_counter()
    observation = observer.observe(frame.image_rgb, camera, detections, frame.stamp_ns)
    compared = time.perf_counter()
    assert observation.similarities is not None and frame.map_from_camera is not None
    similarities = np.asarray(observation.similarities)
    bboxes = _undistorted(detections, camera)
    rows = np.nonzero((bboxes[:, 2:] > bboxes[:, :2]).all(axis=1))[0]  # never true of NaN
    sound = detections.select(rows)
    return QueryFrame(
        stamp_ns=frame.stamp_ns, bboxes_xyxy=bboxes[rows], class_ids=sound.class_ids,
        scores=sound.scores, similarities=similarities[rows].astype(np.float64),
        true_landmark=np.full(len(rows), -1, dtype=np.int64),
        map_from_camera=frame.map_from_camera, group=number, is_main=True,
        detector_ms=(detected - start) * 1e3, clip_ms=(compared - detected) * 1e3)


def _undistorted(detections: Detections, camera: Camera) -> np.ndarray:
    if not any(camera.distortion):
        return detections.bboxes_xyxy
    bboxes = camera.normalize_bboxes(detections.bboxes_xyxy)
    return bboxes * [camera.fx, camera.fy] * 2 + [camera.cx, camera.cy] * 2


def recorded_once(frames: Frames, landmark_map: LandmarkMap, yolo: YoloOptions, clip: ClipOptions
                  ) -> Queries:
    """Return queries from the cache beside the images, or record and cache them.

    Parameters
    ----------
    frames : Frames
    landmark_map : LandmarkMap
    yolo : YoloOptions
    clip : ClipOptions
        Other options need another cache.

    Raises
    ------
    CliplocError
        From loading the networks and from recording. A cache that cannot be read or written
        gives a warning only.
    """
    cache = cache_path(frames, landmark_map, yolo, clip)
    if cache.exists():
        try:
            queries = load_queries(cache, landmark_map.landmark_ids)
            logger.warning('using boxes and similarities of an earlier run: %s', cache)
            return queries
        except DatasetError as error:
            logger.warning('recording again: %s', error)
    queries = record_queries(
        frames, landmark_map, YoloDetector(yolo),
        Observer(*load_encoder(clip, landmark_map.labels)),
        partial(tqdm, total=frames.count, desc='detector and CLIP', unit='image', disable=None))
    try:
        save_queries(cache, queries)
    except DatasetError as error:
        logger.warning('the next run must record again: %s', error)
    return queries


def cache_path(frames: Frames, landmark_map: LandmarkMap, yolo: YoloOptions, clip: ClipOptions
               ) -> Path:
    """Return the cache file: beside the images, named after all that the queries depend on."""
    source = frames.source.resolve()
    parts: list[Any] = [frames.count, landmark_map.landmark_ids, landmark_map.labels,
                        asdict(yolo), asdict(clip),
                        [_state(Path(path)) for path in (source, yolo.model, clip.model,
                                                         clip.pretrained, clip.checkpoint_path)]]
    digest = hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:12]
    return source.with_name(f'{source.name}.cliploc-{digest}.npz')


def _state(path: Path) -> tuple[int, int] | None:
    """Return what changes with a file; None for the name of a published model."""
    try:
        stat = path.stat()
    except OSError:
        return None
    return (0, stat.st_mtime_ns) if path.is_dir() else (stat.st_size, stat.st_mtime_ns)
