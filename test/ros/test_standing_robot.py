# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A robot that asks until it is answered gives chance no more chances than one that asks once."""

from dataclasses import replace

import numpy as np
import pytest

from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.datasets.queries import load_queries
from cliploc_ros.evaluation.trials import make_queries
from cliploc_ros.evaluation.troubles import exchange_landmarks
from cliploc_ros.ros.frame_window import FrameWindow

LOOKS, PERIOD_NS = 20, 100_000_000


@pytest.fixture(scope='module')
def office(shared_data):
    """The real map, its main queries and their true poses."""
    folder = shared_data / 'tum_fr3_office'
    landmark_map = LandmarkMap.from_file(folder / 'map.yaml')
    recorded = load_queries(folder / 'queries.npz', landmark_map.landmark_ids)
    return landmark_map, make_queries(recorded, landmark_map, False), recorded.main_frames()


def ask(landmark_map, observations, min_confidence=0.99):
    """Ask about each image of a robot that stands; return the results, and which are believed."""
    options = RelocalizerOptions(min_confidence=min_confidence)
    relocalizer, window = Relocalizer(landmark_map, options), FrameWindow()
    results, believed = [], []
    for number, observation in enumerate(observations):
        observation = replace(observation, stamp_ns=10**9 + number * PERIOD_NS,
                              odom_from_camera=np.eye(4))
        frames = window.join(observation, 0, 5, 5.0)
        results.append(relocalizer.relocalize([one.observation for one in frames]))
        believed.append(window.judge(results[-1]).accepted)
    return results, believed


def flicker(observation, rng):
    """What a detector makes of the same view another time: it misses a box of five."""
    detections = observation.detections
    rows = np.nonzero(rng.random(len(detections)) > 0.2)[0]
    sides = np.tile(np.diff(detections.bboxes_xyxy.reshape(-1, 2, 2), axis=1)[:, 0], 2)
    shaken = replace(detections, bboxes_xyxy=detections.bboxes_xyxy
                     + 0.02 * sides * rng.normal(size=sides.shape))
    return replace(observation, detections=shaken.select(rows), similarities=np.ascontiguousarray(
        np.asarray(observation.similarities)[rows]))


def test_another_place_misleads_few_who_ask_on(office):
    """Whatever fits is wrong there; these robots believe what is likelier than not."""
    landmark_map, queries, _ = office
    rng, misled, alone = np.random.default_rng(0), 0, 0
    elsewhere, _ = exchange_landmarks(landmark_map, queries, 1.0, np.random.default_rng(5))
    for query in queries[::4]:
        results, believed = ask(elsewhere, [flicker(query.observation, rng)
                                            for _ in range(LOOKS)], min_confidence=0.5)
        alone += any(result.accepted for result in results)
        misled += any(believed)
    print(f'\nof {len(queries[::4])} robots that looked {LOOKS} times each {alone} would have '
          f'believed one look, {misled} were misled')
    assert misled < alone / 2


def test_who_asks_on_still_learns_more(office):
    landmark_map, queries, frames = office
    rng, first, late = np.random.default_rng(0), 0, 0
    for query, frame in zip(queries[::4], frames[::4], strict=True):
        results, believed = ask(landmark_map, [flicker(query.observation, rng)
                                               for _ in range(LOOKS)])
        first += believed[0]
        if any(believed):
            late += 1
            found = results[believed.index(True)].map_from_camera
            assert pose_error(found, frame.map_from_camera)[0] < 1.0
    print(f'\nof {len(queries[::4])} robots {first} were sure at once, {late} in the end')
    assert late > first
