# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Measure layers of many keyframes: ``python -m studies.speed growth FOLDER...``.

A layer is built from the images of the folders, except every 12th, which is asked. It is then
extended by **synthetic keyframes**: points of two real keyframes, with their descriptors mirrored
and disturbed, far away from the rooms. They look like images of other rooms, and match no query.
Each layer is loaded and asked in a process of its own. A robot's request also has objects: the map
has one **simulated** landmark for four keyframes, in front of these. Its time contains features of
the image, and no detector and CLIP.
"""

import os

# As in the nodes. NumPy reads it when it is imported.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import argparse
import multiprocessing
import re
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.command import positive_int
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.keyframes.features import Features
from cliploc_ros.core.keyframes.layer import KeyframeLayer, load_layer_of_map, save_layer
from cliploc_ros.core.keyframes.localization import (
    ImageFeatures,
    ImageRecognizer,
    KeyframeLocalizer,
    query_features,
)
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.offline.recording.keyframe_layer import (
    LayerOptions,
    PosedFeatures,
    build_layer,
    neighbours_of,
)
from cliploc_ros.offline.recording.layer_words import with_words
from cliploc_ros.offline.simulation import LabelModel, guess_detector
from studies.reports import table
from studies.rooms.rooms import open_folder

_ASKED, _APART_M, _NEAR_M = 12, 1000.0, 0.25
# Keyframes for each landmark, distances of landmarks from keyframes of the rooms, and classes.
_PER_LANDMARK, _DISTANCES_M, _CLASSES = 4, (1.0, 4.0), 80
# Numbers of keyframes; extent of the synthetic building, and noise of its descriptors, in bytes.
_SIZES = (200, 300, 1000, 3000, 10_000, 20_000)
_EXTENT_M, _NOISE = (400.0, 400.0, 20.0), 8.0
# Index of each entry of a SIFT descriptor in that of the mirrored image: 4 rows and 4 columns of
# cells with 8 directions.
_MIRROR = np.arange(128).reshape(4, 4, 8)[:, ::-1][:, :, -np.arange(8) % 8].ravel()


class _Asked(NamedTuple):
    """A query: its image, its features for both passes, its camera, and its true pose."""

    image_rgb: NDArray[np.uint8]
    fast: Features
    thorough: Features
    camera: Camera
    map_from_camera: NDArray[np.float64]


def run(arguments: Sequence[str]) -> int:
    """Print the table; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('folders', nargs='+', metavar='DIR[@METRES]')
    parser.add_argument('--keyframes', nargs='+', type=positive_int, default=_SIZES, metavar='N',
                        help=f'({" ".join(map(str, _SIZES))})')
    parser.add_argument('--workers', type=positive_int, default=1, metavar='N')
    options = parser.parse_args(arguments)
    real, asked = _read(options.folders, options.workers)
    rows = []
    with tempfile.TemporaryDirectory(prefix='cliploc_ros_growth_') as folder:
        for count in options.keyframes:
            layer = _grown(real, count)
            grown_s = time.process_time()
            neighbours_of([PosedFeatures(pose, np.empty((0, 2)), np.empty((0, 128), np.uint8))
                           for pose in layer.map_from_camera])
            near_s = time.process_time()
            path = Path(folder, f'{count}.keyframes.npz')
            save_layer(path, with_words(layer))
            words_s = time.process_time()
            with multiprocessing.get_context('spawn').Pool(1) as pool:
                rows.append([f'{len(layer):,d}', f'{near_s - grown_s:.1f}',
                             f'{words_s - near_s:.0f}', f'{path.stat().st_size / 1e6:.0f}',
                             *pool.apply(_measure, (path, asked))])
            print(*rows[-1], flush=True)
    print(f'{len(asked)} queries; processor time of one core:\n' + table(
        ['keyframes', 'neighbours [s]', 'words, file [s]', 'file [MB]', 'load [s]',
         'memory [MB]', 'after queries [MB]', 'a fold of the check [s]', 'fast pass [ms]',
         f'within {_NEAR_M} m', 'both passes [ms]', f'within {_NEAR_M} m', 'landmarks',
         'request [ms]', f'within {_NEAR_M} m', 'accepted'], rows), flush=True)
    return 0


def _read(folders: Sequence[str], workers: int) -> tuple[list[KeyframeLayer], list[_Asked]]:
    """Build a layer of each folder, and return the queries; the rooms are far apart."""
    layers, asked = [], []
    for number, where in enumerate(folders):
        _, frames, _ = open_folder(where)
        places = range(frames.count)
        begin, shift = time.perf_counter(), np.array([number * _APART_M, 0.0, 0.0])
        layer = build_layer(frames.select([row for row in places if row % _ASKED]),
                            LandmarkMap.empty('map'), LayerOptions(workers=workers)).plain()
        print(f'{where}: {(time.perf_counter() - begin) / len(layer):.2f} s a keyframe to build '
              f'{len(layer)} keyframes, {workers} workers', flush=True)
        layer.map_from_camera[:, :3, 3] += shift
        layers.append(layer)
        for frame in frames.select(places[::_ASKED]).read():
            if frame.map_from_camera is not None:
                pose = frame.map_from_camera.copy()
                pose[:3, 3] += shift
                asked.append(_Asked(
                    frame.image_rgb, query_features(frame.image_rgb),
                    query_features(frame.image_rgb, is_thorough=True), frame.camera, pose))
    return layers, asked


def _grown(real: Sequence[KeyframeLayer], count: int) -> KeyframeLayer:
    """Return `count` keyframes of the real layers, of all parts, extended by synthetic ones."""
    rng = np.random.default_rng(0)
    parts = list(_columns(real, rng, count))
    poses, rows, pixels, points, descriptors = zip(*parts, strict=True)
    return replace(
        real[0], map_from_camera=np.array(poses), offsets=np.cumsum([0, *rows]),
        pixels=np.concatenate(pixels), points=np.concatenate(points),
        descriptors=np.concatenate(descriptors), words=np.zeros(sum(rows), np.uint16),
        deviation_per_metre=0.1, camera_rows=None)


def _columns(real: Sequence[KeyframeLayer], rng: np.random.Generator, count: int
             ) -> Iterator[tuple[NDArray[np.float64], int, NDArray[np.uint16],
                                 NDArray[np.floating], NDArray[np.uint8]]]:
    """Yield pose, number of points, pixels, points and descriptors of each keyframe."""
    own = [(layer, row) for layer in real for row in range(len(layer))]
    own = [own[place] for place in np.arange(min(count, len(own))) * len(own) // min(
        count, len(own))]
    for layer, row in own:
        rows = layer.rows(row)
        yield (layer.map_from_camera[row], rows.stop - rows.start, layer.pixels[rows],
               layer.points[rows], layer.descriptors[rows])
    for number in range(len(own), count):
        layer = real[number % len(real)]
        first, second = rng.integers(len(layer), size=2)
        chosen = np.sort(np.concatenate([rng.permutation(np.arange(rows.start, rows.stop))[::2]
                                         for rows in map(layer.rows, (first, second))]))
        pose = layer.map_from_camera[first].copy()
        pose[:3, 3] = rng.uniform(0.0, _EXTENT_M) - (0.0, _APART_M, 0.0)
        mirrored = layer.descriptors[chosen][:, _MIRROR]
        noisy = mirrored + rng.normal(0.0, _NOISE, mirrored.shape) * (mirrored > 0)
        yield (pose, len(chosen), layer.pixels[chosen], layer.points[chosen],
               np.clip(np.round(noisy), 0, 255).astype(np.uint8))


def _measure(path: Path, asked: Sequence[_Asked]) -> list[str]:
    """Return the columns of load, check and requests."""
    cv2.setNumThreads(1)
    before_mb, begin = _resident_mb(), time.process_time()
    layer = load_layer_of_map(path, LandmarkMap.empty('map'))
    localizer = KeyframeLocalizer(layer)
    load_s, loaded_mb = time.process_time() - begin, _resident_mb()
    errors_m, times_s = [], []
    for query in asked:
        start = time.process_time()
        fast = localizer.localize_features(query.fast, query.camera)
        middle = time.process_time()
        both = localizer.localize_features(query.thorough, query.camera, fast=fast)
        times_s.append((middle - start, time.process_time() - start))
        errors_m.append([pose_error(seen.places[0].map_from_camera, query.map_from_camera)[0]
                         if seen.places else np.inf for seen in (fast, both)])
    asked_mb = _resident_mb()
    fold = time.process_time()
    KeyframeLocalizer(layer.view(np.arange(len(layer)) % 5 > 0))
    fold_s = time.process_time() - fold
    requests = [cell for passes in (0, 1) for cell in (
        f'{1e3 * np.median([taken[passes] for taken in times_s]):.0f}',
        f'{np.mean([error[passes] < _NEAR_M for error in errors_m]):.2f}')]
    return [f'{load_s:.1f}', f'{loaded_mb - before_mb:.0f}', f'{asked_mb - before_mb:.0f}',
            f'{fold_s:.1f}', *requests, *_ask_robot(localizer, asked)]


def _ask_robot(localizer: KeyframeLocalizer, asked: Sequence[_Asked]) -> list[str]:
    """Return the columns of a robot's request: by objects and keyframes."""
    rng = np.random.default_rng(0)
    landmark_map = _simulated(localizer.layer.map_from_camera, rng)
    detector, labels = guess_detector(landmark_map), LabelModel.of(landmark_map)
    times_s, errors_m, accepted = [], [], 0
    for query in asked:
        found, shown = replace(detector, camera=query.camera.pinhole).detect(
            query.map_from_camera, rng)
        observation = Observation(query.camera, found, labels.similarities(
            shown, found.class_ids, found.bboxes_xyxy, rng))
        relocalizer, begin = Relocalizer(landmark_map, RelocalizerOptions()), time.process_time()
        answer = relocalizer.relocalize([observation], ImageRecognizer(localizer, ImageFeatures(
            partial(np.asarray, query.image_rgb), query.camera)))
        times_s.append(time.process_time() - begin)
        accepted += answer.accepted
        errors_m.append(np.inf if answer.map_from_camera is None else pose_error(
            answer.map_from_camera, query.map_from_camera)[0])
    return [f'{len(landmark_map):,d}', f'{1e3 * np.median(times_s):.0f}',
            f'{np.mean(np.array(errors_m) < _NEAR_M):.2f}', f'{accepted}']


def _simulated(poses: NDArray[np.float64], rng: np.random.Generator) -> LandmarkMap:
    """Return landmarks in front of keyframes, evenly chosen: objects of random classes."""
    poses = poses[::_PER_LANDMARK]
    bearings = np.column_stack([rng.uniform(-0.5, 0.5, (len(poses), 2)), np.ones(len(poses))])
    inside = bearings * rng.uniform(*_DISTANCES_M, (len(poses), 1))
    classes = rng.integers(_CLASSES, size=len(poses)).tolist()
    names = [f'object {row}' for row in range(len(poses))]
    return LandmarkMap('map', tuple(names), tuple(
        f'thing {kind} of {name}' for kind, name in zip(classes, names, strict=True)),
        tuple(f'class {kind}' for kind in classes),
        np.einsum('kij,kj->ki', poses[:, :3, :3], inside) + poses[:, :3, 3],
        rng.uniform(0.1, 0.5, (len(poses), 3)), np.tile([0.0, 0.0, 0.0, 1.0], (len(poses), 1)))


def _resident_mb() -> float:
    resident = re.search(r'VmRSS:\s+(\d+) kB', Path('/proc/self/status').read_text())
    return int(resident[1]) * 1.024e-3 if resident else 0.0
