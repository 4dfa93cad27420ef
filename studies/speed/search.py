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
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.ellipsoid import ellipse_bboxes, project_ellipsoids, shape_matrices
from cliploc_ros.core.kernels.compiled import compiled
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.search.frame_search import (
    balanced_order,
    class_candidates,
    joined,
    nearest_candidates,
)
from cliploc_ros.core.search.scene import Scene, make_scene
from cliploc_ros.core.search.screening import make_hypothesis, set_up, verify_beyond
from cliploc_ros.core.search.strategies import (
    Leaders,
    Progress,
    compatible_pairs,
    draw_ransac,
    search_exhaustively,
    search_progressively,
    search_samples,
)
from studies.speed.maps import drain, least_s, measure_first_request, measure_maps

_PLAIN_HYPOTHESES = 100
_CHORDS = 32
_K, _IOU_THRESHOLD = 3, 0.2


def run(arguments: Sequence[str]) -> int:
    """Measure and print; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--queries', type=Path, metavar='NPZ', help='recorded frames')
    parser.add_argument('--map', type=Path, metavar='YAML', help='their map')
    parser.add_argument('--landmarks', type=int, nargs='*', default=(100, 100_000, 1_000_000),
                        metavar='N', help='sizes of the maps (%(default)s); 1,000,000 take 6 GB')
    options = parser.parse_args(arguments)
    if (options.queries is None) != (options.map is None):
        parser.error('--queries and --map belong together')
    measure_first_request()
    _measure_hypotheses(synthetic_scene())
    measure_maps(options.landmarks)
    if options.queries is not None:
        for matching in ('hybrid', 'class'):
            scenes = query_scenes(options.queries, options.map, matching)
            _measure_whole(f'{matching}, every sample', scenes, search_exhaustively)
            _measure_whole(f'{matching}, every compatible sample', scenes, _compatible)
    return 0


def synthetic_scene() -> Scene:
    """Return twelve boxes, each with five landmarks of its class, one of them true: 60 pairs."""
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


def query_scenes(queries: Path, map_file: Path, matching: str) -> list[Scene]:
    """Return the scenes of a file's queries, with candidates as the paper has them.

    Parameters
    ----------
    matching : str
        'hybrid' or 'class'.
    """
    from cliploc_ros.offline.datasets.queries import (
        load_queries,  # core needs no data sets otherwise
    )

    landmark_map = LandmarkMap.from_file(map_file)
    recorded = load_queries(queries, landmark_map.landmark_ids)
    camera = Camera(640, 480, *recorded.intrinsics_fx_fy_cx_cy)
    scenes = []
    for frame in recorded.main_frames():
        index = landmark_map.classes
        candidates = potential = class_candidates(index, index.classes_of(frame.class_ids))
        if matching == 'hybrid':
            candidates = balanced_order(
                nearest_candidates(frame.similarities.astype(np.float32), _K))
            potential = joined(candidates, potential, len(landmark_map))
        scenes.append(make_scene(camera.normalize_bboxes(frame.bboxes_xyxy),
                                 landmark_map.centers, landmark_map.shapes, potential.pairs,
                                 candidates.pairs, _IOU_THRESHOLD))
    return scenes


def _measure_hypotheses(scene: Scene) -> None:
    samples = draw_ransac(scene.pairs, 4_000, np.random.default_rng(0))
    samples = samples[samples[:, 0] >= 0]
    bench = set_up(scene)
    solved = _verify_all(bench, samples)
    whole_us = 1e6 * least_s(lambda: _verify_all(bench, samples))
    searched_us = 1e6 * least_s(lambda: drain(search_samples(scene, samples,
                                                               Leaders.none_yet())))
    five_hundred_ms = 1e3 * least_s(lambda: drain(search_samples(scene, samples[:500],
                                                                   Leaders.none_yet())))
    plain_us, plain_score = _plain(scene, samples[:_PLAIN_HYPOTHESES])
    leaders = Leaders.none_yet()
    drain(search_samples(scene, samples[:_PLAIN_HYPOTHESES], leaders))
    print(f'{len(scene.bearings)} boxes, {len(scene.potential.detections)} pairs, one core:\n'
          f'  {whole_us / solved:7.2f} us a hypothesis, P3P to whole verification\n'
          f'  {searched_us / len(samples):7.2f} us a sample, in a search\n'
          f'  {five_hundred_ms:7.2f} ms for N = 500\n'
          f'  {plain_us:7.0f} us a hypothesis, plain loop over OpenCV and NumPy: '
          f'{plain_us * solved / whole_us:.0f} times as long\n'
          f'  best of {_PLAIN_HYPOTHESES}: score {leaders.scores.max():.4f}, plain '
          f'{plain_score:.4f}')


@compiled
def _verify_all(bench, samples):
    """Make every hypothesis and verify it to the end; return how many there are."""
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
        run = partial(_search_once, search, scene)
        tried.append(run())
        times_ms.append(1e3 * least_s(run, 3))
    print(f'{name}, {len(scenes)} queries: {np.median(times_ms):.1f} ms (median), '
          f'{max(times_ms):.1f} ms (longest); {np.median(tried):.0f} and {max(tried)} '
          f'hypotheses; {1e3 * sum(times_ms) / max(sum(tried), 1):.2f} us each')


def _compatible(scene: Scene, leaders: Leaders) -> Iterator[Progress]:
    yield from search_progressively(scene, compatible_pairs(scene), leaders)


def _search_once(search: Callable[[Scene, Leaders], Iterator[Progress]], scene: Scene) -> int:
    return drain(search(scene, Leaders.none_yet()))


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
    """Return camera_from_map (3, 4): of P3P's poses, the one whose sampled IoUs sum highest."""
    import cv2

    seen = scene.box_ellipses[pairs[:, 0], :2].reshape(3, 1, 2)
    points = scene.centers[pairs[:, 1]].reshape(3, 1, 3)
    _, vectors, translations = cv2.solveP3P(points, seen, np.eye(3), None, cv2.SOLVEPNP_AP3P)
    best, best_total = None, -1.0
    for vector, translation in zip(vectors, translations, strict=True):
        pose = np.concatenate([cv2.Rodrigues(vector)[0], translation], axis=1)
        ious = [_plain_iou(scene.box_ellipses[detection], _plain_outline(pose, duals[landmark]))
                for detection, landmark in pairs]
        if sum(ious) > best_total:  # never true of NaN
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
    """Return the dual conic of a landmark; None if the landmark is not wholly in front."""
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
