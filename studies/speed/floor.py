# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Time and memory of mapping a simulated floor: build_map, evaluate and check_map.

Usage: python -m studies.speed floor --objects 5000 --frames 36000 --out DIR

Each step runs in a process of its own, so that its peak memory is its own.
"""

import argparse
import json
import multiprocessing
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.map_file import write_map
from cliploc_ros.offline.datasets.observations import load_observations, save_observations
from cliploc_ros.offline.datasets.queries import Queries, QueryFrame, save_queries
from cliploc_ros.offline.mapping.building import build_map
from cliploc_ros.offline.mapping.labelling import embed_landmarks
from cliploc_ros.offline.mapping.options import MappingOptions, PoseErrors
from studies.speed.floors import (
    CAMERA,
    Floor,
    SeenFloor,
    compare_maps,
    make_floor,
    see_floor,
)
from studies.speed.pose_errors import disturb, draw_errors

# Similarities of crops and labels: of any, of the same class, of the object itself. Guesses that
# give a top-1 of about one half.
_SIMILARITY, _SAME_CLASS, _ITSELF, _DEVIATION = 0.2, 0.03, 0.05, 0.02
_LEAST_BOXES = 5


class Measured(NamedTuple):
    """What a step returned, and what it took, its workers included."""

    result: Any
    wall_s: float
    processor_s: float
    peak_mb: float


def run(arguments: Sequence[str]) -> int:
    """Run the benchmark; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--objects', type=int, default=5000, help='(%(default)s)')
    parser.add_argument('--frames', type=int, default=36000, help='at 10 Hz (%(default)s)')
    parser.add_argument('--embeddings', type=int, default=0, metavar='N',
                        help='numbers of the embedding of each crop; 0: none (%(default)s)')
    parser.add_argument('--pose-noise', type=float, nargs=2, default=(0.0, 0.0),
                        metavar=('METRES', 'DEGREES'), help='errors of the poses on each axis, '
                        'correlated over 3 s (0 0)')
    parser.add_argument('--queries', type=int, default=100, help='of evaluate (%(default)s)')
    parser.add_argument('--workers', type=int, default=2, help='of evaluate (%(default)s)')
    parser.add_argument('--check', action='store_true', help='also run check_map: minutes')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--out', type=Path, required=True, metavar='DIR')
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    print(f'{options.objects} objects, {options.frames} frames; simulated', flush=True)
    show('simulate', measure(simulate, options))
    built = measure(build, options.out, MappingOptions(estimate_pose_errors=True))
    show('build_map', built)
    for stage, seconds in built.result.items():
        print(f'    {stage:22} {seconds:8.1f} s of processor time')
    found = measure(compare, options)
    show('compare', found)
    print(f'    {found.result}')
    evaluated = measure(evaluate, options.out, options.workers)
    show('evaluate', evaluated)
    print(f'    {evaluated.result}')
    if options.check:
        show('check_map', measure(check, options.out))
    return 0


def measure(step: Callable[..., Any], *arguments: Any) -> Measured:
    """Run a step in a process of its own."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context('spawn')) as pool:
        return pool.submit(_measured, step, arguments).result()


def _measured(step: Callable[..., Any], arguments: tuple[Any, ...]) -> Measured:
    wall, processor = time.perf_counter(), sum(os.times()[:4])
    result = step(*arguments)
    # that of the process itself, or of the largest of its workers
    peak_kb = max(resource.getrusage(who).ru_maxrss
                  for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return Measured(result, time.perf_counter() - wall, sum(os.times()[:4]) - processor,
                    peak_kb * 1024 / 1e6)


def show(name: str, measured: Measured) -> None:
    """Print what a step took."""
    print(f'{name:12} {measured.wall_s:8.1f} s, {measured.processor_s:8.1f} s of processor time, '
          f'peak {measured.peak_mb:6.0f} MB', flush=True)


def simulate(options: argparse.Namespace) -> None:
    """Write the observations of a way through a floor."""
    seen = _seen(options, options.seed).detections
    if any(options.pose_noise):
        seen = disturb(seen, draw_errors('correlated', seen.stamps_s,
                                         PoseErrors(*options.pose_noise),
                                         np.random.default_rng(options.seed)))
    if options.embeddings:
        seen = replace(seen, embeddings=_embeddings(len(seen.classes), options.embeddings),
                       encoder_key='simulated')
    save_observations(options.out / 'observations.npz', seen)


def _seen(options: argparse.Namespace, seed: int) -> SeenFloor:
    return see_floor(_floor(options), options.frames, seed)


def _floor(options: argparse.Namespace) -> Floor:
    return make_floor(options.objects, options.seed)


def _embeddings(rows: int, size: int) -> NDArray[np.float16]:
    """Return random unit rows: they cost what true ones cost."""
    rng, found = np.random.default_rng(0), np.empty((rows, size), dtype=np.float16)
    for first in range(0, rows, 10_000):
        some = rng.standard_normal((min(10_000, rows - first), size), dtype=np.float32)
        found[first:first + len(some)] = some / np.linalg.norm(some, axis=1, keepdims=True)
    return found


def build(folder: Path, options: MappingOptions) -> dict[str, float]:
    """Build the map as build_map does; return the processor time [s] of each stage."""
    begin, stage = time.process_time(), 'reading'
    stages: dict[str, float] = {}

    def tell(name: str, share: float) -> None:
        nonlocal begin, stage
        now = time.process_time()
        stages[stage] = stages.get(stage, 0.0) + now - begin
        begin, stage = now, name

    detections = load_observations(folder / 'observations.npz')
    tell('starting', 0.0)
    built = build_map(detections, options, tell)
    tell('writing', 1.0)
    write_map(folder / 'map.yaml', built.landmark_map, built.report.lines()[:2])
    (folder / 'report.json').write_text(json.dumps(built.report.as_dict()))
    if detections.embeddings is not None:
        tell('choosing embeddings', 1.0)
        embed_landmarks(built.landmark_map.landmark_ids, detections, built.shown)
    tell('end', 1.0)
    return stages


def compare(options: argparse.Namespace) -> str:
    """Write queries to the built map; return how it compares with the truth."""
    floor, built = _floor(options), LandmarkMap.from_file(options.out / 'map.yaml')
    against = compare_maps(built, _seen(options, options.seed), floor)
    _write_queries(options, floor, built)
    errors = 100.0 * against.center_errors_m
    return (f'{against.visible} objects shown by 10 frames or more: {against.found} found, '
            f'{against.missed} missed; {against.false} false; centre error median '
            f'{np.median(errors):.1f} cm, 90 % {np.percentile(errors, 90):.1f} cm')


def _write_queries(options: argparse.Namespace, floor: Floor, built: LandmarkMap) -> None:
    """Write queries on the same way, with other boxes and simulated similarities."""
    rng, seen = np.random.default_rng(1), _seen(options, options.seed + 1)
    detections, true = seen.detections, seen.true_landmarks
    distances, nearest = cKDTree(built.centers).query(floor.landmark_map.centers)
    names = np.array(built.class_ids)
    same = (names[nearest] == np.array(floor.landmark_map.class_ids)) & (distances < 0.3)
    counts = np.diff(detections.frame_offsets)
    usable = np.nonzero(counts >= _LEAST_BOXES)[0]
    frames: list[QueryFrame] = []
    for number in usable[np.linspace(0, len(usable) - 1, options.queries).astype(int)]:
        rows = slice(*detections.frame_offsets[number:number + 2])
        classes = np.array(detections.class_names)[detections.classes[rows]]
        similarities = rng.normal(_SIMILARITY, _DEVIATION, (len(classes), len(names)))
        similarities += _SAME_CLASS * (classes[:, None] == names)
        known = (true[rows] >= 0) & same[true[rows]]
        shown = np.where(known, nearest[true[rows]], -1)
        similarities[known, shown[known]] += _ITSELF
        frames.append(QueryFrame(
            stamp_ns=round(detections.stamps_s[number] * 1e9), similarities=similarities,
            bboxes_xyxy=detections.bboxes_xyxy[rows], class_ids=tuple(classes.tolist()),
            scores=detections.scores[rows], true_landmark=shown, group=len(frames),
            map_from_camera=detections.map_from_camera[number], is_main=True))
    save_queries(options.out / 'queries.npz', Queries(
        built.landmark_ids, (CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy), tuple(frames)))


def evaluate(folder: Path, workers: int) -> str:
    """Run evaluate; return its results in a line."""
    _run('evaluate', folder / 'evaluate.log', '--queries', folder / 'queries.npz', '--map',
         folder / 'map.yaml', '--methods', 'auto', '--trials', 1, '--no-figures', '--workers',
         workers, '--out', folder)
    results = json.loads((folder / 'results.json').read_text())
    right = [one['solved'] and one['error_m'] <= 1.0 for one in results]
    accepted = [one['accepted'] for one in results]
    false = sum(taken and not good for taken, good in zip(accepted, right, strict=True))
    return (f'{len(results)} queries, {sum(right)} within 1 m, {sum(accepted)} accepted, {false} '
            f'false; search median {np.median([one["search_ms"] for one in results]):.0f} ms')


def check(folder: Path) -> None:
    """Run check_map."""
    _run('check_map', folder / 'check_map.log', folder / 'map.yaml', '--observations',
         folder / 'observations.npz', '--out', folder / 'check')


def _run(executable: str, log: Path, *arguments: object) -> None:
    with log.open('w') as file:  # check_map ends with 1 if the map misses a threshold
        subprocess.call([sys.executable, '-m', f'cliploc_ros.cli.{executable}',
                         *map(str, arguments)], stdout=file)
