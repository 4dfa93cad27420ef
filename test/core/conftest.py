# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Real queries and a real map for the tests of the method."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from scene import make_room

from cliploc_ros.core.acceptance import camera_check
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.offline.datasets.observations import Queries, load_queries


@pytest.fixture
def verified_camera(monkeypatch):
    """Let no camera be wrong, so that a covariance has the errors of the pose alone."""
    weights = np.zeros_like(camera_check._WEIGHTS)
    weights[0] = 1.0
    monkeypatch.setattr(camera_check, '_WEIGHTS', weights)


@pytest.fixture(scope='session')
def thresholds() -> dict:
    return yaml.safe_load((Path(__file__).parents[1] / 'thresholds.yaml').read_text())


@pytest.fixture(scope='session')
def office(shared_data) -> Path:
    return shared_data / 'tum_fr3_office'


@pytest.fixture(scope='session')
def office_map(office) -> LandmarkMap:
    return LandmarkMap.from_file(office / 'map.yaml')


@pytest.fixture(scope='session')
def queries(office) -> Queries:
    return load_queries(office / 'queries.npz')


@pytest.fixture(scope='session')
def observed(queries):
    """Turn a recorded query frame into an observation."""
    camera = replace(queries.frames[0].observation.camera, width=640, height=480)
    return lambda frame: replace(frame.observation, camera=camera)


@pytest.fixture(scope='session')
def room() -> LandmarkMap:
    return make_room()


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)
