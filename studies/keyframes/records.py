# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Map places, and collect what objects and keyframes say about each query, without a verdict."""

import hashlib
import pickle
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from cliploc_ros.core.acceptance.looks import Look, Looks
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.keyframes import features
from cliploc_ros.core.keyframes.features import DIMENSIONS, Features
from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.core.keyframes.localization import (
    NOTHING_KNOWN,
    ImageRecognizer,
    KeyframeLocalizer,
    query_features,
)
from cliploc_ros.core.keyframes.places import Recognition
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalization, Relocalizer
from cliploc_ros.core.search.frame_search import SearchedFrame
from cliploc_ros.core.search.scene import Constraint
from cliploc_ros.files.storage import make_folder, write_file
from cliploc_ros.models.profiles import load_detector
from cliploc_ros.models.protocols import DetectorOptions, ObjectDetector
from cliploc_ros.offline.datasets.folders import FolderOptions, rgbd_frames, tum_frames
from cliploc_ros.offline.datasets.frames import DepthFormat, Frames, RawFrame
from cliploc_ros.offline.datasets.intrinsics import find_camera
from cliploc_ros.offline.datasets.tum import read_tum
from cliploc_ros.offline.mapping.building import build_map
from cliploc_ros.offline.recording.keyframe_layer import LayerOptions, build_layer
from cliploc_ros.offline.recording.networks import MAX_DETECTIONS, RunNetworks
from cliploc_ros.offline.recording.recorder import record_every_frame
from demo import ASSETS
from studies.keyframes.cases import (
    Case,
    Floats,
    Image,
    Place,
    Query,
    Rng,
    World,
    cases,
    make_query,
)

# Of a rendered room: what is mapped, what is asked, and where second looks come from.
_ROOM_WALKS = (('mapping', 'viewpoints', 'viewpoints_aside'),
               ('mapping', 'other_light', 'other_light_aside'),
               ('one_side', 'other_side', 'other_side'))


class Seen(NamedTuple):
    """What is known of one image: the search of its objects, and what keyframes say."""

    searched: SearchedFrame
    seen: Recognition


@dataclass(frozen=True, eq=False)
class Record:
    """What a verdict about one query needs: its looks, the oldest first; truths as of Query."""

    number: int
    looks: tuple[Seen, ...]
    truths: tuple[Floats, ...]
    options: RelocalizerOptions


@dataclass(frozen=True, eq=False)
class StoredCase:
    """The records of a case at a place, its changed map, and its layer without descriptors."""

    place: str
    name: str
    landmark_map: LandmarkMap
    layer: KeyframeLayer
    records: tuple[Record, ...]


_NO_FEATURES = Features(np.empty((0, 2)), np.empty((0, DIMENSIONS), np.uint8),
                        np.empty(0, np.float32))


class StoredRecognizer(ImageRecognizer):
    """Says of an image again what keyframes said when it was collected."""

    def __init__(self, seen: Recognition, keyframes: KeyframeLocalizer, camera: Camera) -> None:
        super().__init__(keyframes, _NO_FEATURES, camera)
        self._seen = seen

    def recognize(self, guesses: Sequence[Floats], constraint: Constraint = NOTHING_KNOWN
                  ) -> Recognition:
        """Return what was stored."""
        return self._seen


def localize(landmark_map: LandmarkMap, options: RelocalizerOptions,
             frames: Sequence[SearchedFrame],
             recognizers: Sequence[ImageRecognizer | None]) -> Relocalization:
    """Return the answer at the last look of a robot that looked before, too."""
    relocalizer, looks = Relocalizer(landmark_map, options), Looks()
    for count, (frame, recognizer) in enumerate(zip(frames, recognizers, strict=True), start=1):
        found = relocalizer.locate(frames[:count], looks=looks, recognizer=recognizer)
        if found.map_from_camera is not None:
            looks = looks.with_look(Look(frame.observation, found.map_from_camera,
                                         found.confidence, found.recognized))
    return found


class Looker:
    """Detector and features; what they say of each image is kept in a folder."""

    def __init__(self, folder: Path, model: str) -> None:
        self._folder, self._model = folder, model
        self._detector: ObjectDetector | None = None
        self._code = hashlib.sha256(Path(features.__file__).read_bytes()).hexdigest()[:8]

    def detect(self, image_rgb: Image) -> Detections:
        """Return the boxes in an image, as an ObjectDetector does."""
        def find() -> Detections:
            self._detector = self._detector or load_detector(
                DetectorOptions(self._model, conf=0.25))
            return self._detector.detect(image_rgb)
        return Detections(*self._kept(image_rgb, Path(self._model).stem, find))

    def features(self, image_rgb: Image) -> Features:
        """Return the features of an image."""
        return Features(*self._kept(image_rgb, self._code, lambda: query_features(image_rgb)))

    def _kept(self, image_rgb: Image, what: str, find: Callable[[], Any]) -> tuple[Any, ...]:
        digest = hashlib.sha256(image_rgb.tobytes()).hexdigest()[:24]
        path = self._folder / digest[:2] / f'{digest}.{what}.pickle'
        if not path.exists():
            _keep(path, tuple(vars(find()).values()))
        return tuple(pickle.loads(path.read_bytes()))


def make_collect(out: Path, places: Sequence[Place], queries: int
                 ) -> Callable[[tuple[Place, str]], None]:
    """Return what collects the records of a case at a place, or builds the place: without one.

    All images are asked in the plain case, in the others at most a number of queries.
    """
    import torch

    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    lookers = {one.model: Looker(out / 'looks', one.model) for one in places}

    def collect(task: tuple[Place, str]) -> None:
        place, name = task
        looker = lookers[place.model]
        world = World(*_build(place, out / 'places', looker), np.zeros(3))
        if not name:
            return
        case, key = cases()[name], zlib.crc32(f'{place.name} {name}'.encode())
        if case.world is not None:
            world = case.world(world, np.random.default_rng(key))
        path = out / 'cases' / place.name.replace('/', '.') / f'{name}.pickle'
        stored = pickle.loads(path.read_bytes()).records if path.exists() else ()
        records = {one.number: one for one in stored}
        others = {one.site: one for one in places if one.site != place.site}
        localizer = KeyframeLocalizer(world.layer)
        # more queries include those of a run with fewer
        order = np.random.default_rng(0).permutation(len(place.asked)).tolist()
        for number in order if case == Case() else order[:queries]:
            rng = np.random.default_rng([key, number])
            query = None if number in records else make_query(
                case, place, [*others.values()], place.asked[number], world.shift_m, rng)
            if query is not None:
                records[number] = _ask(number, case, query, world.landmark_map, localizer, looker,
                                       rng)
        if len(records) > len(stored):
            _keep(path, StoredCase(place.name, name, world.landmark_map, replace(
                world.layer, descriptors=np.empty((0, DIMENSIONS), np.uint8)),
                tuple(records.values())))
    return collect


def _build(place: Place, folder: Path, looker: Looker) -> tuple[LandmarkMap, KeyframeLayer]:
    """Return map and layer of a place; the first time, they are made and kept."""
    path = folder / f'{place.name.replace("/", ".")}.pickle'
    if not path.exists():
        frames = Frames(Path(place.name), len(place.mapped), lambda is_wanted: (
            raw for raw in place.mapped
            if is_wanted(raw.place, raw.stamp_ns, raw.map_from_camera)))
        landmark_map = build_map(
            record_every_frame(frames, RunNetworks(looker.detect)).detections).landmark_map \
            if place.map_file is None else LandmarkMap.from_file(place.map_file)
        layer = build_layer(frames, landmark_map, LayerOptions(0.0, 0.0))
        print(f'{place.name}: {len(landmark_map)} landmarks, {len(layer)} keyframes, '
              f'{len(layer.points)} points', flush=True)
        _keep(path, (landmark_map, layer))
    landmark_map, layer = pickle.loads(path.read_bytes())
    return landmark_map, layer


def _keep(path: Path, what: Any) -> None:
    make_folder(path.parent)
    write_file(path, lambda partial: partial.write_bytes(pickle.dumps(what)))


def _ask(number: int, case: Case, query: Query, landmark_map: LandmarkMap,
         localizer: KeyframeLocalizer, looker: Looker, rng: Rng) -> Record:
    # by classes alone: CLIP's weights are no part of this study
    options = RelocalizerOptions(matching='class', height_range_m=query.height_range_m)
    relocalizer, looks = Relocalizer(landmark_map, options), list[Seen]()
    for second, (image, camera, odom) in enumerate(query.shots):
        boxes = looker.detect(image).usable(camera.width, camera.height, MAX_DETECTIONS)
        if case.draws_classes:
            drawn = rng.choice(landmark_map.class_ids, len(boxes)).tolist()
            boxes = replace(boxes, class_ids=tuple(drawn))
        searched = relocalizer.search(Observation(
            camera, boxes, stamp_ns=second * 1_000_000_000, up_in_camera=query.up_in_camera,
            odom_from_camera=odom))
        recognizer = ImageRecognizer(localizer, Features(
            *(column[:case.features] for column in vars(looker.features(image)).values())),
            camera)
        found = relocalizer.locate([*(one.searched for one in looks), searched],
                                   recognizer=recognizer)
        looks.append(Seen(searched, found.recognition or Recognition()))
    return Record(number, tuple(looks), query.truths, options)


def read_places(where: str, model: str) -> Iterator[Place]:
    """Yield the places of a site.

    Parameters
    ----------
    where : str
        A folder that make_keyframe_rooms made; a TUM folder with a map.yaml, which is mapped
        without depth; or an RGB-D folder. ``DIR@METRES`` gives a TUM folder's unit of depth.
    model : str
        Weights of YOLO for real images.
    """
    path, _, unit = where.partition('@')
    folder = Path(path)
    if (folder / 'mapping').is_dir():
        for walks in _ROOM_WALKS:
            yield Place(folder.name, f'{folder.name}/{walks[1]}', str(ASSETS / 'yolo.pt'),
                        _walk(folder / walks[0]), _walk(folder / walks[1]),
                        _walk(folder / walks[2]), folder / 'map.yaml')
        return
    map_file = folder / 'map.yaml' if (folder / 'map.yaml').exists() else None
    depth = DepthFormat(float(unit) if unit else None)
    raws = _walk(folder) if map_file else _posed(rgbd_frames(
        folder, FolderOptions(depth=depth, level=not (folder / 'rgb.txt').exists())))
    rows = np.arange(len(raws))
    parts = {'interleaved': rows % 2 == 0, 'first half': rows < len(raws) // 2,
             'second half': rows >= len(raws) // 2}
    for part, is_mapped in parts.items():
        mapped, asked = (tuple(raws[row] for row in rows[chosen])
                         for chosen in (is_mapped, ~is_mapped))
        yield Place(folder.name, f'{folder.name}/{part}', model, mapped, asked, asked, map_file)


def _walk(folder: Path) -> tuple[RawFrame, ...]:
    """Return the images of a TUM folder, without depth."""
    return _posed(tum_frames(read_tum(folder), find_camera(None, folder)[0]))


def _posed(frames: Frames) -> tuple[RawFrame, ...]:
    return tuple(frames.read_raw(lambda place, stamp_ns, pose: pose is not None))
