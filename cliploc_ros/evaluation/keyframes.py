# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Landmarks, keyframes and both on real images: ``python -m cliploc_ros.evaluation.keyframes``.

Maps and layers are made of one part of an RGB-D recording; the images of the other part are
queries, as they are and changed. Then come queries that must not be accepted: images of other
rooms, images with a large poster of another place, and a second room that looks the same. What is
changed is simulated; images, depth, poses and boxes are real. By classes alone, without CLIP.
"""

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

from cliploc_ros.command import positive_int, run_command
from cliploc_ros.core.keyframes.layer_file import save_layer
from cliploc_ros.core.keyframes.localization import KeyframeLocalizer
from cliploc_ros.core.maps.landmark_map import LandmarkMap
from cliploc_ros.core.maps.map_file import write_map
from cliploc_ros.datasets.folders import FolderOptions, rgbd_frames, tum_frames
from cliploc_ros.datasets.frames import Frame, Frames
from cliploc_ros.datasets.intrinsics import find_camera
from cliploc_ros.datasets.tum import read_tum
from cliploc_ros.evaluation.keyframe_study.asking import Place, Query, Row, query_of, table
from cliploc_ros.evaluation.keyframe_study.baseline import Baseline
from cliploc_ros.evaluation.keyframe_study.changes import (
    IMAGE_CHANGES,
    ImageChange,
    elsewhere,
    put_poster,
    twin_layer,
    twin_map,
)
from cliploc_ros.evaluation.keyframe_study.reliability import false_accepts, reliability
from cliploc_ros.evaluation.output import make_folder, write_text
from cliploc_ros.mapping.building import build_map
from cliploc_ros.mapping.options import MappingOptions
from cliploc_ros.mapping.posed_detections import PosedDetections
from cliploc_ros.models.protocols import ObjectDetector
from cliploc_ros.models.yolo_detector import YoloDetector
from cliploc_ros.models.yolo_weights import YoloOptions
from cliploc_ros.recording.keyframe_layer import LayerOptions, build_layer
from cliploc_ros.recording.networks import Look
from cliploc_ros.recording.recorder import record_every_frame

_POSTER_SHARES = (0.3, 0.6)
_MOVED_SHARE, _MOVED_M = 0.3, 0.5
_TWIN_LACKS = 3
# Parts of the study that can run alone: those that map a part of the images, and the changes.
_PARTS = {'interleaved': 'interleaved', 'first': 'first half to second',
          'second': 'second half to first', 'changed': 'changed'}


class Study:
    """A recording, its detections, and the queries of each case."""

    def __init__(self, frames: Frames, detector: ObjectDetector, seed: int) -> None:
        self._frames = frames
        self._detector = detector
        self._seed = seed
        self.images = list(frames.read())
        self.recorded: PosedDetections = record_every_frame(frames, Look(detector)).detections

    def place(self, rows: Sequence[int], out: Path, options: LayerOptions) -> Place:
        """Return what is built of some images, and write it."""
        built = build_map(self.recorded.select_frames(rows), MappingOptions()).landmark_map
        layer = build_layer(self._frames.select(rows), built, options)
        name = out.name.partition('.')[0]
        write_map(out.with_name(f'{name}.yaml'), built, ['study of keyframes'], None)
        save_layer(out, layer)
        baseline = Baseline([self.images[row] for row in rows])
        print(f'{name}: {len(built)} landmarks, {len(layer)} keyframes, '
              f'{out.stat().st_size / 1e6:.1f} MB; baseline {baseline.megabytes:.1f} MB',
              flush=True)
        return Place(built, KeyframeLocalizer(layer), baseline)

    def queries(self, rows: Sequence[int], change: ImageChange | None = None) -> Iterator[Query]:
        """Yield images as queries, changed or not."""
        rng = np.random.default_rng(self._seed)
        for row in rows:
            frame = self.images[row]
            image = frame.image_rgb if change is None else change(frame.image_rgb, rng)
            yield self.query(replace(frame, image_rgb=image))

    def posters(self, rows: Sequence[int], mapped: Sequence[int], share: float
                ) -> Iterator[Query]:
        """Yield queries with a large poster: a part of a mapped image of another place."""
        rng = np.random.default_rng(self._seed)
        for row in rows:
            frame = self.images[row]
            other = elsewhere(frame, [self.images[one] for one in mapped], rng)
            yield self.query(replace(frame, image_rgb=put_poster(
                frame.image_rgb, other.image_rgb, share)))

    def query(self, frame: Frame, is_here: bool = True) -> Query:
        """Return an image with its detections."""
        return query_of(frame, self._detector, is_here)


def _with_moved_objects(landmark_map: LandmarkMap, seed: int) -> LandmarkMap:
    """Return a map in which a share of the objects was elsewhere: the world has changed since."""
    rng = np.random.default_rng(seed)
    steps = rng.normal(size=landmark_map.centers.shape)
    steps *= _MOVED_M / np.linalg.norm(steps, axis=1, keepdims=True)
    steps[rng.random(len(steps)) >= _MOVED_SHARE] = 0.0
    return replace(landmark_map, centers=landmark_map.centers + steps)


def _ask(place: Place, case: str, queries: Iterator[Query]) -> list[Row]:
    rows = [place.ask(case, number, query)
            for number, query in enumerate(tqdm(queries, case, disable=None))]
    print('\n'.join(table(rows)[1:]), flush=True)
    return rows


def _cases(study: Study, place: Place, mapped: Sequence[int], asked: Sequence[int],
           others: Sequence[Path], every: int, seed: int) -> Iterator[list[Row]]:
    """Yield the results of the changed images and of those that must not be accepted."""
    for name, change in IMAGE_CHANGES.items():
        yield _ask(place, name, study.queries(asked, change))
    moved = Place(_with_moved_objects(place.landmark_map, seed), place.keyframes)
    yield _ask(moved, f'{_MOVED_SHARE:.0%} of objects moved', study.queries(asked))
    for share in _POSTER_SHARES:
        yield _ask(place, f'poster, {share:.0%} of image', study.posters(asked, mapped, share))
    twins = Place(twin_map(place.landmark_map, _TWIN_LACKS, np.random.default_rng(seed)),
                  KeyframeLocalizer(twin_layer(place.keyframes.layer)))
    yield _ask(twins, 'two identical rooms', study.queries(asked))
    for folder in others:
        frames = tum_frames(read_tum(folder), find_camera(None, folder)[0])
        yield _ask(place, f'other room {folder.name}',
                   (study.query(one, is_here=False) for one in islice(frames.read(), None, None,
                                                                     every)))


def run(arguments: list[str]) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog='keyframes', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--rgbd', type=Path, required=True, metavar='DIR')
    parser.add_argument('--model', required=True, help='weights of YOLO')
    parser.add_argument('--other', type=Path, nargs='*', default=[], metavar='DIR',
                        help='TUM folders of other rooms')
    parser.add_argument('--out', type=Path, default=Path('keyframes'), metavar='DIR')
    parser.add_argument('--choose', type=float, nargs=2, default=(0.0, 0.0),
                        metavar=('METRES', 'DEGREES'), help='distance of keyframes (0 0: all)')
    parser.add_argument('--every', type=positive_int, default=1, metavar='N',
                        help='change each N-th query only (%(default)s)')
    parser.add_argument('--parts', nargs='+', choices=_PARTS, default=list(_PARTS),
                        help='which parts to run (all)')
    parser.add_argument('--seed', type=int, default=0)
    options = parser.parse_args(arguments)
    cv2.setNumThreads(1)
    make_folder(options.out)
    study = Study(rgbd_frames(options.rgbd, FolderOptions()),
                  YoloDetector(YoloOptions(options.model, conf=0.25)), options.seed)
    rows: list[Row] = []
    for name in options.parts:
        for found in _part(study, name, options):
            rows += found
            _write(options.out, rows)
    print('\n'.join([*table(rows), '', *false_accepts(rows), '', *reliability(rows)]))
    return 0


def _part(study: Study, name: str, options: argparse.Namespace) -> Iterator[list[Row]]:
    """Yield the results of a split, or of the changed images and other rooms."""
    count = len(study.images)
    half = count // 2
    interleaved = range(0, count, 2), range(1, count, 2)
    mapped, asked = {'first': (range(half), range(half, count)),
                     'second': (range(half, count), range(half))}.get(name, interleaved)
    place = study.place(mapped, options.out / f'{name}.keyframes.npz',
                        LayerOptions(*options.choose))
    if name == 'changed':
        yield from _cases(study, place, mapped, asked[::options.every], options.other,
                          options.every, options.seed)
    else:
        yield _ask(place, _PARTS[name], study.queries(asked))


def _write(folder: Path, rows: Sequence[Row]) -> None:
    write_text(folder / 'results.json', json.dumps([row.as_dict() for row in rows], indent=1))


def main() -> int:
    """Run from the command line; return the exit code."""
    return run_command(lambda: run(sys.argv[1:]))


if __name__ == '__main__':
    sys.exit(main())
