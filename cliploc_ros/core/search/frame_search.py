# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Associate one frame with the map, and search it by the algorithm that the options name.

Candidates are pairs of a detection and a landmark that it may show. Matching types (Matsuzaki et
al. 2024, Sec. IV-A3): *class* pairs detections and landmarks of equal detector class, *clip* pairs
each detection with the k landmarks whose labels are most similar to its crop, and *hybrid* samples
from the clip pairs and verifies with both.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from math import comb, inf
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.depth import depth_deviations
from cliploc_ros.core.map.culling import FEW, SortedLandmarks
from cliploc_ros.core.map.joined_map import parts_of
from cliploc_ros.core.map.landmark_map import ClassIndex, LandmarkMap
from cliploc_ros.core.map.similarities import Similarities, nearest_landmarks
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import Deadline, RelocalizerOptions
from cliploc_ros.core.search import strategies
from cliploc_ros.core.search.scene import VERTICAL_UNKNOWN, Constraint, Scene, make_scene
from cliploc_ros.errors import OptionsError

#: Maximum number of candidates of auto. Their compatibility mask takes the square of this number
#: in bytes and a few milliseconds to compute. In sparse maps of 100,000 landmarks this limit ends
#: the search before the limit of iterations does: candidates of equal class are rarely neighbours.
MAX_CANDIDATES = 1_500
# No lens yields larger coordinates on the plane z = 1; the squares of smaller ones are finite.
_FARTHEST = 1e6
# Larger depths have a different unit.
_FARTHEST_M = 40.0
#: Number of best hypotheses that are refined. On the recorded frames, a hypothesis of lower rank
#: never became the best by refinement.
REFINED = 32
# The third axis of the map points up (REP 103), the second axis of the optical frame down.
_UP_IN_MAP = (0.0, 0.0, 1.0)
_UPRIGHT = (0.0, -1.0, 0.0)
_UNIT_TOLERANCE = 1e-3


class Candidates(NamedTuple):
    """Correspondence candidates, in the sampler's order of preference."""

    #: (c,), (c,): indices of the detection and the landmark
    detections: NDArray[np.int64]
    landmarks: NDArray[np.int64]
    #: (c,): 0 for a detection's most similar landmark, 1 for the next, and so on
    ranks: NDArray[np.int64]
    #: (c,): cosine similarity of crop and label; 0 for candidates by class
    similarities: NDArray[np.float64]

    @property
    def pairs(self) -> NDArray[np.int64]:
        """Return (detection, landmark) of each candidate (c, 2)."""
        return np.stack([self.detections, self.landmarks], axis=1)

    def select(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> 'Candidates':
        """Return the selected candidates."""
        return Candidates._make(column[rows] for column in self)

    def moved(self, first: int) -> 'Candidates':
        """Return the candidates of one of several maps, whose landmarks start at row `first`."""
        return self._replace(landmarks=self.landmarks + first)

    def ordered(self, *keys: NDArray[np.float64] | NDArray[np.int64]) -> 'Candidates':
        """Sort the candidates by keys, the primary key first; ties keep their order."""
        return self.select(np.lexsort(keys[::-1]))


def class_candidates(index: ClassIndex, classes: NDArray[np.int64], limit: int | None = None
                     ) -> Candidates:
    """Return the pairs of equal class, detection by detection.

    With a limit, the pairs of the rarest classes are kept: pairs of a class with few landmarks
    are the most probable.

    Parameters
    ----------
    classes : ndarray (n,) of int
        Class of each detection, as numbered in the index; negative: no class of the map.
    """
    order = np.arange(len(classes)) if limit is None else np.argsort(index.sizes_of(classes),
                                                                     kind='stable')
    pairs = index.pairs(classes, order, limit)
    zeros = np.zeros(len(pairs))
    return Candidates(pairs[:, 0], pairs[:, 1], zeros.astype(np.int64), zeros)


def nearest_candidates(similarities: Similarities, k: int) -> Candidates:
    """Return the k most similar landmarks of each detection as candidates, best first.

    The map has at least k landmarks.
    """
    detection_count, _ = similarities.shape
    landmarks, values = nearest_landmarks(similarities, k)
    return Candidates(np.repeat(np.arange(detection_count), k), landmarks.ravel(),
                      np.tile(np.arange(k), detection_count), values.ravel().astype(np.float64))


def balanced_order(candidates: Candidates) -> Candidates:
    """Sort by rank, then by decreasing similarity: all nearest landmarks, all second-nearest, ...

    The order of B-PROSAC (Matsuzaki et al. 2024, Fig. 3) keeps large, confident detections from
    filling the head of the list.
    """
    return candidates.ordered(candidates.ranks, -candidates.similarities)


def concatenated(lists: Sequence[Candidates]) -> Candidates:
    """Concatenate one or more lists of candidates."""
    return Candidates(*map(np.concatenate, zip(*lists, strict=True)))


def joined(first: Candidates, second: Candidates, landmark_count: int) -> Candidates:
    """Return the first candidates, followed by the second candidates that are not among them."""
    known = first.detections * landmark_count + first.landmarks
    new = np.nonzero(~np.isin(second.detections * landmark_count + second.landmarks, known))[0]
    return concatenated([first, second.select(new)])


def match_frame(landmark_map: LandmarkMap, observation: Observation, options: RelocalizerOptions
                ) -> tuple[Scene, int]:
    """Associate one frame with the map.

    Returns
    -------
    scene : Scene
        Its pairs are the candidates, in the order of the sampler.
    left_out : int
        Number of candidates dropped because of the limit of auto.

    Raises
    ------
    OptionsError
        The similarities that the matching type needs are missing, of the wrong shape, or not
        finite, or the depths are of the wrong shape.
    """
    bboxes = observation.camera.normalize_bboxes(observation.detections.bboxes_xyxy)
    # where the lens model has no inverse, boxes are NaN; a box with swapped corners has no ellipse
    sound = (bboxes[:, 2:] > bboxes[:, :2]).all(axis=1) & (np.abs(bboxes) < _FARTHEST).all(axis=1)
    classes = landmark_map.classes.classes_of(observation.detections.class_ids)
    classes[~sound] = -1
    nearest = _nearest(landmark_map, observation, options, sound)
    candidates, left_out = _candidates(landmark_map, observation.detections.class_ids, classes,
                                       nearest, options)
    by_class = classes if options.matching != 'clip' else np.full_like(classes, -1)
    single, sorted_landmarks = _potential(landmark_map, by_class, nearest)
    # no pair refers to a box that is not sound: its placeholder has no effect
    return make_scene(np.where(sound[:, None], bboxes, 1.0), landmark_map.centers,
                      landmark_map.shapes, single, candidates.pairs, options.iou_threshold,
                      sorted_landmarks, by_class, _depths(observation, options)), left_out


def _depths(observation: Observation, options: RelocalizerOptions) -> NDArray[np.float64] | None:
    """Return the depths of a scene (n, 2), or None: the paper's algorithms do not use depths."""
    depths = observation.depths
    if depths is None or options.algorithm != 'auto':
        return None
    if depths.shape != (len(observation.detections),):
        raise OptionsError(f'depths has shape {depths.shape}, but there are '
                           f'{len(observation.detections)} detections')
    with np.errstate(invalid='ignore'):
        known = (depths > 0.0) & (depths < _FARTHEST_M)
    return np.where(known[:, None], np.column_stack([depths, depth_deviations(depths)]), 0.0)


def _potential(landmark_map: LandmarkMap, classes: NDArray[np.int64], nearest: Candidates | None
               ) -> tuple[NDArray[np.int64], SortedLandmarks | None]:
    """Return the pairs (p, 2) to verify, and further landmarks to verify by class.

    In a small map the pairs include all pairs of equal class: culling costs more than it saves.
    """
    if len(landmark_map) <= FEW:
        of_class = class_candidates(landmark_map.classes, classes)
        return (of_class if nearest is None else
                joined(nearest, of_class, len(landmark_map))).pairs, None
    if nearest is None:
        return np.empty((0, 2), dtype=np.int64), landmark_map.sorted_landmarks
    shares = landmark_map.classes.shares(nearest.landmarks, classes[nearest.detections])
    return nearest.select(shares == 0.0).pairs, landmark_map.sorted_landmarks


def _nearest(landmark_map: LandmarkMap, observation: Observation, options: RelocalizerOptions,
             sound: NDArray[np.bool_]) -> Candidates | None:
    """Return the k most similar landmarks of each sound detection that was compared, or None.

    None: the matching type needs no similarities.
    """
    if not options.needs_similarities:
        return None
    compared = observation.compared
    if compared is None:
        compared = np.arange(len(observation.detections))
    shape = (len(compared), len(landmark_map))
    similarities = observation.similarities
    if similarities is None or similarities.shape != shape:
        found = 'none' if similarities is None else f'{similarities.shape}'
        raise OptionsError(f"matching '{options.matching}' needs similarities of shape "
                           f'{shape}, found {found}')
    parts, pieces = parts_of(landmark_map), [similarities]
    if len(parts) > 1:
        pieces = np.split(np.asarray(similarities), [part.first for part in parts[1:]], axis=1)
    # k landmarks from each map, so that the labels of one map do not hide rivals in other maps
    nearest = concatenated([
        nearest_candidates(piece, min(options.k, len(part.landmark_map))).moved(part.first)
        for part, piece in zip(parts, pieces, strict=True)])
    nearest = nearest._replace(detections=compared[nearest.detections])
    return nearest.select(sound[nearest.detections])


def _candidates(landmark_map: LandmarkMap, class_ids: Sequence[str],
                classes: NDArray[np.int64], nearest: Candidates | None,
                options: RelocalizerOptions) -> tuple[Candidates, int]:
    """Return the candidates in the order of the sampler, and the number dropped.

    auto uses at most MAX_CANDIDATES pairs of equal class. Several maps have equal shares, and
    their candidates alternate, so that a search that is stopped early covers rivals in all maps.
    """
    index = landmark_map.classes
    if nearest is not None:
        if options.algorithm == 'prosac':  # decreasing similarity (Chum and Matas 2005)
            nearest = nearest.ordered(-nearest.similarities)
        elif options.algorithm in ('b-prosac', 'auto'):
            nearest = balanced_order(nearest)
        if options.matching == 'clip' or options.algorithm != 'auto':
            return nearest, 0
    if options.algorithm != 'auto':
        return class_candidates(index, classes), 0
    parts, found = parts_of(landmark_map), []
    for part in parts:
        of_part = part.landmark_map.classes
        own = np.where(classes >= 0, of_part.classes_of(class_ids), -1)
        found.append(class_candidates(of_part, own, MAX_CANDIDATES // len(parts))
                     .moved(part.first))
    turns = np.concatenate([np.arange(len(candidates.landmarks)) for candidates in found])
    of_class = concatenated(found).ordered(turns)
    left_out = int(index.sizes_of(classes).sum()) - len(of_class.landmarks)
    return of_class if nearest is None else joined(nearest, of_class, len(landmark_map)), left_out


class SearchedFrame(NamedTuple):
    """A frame and the result of its search."""

    observation: Observation
    scene: Scene  #: Scene of the observation
    vertical: NDArray[np.float64]  #: (7,): see VERTICAL_UNKNOWN
    leaders: strategies.Leaders  #: The best hypotheses, as poses of this frame's camera
    #: The best hypotheses found without the vertical; unused if it is unknown
    tilted: strategies.Leaders
    progress: strategies.Progress
    #: (t, 3): the samples tried; None: all samples of the first candidates, see progress.reach
    samples: NDArray[np.int64] | None = None
    firsts: tuple[int, ...] = (0,)  #: Row of the first landmark of each map

    @property
    def sample_size(self) -> int:
        """Return the number of candidates in a minimal sample."""
        return strategies.SAMPLE_SIZE - 1 if self.vertical[6] > 0.0 else strategies.SAMPLE_SIZE

    @property
    def has_samples(self) -> bool:
        """Check whether there are enough different detections and landmarks for a sample."""
        pairs = self.scene.pairs
        return min(len(np.unique(pairs[:, 0])), len(np.unique(pairs[:, 1]))) >= self.sample_size

    @property
    def known_tried(self) -> int:
        """Return the number of samples tried or rejected as incompatible, averaged over the maps.

        Samples across maps are invalid and are not counted.
        """
        maps = np.searchsorted(self.firsts, self.scene.pairs[:self.progress.reach, 1], 'right')
        within = sum(comb(count, self.sample_size) for count in np.bincount(maps).tolist())
        return max(self.progress.tried, within) // len(self.firsts)


def search_frame(landmark_map: LandmarkMap, observation: Observation,
                 options: RelocalizerOptions, deadline: Deadline) -> SearchedFrame:
    """Search one frame until a deadline.

    Raises OptionsError if similarities that the matching type needs are missing or of the wrong
    shape, or if the vertical is not a unit vector.
    """
    if not len(landmark_map):  # a map of keyframes alone: detections match nothing
        none = np.empty(0, dtype=np.int64)
        observation = replace(
            observation, detections=observation.detections.select(none), compared=none,
            similarities=np.empty((0, 0), dtype=np.float32), depths=None)
    scene, left_out = match_frame(landmark_map, observation, options)
    frame = SearchedFrame(
        observation, scene, vertical_of(observation, options),
        strategies.Leaders.none_yet(REFINED if options.refine else strategies.MAX_DISTINCT),
        strategies.Leaders.none_yet(), strategies.Progress(0, 1.0), None,
        tuple(part.first for part in parts_of(landmark_map)))
    if not frame.has_samples:
        return frame
    samples, constraint = None, constraint_of(observation, options)
    if options.algorithm == 'auto':
        try_all = partial(
            strategies.search_progressively, scene, strategies.compatible_pairs(scene),
            constraint=constraint, limit=options.iterations)
        progress = _run(try_all(frame.leaders, size=frame.sample_size), deadline)
        if frame.vertical[6] > 0.0:
            # The vertical may be wrong, for example because the stated camera mount is wrong. Then
            # the pose that the boxes alone suggest must be among the rivals.
            free = _run(try_all(frame.tilted), deadline)
            progress = progress._replace(tried=progress.tried + free.tried)
    elif options.algorithm == 'bf':
        progress = _run(strategies.search_exhaustively(scene, frame.leaders, constraint), deadline)
    else:
        draw = strategies.draw_ransac if options.algorithm == 'ransac' else strategies.draw_prosac
        seed = options.random_seed if options.random_seed >= 0 else None
        samples = draw(scene.pairs, options.iterations, np.random.default_rng(seed))
        progress = _run(strategies.search_samples(scene, samples, frame.leaders, constraint),
                        deadline)
    if left_out:  # kept: the share of samples without dropped candidates
        kept = comb(len(scene.pairs), strategies.SAMPLE_SIZE) / max(
            comb(len(scene.pairs) + left_out, strategies.SAMPLE_SIZE), 1)
        progress = progress._replace(coverage=progress.coverage * kept)
    return frame._replace(progress=progress, samples=samples)


def constraint_of(observation: Observation, options: RelocalizerOptions) -> Constraint:
    """Return the constraints on the camera of a frame that are known before the search."""
    vertical, (low, high) = vertical_of(observation, options), options.height_range_m
    known = vertical[6] > 0.0
    return Constraint(tuple(vertical[:3]) if known else _UPRIGHT, _UP_IN_MAP, low, high,
                      np.radians(options.max_tilt_deg), vertical[6] if known else inf)


def coverage_of(frames: Sequence[SearchedFrame]) -> float:
    """Return the minimum over the frames of the share of samples tried."""
    return min(frame.progress.coverage for frame in frames)


def vertical_of(observation: Observation, options: RelocalizerOptions) -> NDArray[np.float64]:
    """Return the vertical (7,) of a frame, unknown for the paper's algorithms.

    Raises OptionsError if it is not a unit vector.
    """
    up = observation.up_in_camera
    if up is None or options.algorithm != 'auto':
        return VERTICAL_UNKNOWN
    if up.shape != (3,) or not abs(np.linalg.norm(up) - 1.0) < _UNIT_TOLERANCE:
        raise OptionsError(f'up_in_camera: {up} is not a unit vector (3,)')
    return np.array([*up, *_UP_IN_MAP, np.radians(options.vertical_deviation_deg)])


def _run(search: Iterator[strategies.Progress], deadline: Deadline) -> strategies.Progress:
    """Run a search to its end or to a deadline; return its progress."""
    progress = strategies.Progress(0, 1.0)
    for step in search:
        progress = step
        if deadline.is_over:
            break
    return progress
