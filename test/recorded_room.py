# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A small world for evaluations: the simulated room, with queries."""

from dataclasses import replace

import numpy as np
import pytest
from scene import CAMERA, MAP_FROM_CAMERA, make_room, see_room, write_map

from cliploc_ros.core.observation import Observation
from cliploc_ros.offline.datasets.observations import Queries, save_queries
from cliploc_ros.offline.posed_query import PosedQuery

QUERIES = 12


def make_recording(room):
    """Return views of two to twelve objects, with slightly noisy boxes and ambiguous labels."""
    rng = np.random.default_rng(3)
    seen = see_room(room)
    frames = []
    for number in range(QUERIES):
        rows = np.sort(rng.permutation(len(seen))[:2 + number])
        own = np.zeros((len(rows), len(room)))
        own[np.arange(len(rows)), rows] = 0.08
        boxes = seen.bboxes_xyxy[rows] + rng.normal(0, 1.0, (len(rows), 4))
        frames.append(PosedQuery(number, Observation(
            CAMERA, replace(seen.select(rows), bboxes_xyxy=boxes),
            rng.uniform(0.1, 0.3, own.shape) + own, (100 + number) * 10**9), MAP_FROM_CAMERA,
            group=number, true_landmark=rows))
    return Queries(room.landmark_ids, tuple(frames))


@pytest.fixture(scope='package')
def room():
    return make_room()


@pytest.fixture(scope='package')
def recording(room):
    return make_recording(room)


@pytest.fixture(scope='package')
def files(room, recording, tmp_path_factory):
    """A folder with queries.npz and map.yaml."""
    folder = tmp_path_factory.mktemp('small')
    write_map(room, folder / 'map.yaml')
    save_queries(folder / 'queries.npz', recording)
    return folder
