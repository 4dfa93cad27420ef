# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Requests that search all floors of a building: success, false accepts, time, memory. Simulated.

Usage: python -m studies.speed building --floors 20 --objects 2000 --queries 200

Each query is seen on one floor. It is searched in the map of this floor alone, on all floors, and
(queries of the first three floors) on all floors but this one, where every accepted pose is wrong.
Embeddings of crops and labels are random vectors that share a part with their class.
"""

import argparse
import resource
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.command import positive_int
from cliploc_ros.core.geometry.transforms import RIGHT_M, pose_error
from cliploc_ros.core.localizer import localize_on_demand
from cliploc_ros.core.map.joined_map import join_maps
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.similarities import CropSimilarities, LabelEmbeddings
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalization, Relocalizer, in_its_map
from studies.speed.floors import CAMERA, SeenFloor, make_floor, see_floor
from studies.worlds.things import CLASS_NAMES

# Shares of class and noise in an embedding of 512 numbers: similarities to a label of the same
# class and to the own label are 1.5 and 4 deviations above the others'. Guesses.
_OF_CLASS, _NOISE = 0.775, 5.6
_SIZE, _LEAST_BOXES = 512, 5
_FRAMES = 400


class Query(NamedTuple):
    """What was seen on a floor, from where, and the embeddings of its crops (n, d)."""

    floor: int
    map_from_camera: NDArray[np.float64]
    observation: Observation
    crops: NDArray[np.float32]
    true_landmarks: NDArray[np.int64]


class Searched(NamedTuple):
    """A map to search, and the embeddings of its labels."""

    relocalizer: Relocalizer
    landmark_map: LandmarkMap
    labels: LabelEmbeddings


def searched(maps: Sequence[LandmarkMap], labels: Sequence[NDArray[np.float32]],
             settings: RelocalizerOptions) -> Searched:
    """Return some maps with their labels (L, d) as one."""
    joined = join_maps(maps, [one.frame_id for one in maps])
    rows = LabelEmbeddings.of(np.concatenate(labels))
    return Searched(Relocalizer(joined, settings), joined,
                    rows.in_parts([len(one) for one in maps]))


def run(arguments: Sequence[str]) -> int:
    """Print success, false accepts, time and memory; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--floors', type=positive_int, default=20, help='(%(default)s)')
    parser.add_argument('--objects', type=positive_int, default=2000,
                        help='of each floor (%(default)s)')
    parser.add_argument('--queries', type=positive_int, default=200, help='(%(default)s)')
    parser.add_argument('--alike', action='store_true',
                        help='all floors have the same objects and labels')
    parser.add_argument('--time-budget-ms', type=float, default=50.0,
                        help='of each search; inf: 10,000 samples end it (%(default)s)')
    options = parser.parse_args(arguments)
    maps, labels, queries = simulate(options)
    settings = RelocalizerOptions(time_budget_s=options.time_budget_ms / 1e3)
    start = time.perf_counter()
    everything = searched(maps, labels, settings)
    print(f'{len(maps)} maps of {options.objects} landmarks{", alike" * options.alike}: joined in '
          f'{time.perf_counter() - start:.2f} s; {len(queries)} queries with '
          f'{np.mean([len(one.crops) for one in queries]):.0f} boxes, top-1 within their floor '
          f'{_top1(labels, queries):.2f}; {options.time_budget_ms:g} ms a search', flush=True)
    everything.relocalizer.warm_up()
    _localize(queries[0], everything)  # the first one touches all memory
    print('searched             right  accepted  false accepts  median ms   95 %  processor ms')
    show('its floor alone', [
        (one, searched(maps[one.floor:one.floor + 1], labels[one.floor:one.floor + 1], settings))
        for one in queries])
    show('all floors', [(one, everything) for one in queries])
    if len(maps) > 2 and not options.alike:
        others = [searched(_without(maps, floor), _without(labels, floor), settings)
                  for floor in range(min(3, len(maps)))]
        show('all but its floor', [(one, others[one.floor]) for one in queries
                                   if one.floor < len(others)])
    print(f'peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB')
    return 0


def _without[T](some: Sequence[T], number: int) -> list[T]:
    return [*some[:number], *some[number + 1:]]


def show(name: str, requests: Sequence[tuple[Query, Searched]]) -> None:
    """Run requests, and print what became of them in a line."""
    right = accepted = false = 0
    wall_ms, processor_ms = [], []
    for query, where in requests:
        wall, processor = time.perf_counter(), time.process_time()
        found = _localize(query, where)
        wall_ms.append(1e3 * (time.perf_counter() - wall))
        processor_ms.append(1e3 * (time.process_time() - processor))
        found, part = in_its_map(found, where.landmark_map)
        is_right = (found.map_from_camera is not None
                    and part.landmark_map.frame_id == f'floor_{query.floor}'
                    and pose_error(found.map_from_camera, query.map_from_camera)[0] <= RIGHT_M)
        right += is_right
        accepted += found.accepted
        false += found.accepted and not is_right
    median, high = np.percentile(wall_ms, [50, 95])
    print(f'{name:18} {right:4} of {len(requests):<4} {accepted:5} {false:14} {median:10.0f} '
          f'{high:6.0f} {np.median(processor_ms):13.0f}', flush=True)


def _localize(query: Query, where: Searched) -> Relocalization:
    return localize_on_demand(where.relocalizer, (), replace(
        query.observation, similarities=CropSimilarities(query.crops, where.labels)))[1]


def simulate(options: argparse.Namespace
             ) -> tuple[list[LandmarkMap], list[NDArray[np.float32]], list[Query]]:
    """Return the floors' maps, the embeddings of their labels, and the queries."""
    rng = np.random.default_rng(0)
    of_classes = dict(zip(CLASS_NAMES, _units(rng, len(CLASS_NAMES)), strict=True))
    maps, labels, queries = [], [], []
    for number in range(options.floors):
        seed = 0 if options.alike else number
        floor = make_floor(options.objects, seed)
        one = replace(floor.landmark_map, frame_id=f'floor_{number}')
        own = _units(np.random.default_rng([1, seed]), len(one))
        maps.append(one)
        labels.append(_unit(own + _OF_CLASS * np.array([of_classes[name]
                                                        for name in one.class_ids])))
        count = len(range(number, options.queries, options.floors))
        queries += _queries(number, see_floor(floor, _FRAMES, 1000 + number), labels[-1], count,
                            rng)
    return maps, labels, queries


def _queries(floor: int, seen: SeenFloor, labels: NDArray[np.float32], count: int,
             rng: np.random.Generator) -> list[Query]:
    """Return some queries on one floor, spread over the way through it."""
    detections, found = seen.detections, []
    usable = np.nonzero(np.diff(detections.frame_offsets) >= _LEAST_BOXES)[0]
    for frame in usable[np.linspace(0, len(usable) - 1, count).astype(int)]:
        rows = slice(*detections.frame_offsets[frame:frame + 2])
        true, pose = seen.true_landmarks[rows], detections.map_from_camera[frame]
        noise = _units(rng, len(true))
        crops = _unit(np.where(true[:, None] >= 0, labels[true], 0.0) + _NOISE * noise)
        found.append(Query(floor, pose, Observation(
            CAMERA, detections.detections_of(frame)), crops, true))
    return found


def _top1(labels: Sequence[NDArray[np.float32]], queries: Sequence[Query]) -> float:
    """Return how often the label most similar to a crop is that of its object."""
    hits = [np.argmax(one.crops @ labels[one.floor].T, axis=1) == one.true_landmarks
            for one in queries]
    known = [one.true_landmarks >= 0 for one in queries]
    return float(np.concatenate(hits)[np.concatenate(known)].mean())


def _units(rng: np.random.Generator, count: int) -> NDArray[np.float32]:
    return _unit(rng.standard_normal((count, _SIZE), dtype=np.float32))


def _unit(rows: NDArray[Any]) -> NDArray[np.float32]:
    return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True), dtype=np.float32)
