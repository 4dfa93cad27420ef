# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Collect what objects and keyframes say about each query, without a verdict."""

import hashlib
import pickle
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from cliploc_ros.core.acceptance.looks import Looks
from cliploc_ros.core.keyframes import features
from cliploc_ros.core.keyframes.features import Features
from cliploc_ros.core.keyframes.localization import KeyframeLocalizer, Recognized, query_features
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
from studies.keyframes.cases import Case, Image, Query, Rng, World, cases, make_query
from studies.keyframes.sites import Floats, Place

#: By classes alone: CLIP's weights are no part of this study.
OPTIONS = RelocalizerOptions(matching='class')
_GUESSES = 3
# Of this case, all images are asked.
_PLAIN = 'plain: one image'


class Look(NamedTuple):
    """What is known of one image: the search of its objects, and its keyframes."""

    searched: SearchedFrame
    seen: Recognized | None


@dataclass(frozen=True, eq=False)
class Record:
    """What a verdict about one query needs: its looks, the oldest first; truths as of Query."""

    number: int
    looks: tuple[Look, ...]
    truths: tuple[Floats, ...]
    options: RelocalizerOptions


@dataclass(frozen=True, eq=False)
class StoredCase:
    """The records of a case at a place, and its changed map."""

    place: str
    name: str
    landmark_map: LandmarkMap
    records: tuple[Record, ...]


def by_objects(landmark_map: LandmarkMap, options: RelocalizerOptions,
               frames: list[SearchedFrame]) -> Relocalization:
    """Return the answer of objects at the last look of a robot that looked before, too."""
    relocalizer, looks = Relocalizer(landmark_map, options), Looks()
    for count in range(1, len(frames) + 1):
        found = relocalizer.locate(frames[:count], looks=looks)
        if found.map_from_camera is not None:
            looks = looks.with_look(frames[count - 1].observation, found.map_from_camera,
                                    found.confidence)
    return found


class Looker:
    """Detector and features; what they say of each image is kept in a folder."""

    def __init__(self, folder: Path, model: str) -> None:
        self._folder, self._model = folder, model
        self._detector: YoloDetector | None = None
        code = hashlib.sha256(Path(features.__file__).read_bytes()).hexdigest()[:8]
        self._name = f'{Path(model).stem}.{code}'

    def look(self, image_rgb: Image) -> tuple[Detections, Features]:
        """Return the boxes in an image, and its features."""
        digest = hashlib.sha256(image_rgb.tobytes()).hexdigest()[:24]
        path = self._folder / digest[:2] / f'{digest}.{self._name}.pickle'
        if not path.exists():
            self._detector = self._detector or YoloDetector(YoloOptions(self._model, conf=0.25))
            found = vars(self._detector.detect(image_rgb)), vars(query_features(image_rgb))
            make_folder(path.parent)
            write_file(path, lambda partial: partial.write_bytes(pickle.dumps(found)))
        boxes, local = pickle.loads(path.read_bytes())
        return Detections(**boxes), Features(**local)

    def detect(self, image_rgb: Image) -> Detections:
        """Return the boxes in an image, as an ObjectDetector does."""
        return self.look(image_rgb)[0]


@dataclass(frozen=True)
class Collect:
    """Makes what collects the records of a case at a place, or builds the place: without one."""

    out: Path
    places: tuple[Place, ...]
    queries: int  # the most of each case but the plain one

    def __call__(self) -> Callable[[tuple[Place, str]], None]:
        """Return the function."""
        import torch

        torch.set_num_threads(1)
        cv2.setNumThreads(1)
        lookers = {model: Looker(self.out / 'looks', model)
                   for model in {one.model for one in self.places}}
        return lambda task: self._collect(*task, lookers[task[0].model])

    def _collect(self, place: Place, name: str, looker: Looker) -> None:
        world = World(*place.build(self.out / 'places', looker), np.zeros(3))
        if not name:
            return
        case, key = cases()[name], zlib.crc32(f'{place.name} {name}'.encode())
        if case.world is not None:
            world = case.world(world, np.random.default_rng(key))
        folder = self.out / 'cases' / place.name.replace('/', '.')
        path = folder / f'{name.replace(": ", ".").replace(" ", "_")}.pickle'
        records = {one.number: one for one in pickle.loads(path.read_bytes()).records
                   } if path.exists() else {}
        others = {one.site: one for one in self.places if one.site != place.site}
        localizer = KeyframeLocalizer(world.layer)
        # more queries include those of a run with fewer
        order = np.random.default_rng(0).permutation(len(place.asked)).tolist()
        for number in order if name == _PLAIN else order[:self.queries]:
            rng = np.random.default_rng([key, number])
            query = None if number in records else make_query(
                case, place, [*others.values()], place.asked[number], world.shift_m, rng)
            if query is not None:
                records[number] = _ask(number, case, query, world.landmark_map, localizer, looker,
                                       rng)
        make_folder(folder)
        stored = StoredCase(place.name, name, world.landmark_map, tuple(records.values()))
        write_file(path, lambda partial: partial.write_bytes(pickle.dumps(stored)))


def _ask(number: int, case: Case, query: Query, landmark_map: LandmarkMap,
         localizer: KeyframeLocalizer, looker: Looker, rng: Rng) -> Record:
    options = replace(OPTIONS, height_range_m=query.height_range_m)
    relocalizer = Relocalizer(landmark_map, options)
    looks: list[Look] = []
    for second, (image, camera, odom) in enumerate(query.shots):
        boxes, local = looker.look(image)
        boxes = boxes.usable(camera.width, camera.height, MAX_DETECTIONS)
        if case.draws_classes:
            drawn = rng.choice(landmark_map.class_ids, len(boxes)).tolist()
            boxes = replace(boxes, class_ids=tuple(drawn))
        searched = relocalizer.search(Observation(
            camera, boxes, stamp_ns=second * 1_000_000_000, up_in_camera=query.up_in_camera,
            odom_from_camera=odom))
        found = by_objects(landmark_map, options, [*(one.searched for one in looks), searched])
        looks.append(Look(searched, localizer.localize_features(
            Features(*(column[:case.features] for column in vars(local).values())), camera,
            [one.map_from_camera for one in found.hypotheses[:_GUESSES]])))
    return Record(number, tuple(looks), query.truths, options)
