# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Match objects of the recording with landmarks of the old map, and decide the fates of all.

Every landmark gets at most one object of its class, and every object at most one landmark, so that
the sum of gains is the greatest possible (Hungarian method). A gain is a log-likelihood ratio of
appearance and size, plus a bonus for an object in the place of the landmark. Pairs without a
positive gain are not matched.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from cliploc_ros.core.map.landmark_embeddings import LandmarkEmbeddings, concatenated
from cliploc_ros.offline.mapping.labelling import embed_landmarks
from cliploc_ros.offline.mapping.landmarks import Landmarks
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.mapping.update.alignment import OldMap, has_moved
from cliploc_ros.offline.mapping.update.judging import Judgement

# Gains, in nats. Chosen: one dissimilar appearance does not outweigh an object in its place, but
# two exchanged ones do; appearance decides whether a new object is a missing one.
_IN_PLACE_GAIN, _NEAR_GAIN, _ELSEWHERE_GAIN = 8.0, 6.0, 4.0
_MAX_LOOK_GAIN = 5.0
# Among similar objects the nearest is chosen: the gain falls with log(1 + distance / length [m]).
_WAY_GAIN, _WAY_M = 1.2, 0.3
# A landmark that is only doubtful has not moved farther than this [m]. Chosen.
_MAX_DOUBTED_MOVE_M = 1.5
# A landmark that was seen in a greater share of the viewpoints has not moved: false detections
# appear in fewer viewpoints. Chosen.
_MOST_SEEN_IF_MOVED = 0.05
# A match is ambiguous if the gain of another landmark is lower by less than this.
_AMBIGUOUS_GAIN = 1.0
# Deviation of the logarithm of an object's size, and the greatest difference. Chosen.
_SIZE_SIGMA, _MAX_SIZE_CHANGE = 0.25, 0.8
# Least number of objects in their places from which to learn the similarity of embeddings.
_FEWEST_LOOKS = 8
# A landmark in its place is doubtful if its similarity is this many deviations below the usual.
_DOUBT = 1.0


class Fates(NamedTuple):
    """Rows of L old landmarks, by their fate, and new objects."""

    #: Rows of old landmarks
    confirmed: NDArray[np.int64]
    moved: NDArray[np.int64]
    missing: NDArray[np.int64]
    not_observed: NDArray[np.int64]
    kept: NDArray[np.int64]  #: All that are in the new map
    new: NDArray[np.int64]  #: Objects that are not an old landmark
    objects: NDArray[np.int64]  #: (L,): the object that each old landmark is, -1 for none
    rivals: dict[int, tuple[int, ...]]  #: Other old landmarks that an object could be


def decide_fates(known: OldMap, judged: Judgement, looks: 'Likeness | None', here: int) -> Fates:
    """Return the fate of each old landmark; only the first ones are still in the map."""
    numbers, rivals = _identify(known, judged, looks)
    found, rows = numbers >= 0, np.arange(len(numbers))
    elsewhere = found & (numbers != rows)
    # an object slightly off its place did not move: it was mapped inaccurately
    away = np.nonzero(elsewhere)[0]
    elsewhere[away] = has_moved(known.landmarks.select(away), known.sigmas[away],
                                judged.refits.select(numbers[away]))
    is_lost = ~found & (rows < here)
    missing = is_lost & ((judged.is_gone & ~judged.is_doubtful) | judged.is_there)
    new = len(rows) + np.nonzero([not find.weak for find in judged.finds.each])[0]
    return Fates(rows[found & ~elsewhere], rows[elsewhere], rows[missing],
                 rows[is_lost & ~missing], rows[found | (is_lost & ~missing)],
                 np.setdiff1d(new, numbers[found]), numbers, rivals)


class Likeness(NamedTuple):
    """Embeddings of landmarks and objects by one encoder: unit rows, zero if unknown."""

    landmarks: NDArray[np.float32]  #: (L, d): of the old map
    objects: NDArray[np.float32]  #: (m, d): of the recording

    def similarities(self, rows: NDArray[np.int64], objects: NDArray[np.int64]
                     ) -> NDArray[np.float64]:
        """Return cosines (k, j) of landmarks and objects; NaN if one is unknown."""
        first, second = self.landmarks[rows], self.objects[objects]
        cosines = (first @ second.T).astype(np.float64)
        cosines[~first.any(axis=1)] = np.nan
        cosines[:, ~second.any(axis=1)] = np.nan
        return cosines


def why_not_comparable(old: LandmarkEmbeddings | None, detections: PosedDetections) -> str:
    """Return why the embeddings of a map and a recording cannot be compared; '' if they can."""
    if old is None:
        return 'the map has no image embeddings'
    if detections.embeddings is None or not detections.encoder_key:
        return 'the recording has no embeddings that name their encoder; record it with CLIP'
    if old.encoder_key != detections.encoder_key:
        return f"the map's encoder is {old.encoder_key}, the recording's {detections.encoder_key}"
    if old.means.shape[1] != detections.embeddings.shape[1]:
        return 'the embeddings of map and recording differ in length'
    return ''


def compare_looks(old: LandmarkEmbeddings, landmark_ids: Sequence[str],
                  detections: PosedDetections, judged: Judgement) -> Likeness:
    """Return the embeddings of the old landmarks, by their ids, and of the recording's objects."""
    of_objects = embed_landmarks([str(number) for number in range(len(judged.sight.seen))],
                                 detections, judged.shown)
    return Likeness(old.in_order(landmark_ids).means.astype(np.float32),
                    of_objects.means.astype(np.float32))


def renew_embeddings(old: LandmarkEmbeddings | None, landmark_ids: Sequence[str],
                     detections: PosedDetections, shown: NDArray[np.int64]
                     ) -> LandmarkEmbeddings | None:
    """Return the embeddings of the new map: old ones if known, otherwise the recording's.

    The ids are those of the new map; shown (n,) is the row in it that each box shows, -1 for none.
    """
    kept = None if old is None else old.in_order(landmark_ids)
    if detections.embeddings is None or not detections.encoder_key:
        return kept
    seen = embed_landmarks(landmark_ids, detections, shown)
    if kept is None:
        return seen
    if why_not_comparable(kept, detections):
        return kept
    known = dict(zip(landmark_ids, kept.is_known.tolist(), strict=True))
    parts = [embeddings.in_order([name for name in landmark_ids if known[name] == is_known])
             for embeddings, is_known in ((kept, True), (seen, False))]
    return concatenated(parts, parts[0].landmark_ids + parts[1].landmark_ids).in_order(
        landmark_ids)


class _LookModel(NamedTuple):
    """Cosines of two embeddings of one object, and of two objects of one class."""

    own: float
    other: float
    sigma: float

    def gains(self, cosines: NDArray[np.float64]) -> NDArray[np.float64]:
        middle = 0.5 * (self.own + self.other)
        gains = (self.own - self.other) * (cosines - middle) / self.sigma ** 2
        return np.nan_to_num(np.clip(gains, -_MAX_LOOK_GAIN, _MAX_LOOK_GAIN), nan=0.0)


def _identify(known: OldMap, judged: Judgement, looks: Likeness | None
              ) -> tuple[NDArray[np.int64], dict[int, tuple[int, ...]]]:
    """Return the object (L,) that each old landmark is, -1 for none, and the rivals of objects.

    A landmark that is gone may be any new object, and a doubtful one may be a nearby object. Any
    other landmark can only be the object in its place or near it.
    """
    held = np.nonzero(judged.is_there)[0]
    result = np.where(judged.is_there, np.arange(len(known.sigmas)), -1)
    groups = _class_groups(known, judged.landmarks)
    model = None if looks is None else _learn_looks(judged, looks, groups)
    doubtful = np.zeros(len(held), dtype=np.bool_)
    if looks is not None and model is not None:
        cosines = looks.similarities(held, held).diagonal()  # NaN is not doubtful
        doubtful = cosines < model.own - _DOUBT * model.sigma
    own = judged.sight.select(slice(len(known.sigmas)))
    searched = (judged.is_gone | judged.is_doubtful) & (
        own.seen <= _MOST_SEEN_IF_MOVED * own.expected)
    searched[[row for _, row in judged.near]] = True
    searched[held] = doubtful
    offered = np.arange(len(judged.sight.seen)) >= len(known.sigmas)
    offered[held] = doubtful
    rivals: dict[int, tuple[int, ...]] = {}
    of_landmarks = np.where(known.landmarks.classes >= 0, groups[known.landmarks.classes], -1)
    of_objects = np.where(judged.landmarks.classes >= 0, groups[judged.landmarks.classes], -1)
    for group in np.unique(of_objects[offered]):
        rows = np.nonzero(searched & (of_landmarks == group))[0]
        columns = np.nonzero(offered & (of_objects == group))[0]
        if len(rows) and len(columns):
            gains = _gains(known, judged, rows, columns)
            if looks is not None and model is not None:
                gains += model.gains(looks.similarities(rows, columns))
            result[rows], close = _assign(gains, rows, columns)
            rivals |= close
    return result, rivals


def _class_groups(known: OldMap, objects: Landmarks) -> NDArray[np.int64]:
    """Return a group for each class; all classes of a landmark are in one group."""
    count = 1 + int(objects.names[:, 1].max(initial=0))
    rows, classes = known.landmarks.names.T
    main = known.landmarks.classes[rows]
    links = coo_matrix((np.ones(len(main)), (main, classes)), shape=(count, count))
    return np.asarray(connected_components(links, directed=False)[1], dtype=np.int64)


def _learn_looks(judged: Judgement, looks: Likeness, groups: NDArray[np.int64]
                 ) -> _LookModel | None:
    """Learn the cosines of embeddings from the landmarks in their place; None if too few."""
    held = np.nonzero(judged.is_there)[0]
    own, other = [np.empty(0)], [np.empty(0)]
    classes = groups[judged.landmarks.classes[held]]
    for group in np.unique(classes):
        columns = held[classes == group]
        cosines = looks.similarities(columns, columns)
        is_own = np.eye(len(columns), dtype=np.bool_)
        own.append(cosines[is_own])
        other.append(cosines[~is_own])
    same, different = (values[np.isfinite(values)] for values in map(np.concatenate, (own, other)))
    if len(same) < _FEWEST_LOOKS or len(different) < _FEWEST_LOOKS:
        return None
    middle, elsewhere = float(np.median(same)), float(np.median(different))
    if middle <= elsewhere:
        return None  # embeddings cannot distinguish objects here
    spreads = [1.4826 * float(np.median(np.abs(values - center)))
               for values, center in ((same, middle), (different, elsewhere))]
    return _LookModel(middle, elsewhere, max(*spreads, 1e-3))


def _gains(known: OldMap, judged: Judgement, rows: NDArray[np.int64], columns: NDArray[np.int64]
           ) -> NDArray[np.float64]:
    """Return the gains (k, j) by place, class, size and distance; -inf for impossible pairs."""
    sizes = [np.log(np.sort(np.linalg.norm(landmarks.bases, axis=1), axis=1)[:, 1:]).mean(axis=1)
             for landmarks in (known.landmarks.select(rows), judged.landmarks.select(columns))]
    change = np.abs(sizes[0][:, None] - sizes[1][None])
    ways_m = np.linalg.norm(known.landmarks.centers[rows][:, None]
                            - judged.landmarks.centers[columns][None], axis=2)
    gains = (_ELSEWHERE_GAIN - 0.5 * np.square(change / _SIZE_SIGMA)
             - _WAY_GAIN * np.log1p(ways_m / _WAY_M))
    names = known.names
    for place, row in enumerate(rows):
        for column, number in enumerate(columns):
            if number == row:
                gains[place, column] = _IN_PLACE_GAIN
            elif (int(number), int(row)) in judged.near:
                gains[place, column] += _NEAR_GAIN - _ELSEWHERE_GAIN
            elif (change[place, column] > _MAX_SIZE_CHANGE
                  or not (judged.is_gone[row] or judged.is_there[row]
                          or (judged.is_doubtful[row]
                              and ways_m[place, column] < _MAX_DOUBTED_MOVE_M))
                  or (int(row), int(judged.landmarks.classes[number])) not in names):
                gains[place, column] = -np.inf
    return gains


def _assign(gains: NDArray[np.float64], rows: NDArray[np.int64], columns: NDArray[np.int64]
            ) -> tuple[NDArray[np.int64], dict[int, tuple[int, ...]]]:
    """Return the object of each row, -1 for none, and the rivals of the rows."""
    useful = np.maximum(np.nan_to_num(gains, neginf=0.0), 0.0)
    chosen = np.full(len(rows), -1, dtype=np.int64)
    rivals = {}
    for place, column in zip(*linear_sum_assignment(useful, maximize=True), strict=True):
        if useful[place, column] <= 0.0:
            continue
        chosen[place] = columns[column]
        close = gains[:, column] > gains[place, column] - _AMBIGUOUS_GAIN
        close[place] = False
        if close.any():
            rivals[int(columns[column])] = tuple(int(row) for row in rows[close])
    return chosen, rivals
