# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A recording is compared with a map's labels, images or both; its networks run once."""

import shutil

import numpy as np
import pytest

from cliploc_ros.core.map.landmark_embeddings import (
    LandmarkEmbeddings,
    embeddings_path,
    save_landmark_embeddings,
)
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.models.clip_encoder import embed_labels
from cliploc_ros.models.clip_weights import ClipOptions, resolve_clip_weights
from cliploc_ros.models.protocols import DetectorOptions
from cliploc_ros.offline.datasets.captures.capture import FolderOptions
from cliploc_ros.offline.datasets.folders import read_folder
from cliploc_ros.offline.evaluation.recording import recorded_queries
from cliploc_ros.offline.recording.recorder import EVERY_FRAME, RecordingOptions
from demo import ASSETS


@pytest.fixture(scope='module')
def walk(tmp_path_factory):
    """Return the demo's walk and map; the images next to the map are labels of other landmarks."""
    folder = tmp_path_factory.mktemp('walk')
    shutil.copytree(ASSETS / 'sequence', folder / 'sequence')
    shutil.copy(ASSETS / 'map.yaml', folder)
    clip = ClipOptions(cache_dir=str(folder), pretrained=str(ASSETS / 'clip'))
    landmark_map = LandmarkMap.from_file(folder / 'map.yaml')
    others = np.roll(np.asarray(embed_labels(
        resolve_clip_weights(clip), clip, landmark_map.labels)), 1, axis=0)
    save_landmark_embeddings(embeddings_path(folder / 'map.yaml'), LandmarkEmbeddings(
        resolve_clip_weights(clip).key, landmark_map.landmark_ids, others.astype(np.float16),
        others[:0].astype(np.float16), np.zeros(len(others) + 1, np.int64)))
    return folder, landmark_map, RecordingOptions(
        DetectorOptions(model=str(ASSETS / 'yolo.onnx')), clip, EVERY_FRAME,
        'every 24th')


def similarities(walk, compare):
    folder, landmark_map, options = walk
    frames = read_folder(folder / 'sequence', FolderOptions(layout='tum')).select((0, 24))
    queries = recorded_queries(frames, landmark_map, options, [str(folder / 'map.yaml')], compare)
    assert len(queries) == 2
    return np.concatenate([frame.observation.similarities for frame in queries])


def test_what_crops_are_compared_with(walk):
    text, image, both = (similarities(walk, compare) for compare in ('text', 'image', 'both'))
    assert len(text) > 5
    assert image == pytest.approx(np.roll(text, 1, axis=1), abs=1e-3)
    share, = np.linalg.lstsq(np.c_[(text - image).ravel()], (both - image).ravel(), rcond=None)[0]
    assert 0.3 < share < 0.7  # labels and these images have the same spread
    assert both == pytest.approx(share * text + (1 - share) * image, abs=1e-3)
