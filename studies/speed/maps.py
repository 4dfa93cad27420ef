# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Time and memory against the size of the map; part of studies.speed.search."""

import re
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from math import inf
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.ellipsoid import ellipse_bboxes, project_ellipsoids
from cliploc_ros.core.geometry.transforms import invert_transform, make_transform
from cliploc_ros.core.map.culling import make_groups
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.similarities import (
    CropSimilarities,
    LabelEmbeddings,
    nearest_landmarks,
)
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.core.search.frame_search import match_frame
from cliploc_ros.core.search.scene import Scene
from cliploc_ros.core.search.screening import set_up
from cliploc_ros.core.search.strategies import Leaders, Progress, draw_ransac, search_samples

_CROPS, _DIMENSIONS, _K, _CLASSES = 12, 512, 3, 40
_CAMERA = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)


def storey(count: int) -> tuple[LandmarkMap, Observation]:
    """Return a map of one landmark in four square metres, and a frame of up to twelve boxes."""
    rng, side = np.random.default_rng(0), np.sqrt(4.0 * count)
    names = tuple(f'class {number}' for number in rng.integers(0, _CLASSES, count))
    quats = rng.normal(size=(count, 4))
    ids = tuple(map(str, range(count)))
    landmark_map = LandmarkMap(
        'map', ids, ids, names, np.c_[rng.uniform(0, side, (count, 2)), rng.uniform(0, 2, count)],
        rng.uniform(0.05, 0.4, (count, 3)), quats / np.linalg.norm(quats, axis=1, keepdims=True))
    map_from_camera = make_transform(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]),
                                     np.array([0.4 * side, 0.5 * side, 1.2]))
    boxes = ellipse_bboxes(project_ellipsoids(invert_transform(map_from_camera),
                                              landmark_map.centers, landmark_map.shapes))
    near = np.linalg.norm(landmark_map.centers - map_from_camera[:3, 3], axis=1) < 12
    seen = np.nonzero((np.abs(boxes) < 0.48).all(axis=1) & near)[0][:_CROPS]
    pixels = 500 * (boxes[seen] + rng.normal(0, 0.004, (len(seen), 4))) + [320, 240, 320, 240]
    labels = _units(rng, count)
    crops = labels[seen] + 0.5 * _units(rng, len(seen))
    crops /= np.linalg.norm(crops, axis=1, keepdims=True)
    detections = Detections(pixels, tuple(names[row] for row in seen), np.ones(len(seen)))
    return landmark_map, Observation(_CAMERA, detections,
                                     CropSimilarities(crops, LabelEmbeddings.of(labels)))


def measure_maps(counts: Sequence[int]) -> None:
    """Print time and memory for maps of some sizes."""
    print(f'maps, {_CROPS} crops of {_DIMENSIONS} numbers, all labels different:\n'
          '  landmarks  k-NN ms  labels MB  sort s  sorted MB  frame ms  us a sample  ratio  '
          'request ms  process MB')
    first_us = None
    for count in counts:
        landmark_map, observation = storey(count)
        similarities = observation.similarities
        assert isinstance(similarities, CropSimilarities)
        start = time.perf_counter()
        landmark_map.prepare()
        sort_s = time.perf_counter() - start
        sorted_mb = sum(array.nbytes for array in landmark_map.sorted_landmarks) / 1e6
        knn_ms = 1e3 * least_s(partial(nearest_landmarks, similarities, _K), 5)
        scene, _ = match_frame(landmark_map, observation, RelocalizerOptions())
        # those of CLIP's candidates, whose mixture does not depend on the map's size
        samples = draw_ransac(scene.pairs[:min(len(scene.pairs), _K * _CROPS)], 4_000,
                              np.random.default_rng(0))
        samples = samples[samples[:, 0] >= 0]
        frame_ms = 1e3 * least_s(partial(_frame, landmark_map, observation, scene), 5)
        sample_us = 1e6 / len(samples) * least_s(partial(_search, scene, samples), 5)
        relocalizer = Relocalizer(landmark_map, RelocalizerOptions())
        relocalizer.warm_up()
        request_ms = 1e3 * least_s(partial(relocalizer.relocalize, [observation]), 5)
        first_us = first_us or sample_us
        print(f'  {count:9,d} {knn_ms:8.1f} {similarities.labels.unique.nbytes / 1e6:10.0f} '
              f'{sort_s:7.2f} {sorted_mb:10.1f} '
              f'{frame_ms:9.2f} {sample_us:12.2f} {sample_us / first_us:6.2f} '
              f'{request_ms:11.1f} {_peak_mb():11.0f}', flush=True)


def measure_first_request() -> None:
    """Print the time of the first request after a start, compared with the tenth."""
    landmark_map, observation = storey(100)
    start = time.perf_counter()
    relocalizer = Relocalizer(landmark_map, RelocalizerOptions())
    relocalizer.warm_up()
    ready_s, times_ms = time.perf_counter() - start, []
    for _ in range(10):
        start = time.perf_counter()
        relocalizer.relocalize([observation])
        times_ms.append(1e3 * (time.perf_counter() - start))
    print(f'first request: {times_ms[0]:.1f} ms, {times_ms[0] / times_ms[9]:.2f} times the tenth, '
          f'after a start of {ready_s:.1f} s')


def _frame(landmark_map: LandmarkMap, observation: Observation, scene: Scene) -> None:
    """Prepare the search of a frame: the tree of its classes' landmarks, and the bench."""
    make_groups(landmark_map.sorted_landmarks,
                landmark_map.classes.classes_of(observation.detections.class_ids),
                scene.box_ellipses, scene.iou_threshold)
    set_up(scene)


def _search(scene: Scene, samples: NDArray[np.int64]) -> None:
    drain(search_samples(scene, samples, Leaders.none_yet()))


def drain(search: Iterator[Progress]) -> int:
    """Search to the end; return how many hypotheses were tried."""
    tried = 0
    for progress in search:
        tried = progress.tried
    return tried


def _units(rng: np.random.Generator, count: int) -> NDArray[np.float32]:
    rows = rng.standard_normal((count, _DIMENSIONS), dtype=np.float32)
    rows /= np.sqrt(np.einsum('ij,ij->i', rows, rows))[:, None]
    return rows


def least_s(run: Callable[[], object], repetitions: int = 20) -> float:
    """Return the least time [s] of some runs, the one least disturbed by other programs."""
    least = inf
    for _ in range(repetitions):
        start = time.perf_counter()
        run()
        least = min(least, time.perf_counter() - start)
    return least


def _peak_mb() -> float:
    found = re.search(r'VmHWM:\s+(\d+) kB', Path('/proc/self/status').read_text())
    return int(found[1]) * 1024 / 1e6 if found else 0.0
