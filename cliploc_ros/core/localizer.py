# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Answer the successive queries of one moving robot. All programs use this module.

A localizer fuses each frame with the last few frames that odometry links to it. It accepts a pose
only if the mean confidence of the successive looks in it is high enough.

Crops are compared on demand, because embedding them takes most of the time on a CPU. A frame is
first localized by classes alone, then with more and more of its crops, the most informative crops
first, until the pose is accepted or no crop is left. Each of these searches is another chance of a
false accept. A pose from a part of the crops therefore needs a higher confidence, see
cliploc_ros.core.acceptance.verdict.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.camera_check import CameraCheck
from cliploc_ros.core.acceptance.depth_check import DepthScale
from cliploc_ros.core.acceptance.looks import NO_LOOKS, Look, Looks
from cliploc_ros.core.acceptance.verdict import RefusalKind
from cliploc_ros.core.fit.succession import Answered, Track, follow
from cliploc_ros.core.fit.verification import MAX_FRAMES
from cliploc_ros.core.geometry.transforms import SAME_VIEW, pose_error
from cliploc_ros.core.keyframes.localization import (
    LEAST_S,
    ImageFeatures,
    ImageRecognizer,
    KeyframeLocalizer,
)
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.similarities import CropSimilarities, Similarities
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.query import Case, Query
from cliploc_ros.core.relocalizer import Relocalization, Relocalizer, TimeBudget
from cliploc_ros.core.search.frame_search import SearchedFrame
from cliploc_ros.units import NS_PER_S

# These are time limits and therefore not in calibration.yaml. The confidence that a pose from a
# part of the crops needs is there, in the section search.
#: Number of crops between two searches. A search takes less time than most networks need for one
#: crop on a CPU.
BATCH = 4
# Time that a request needs after its last crops: for searches, in units of the time budget and at
# most this share of the time left, and for the answer [s]. Chosen.
_SEARCHES, _MOST_SHARE, _ANSWER_S = 2.0, 0.2, 0.1
# Remedy where the end of a request cuts off the search.
_RAISE = '; raise timeout_s'
_NO_ROWS = np.empty(0, dtype=np.int64)


class ImageCrops(Protocol):
    """The crops of one image."""

    @property
    def known(self) -> NDArray[np.int64]:
        """Return the detections (m,) whose embeddings are known, so that they take no time."""

    def compare(self, rows: NDArray[np.int64]) -> Similarities:
        """Return the similarities (m, L) of detections (m,) to the labels."""


class CropSource(Protocol):
    """Compare crops of images with the labels of a map, see cliploc_ros.models.observer."""

    def crops(self, image_rgb: NDArray[np.uint8], bboxes_xyxy: NDArray[np.float64],
              known: Mapping[int, NDArray[np.float32]] | None = None) -> ImageCrops:
        """Return the crops of an image (h, w, 3) at boxes (n, 4) [px].

        `known` has the known embeddings by row; by default the embeddings of earlier images.
        """

    def crops_within(self, left_s: float) -> int:
        """Return the number of crops that can be compared in the time left [s]."""


@dataclass(frozen=True)
class Crops:
    """The crops of one frame, which are compared with the labels on demand."""

    #: Returns the similarities (m, L) of the detections of m rows
    compare: Callable[[NDArray[np.int64]], Similarities]
    #: (m,): detections that the first search uses, because their similarities take no time
    known: NDArray[np.int64] = field(default_factory=_NO_ROWS.copy)
    room: Callable[[], int] = lambda: BATCH  #: Returns how many crops to compare next; 0: stop


def can_do_without_crops(options: RelocalizerOptions) -> bool:
    """Return whether a frame can be localized before all crops are compared: for hybrid_auto."""
    return options.algorithm == 'auto' and options.matching == 'hybrid'


def by_classes(observation: Observation, landmarks: int) -> Observation:
    """Return an observation without similarities, for a map with a number of landmarks.

    The node compares the crops of one camera only. This is used for the other cameras of a rig.
    """
    return replace(observation, similarities=np.empty((0, landmarks), dtype=np.float32),
                   compared=np.empty(0, dtype=np.int64))


def informative_first(landmark_map: LandmarkMap, observation: Observation) -> NDArray[np.int64]:
    """Return the detections (n,), sorted by how informative their crops are, best first.

    A crop distinguishes the landmarks of its class, so its information grows with their number. It
    also grows with the size of the crop, because large crops are more reliable.
    """
    classes = landmark_map.classes.classes_of(observation.detections.class_ids)
    sizes = landmark_map.classes.sizes_of(classes)
    boxes = observation.detections.bboxes_xyxy
    sides = np.sqrt(np.prod(np.maximum(boxes[:, 2:] - boxes[:, :2], 0.0), axis=1))
    return np.asarray(np.argsort(-np.log2(1.0 + sizes) * sides, kind='stable'))


def localize_on_demand(relocalizer: Relocalizer, earlier: Sequence[SearchedFrame],
                       observation: Observation, crops: Crops | None = None,
                       looks: Looks = NO_LOOKS, recognizer: ImageRecognizer | None = None,
                       budget: TimeBudget | None = None, cameras: CameraCheck | None = None,
                       request: float = math.inf) -> tuple[SearchedFrame, Relocalization]:
    """Localize a frame with more and more of its crops until its pose is accepted.

    Parameters
    ----------
    earlier : sequence of SearchedFrame
        Frames before it, linked by odometry.
    crops : Crops, optional
        The crops of the frame, which replace its similarities. Without crops, the frame is
        localized once with the similarities that it has.
    looks : Looks, optional
        Earlier looks, which must agree with the pose.
    recognizer : ImageRecognizer, optional
        Search of keyframes for the image of the frame.
    budget : TimeBudget, optional
        Time budget of the first search, by default a new one. Each further search has a new one.
    cameras : CameraCheck, optional
        Evidence about the cameras; by default there is none.
    request : float
        When a request needs the result (monotonic clock) [s].

    Returns
    -------
    frame : SearchedFrame
        The frame with the similarities of the crops that were compared.
    found : Relocalization
        The result of the last search, with the time of all searches.

    Raises
    ------
    OptionsError
        See Relocalizer.relocalize.
    """
    search_ms, left = 0.0, np.empty(0, dtype=np.int64)
    if crops is not None:
        compared = crops.known
        observation = replace(observation, similarities=crops.compare(compared), compared=compared)
        left = informative_first(relocalizer.landmark_map, observation)
        left = left[~np.isin(left, compared)]
    while True:
        budget = budget or relocalizer.begin(len(earlier) + 1, request=request)
        frame = relocalizer.search(observation, budget.search_end())
        found = relocalizer.locate([*earlier, frame], budget, looks, recognizer, cameras)
        search_ms, budget = search_ms + found.search_ms, None
        if found.accepted or crops is None or not len(left) or (count := crops.room()) <= 0:
            found = replace(found, search_ms=search_ms)
            return frame, relocalizer.look_again(found, [*earlier, frame], looks, recognizer,
                                                 cameras)
        compared, left = np.append(compared, left[:count]), left[count:]
        observation = replace(observation, similarities=crops.compare(compared), compared=compared)


class KeptInstant(NamedTuple):
    """The searched frames of one instant, and the anchor of its view."""

    searched: tuple[SearchedFrame, ...]
    #: (4, 4): odom_from_camera of the last camera. If this instant replaced earlier instants with
    #: the same view, the anchor is that of the first of them, so that a camera which creeps slowly
    #: away from it gets a new view in the end.
    anchor: NDArray[np.float64]

    @property
    def stamp_ns(self) -> int:
        """Return the time of the instant [ns]."""
        return self.searched[-1].observation.stamp_ns


class Localizer:
    """Answer successive queries, each together with the queries before it.

    Parameters
    ----------
    keyframes : KeyframeLocalizer, optional
        Localization by the keyframes of the map.
    """

    def __init__(self, relocalizer: Relocalizer, keyframes: KeyframeLocalizer | None = None
                 ) -> None:
        self._relocalizer, self._keyframes = relocalizer, keyframes
        self._instants: list[KeptInstant] = []
        self._looks = Looks()
        self._accepted: Track | None = None  # by the accepted answers alone, see follow
        #: The pose by all answers of the current run of odometry
        self.track: Track | None = None
        self._run: int | None = -1
        self._stamp_ns = 0
        #: The newest query with everything that its answer depended on, so that it can be repeated
        self.query: Query | None = None
        #: Scale of the depths; once it is wrong, depths are ignored
        self.depth_scale = DepthScale()
        self.cameras = CameraCheck()

    def use(self, relocalizer: Relocalizer) -> None:
        """Continue with a relocalizer with other options on the same map.

        Looks, cameras, depth scale and filter are kept. Instants are not, because they were
        searched with the former options. On another map, use a new localizer: cameras and depths
        were compared with this map.
        """
        self._relocalizer, self._instants = relocalizer, []

    def answer(self, query: Query, crops: CropSource | None = None, deadline: float = math.inf,
               begin_stage: Callable[[str], None] = lambda stage: None) -> Relocalization:
        """Localize with the frames of an instant and, if odometry links them, earlier instants.

        Odometry links all instants of one run. A new run, or a stamp before the last stamp, drops
        all earlier instants and looks. Looks are kept until a pose is accepted, whatever the
        length_s of the query.

        Parameters
        ----------
        query : Query
            Its newest frame is localized. Without odom_from_camera or run, the frame is localized
            alone, and instants and looks do not change.
        crops : CropSource, optional
            Compares the crops for which the query has no similarities, until the pose is accepted.
        deadline : float
            After this time, no crops are compared, no keyframes are matched, and no search goes on
            (monotonic clock) [s].
        begin_stage : callable
            Called with the name of each stage that begins: 'CLIP', 'keyframes', and 'search' after
            them.

        Raises
        ------
        OptionsError
            See Relocalizer.relocalize. The localizer then drops this instant.
        """
        if self.depth_scale.is_wrong:
            query = replace(query, frames=tuple(replace(frame, depths=None)
                                                for frame in query.frames))
        if query.cameras is not None:
            self.cameras = query.cameras.copied()
        query = replace(query, cameras=self.cameras.copied(), by_keyframes=query.by_keyframes
                        and deadline - time.monotonic() >= LEAST_S)
        others = [self.with_free_crops(query, row, crops) for row in range(len(query.frames) - 1)]
        for frame in query.frames:
            self.cameras.see(frame)
        found = self._localize(query, others, *self._crops(query, crops, deadline, begin_stage),
                               self.recognizer(query, deadline, begin_stage),
                               deadline - _ANSWER_S)
        self.cameras.add(found.cameras)
        if found.accepted and found.depth is not None:
            self.depth_scale.add(found.depth)
        if others and found.accepted and found.frame_matches:
            # refused poses are not counted, because the map may be out of date
            index = self._relocalizer.landmark_map.classes
            self.cameras.add_instant(query.frames, [int(index.are_own(index.classes_of(
                frame.detections.class_ids)).sum()) for frame in query.frames], [
                    len(frame_match) for frame_match in found.frame_matches[-len(query.frames):]])
        return found

    def recognizer(self, query: Query, deadline: float = math.inf,
                   begin_stage: Callable[[str], None] = lambda stage: None
                   ) -> ImageRecognizer | None:
        """Return the search of keyframes for the newest image; None without keyframes or image."""
        if self._keyframes is None or not query.images or not query.by_keyframes:
            return None
        features = ImageFeatures(lambda: query.images[-1], query.newest.camera,
                                 self._keyframes.layer.kind)
        return ImageRecognizer(self._keyframes, features, deadline, begin_stage, query.is_thorough)

    def with_free_crops(self, query: Query, row: int, source: CropSource | None,
                        begin_stage: Callable[[str], None] = lambda stage: None) -> Observation:
        """Return a frame of a query with the similarities that take no time to compute.

        For the paper's algorithms, all crops are compared, however long that takes.
        """
        frame, options = query.frames[row], self._relocalizer.options
        compares_all = not can_do_without_crops(options)
        crops = self._crops_of(query, row, source, not compares_all, begin_stage)
        if crops is None or not options.needs_similarities:
            return frame
        rows = None if compares_all else crops.known if frame.compared is None else frame.compared
        return replace(frame, compared=rows, similarities=crops.compare(
            np.arange(len(frame.detections)) if rows is None else rows))

    def _crops(self, query: Query, source: CropSource | None, deadline: float,
               begin_stage: Callable[[str], None]) -> tuple[Observation, Crops | None]:
        """Return the newest frame, and its crops that are compared on demand, if any."""
        newest, options, last = query.newest, self._relocalizer.options, len(query.frames) - 1
        on_demand = options.crops == 'on_demand'
        if not can_do_without_crops(options):
            return self.with_free_crops(query, last, source, begin_stage), None
        is_given = newest.similarities is not None
        if is_given and not query.rooms and (newest.compared is not None or not on_demand):
            return newest, None
        crops = self._crops_of(query, last, source, on_demand, begin_stage)
        if crops is None or (is_given and not query.rooms):
            return newest, crops
        if query.rooms:
            assert newest.compared is not None
            first, *others = query.rooms
            rooms = iter(others)
            return newest, replace(crops, known=newest.compared[:first],
                                   room=lambda: next(rooms, BATCH))
        assert source is not None
        end = deadline if math.isinf(deadline) else deadline - _ANSWER_S - min(
            _SEARCHES * options.time_budget_s, _MOST_SHARE * (deadline - time.monotonic()))

        def room() -> int:
            return source.crops_within(end - time.monotonic())
        if on_demand:
            return newest, replace(crops, room=lambda: min(BATCH, room()))
        rows, count = informative_first(self._relocalizer.landmark_map, newest), 0
        while count < len(rows) and (more := room()) > 0:
            count += more
            crops.compare(rows[:count])
        return newest, replace(crops, known=rows[:count], room=lambda: 0)

    def _crops_of(self, query: Query, row: int, source: CropSource | None, remembers: bool,
                  begin_stage: Callable[[str], None]) -> Crops | None:
        """Return the crops of a frame, recorded or cut from its image; None if it has neither."""
        frame = query.frames[row]
        given, rows = frame.similarities, frame.similarity_rows
        if given is not None and (source is None or not query.images
                                  or not isinstance(given, CropSimilarities)):
            recorded = np.asarray(given)
            return Crops(lambda wanted: recorded[rows[wanted]])
        if source is None or not query.images:
            return None
        known: dict[int, NDArray[np.float32]] | None = None if remembers else {}
        if isinstance(given, CropSimilarities):
            known = {detection: given.crops[row_of_crop]
                     for detection, row_of_crop in enumerate(rows.tolist()) if row_of_crop >= 0}
        of_image = source.crops(query.images[row], frame.detections.bboxes_xyxy, known)

        def compare(wanted: NDArray[np.int64]) -> Similarities:
            begin_stage('CLIP')
            similarities = of_image.compare(wanted)
            begin_stage('search')
            return similarities
        return Crops(compare, of_image.known)

    def _localize(self, query: Query, others: Sequence[Observation], newest: Observation,
                  crops: Crops | None, recognizer: ImageRecognizer | None, request: float
                  ) -> Relocalization:
        """Localize the newest frame together with the other frames, and store the full query."""
        budget = self._relocalizer.begin(len(others) + 1, len(others) + 1, request) \
            if others else None
        beside = [self._relocalizer.search(other, budget.search_end(number, len(others) + 1))
                  for number, other in enumerate(others, start=1)] if budget else []
        rooms: list[int] = []
        if crops is not None:
            rooms, room = [len(crops.known)], crops.room

            def recorded_room() -> int:
                rooms.append(max(0, room()))
                return rooms[-1]
            crops = replace(crops, room=recorded_room)
        is_alone = newest.odom_from_camera is None or query.run is None
        earlier, looks = list[KeptInstant](), NO_LOOKS
        if not is_alone:
            if query.run != self._run or newest.stamp_ns < self._stamp_ns:
                self._instants, self._looks = [], Looks()
                self.track = self._accepted = None
            self._run, self._stamp_ns = query.run, newest.stamp_ns
            looks = self._looks
            earlier, anchor = instants_to_fuse(self._instants, newest, query.limit, query.length_s)
            while earlier and sum(len(instant.searched) for instant in earlier) + len(beside) \
                    >= MAX_FRAMES:
                del earlier[0]
        searched, found = localize_on_demand(
            self._relocalizer,
            [*(frame for instant in earlier for frame in instant.searched), *beside],
            newest, crops, looks, recognizer, budget, self.cameras, request)
        seen = found.recognition
        self.query = replace(query, frames=(*others, searched.observation), rooms=tuple(rooms),
                             by_keyframes=query.by_keyframes and (
                                 seen is None or seen.is_complete),
                             is_thorough=seen is not None and seen.is_thorough)
        if found.refusal_kind is RefusalKind.SEARCH_CUT_SHORT and time.monotonic() >= request:
            found = replace(found, reason=found.reason.partition('; raise ')[0] + _RAISE)
        if self._keyframes is not None and query.images and not found.accepted:
            if not self.query.by_keyframes:
                late = 'keyframes: time was up' + _RAISE
                found = replace(found, reason=f'{found.reason}; {late}') if found.solved else \
                    replace(found, reason=late, refusal_kind=RefusalKind.TIME_UP)
            elif seen is not None and query.is_thorough and not seen.is_thorough:
                found = replace(found, reason=f'{found.reason}; thorough search of keyframes: '
                                              'time was up' + _RAISE)
        if seen is not None and seen.outside_m is not None and not found.accepted:
            found = replace(found, reason=(
                f'keyframes give z {seen.outside_m:.2f} m, outside height_range_m '
                f'{list(self._relocalizer.options.height_range_m)}: correct or remove it; '
                f'{found.reason}'))
        if is_alone:
            return found
        while earlier and sum(len(instant.searched) for instant in earlier) + len(beside) \
                >= found.frames:
            del earlier[0]  # odometry does not link it
            self.track = self._accepted = None
        self._instants = [*earlier, KeptInstant((*beside, searched), anchor)]
        if found.map_from_camera is not None and found.evidence is not None:
            self._looks = self._looks.with_look(Look(
                replace(newest, similarities=None, compared=None), found.map_from_camera,
                replace(found.evidence, camera=1.0).confidence, found.recognized,
                found.evidence.confidence), found.accepted)
        return found

    def follow(self, found: Relocalization, is_new: bool = False) -> NDArray[np.float64] | None:
        """Update the track with the newest result, and return its covariance for filters (6, 6).

        Call this once for each result that is published. With this covariance, a filter may fuse
        all accepted results as independent measurements. Without odometry, there is no track, and
        the covariance of the result is returned unchanged.

        Parameters
        ----------
        is_new : bool
            Whether an accepted result begins a new track: the robot may have been carried.
        """
        assert self.query is not None
        odom_from_camera = self.query.newest.odom_from_camera
        if self.query.run is None or odom_from_camera is None:
            self.track = None
            return found.covariance
        if found.map_from_camera is None or found.covariance is None or found.evidence is None:
            self.track = self.track and self.track.carried(odom_from_camera)
            return None
        answer = Answered(odom_from_camera, found.map_from_camera, found.covariance,
                          found.evidence.confidence, found.accepted)
        self.track = follow(None if is_new and found.accepted else self.track, answer)
        if not found.accepted:
            return found.covariance
        # a filter does not get refused results, so it knows less than the track
        self._accepted = follow(self._accepted, answer)
        assert self._accepted is not None
        return self._accepted.for_filter


def repeat(case: Case, localizer: Localizer, crops: CropSource | None = None) -> Relocalization:
    """Repeat a recorded request with a new localizer. On the same map, the answer is identical.

    `crops` are required if the options compare crops with labels.

    Raises
    ------
    CliplocError
        The case is damaged, or was not recorded with this map.
    """
    for query in case.queries:
        found = localizer.answer(query, crops)
    return found


def instants_to_fuse(instants: Sequence[KeptInstant], observation: Observation, limit: int,
                     length_s: float) -> tuple[list[KeptInstant], NDArray[np.float64]]:
    """Select the instants to fuse a new instant with, oldest first; also return its anchor.

    If there are too many instants, those furthest apart are kept, so that a camera that turns is
    localized with everything that it saw on the way.
    """
    first_ns = observation.stamp_ns - round(length_s * NS_PER_S)
    # skip instants without detections
    earlier = [instant for instant in instants
               if first_ns <= instant.stamp_ns < observation.stamp_ns
               and any(len(frame.observation.detections) for frame in instant.searched)]
    anchor = observation.odom_from_camera
    assert anchor is not None
    if earlier and max(_steps(earlier[-1].anchor, anchor)) <= 1.0:
        anchor = earlier.pop().anchor
    while len(earlier) >= limit:
        # drop the instant nearest to its neighbours, but neither end if possible
        anchors = [*(instant.anchor for instant in earlier), anchor]
        ways = [sum(_steps(anchors[row - 1], anchors[row])
                    + _steps(anchors[row], anchors[row + 1]))
                for row in range(1, len(anchors) - 1)]
        del earlier[1 + int(np.argmin(ways)) if ways else 0]
    return earlier, anchor


def _steps(before: NDArray[np.float64], after: NDArray[np.float64]) -> tuple[float, float]:
    """Return distance and angle between two camera poses, in units of the tolerance SAME_VIEW."""
    distance_m, angle_deg = pose_error(before, after)
    return distance_m / SAME_VIEW.distance_m, angle_deg / SAME_VIEW.angle_deg
