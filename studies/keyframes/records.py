# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Map places, and collect the results of objects and keyframes for each query, without verdict."""

import pickle
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from cliploc_ros.core.acceptance.looks import Look, Looks
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.keyframes.features import DIMENSIONS, Features
from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.core.keyframes.localization import (
    NOTHING_KNOWN,
    ImageFeatures,
    ImageRecognizer,
    KeyframeLocalizer,
)
from cliploc_ros.core.keyframes.places import Recognition
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalization, Relocalizer
from cliploc_ros.core.search.frame_search import SearchedFrame
from cliploc_ros.core.search.scene import Constraint
from cliploc_ros.offline.datasets.folders import read_folder
from cliploc_ros.offline.datasets.frames import FolderOptions, RawFrame
from cliploc_ros.offline.mapping.building import build_map
from cliploc_ros.offline.recording.keyframe_layer import LayerOptions, build_layer
from cliploc_ros.offline.recording.networks import MAX_DETECTIONS, run_networks
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
    moved_half,
)
from studies.rooms.rooms import Looker, frames_of_raws, keep, open_folder, posed

# Walks of a rendered room: for the map, for the queries, and for second looks.
_ROOM_WALKS = (('mapping', 'viewpoints', 'viewpoints_aside'),
               ('mapping', 'other_light', 'other_light_aside'),
               ('one_side', 'other_side', 'other_side'))


class Seen(NamedTuple):
    """The results of one image: the search of its objects, and the recognition by keyframes."""

    searched: SearchedFrame
    seen: tuple[Recognition, Recognition]  #: In the fast pass and in the thorough pass


@dataclass(frozen=True, eq=False)
class Record:
    """The input of a verdict on one query: its looks, oldest first, and truths as in Query."""

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


_NO_IMAGE = np.empty((0, 0, 3), dtype=np.uint8)


class StoredRecognizer(ImageRecognizer):
    """Returns the stored recognition of an image."""

    def __init__(self, seen: tuple[Recognition, Recognition], keyframes: KeyframeLocalizer,
                 camera: Camera, may_be_thorough: bool) -> None:
        super().__init__(keyframes, ImageFeatures(lambda: _NO_IMAGE, camera),
                         may_be_thorough=may_be_thorough)
        self._seen = seen

    def recognize(self, guesses: Sequence[Floats], constraint: Constraint = NOTHING_KNOWN
                  ) -> Recognition:
        """Return the stored recognition of the current pass."""
        self._known = set(), self._seen[self._fast is not None]
        return self._known[1]


def localize(landmark_map: LandmarkMap, options: RelocalizerOptions,
             frames: Sequence[SearchedFrame],
             recognizers: Sequence[ImageRecognizer | None]) -> Relocalization:
    """Return the answer at the last look, given the earlier looks."""
    relocalizer, looks = Relocalizer(landmark_map, options), Looks()
    for count, (frame, recognizer) in enumerate(zip(frames, recognizers, strict=True), start=1):
        found = relocalizer.look_again(relocalizer.locate(
            frames[:count], looks=looks, recognizer=recognizer), frames[:count], looks, recognizer)
        if found.map_from_camera is not None:
            looks = looks.with_look(Look(frame.observation, found.map_from_camera,
                                         found.confidence, found.recognized))
    return found


def make_collect(out: Path, places: Sequence[Place], queries: int, stale_m: float
                 ) -> Callable[[tuple[Place, str]], None]:
    """Return a function that collects the records of a case at a place; '' only builds the place.

    The plain case uses all images, other cases at most ``queries``. Before the change of the case,
    half of the place moves by ``stale_m``, see moved_half.
    """
    import torch

    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    lookers = {place.model: Looker(out / 'looks', place.model) for place in places}

    def collect(task: tuple[Place, str]) -> None:
        place, name = task
        looker = lookers[place.model]
        world = World(*_build(place, out / 'places', looker), np.zeros(3))
        if not name:
            return
        case, key = cases()[name], zlib.crc32(f'{place.name} {name}'.encode())
        if stale_m:
            world = moved_half(stale_m, world, np.random.default_rng(
                zlib.crc32(place.name.encode())))
            case = replace(case, truths=case.truths if case.world else (0, 1))
        if case.world is not None:
            world = case.world(world, np.random.default_rng(key))
        path = out / 'cases' / place.name.replace('/', '.') / f'{name}.pickle'
        stored = pickle.loads(path.read_bytes()).records if path.exists() else ()
        records = {record.number: record for record in stored}
        others = {other.site: other for other in places if other.site != place.site}
        localizer = KeyframeLocalizer(world.layer)
        # a run with more queries includes those of a run with fewer
        order = np.random.default_rng(0).permutation(len(place.asked)).tolist()
        for number in order if cases()[name] == Case() else order[:queries]:
            rng = np.random.default_rng([key, number])
            query = None if number in records else make_query(
                case, place, [*others.values()], place.asked[number], world.shift_m, rng)
            if query is not None:
                records[number] = _ask(number, case, query, world.landmark_map, localizer, looker,
                                       rng)
        if len(records) > len(stored):
            keep(path, StoredCase(place.name, name, world.landmark_map, replace(
                world.layer, descriptors=np.empty((0, DIMENSIONS), np.uint8)),
                tuple(records.values())))
    return collect


def _build(place: Place, folder: Path, looker: Looker) -> tuple[LandmarkMap, KeyframeLayer]:
    """Return map and layer of a place; build and store them the first time."""
    path = folder / f'{place.name.replace("/", ".")}.pickle'
    if not path.exists():
        frames = frames_of_raws(Path(place.name), place.mapped)
        landmark_map = build_map(
            record_every_frame(frames, partial(run_networks, looker.detect, None))).landmark_map \
            if place.map_file is None else LandmarkMap.from_file(place.map_file)
        layer = build_layer(frames, landmark_map, LayerOptions(0.0, 0.0))
        print(f'{place.name}: {len(landmark_map)} landmarks, {len(layer)} keyframes, '
              f'{len(layer.points)} points', flush=True)
        keep(path, (landmark_map, layer))
    landmark_map, layer = pickle.loads(path.read_bytes())
    return landmark_map, layer


class _Features(ImageFeatures):
    """The strongest features of an image, up to a number; stored for later runs."""

    def __init__(self, image: Image, camera: Camera, looker: Looker, most: int) -> None:
        super().__init__(lambda: image, camera)
        self._looker, self._most = looker, most

    def of_pass(self, is_thorough: bool) -> Features:
        """Return the features of a pass."""
        found = self._looker.features(self._read_rgb(), is_thorough)
        return Features(*(column[:self._most] for column in vars(found).values()))


def _ask(number: int, case: Case, query: Query, landmark_map: LandmarkMap,
         localizer: KeyframeLocalizer, looker: Looker, rng: Rng) -> Record:
    # match by class only, since CLIP is not part of this study
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
        recognizer = ImageRecognizer(localizer, _Features(image, camera, looker, case.features))
        frames, seen = [*(look.searched for look in looks), searched], list[Recognition]()
        for _ in range(2):
            found = relocalizer.locate(frames, recognizer=recognizer)
            seen.append(found.recognition or Recognition())
            recognizer.begin_thorough()
        looks.append(Seen(searched, (seen[0], seen[1])))
    return Record(number, tuple(looks), query.truths, options)


def read_places(where: str, model: str) -> Iterator[Place]:
    """Yield the places of a site.

    Parameters
    ----------
    where : str
        A folder from make_keyframe_rooms; a TUM folder with a map.yaml, which is mapped without
        depth; or an RGB-D folder. ``DIR@METRES`` gives a TUM folder's unit of depth.
    model : str
        Weights of YOLO for real images.
    """
    folder = Path(where)
    if (folder / 'mapping').is_dir():
        for walks in _ROOM_WALKS:
            yield Place(folder.name, f'{folder.name}/{walks[1]}', str(ASSETS / 'yolo.onnx'),
                        _walk(folder / walks[0]), _walk(folder / walks[1]),
                        _walk(folder / walks[2]), folder / 'map.yaml')
        return
    folder, frames, _ = open_folder(where)
    map_file = folder / 'map.yaml' if (folder / 'map.yaml').exists() else None
    raws = _walk(folder) if map_file else posed(frames)
    rows = np.arange(len(raws))
    parts = {'interleaved': rows % 2 == 0, 'first half': rows < len(raws) // 2,
             'second half': rows >= len(raws) // 2}
    for part, is_mapped in parts.items():
        mapped, asked = (tuple(raws[row] for row in rows[chosen])
                         for chosen in (is_mapped, ~is_mapped))
        yield Place(folder.name, f'{folder.name}/{part}', model, mapped, asked, asked, map_file)


def _walk(folder: Path) -> tuple[RawFrame, ...]:
    """Return the images of a TUM folder, without depth."""
    return posed(read_folder(folder, FolderOptions(layout='tum')))
