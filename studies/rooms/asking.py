# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Map a part of a room, and localize images of the other part and of other rooms in it."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np

from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.keyframes.localization import ImageRecognizer, KeyframeLocalizer
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.errors import MappingError
from cliploc_ros.offline.mapping.make_map import Labeller, make_map
from cliploc_ros.offline.posed_query import PosedQuery
from cliploc_ros.offline.recording.keyframe_layer import LayerOptions
from studies.blame import blame
from studies.reports import Answer, judged
from studies.rooms.rooms import ROBOT, Room, RoomOptions, known_of, read_room, without_boxes

if TYPE_CHECKING:
    from studies.rooms.baseline import SiftMap

#: Ways to localize.
WAYS = OBJECTS, KEYFRAMES, BOTH, BASELINE = 'objects', 'keyframes', 'both', 'baseline'
#: Input besides the image. Keyframes do not use depth.
KNOWN = NOTHING, VERTICAL, DEPTH, ALL = '-', 'vertical', 'depth', 'vertical, depth'
# Lower bounds of the bins of the number of boxes.
_BOXES = (0, 3, 4, 5, 7)
# An object-based pose with a greater error is a failure, and its cause is determined [m].
_FAILED_M = 0.5


class Task(NamedTuple):
    """A part of a room, by its name."""

    room: str
    kind: str
    part: str


class AskOptions(NamedTuple):
    """Greatest numbers of queries of a map, and their input."""

    images: int  # from the other part of the room
    elsewhere: int  # from each other room
    known: Sequence[str]  # each query is repeated with each of these
    with_baseline: bool


@dataclass(frozen=True, kw_only=True)
class Outcome(Answer):
    """The best pose of one query in one way."""

    room: str
    kind: str
    part: str
    asked: str  #: The room of the image
    number: int  #: Number of the image in its room
    way: str
    known: str
    source: str
    reason: str
    boxes: int
    inliers: int
    cause: str = ''  #: Cause of the failure of objects

    @property
    def is_here(self) -> bool:
        """Return whether the image is of the mapped room."""
        return self.asked == self.room

    @property
    def boxes_from(self) -> int:
        """Return the lower bound of the bin of the number of boxes."""
        return max(bound for bound in _BOXES if bound <= self.boxes)


@dataclass(frozen=True)
class Answers:
    """All outcomes of a part, and the size of its map, which may have no landmarks."""

    task: Task
    landmarks: int = 0
    keyframes: int = 0
    outcomes: tuple[Outcome, ...] = ()
    failure: str = ''  #: Why there is no map


def make_ask(folders: Sequence[str], reading: RoomOptions, options: AskOptions
             ) -> Callable[[Task], list[Answers]]:
    """Return the function that maps a part and localizes queries in its map, for a worker."""
    cv2.setNumThreads(1)

    @lru_cache
    def rooms() -> dict[str, Room]:
        return {room.name: room for room in (read_room(folder, reading) for folder in folders)}

    def ask(task: Task) -> list[Answers]:
        room = rooms()[task.room]
        mapped, asked = next((mapped, asked) for _, part, mapped, asked in room.parts()
                             if part == task.part)
        try:
            made = make_map(room.detections.select_frames(mapped), Labeller({}), frames=
                            room.frames.select(mapped.tolist()), layer=LayerOptions())
        except MappingError as error:
            return [Answers(task, failure=str(error))]
        landmark_map, layer, baseline = made.landmark_map, made.layer, None
        keyframes = None if layer is None else KeyframeLocalizer(layer)
        if options.with_baseline:
            from studies.rooms.baseline import SiftMap  # needs pycolmap
            baseline = SiftMap(room.raws[row].decode() for row in mapped)
        asking = room.by_robot if task.kind == ROBOT else room
        if len(asked) > options.images:  # evenly spread over the time
            asked = asked[np.linspace(0, len(asked) - 1, options.images).astype(np.int64)]
        found = [outcome for row in asked for outcome in _ask_here(
            task, options.known, asking, landmark_map, keyframes, baseline, asking.queries[row])]
        rng = np.random.default_rng(len(task.part))
        for other in rooms().values():
            if other.name != room.name:
                some = rng.permutation(len(other))[:options.elsewhere]
                # all of these should be refused
                found += [outcome_of(task, other, other.queries[row], way, known, landmark_map,
                                     keyframes)
                          for row in some for way, known in product(WAYS[:3], options.known)
                          if known == NOTHING or (known == VERTICAL and other.has_poses)]
        return [Answers(task, len(landmark_map), len(layer or ()), tuple(found))]
    return ask


def _ask_here(task: Task, names: Sequence[str], room: Room, landmark_map: LandmarkMap,
              keyframes: KeyframeLocalizer | None, baseline: 'SiftMap | None',
              query: PosedQuery) -> Iterator[Outcome]:
    """Yield the answers to an image of the mapped room."""
    for way, known in product((OBJECTS, BOTH, KEYFRAMES), names):
        if known not in (NOTHING, VERTICAL) and (way == KEYFRAMES or not room.has_depth):
            continue
        yield outcome_of(task, room, query, way, known, landmark_map, keyframes)
    if baseline is not None:
        image_rgb, camera = room.raws[query.number].color()
        pose = baseline.locate(image_rgb, camera)
        errors: dict[str, Any] = {} if pose is None else dict(zip(
            ('error_m', 'error_deg'), pose_error(pose, query.map_from_camera), strict=True))
        yield Outcome(room=task.room, kind=task.kind, part=task.part, asked=room.name,
                      number=query.number, way=BASELINE, known=NOTHING, accepted=False,
                      confidence=0.0, source=BASELINE, reason='', boxes=0, inliers=0, **errors)


def outcome_of(task: Task, asked: Room, query: PosedQuery, way: str, known: str,
               landmark_map: LandmarkMap, keyframes: KeyframeLocalizer | None) -> Outcome:
    """Ask an independent question: without evidence of earlier images about the camera.

    The relocalizer is asked, not a localizer, because the features of the images are stored.
    """
    observation = known_of(query.observation, known)
    if way == KEYFRAMES:
        observation = without_boxes(observation)
    relocalizer = Relocalizer(landmark_map, RelocalizerOptions(matching='class'))
    recognizer = None
    if way != OBJECTS and keyframes is not None:
        recognizer = ImageRecognizer(keyframes, asked.features[query.number])
    found = relocalizer.relocalize([observation], recognizer)
    outcome = Outcome(
        room=task.room, kind=task.kind, part=task.part, asked=asked.name, number=query.number,
        way=way, known=known, source=found.source, reason=found.reason,
        boxes=len(observation.detections),
        inliers=len(found.matches),
        **judged(found, query.map_from_camera if asked.name == task.room else None))
    if (way == OBJECTS and known == NOTHING and outcome.is_here and len(landmark_map)
            and outcome.error_m > _FAILED_M):
        return replace(outcome, cause=blame(
            landmark_map, relocalizer, replace(query, observation=observation), _FAILED_M).cause)
    return outcome
