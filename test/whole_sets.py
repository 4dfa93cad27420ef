# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A small map with all files next to it: embeddings, keyframes, and records of its origin."""

from dataclasses import replace

import numpy as np
from scene import CAMERA, ROOM, embeddings_of

from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.offline.datasets.map_recording import MapRecording
from cliploc_ros.offline.mapping.make_map import MadeMap, write_made_map
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.recording.updating import UpdatedLayer


def made_map(number):
    """Return a map whose files all contain its number, by which the room is also moved."""
    landmark_map = replace(ROOM, centers=ROOM.centers + np.array([0.01, 0.0, 0.0]) * number)
    means = np.tile(np.eye(8)[number % 8], (len(ROOM), 1))
    layer = KeyframeLayer(
        'map', ROOM.landmark_ids, landmark_map.centers.astype(np.float32), (CAMERA,),
        np.tile(np.eye(4), (1, 1, 1)), np.array([0, 5]), np.zeros((5, 2), np.uint16),
        np.full((5, 3), number, dtype=np.float32), np.zeros((5, 128), np.uint8),
        np.zeros(5, np.uint16), np.ones((1, 128), np.uint8))
    return MadeMap(landmark_map, None, embeddings_of(ROOM.landmark_ids, means), layer,
                   keyframes=UpdatedLayer(layer, layer, ()))


def write_set(path, number):
    """Write the map of a number, and all files next to it."""
    seen = PosedDetections((CAMERA,), np.eye(4)[None], np.array([float(number)]), np.zeros(2, int),
                           np.empty((0, 4)), (), np.empty(0, int), np.empty(0))
    return write_made_map(path, made_map(number), ['a test'], MapRecording(
        path.with_name('seen.npz'), scale=1.0 + number), together=seen)
