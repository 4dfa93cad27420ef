# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Measure the speed of the search: ``python -m studies.speed search``.

One run compares the kernel on one core with a plain loop over OpenCV and NumPy, and measures maps
of several sizes. With --queries and --map, it also searches each recorded query to the end.
"""

import os

# As in the nodes. NumPy reads it when it is imported.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import argparse
import re
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from math import inf
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.ellipsoid import ellipse_bboxes, project_ellipsoids, shape_matrices
from cliploc_ros.core.geometry.transforms import invert_transform, make_transform
from cliploc_ros.core.kernels.compiled import compiled
from cliploc_ros.core.map.culling import make_groups
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.similarities import CropSimilarities, LabelEmbeddings, nearest_landmarks
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.core.search import strategies
from cliploc_ros.core.search.frame_search import match_frame
from cliploc_ros.core.search.scene import Scene, make_scene
from cliploc_ros.core.search.screening import make_hypothesis, set_up, verify_beyond
from cliploc_ros.core.search.strategies import Leaders, Progress, compatible_pairs, draw_ransac
from studies.acceptance.places import ONE, Recording
from studies.reports import table

_PLAIN_HYPOTHESES = 100
_CHORDS = 32
_IOU_THRESHOLD = 0.2
_CROPS, _DIMENSIONS, _K, _CLASSES = 12, 512, 3, 40
_CAMERA = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)


def run(arguments: Sequence[str]) -> int:
    """Measure and print; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--queries', type=Path, metavar='NPZ', help='recorded frames')
    parser.add_argument('--map', type=Path, metavar='YAML', help='map of the frames')
    parser.add_argument('--landmarks', type=int, nargs='*', default=(100, 100_000, 1_000_000),
                        metavar='N', help='sizes of the maps (%(default)s); 1,000,000 take 6 GB')
    options = parser.parse_args(arguments)
    if (options.queries is None) != (options.map is None):
        parser.error('--queries and --map must be given together')
    measure_first_request()
    _measure_hypotheses(synthetic_scene())
    measure_maps(options.landmarks)
    if options.queries is not None:
        place = Recording(options.queries, options.map, every_frame=False).load()
        for matching, algorithm in (('hybrid', 'b-prosac'), ('class', 'bf')):
            # candidates as in the paper
            paper = RelocalizerOptions(matching=matching, algorithm=algorithm)
            scenes = [match_frame(place.landmark_map, query.observation, paper)[0]
                      for query in place.ask(ONE)]
            _measure_whole(f'{matching}, every sample', scenes, strategies.search_exhaustively)
            _measure_whole(f'{matching}, every compatible sample', scenes,
                           lambda scene, leaders: strategies.search_progressively(
                               scene, compatible_pairs(scene), leaders))
    return 0


def synthetic_scene() -> Scene:
    """Return a scene of twelve boxes, each paired with five landmarks, one of them true."""
    rng = np.random.default_rng(0)
    count, in_view = 20, 12
    centers = np.c_[rng.uniform(-3, 3, (count, 2)), rng.uniform(3, 7, count)]
    quats = rng.normal(size=(count, 4))
    shapes = shape_matrices(rng.uniform(0.05, 0.3, (count, 3)),
                            quats / np.linalg.norm(quats, axis=1, keepdims=True))
    boxes = ellipse_bboxes(project_ellipsoids(np.eye(4), centers, shapes))[:in_view]
    boxes += rng.normal(0.0, 0.005, boxes.shape)
    potential = np.arange(in_view)[:, None] % 4 == np.arange(count)[None] % 4
    return make_scene(boxes, centers, shapes, potential, np.argwhere(potential), _IOU_THRESHOLD)


def _measure_hypotheses(scene: Scene) -> None:
    samples = draw_ransac(scene.pairs, 4_000, np.random.default_rng(0))
    samples = samples[samples[:, 0] >= 0]
    bench = set_up(scene)
    solved = _verify_all(bench, samples)
    whole_us = 1e6 * least_s(lambda: _verify_all(bench, samples))
    searched_us = 1e6 * least_s(partial(_search, scene, samples))
    five_hundred_ms = 1e3 * least_s(partial(_search, scene, samples[:500]))
    plain_us, plain_score = _plain(scene, samples[:_PLAIN_HYPOTHESES])
    leaders = Leaders.none_yet()
    drain(strategies.search_samples(scene, samples[:_PLAIN_HYPOTHESES], leaders))
    print(f'{len(scene.bearings)} boxes, {len(scene.potential.detections)} pairs, one core:\n'
          f'  {whole_us / solved:7.2f} us a hypothesis, from P3P to complete verification\n'
          f'  {searched_us / len(samples):7.2f} us a sample, in a search\n'
          f'  {five_hundred_ms:7.2f} ms for N = 500\n'
          f'  {plain_us:7.0f} us a hypothesis, plain loop over OpenCV and NumPy: '
          f'{plain_us * solved / whole_us:.0f} times as long\n'
          f'  best of {_PLAIN_HYPOTHESES}: score {leaders.scores.max():.4f}, plain '
          f'{plain_score:.4f}')


@compiled
def _verify_all(bench, samples):
    """Make every hypothesis and verify it completely; return the number of hypotheses."""
    candidates, prior, targets, sample, poses, overlaps = bench
    solved = 0
    for number in range(samples.shape[0]):
        which = make_hypothesis(candidates, prior, sample, poses, samples, number, 0.0)
        if which >= 0:
            verify_beyond(targets, poses, which, overlaps, -1.0)
            solved += 1
    return solved


def _measure_whole(name: str, scenes: list[Scene],
                   search: Callable[[Scene, Leaders], Iterator[Progress]]) -> None:
    times_ms, tried = [], []
    for scene in scenes:
        def run(scene: Scene = scene) -> int:
            return drain(search(scene, Leaders.none_yet()))

        tried.append(run())
        times_ms.append(1e3 * least_s(run, 3))
    print(f'{name}, {len(scenes)} queries: {np.median(times_ms):.1f} ms (median), '
          f'{max(times_ms):.1f} ms (longest); {np.median(tried):.0f} and {max(tried)} '
          f'hypotheses; {1e3 * sum(times_ms) / max(sum(tried), 1):.2f} us each')


def _plain(scene: Scene, samples: NDArray[np.int64]) -> tuple[float, float]:
    """Return the time of the plain loop [us a hypothesis], and its best score."""
    solved, best = 0, 0.0
    duals = [_dual_quadric(center, shape)
             for center, shape in zip(scene.centers, scene.shapes, strict=True)]
    start = time.perf_counter()
    for sample in samples:
        pose = _plain_pose(scene, duals, scene.pairs[sample])
        if pose is not None:
            solved += 1
            best = max(best, _plain_score(scene, duals, pose))
    return 1e6 * (time.perf_counter() - start) / max(solved, 1), best


def _plain_pose(scene: Scene, duals: list[NDArray[np.float64]], pairs: NDArray[np.int64]
                ) -> NDArray[np.float64] | None:
    """Return camera_from_map (3, 4), the pose from P3P with the greatest sum of sampled IoUs."""
    seen = scene.box_ellipses[pairs[:, 0], :2].reshape(3, 1, 2)
    points = scene.centers[pairs[:, 1]].reshape(3, 1, 3)
    _, vectors, translations = cv2.solveP3P(points, seen, np.eye(3), None, cv2.SOLVEPNP_AP3P)
    best, best_total = None, -1.0
    for vector, translation in zip(vectors, translations, strict=True):
        pose = np.concatenate([cv2.Rodrigues(vector)[0], translation], axis=1)
        ious = [_plain_iou(scene.box_ellipses[detection], _plain_outline(pose, duals[landmark]))
                for detection, landmark in pairs]
        if sum(ious) > best_total:  # always false for NaN
            best, best_total = pose, sum(ious)
    return best


def _plain_score(scene: Scene, duals: list[NDArray[np.float64]], pose: NDArray[np.float64]
                 ) -> float:
    """Return the score of a pose: the sum of each detection's best IoU above the threshold."""
    ious, potential = np.zeros(len(scene.bearings)), scene.potential
    for number, landmark in enumerate(potential.landmarks):
        outline = _plain_outline(pose, duals[landmark])
        for detection in potential.detections[
                potential.starts[number]:potential.starts[number + 1]]:
            iou = _plain_iou(scene.box_ellipses[detection], outline)
            if iou > max(scene.iou_threshold, ious[detection]):
                ious[detection] = iou
    return float(ious.sum())


def _dual_quadric(center: NDArray[np.float64], shape: NDArray[np.float64]
                  ) -> NDArray[np.float64]:
    """Return the dual quadric (4, 4) of a landmark."""
    dual, upper = np.empty((4, 4)), np.triu_indices(3)
    dual[:3, :3][upper] = dual[:3, :3].T[upper] = shape
    dual[:3, :3] -= np.outer(center, center)
    dual[:3, 3] = dual[3, :3] = -center
    dual[3, 3] = -1.0
    return dual


def _plain_outline(pose: NDArray[np.float64], dual: NDArray[np.float64]
                   ) -> NDArray[np.float64] | None:
    """Return the dual conic of a landmark; None if it is not completely in front of the camera."""
    conic = pose @ dual @ pose.T
    if pose[2] @ dual[3] >= 0.0 or conic[2, 2] >= 0.0:
        return None
    return np.asarray(conic / conic[2, 2])


def _plain_iou(box: NDArray[np.float64], conic: NDArray[np.float64] | None) -> float:
    """Return the IoU of a box's ellipse and an outline from the lengths of vertical chords."""
    if conic is None:
        return float('nan')
    cx, cy = conic[0, 2], conic[1, 2]
    exx, exy, eyy = cx * cx - conic[0, 0], cx * cy - conic[0, 1], cy * cy - conic[1, 1]
    low, high = max(box[0] - box[2], cx - np.sqrt(exx)), min(box[0] + box[2], cx + np.sqrt(exx))
    if low >= high:
        return 0.0
    angles = (np.arange(_CHORDS) + 0.5) / _CHORDS * np.pi
    x = (low + high) / 2 - (high - low) / 2 * np.cos(angles)
    half_a = box[3] * np.sqrt(np.maximum(0.0, 1 - ((x - box[0]) / box[2])**2))
    middle = cy + exy / exx * (x - cx)
    half_b = np.sqrt(np.maximum(0.0, (eyy - exy * exy / exx) * (1 - (x - cx)**2 / exx)))
    chords = np.minimum(box[1] + half_a, middle + half_b) - np.maximum(box[1] - half_a,
                                                                       middle - half_b)
    shared = float((np.maximum(0.0, chords) * np.sin(angles)).sum()) * (
        (high - low) / 2 * np.pi / _CHORDS)
    area = np.pi * (box[2] * box[3] + np.sqrt(exx * eyy - exy * exy))
    return float(shared / (area - shared))


def storey(count: int) -> tuple[LandmarkMap, Observation]:
    """Return a map with one landmark per four square metres, and a frame of up to twelve boxes."""
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
    rows, first_us = [], None
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
        # samples of CLIP's candidates, whose mixture does not depend on the map's size
        samples = draw_ransac(scene.pairs[:min(len(scene.pairs), _K * _CROPS)], 4_000,
                              np.random.default_rng(0))
        samples = samples[samples[:, 0] >= 0]
        frame_ms = 1e3 * least_s(partial(_frame, landmark_map, observation, scene), 5)
        sample_us = 1e6 / len(samples) * least_s(partial(_search, scene, samples), 5)
        relocalizer = Relocalizer(landmark_map, RelocalizerOptions())
        relocalizer.warm_up()
        request_ms = 1e3 * least_s(partial(relocalizer.relocalize, [observation]), 5)
        first_us = first_us or sample_us
        peak = re.search(r'VmHWM:\s+(\d+) kB', Path('/proc/self/status').read_text())
        rows.append([f'{count:,d}', f'{knn_ms:.1f}',
                     f'{similarities.labels.unique.nbytes / 1e6:.0f}', f'{sort_s:.2f}',
                     f'{sorted_mb:.1f}', f'{frame_ms:.2f}', f'{sample_us:.2f}',
                     f'{sample_us / first_us:.2f}', f'{request_ms:.1f}',
                     f'{int(peak[1]) * 1.024e-3:.0f}' if peak else ''])
    print(f'maps, {_CROPS} crops of {_DIMENSIONS} numbers, all labels different:\n' + table(
        ['landmarks', 'k-NN [ms]', 'labels [MB]', 'sorting [s]', 'sorted map [MB]', 'frame [ms]',
         'a sample [us]', 'ratio', 'request [ms]', 'process [MB]'], rows), flush=True)


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
    drain(strategies.search_samples(scene, samples, Leaders.none_yet()))


def drain(search: Iterator[Progress]) -> int:
    """Run a search to its end; return the number of hypotheses tried."""
    tried = 0
    for progress in search:
        tried = progress.tried
    return tried


def _units(rng: np.random.Generator, count: int) -> NDArray[np.float32]:
    rows = rng.standard_normal((count, _DIMENSIONS), dtype=np.float32)
    rows /= np.sqrt(np.einsum('ij,ij->i', rows, rows))[:, None]
    return rows


def least_s(run: Callable[[], object], repetitions: int = 20) -> float:
    """Return the least time of several runs [s], which other programs disturbed least."""
    least = inf
    for _ in range(repetitions):
        start = time.perf_counter()
        run()
        least = min(least, time.perf_counter() - start)
    return least
