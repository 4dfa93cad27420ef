# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Make queries of recorded observations: every method gets the same input.

This is not in trials, because core tests with few packages import trials.
"""

from collections import defaultdict, deque
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.similarities import CropSimilarities, LabelEmbeddings
from cliploc_ros.core.observation import Observation
from cliploc_ros.models.clip_encoder import embed_map
from cliploc_ros.offline.datasets.frames import Frames, undistorted
from cliploc_ros.offline.datasets.observations import Queries
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.posed_query import PosedQuery
from cliploc_ros.offline.recording.recorder import RecordingOptions, record_once


def recorded_queries(frames: Frames, landmark_map: LandmarkMap, options: RecordingOptions,
                     map_files: Sequence[str], compare: str) -> Queries:
    """Return the images with ground truth as queries; detector and CLIP run once.

    CliplocError: the networks cannot be loaded, or the recording fails.

    Parameters
    ----------
    options : RecordingOptions
        Without CLIP, all similarities are 0, which suits methods that match by class only.
    map_files, compare
        See load_encoder_for_map.
    """
    labels = (None if options.clip is None
              else embed_map(options.clip, landmark_map, map_files, compare))
    return make_queries_of(record_once(frames, options), landmark_map, labels)


def make_queries_of(detections: PosedDetections, landmark_map: LandmarkMap,
                    labels: LabelEmbeddings | None) -> Queries:
    """Return recorded frames as queries, each in its own group; true landmarks are unknown."""
    camera, frames = detections.cameras[0], []
    assert detections.stamps_ns is not None
    for frame, stamp_ns in enumerate(detections.stamps_ns):
        rows = slice(*map(int, detections.frame_offsets[frame:frame + 2]))
        boxes = detections.bboxes_xyxy[rows]
        if detections.camera_of(frame) != camera:  # all queries have the same camera
            boxes = camera.bboxes_in_pixels(detections.camera_of(frame).normalize_bboxes(boxes))
        similarities = np.zeros((len(boxes), len(landmark_map)), np.float32)
        if labels is not None:
            assert detections.embeddings is not None
            crops = detections.embeddings[rows].astype(np.float32)
            similarities = np.asarray(CropSimilarities(crops, labels))
        frames.append(PosedQuery(
            frame, Observation(
                camera, replace(detections.detections_of(frame), bboxes_xyxy=boxes), similarities,
                int(stamp_ns), depths=None if detections.depths is None
                else detections.depths[rows].astype(np.float64)),
            detections.map_from_camera[frame], group=frame))
    return Queries(landmark_map.landmark_ids, tuple(frames))


def with_images(queries: Sequence[PosedQuery], frames: Frames) -> tuple[PosedQuery, ...]:
    """Return queries with their undistorted images; a query without an image is unchanged.

    `frames` are the recording of the queries.
    """
    waiting: dict[int, deque[int]] = defaultdict(deque)
    for row, query in enumerate(queries):
        waiting[query.observation.stamp_ns].append(row)
    found = list(queries)
    wanted = frames.read_raw(lambda place, stamp_ns, pose: pose is not None
                             and bool(waiting.get(stamp_ns)))
    for raw in tqdm(wanted, 'images', len(queries), unit='image', disable=None):
        if not waiting[raw.stamp_ns]:
            continue  # more images of this stamp than queries
        row = waiting[raw.stamp_ns].popleft()
        image_rgb, camera = raw.color()
        image_rgb = undistorted(image_rgb, camera, queries[row].observation.camera)
        # kept compressed, since the images of a long recording would fill the memory
        _, content = cv2.imencode('.png', image_rgb, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        found[row] = replace(queries[row], image=partial(_decoded, content))
    return tuple(found)


def _decoded(content: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the image that was compressed, its channels in the same order."""
    return np.asarray(cv2.imdecode(content, cv2.IMREAD_COLOR), dtype=np.uint8)
