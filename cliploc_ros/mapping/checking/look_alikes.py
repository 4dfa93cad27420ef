# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Places that look alike: landmarks that a turn about the vertical and a shift lay on others.

Two pairs of landmarks with equal classes, distance and difference in height give the turn and
the shift. Pairs vote for where the place is, where it seems to be, and the turn; what gets most
votes is verified on all landmarks around.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cliploc_ros.core.maps.landmark_map import LandmarkMap

#: A place is what lies within this of its middle: about what one image shows [m].
RADIUS_M = 2.0
# Landmarks this near to where others are expected cannot be told from them [m].
_TOLERANCE_M = 0.25
_MIN_PAIR_M = 0.3
_MIN_MATCHED = 4
# Share of a place's landmarks that the other one repeats.
_MIN_SHARE = 0.6
_MIN_SHIFT_M, _MIN_TURN_DEG = 1.0, 45.0
# Bounds of the work in large maps.
_MAX_PAIRS_OF_A_KIND = 60
_MAX_PAIRS = 100_000
_VERIFIED = 500
_MEMBERS_TRIED = 4
_TURN_BIN_DEG = 20.0


@dataclass(frozen=True)
class LookAlike:
    """A pair of places that look alike.

    Parameters
    ----------
    first, second : tuple of float
        The middles of the places [m].
    matched : tuple of (str, str)
        Landmarks of the first place, and those of the second place that they look like.
    landmarks : int
        The greater number of landmarks of the two places.
    share : float
        Share of these that are matched, 0 to 1.
    same_labels : int
        Matched landmarks whose labels are equal, so that no crop tells them apart.
    turn_deg : float
        About the vertical, from the first place to the second [deg].
    """

    first: tuple[float, float, float]
    second: tuple[float, float, float]
    matched: tuple[tuple[str, str], ...]
    landmarks: int
    share: float
    same_labels: int
    turn_deg: float


def find_look_alikes(landmark_map: LandmarkMap, rng: np.random.Generator) -> list[LookAlike]:
    """Return the pairs of places that look alike, the most alike first.

    A place that a turn by more than 45 degrees lays on itself counts, too.

    Parameters
    ----------
    landmark_map : LandmarkMap
        With z up.
    rng : numpy.random.Generator
        Chooses among the pairs of landmarks of a map that has too many.
    """
    centers = landmark_map.centers
    classes = landmark_map.classes.of_landmarks
    tree = cKDTree(centers[:, :2])
    pairs = _pairs(tree, centers, rng)
    if len(pairs) == 0:
        return []
    first, second = _matching_pairs(pairs, centers, classes, rng)
    found = [one for members in _candidates(centers, pairs, first, second)
             if (one := _verified(landmark_map, classes, tree, *members)) is not None]
    return _distinct(found)


def _pairs(tree: cKDTree, centers: NDArray[np.float64], rng: np.random.Generator
           ) -> NDArray[np.int64]:
    """Return pairs (p, 2) of landmarks that one image may show."""
    pairs = tree.query_pairs(RADIUS_M, output_type='ndarray')
    lengths = np.linalg.norm(centers[pairs[:, 0], :2] - centers[pairs[:, 1], :2], axis=1)
    pairs = pairs[lengths > _MIN_PAIR_M]
    if len(pairs) > _MAX_PAIRS:
        pairs = pairs[np.sort(rng.choice(len(pairs), _MAX_PAIRS, replace=False))]
    return np.concatenate([pairs, pairs[:, ::-1]]).astype(np.int64)


def _matching_pairs(pairs: NDArray[np.int64], centers: NDArray[np.float64],
                    classes: NDArray[np.int64], rng: np.random.Generator
                    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return rows of pairs that are alike in class, distance and height."""
    offsets = centers[pairs[:, 1]] - centers[pairs[:, 0]]
    kinds = np.stack([classes[pairs[:, 0]], classes[pairs[:, 1]],
                      np.floor(np.linalg.norm(offsets[:, :2], axis=1) / _TOLERANCE_M),
                      np.round(offsets[:, 2] / _TOLERANCE_M)], axis=1).astype(np.int64)
    _, kind_of, counts = np.unique(kinds, axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(kind_of.ravel(), kind='stable')
    firsts, seconds = [], []
    for members in np.split(order, np.cumsum(counts)[:-1]):
        if len(members) > _MAX_PAIRS_OF_A_KIND:
            members = rng.choice(members, _MAX_PAIRS_OF_A_KIND, replace=False)
        one, other = np.triu_indices(len(members), 1)
        firsts.append(members[one])
        seconds.append(members[other])
    return np.concatenate(firsts), np.concatenate(seconds)


def _candidates(centers: NDArray[np.float64], pairs: NDArray[np.int64],
                first: NDArray[np.int64], second: NDArray[np.int64]
                ) -> list[tuple[float, NDArray[np.float64], NDArray[np.float64]]]:
    """Return turns [rad] with the middles of place and look-alike, the most votes first."""
    offsets = centers[pairs[:, 1], :2] - centers[pairs[:, 0], :2]
    angles = np.arctan2(offsets[:, 1], offsets[:, 0])
    turns = (angles[second] - angles[first] + np.pi) % (2.0 * np.pi) - np.pi
    middles = 0.5 * (centers[pairs[:, 0]] + centers[pairs[:, 1]])
    shifts = np.linalg.norm(middles[second] - middles[first], axis=1)
    apart = (shifts > _MIN_SHIFT_M) | (np.abs(turns) > np.radians(_MIN_TURN_DEG))
    first, second, turns = first[apart], second[apart], turns[apart]
    if len(first) == 0:
        return []
    cells = np.concatenate([np.floor(middles[first] / RADIUS_M), np.floor(middles[second]
                                                                          / RADIUS_M),
                            np.round(turns / np.radians(_TURN_BIN_DEG))[:, None]], axis=1)
    _, cell_of, votes = np.unique(cells.astype(np.int64), axis=0, return_inverse=True,
                                  return_counts=True)
    order = np.argsort(cell_of.ravel(), kind='stable')
    begins = np.cumsum(votes) - votes
    return [(float(turns[row]), middles[first[row]], middles[second[row]])
            for number in np.argsort(-votes, kind='stable')[:_VERIFIED]
            for row in order[begins[number]:][:min(votes[number], _MEMBERS_TRIED)]]


def _verified(landmark_map: LandmarkMap, classes: NDArray[np.int64], tree: cKDTree, turn: float,
              here: NDArray[np.float64], there: NDArray[np.float64]) -> LookAlike | None:
    """Return the pair of places, if most of their landmarks match."""
    around = np.array(tree.query_ball_point(here[:2], RADIUS_M))
    targets = np.array(tree.query_ball_point(there[:2], RADIUS_M))
    cosine, sine = np.cos(turn), np.sin(turn)
    rotation = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    moved = (landmark_map.centers[around] - here) @ rotation.T + there
    distances = np.linalg.norm(moved[:, None] - landmark_map.centers[targets][None], axis=2)
    distances[classes[around][:, None] != classes[targets][None]] = np.inf
    matched: list[tuple[int, int]] = []
    for flat in np.argsort(distances, axis=None):
        row, column = divmod(int(flat), len(targets))
        if distances[row, column] > _TOLERANCE_M:
            break
        one, other = int(around[row]), int(targets[column])
        if one != other and all(one != a and other != b for a, b in matched):
            matched.append((one, other))
    landmarks = max(len(around), len(targets))
    share = len(matched) / landmarks
    if len(matched) < _MIN_MATCHED or share < _MIN_SHARE:
        return None
    ids, labels = landmark_map.landmark_ids, landmark_map.labels
    return LookAlike(
        tuple(here.tolist()), tuple(there.tolist()),
        tuple((ids[one], ids[other]) for one, other in matched), landmarks, share,
        sum(labels[one] == labels[other] for one, other in matched), float(np.degrees(turn)))


def _distinct(found: list[LookAlike]) -> list[LookAlike]:
    """Return the best of the pairs that mean the same places, the most alike first."""
    kept: list[LookAlike] = []
    for one in sorted(found, key=lambda one: (-len(one.matched) * one.share, -one.share)):
        if not any((_near(one.first, other.first) and _near(one.second, other.second))
                   or (_near(one.first, other.second) and _near(one.second, other.first))
                   for other in kept):
            kept.append(one)
    return kept


def _near(first: tuple[float, float, float], second: tuple[float, float, float]) -> bool:
    return float(np.hypot(first[0] - second[0], first[1] - second[1])) < RADIUS_M
