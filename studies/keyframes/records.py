# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Collect what objects and keyframes say about each query, without a verdict."""

import hashlib
import pickle
import zlib
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.looks import Looks
from cliploc_ros.core.keyframes import features as feature_module
from cliploc_ros.core.keyframes.features import Features, extract
from cliploc_ros.core.keyframes.localization import KeyframeLocalizer, Recognized
from cliploc_ros.core.maps.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalization import Relocalization
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.core.search.frame_search import SearchedFrame
from cliploc_ros.evaluation.output import make_folder, write_file
from cliploc_ros.models.yolo_detector import YoloDetector
from cliploc_ros.models.yolo_weights import YoloOptions
from cliploc_ros.recording.networks import MAX_DETECTIONS
from studies.keyframes.changes import World
from studies.keyframes.families import Query, Scene, Shot, cases
from studies.keyframes.sites import Place

#: By classes alone: CLIP's weights are no part of this study.
OPTIONS = RelocalizerOptions(matching='class')
_GUESSES = 3
_ALL_ASKED = ('plain: one image',)


class Look(NamedTuple):
    """What is known of one image: the search of its objects, and its keyframes."""

    searched: SearchedFrame
    seen: Recognized | None


@dataclass(frozen=True, eq=False)
class Record:
    """What a verdict about one query needs.

    Parameters
    ----------
    number : int
        Of the query among those of its place.
    looks : tuple of Look
        The oldest first.
    truths : tuple of ndarray (4, 4)
        See Query.
    options : RelocalizerOptions
    """

    number: int
    looks: tuple[Look, ...]
    truths: tuple[NDArray[np.float64], ...]
    options: RelocalizerOptions


@dataclass(frozen=True, eq=False)
class StoredCase:
    """The records of a case at a place."""

    place: str
    name: str
    landmark_map: LandmarkMap
    records: list[Record]
    #: Where the last complete record ends in the file.
    size: int = 0


def locate(landmark_map: LandmarkMap, options: RelocalizerOptions,
           frames: Sequence[SearchedFrame], looks: Looks | None = None) -> Relocalization:
    """Return what searched frames of one robot say by objects."""
    return Relocalizer(landmark_map, options).locate(frames, looks=looks or Looks())


def read_case(path: Path) -> StoredCase | None:
    """Return the records of a file; None without one. What a stopped run left is dropped."""
    if not path.exists():
        return None
    found: list[Any] = []
    size = 0
    with path.open('rb') as file, suppress(EOFError, pickle.UnpicklingError):
        while True:
            found.append(pickle.load(file))
            size = file.tell()
    if not found:
        return None
    place, name, landmark_map = found[0]
    return StoredCase(place, name, landmark_map, found[1:], size)


class Looker:
    """Detector and features, each image once: what was seen lies in a folder."""

    def __init__(self, folder: Path, model: str) -> None:
        self._folder = folder
        self._model = model
        self._detector: YoloDetector | None = None
        self._code = hashlib.sha256(Path(feature_module.__file__).read_bytes()).hexdigest()[:8]

    def detect(self, image_rgb: NDArray[np.uint8]) -> Detections:
        """Return the boxes in an image; as an ObjectDetector."""
        def look() -> tuple[Any, ...]:
            self._detector = self._detector or YoloDetector(YoloOptions(self._model, conf=0.25))
            found = self._detector.detect(image_rgb)
            return found.bboxes_xyxy, found.class_ids, found.scores
        return Detections(*self._kept(image_rgb, Path(self._model).stem, look))

    def features(self, image_rgb: NDArray[np.uint8], most: int) -> Features:
        """Return the features of an image."""
        def look() -> tuple[Any, ...]:
            found = extract(image_rgb, most)
            return found.pixels, found.descriptors, found.strengths
        return Features(*self._kept(image_rgb, f'{most}.{self._code}', look))

    def _kept(self, image_rgb: NDArray[np.uint8], what: str, look: Callable[[], tuple[Any, ...]]
              ) -> tuple[Any, ...]:
        digest = hashlib.sha256(image_rgb.tobytes()).hexdigest()[:24]
        path = self._folder / digest[:2] / f'{digest}.{what}.pickle'
        with suppress(OSError, EOFError, pickle.UnpicklingError):
            return tuple(pickle.loads(path.read_bytes()))
        found = look()
        make_folder(path.parent)
        write_file(path, lambda partial: partial.write_bytes(pickle.dumps(found)))
        return found


@dataclass(frozen=True)
class Collect:
    """Does a task, a case at a place; without a case, the place is built.

    Parameters
    ----------
    out : Path
    places : tuple of Place
    queries : int
        The most of each case but the plain one.
    seed : int
    """

    out: Path
    places: tuple[Place, ...]
    queries: int
    seed: int

    def __call__(self) -> Callable[[tuple[str, str]], int]:
        """Return the function."""
        import torch

        torch.set_num_threads(1)
        cv2.setNumThreads(1)
        places = {one.name: one for one in self.places}
        lookers = {model: Looker(self.out / 'looks', model)
                   for model in {one.model for one in self.places}}
        return lambda task: self._collect(places[task[0]], task[1],
                                          lookers[places[task[0]].model])

    def case_file(self, place: str, case: str) -> Path:
        """Return where the records of a case are."""
        name = ''.join(char if char.isalnum() or char in '.-' else '_' for char in case)
        return self.out / 'cases' / place.replace('/', '.') / f'{name}.pickle'

    def _collect(self, place: Place, name: str, looker: Looker) -> int:
        landmark_map, layer = place.build(self.out / 'places', looker)
        if not name:
            return 0
        case = cases()[name]
        key = [self.seed, zlib.crc32(f'{place.name} {name}'.encode())]
        world = World(landmark_map, layer, np.zeros(3))
        if case.world is not None:
            world = case.world(world, np.random.default_rng(key))
        others = {one.site: one for one in self.places if one.site != place.site}
        scene = Scene(place, world.shift_m, tuple(others.values()))
        path = self.case_file(place.name, name)
        stored = read_case(path)
        make_folder(path.parent)
        if stored is None:
            path.write_bytes(pickle.dumps((place.name, name, world.landmark_map)))
        else:
            with path.open('r+b') as file:
                file.truncate(stored.size)
        done = {one.number: one for one in stored.records} if stored else {}
        # more queries include those of a run with fewer
        order = np.random.default_rng(self.seed).permutation(len(place.asked)).tolist()
        numbers = sorted(order if name in _ALL_ASKED else order[:self.queries])
        localizer = None
        for number in numbers:
            if number in done:
                continue
            query = case.query(scene, place.asked[number], np.random.default_rng([*key, number]))
            if query is None:
                continue
            localizer = localizer or KeyframeLocalizer(world.layer)
            record = _ask(number, query, world.landmark_map, localizer, looker)
            with path.open('ab') as file:
                file.write(pickle.dumps(record))
            done[number] = record
        return len(done)


def _ask(number: int, query: Query, landmark_map: LandmarkMap, localizer: KeyframeLocalizer,
         looker: Looker) -> Record:
    options = OPTIONS if query.height_range_m is None else replace(
        OPTIONS, height_range_m=query.height_range_m)
    relocalizer = Relocalizer(landmark_map, options)
    looks: list[Look] = []
    for row, shot in enumerate(query.shots):
        searched = relocalizer.search(_observed(shot, row, landmark_map, looker))
        found = locate(landmark_map, options, [*(one.searched for one in looks), searched])
        guesses = [one.map_from_camera for one in found.hypotheses[:_GUESSES]]
        looks.append(Look(searched, localizer.localize_features(
            looker.features(shot.image_rgb, shot.most_features), shot.camera, guesses)))
    return Record(number, tuple(looks), query.truths, options)


def _observed(shot: Shot, row: int, landmark_map: LandmarkMap, looker: Looker) -> Observation:
    camera = shot.camera
    boxes = looker.detect(shot.image_rgb).usable(camera.width, camera.height, MAX_DETECTIONS)
    if shot.classes is not None:
        boxes = replace(boxes, class_ids=tuple(
            map(str, shot.classes.choice(landmark_map.class_ids, len(boxes)))))
    return Observation(camera, boxes, stamp_ns=row * 1_000_000_000,
                       up_in_camera=shot.up_in_camera, odom_from_camera=shot.odom_from_camera)
