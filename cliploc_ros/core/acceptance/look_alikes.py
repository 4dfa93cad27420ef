# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Places that look alike, such as two rooms with the same furniture.

A camera has the same view at two places if a turn about the vertical and a shift map the landmarks
of one place onto those of the other. The map is searched for such twins of the best pose, so that
they count as rivals even if the search of poses found only one of the places. `check_map` lists
the places of a map that have twins.

Landmarks on one axis look the same from all directions around it, and chairs around a table nearly
so. The pose turned about such an axis therefore counts as a twin, too.

Two poses at places that look alike explain the same detections. It is then weak evidence that one
of them matches one object more, or fits better, because maps lack objects, and objects move.
Labels distinguish the places. All objects that only one of the places explains have one common
cause: the map of one place is out of date. They therefore count once, not separately.

Within one room, places look alike by chance, and one map shows both. A twin there that explains
clearly fewer objects is a rival like the other poses of a search.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from cliploc_ros.core.acceptance.confidence import Support, utilities
from cliploc_ros.core.calibration import CALIBRATION
from cliploc_ros.core.geometry import transforms
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.pairs import find_repeats

_TERMS = CALIBRATION.twins
_SAME_TURN = np.cos(np.radians(transforms.SAME_MOVE.angle_deg))
_OWN_TURN = np.cos(np.radians(transforms.SAME_ANSWER.angle_deg))
# Both places are upright, so a turn about the vertical maps one onto the other.
_MOST_TILT = np.cos(np.radians(_TERMS.most_tilt_deg))
# How near a moved landmark must lie to a landmark of its class, in successive fits of a move [m].
_NEAR_M = (_TERMS.first_near_m, _TERMS.second_near_m, _TERMS.last_near_m)
# Columns of Support.shown.
_COUNT, _LIKENESS, _UNLABELLED = 0, 3, 5
# Turns about an axis [rad].
_TURNS = np.radians(np.arange(_TERMS.axis_step_deg, 360.0, _TERMS.axis_step_deg))
_NOBODY, _NOWHERE = np.empty(0, dtype=np.int64), np.empty((0, 4, 4))


class Alike(NamedTuple):
    """The m places that look like a given place, the most similar place first."""

    #: (m, 4, 4): moves of the given place onto each other place: a turn about the vertical and a
    #: shift
    moves: NDArray[np.float64]
    landmarks: NDArray[np.int64]  #: (r,): landmarks of the given place
    #: (m, r): the corresponding landmark of the same class at the other place, if found
    others: NDArray[np.int64]
    found: NDArray[np.bool_]  #: (m, r): whether there is a corresponding landmark

    @property
    def shares(self) -> NDArray[np.float64]:
        """Return the share (m,) of the given place's landmarks that are found at each place."""
        return np.asarray(self.found.sum(axis=1) / max(1, len(self.landmarks)))

    def are_rooms(self, least_half: float = 0.0) -> NDArray[np.bool_]:
        """Return which places (m,) are rooms of their own, or the other half of a symmetric room.

        Another half has at least `least_half` common landmarks.

        Many of their common landmarks lie beyond the given place. If the places are so near that
        it has the landmarks of both, a move takes each landmark to another one. Moves that fit by
        chance take several landmarks to one, or a landmark to itself. Rooms that are furnished
        alike may have the same posters, too.
        """
        common = self.found.sum(axis=1)
        beyond = self.found & ~np.isin(self.others, self.landmarks)
        moved = self.found & (self.others != self.landmarks)
        distinct = np.array([len({*others[found]})
                             for others, found in zip(self.others, moved, strict=True)])
        return np.asarray((beyond.sum(axis=1) >= _TERMS.least_share * common)
                          | ((distinct >= _TERMS.one_to_one * common) & (common >= least_half)))


def find_alike(landmark_map: LandmarkMap, position: NDArray[np.float64],
               matched: NDArray[np.int64] = _NOBODY,
               moves: NDArray[np.float64] = _NOWHERE) -> Alike:
    """Find the places that look like the place around a position.

    Two places look alike if the move between them takes enough landmarks near landmarks of their
    class: at least four landmarks, .38 of the landmarks around the position, and .4 of the matched
    landmarks. Moves that change the position by less than 1 m and 45 degrees are ignored.

    Parameters
    ----------
    landmark_map : LandmarkMap
        L landmarks, z up.
    position : ndarray (3,)
    matched : ndarray (n,) of int, optional
        Landmarks that belong to the place whatever their distance.
    moves : ndarray (k, 4, 4), optional
        Moves to try in addition to those that the map suggests.
    """
    # first the matched landmarks, then those around, nearest first
    ranks = [*range(1, min(int(_TERMS.around), len(landmark_map)) + 1)]
    distances, rows = landmark_map.tree.query(
        position, ranks, distance_upper_bound=_TERMS.radius_m) if ranks else (
        np.empty(0), np.empty(0, dtype=np.int64))
    rows = rows[np.isfinite(distances)]
    rows = np.concatenate([matched, rows[~np.isin(rows, matched)]])
    rows = rows[:int(_TERMS.most_landmarks)]
    if len(rows) < _TERMS.least_landmarks:
        return Alike(_NOWHERE, rows, np.empty((0, len(rows)), np.int64),
                     np.empty((0, len(rows)), np.bool_))
    moves, others, found = _verified(landmark_map, rows, np.concatenate(
        [_moves_of_map(landmark_map, rows), moves]), position)
    shares = found.mean(axis=1)
    alike = shares >= _TERMS.least_share
    if len(matched):
        # objects in the image may have been moved, although the rest of the place looks alike
        alike &= ((found[:, :len(matched)].mean(axis=1) >= _TERMS.least_matched)
                  | (shares >= _TERMS.enough))
    ends = np.einsum('nij,rj->nri', moves[:, :3, :3], landmark_map.centers[rows])
    misses = np.linalg.norm(ends + moves[:, None, :3, 3] - landmark_map.centers[others], axis=2)
    order = np.lexsort([(misses * found).sum(axis=1), -shares])
    order = order[alike[order]]
    order = order[transforms.first_of_each(_are_same(moves[order], position), int(_TERMS.most))]
    return Alike(moves[order], rows, others[order], found[order])


def find_twins(landmark_map: LandmarkMap, map_from_camera: NDArray[np.float64],
               matched: NDArray[np.int64], others: NDArray[np.float64]
               ) -> tuple[NDArray[np.float64], Alike]:
    """Return the camera poses at the places that look most like the place of a pose.

    Parameters
    ----------
    map_from_camera : ndarray (4, 4)
    matched : ndarray (n,) of int
        Landmarks that the pose matches. If there are none, all landmarks around the pose count.
    others : ndarray (k, 4, 4)
        Poses that a search found elsewhere, best first. The first five are compared, too.

    Returns
    -------
    poses : ndarray (m, 4, 4)
        At most 3 poses, that of the most similar place first.
    alike : Alike
        These places.
    """
    position = map_from_camera[:3, 3]
    moves = others[:int(_TERMS.others)] @ transforms.invert_transform(map_from_camera)
    moves = moves[moves[:, 2, 2] > _MOST_TILT]
    upright = _upright_moves(np.arctan2(moves[:, 1, 0], moves[:, 0, 0]), position,
                             moves[:, :3, :3] @ position + moves[:, :3, 3])
    alike = find_alike(landmark_map, position, matched, upright)
    return alike.moves @ map_from_camera, alike


def turned_about_axis(landmark_map: LandmarkMap, map_from_camera: NDArray[np.float64],
                      matched: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return a pose turned about an axis that most matched landmarks share, as poses (m, 4, 4).

    Landmarks on one axis determine a pose up to a turn about the axis, because the camera sees the
    same from all around. So do objects around a table: a turn takes a chair to another chair. The
    axis is either vertical, through the mean of the landmarks or the landmark with the most others
    above and below it, or a line fitted to all of them. A turn about a vertical axis must take
    half of the landmarks near landmarks of their class; the line must touch half of them.

    Parameters
    ----------
    map_from_camera : ndarray (4, 4)
    matched : ndarray (n,) of int
        Landmarks that the pose matches.
    """
    if len(matched) < 2:
        return _NOWHERE
    centers, radii = landmark_map.centers[matched], landmark_map.semi_axes[matched].mean(axis=1)
    middle = centers.mean(axis=0)
    beside = np.linalg.norm((centers - centers[:, None])[..., :2], axis=2) <= radii
    central = centers[np.lexsort([np.linalg.norm(centers - middle, axis=1),
                                  -beside.sum(axis=1)])[0]]
    points = np.repeat([central, middle], len(_TURNS), axis=0)
    moves = _upright_moves(np.tile(_TURNS, 2), points, points)
    ends = np.einsum('nij,rj->nri', moves[:, :3, :3], centers) + moves[:, None, :3, 3]
    shares = landmark_map.of_class_near(ends, matched, _NEAR_M[-1])[1].mean(axis=1)
    # the axis with the most landmarks that turns take near landmarks of their class
    best = int(np.argmax(shares.reshape(-1, len(_TURNS)).sum(axis=1))) * len(_TURNS)
    rows = np.arange(best, best + len(_TURNS))
    found = moves[rows[shares[rows] >= _TERMS.on_axis]]
    line = np.linalg.svd(centers - middle)[2][0]
    offsets = centers - middle
    offsets -= (offsets @ line)[:, None] * line
    if (np.linalg.norm(offsets, axis=1) <= radii).mean() >= _TERMS.on_axis:
        moves = np.tile(np.eye(4), (len(_TURNS), 1, 1))
        moves[:, :3, :3] = Rotation.from_rotvec(_TURNS[:, None] * line).as_matrix()
        moves[:, :3, 3] = middle - moves[:, :3, :3] @ middle
        found = np.concatenate([found, moves])
    return np.asarray(found @ map_from_camera)


def lead_over_twin(its: Support, twin: Support, place_share: float = 0.0,
                   is_room: bool = True) -> float:
    """Return the log odds by which objects prefer a pose to its twin at a place that looks alike.

    Objects that both poses explain distinguish the poses by their labels. If the places share few
    objects, an object that only one pose explains counts by its label. If they share many, one of
    the two places is out of date, or was furnished like the other. This one cause then accounts
    for all objects that only one pose explains.

    Parameters
    ----------
    its, twin : Support
        Support of the pose and of its twin.
    place_share : float
        Share of the landmarks around the pose that the other place has, too.
    is_room : bool
        Whether the other place is a separate room. Rooms that are furnished alike may have the
        same errors in their labels, so the labels count less.
    """
    terms = CALIBRATION.places
    common = its.shown.keys() & twin.shown.keys()
    lead, counts, further = 0.0, 0.0, 0.0
    for sign, shown in ((1.0, its.shown), (-1.0, twin.shown)):
        for detection, row in shown.items():
            odds = sign * (terms.likeness * row[_LIKENESS] + terms.unlabelled * row[_UNLABELLED])
            if detection in common:
                lead += odds
            else:
                further, counts = further + odds, counts + sign * row[_COUNT]
    share = sum(its.shown[detection][_COUNT] for detection in common) / max(its.inliers, 1e-9)
    alike = max(
        float(np.interp(share, (terms.differ, terms.alike), (0.0, 1.0))),
        float(np.interp(place_share, (terms.differ_around, terms.alike_around), (0.0, 1.0))))
    most = min(abs(further), terms.unlabelled * abs(counts), terms.aged)
    if is_room:
        lead *= 1.0 - (1.0 - terms.labels) * alike
    lead += (1.0 - alike) * further + alike * math.copysign(most, further)
    if is_room:
        return lead
    own, other = utilities((its, twin))
    by_search = (1.0 + CALIBRATION.objects.slope) * float(own - other)  # see confidences
    differing = float(np.interp(share, (terms.differ_within, terms.alike_within), (1.0, 0.0)))
    return lead + differing * max(0.0, by_search - lead)


def _moves_of_map(landmark_map: LandmarkMap, rows: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the moves (m, 4, 4) of a place onto other places with the most votes of pairs."""
    repeats = find_repeats(landmark_map.pairs, rows[:int(_TERMS.looked_up)])
    order = np.argsort(-repeats.votes, kind='stable')[:int(_TERMS.compared)]
    moves = _upright_moves(repeats.turns[order], landmark_map.centers[repeats.landmarks[order]],
                           landmark_map.centers[repeats.others[order]])
    if len(moves) == 0:
        return moves
    middle = landmark_map.centers[rows].mean(axis=0)
    weights = _are_same(moves, middle) * repeats.votes[order]
    votes = weights.sum(axis=1)
    # each move is replaced by the mean of the moves that are the same
    ends = weights @ (moves[:, :3, :3] @ middle + moves[:, :3, 3]) / votes[:, None]
    moves = _upright_moves(np.arctan2(weights @ moves[:, 1, 0], weights @ moves[:, 0, 0]),
                           middle, ends)[np.argsort(-votes, kind='stable')]
    return moves[transforms.first_of_each(_are_same(moves, middle), int(_TERMS.moves))]


def _upright_moves(turns: NDArray[np.float64], before: NDArray[np.float64],
                   after: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the moves (m, 4, 4) with given yaw angles (m,) that take points to other points.

    Points are `before` (3,) or (m, 3), and `after` (m, 3).
    """
    moves = np.tile(np.eye(4), (len(turns), 1, 1))
    moves[:, 0, 0] = moves[:, 1, 1] = np.cos(turns)
    moves[:, 1, 0], moves[:, 0, 1] = np.sin(turns), -np.sin(turns)
    moves[:, :3, 3] = after - np.einsum('nij,nj->ni', moves[:, :3, :3],
                                        np.broadcast_to(before, (len(turns), 3)))
    return moves


def _are_same(moves: NDArray[np.float64], point: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which pairs of moves (m, m) take a point to the same place with the same turn."""
    ends = moves[:, :3, :3] @ point + moves[:, :3, 3]
    cosines = moves[:, :2, 0] @ moves[:, :2, 0].T
    return np.asarray((cdist(ends, ends) < transforms.SAME_MOVE.distance_m)
                      & (cosines > _SAME_TURN))


def _verified(landmark_map: LandmarkMap, rows: NDArray[np.int64], moves: NDArray[np.float64],
              position: NDArray[np.float64]
              ) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.bool_]]:
    """Fit moves (m, 4, 4) to the landmarks of a place, and drop moves that fit too few of them.

    Also returns the corresponding landmarks (m, r) of each move, and whether they were found.
    """
    centers = landmark_map.centers[rows]
    for near_m in _NEAR_M:
        ends = np.einsum('nij,rj->nri', moves[:, :3, :3], centers) + moves[:, None, :3, 3]
        others, found = landmark_map.of_class_near(ends, rows, near_m)
        kept = found.sum(axis=1) >= _TERMS.least_landmarks
        moves, others, found = moves[kept], others[kept], found[kept]
        if near_m > _NEAR_M[-1]:
            # least-squares fit of upright moves that take centers (r, 3) to after (m, r, 3)
            after = landmark_map.centers[others]
            weights = found / np.maximum(1, found.sum(axis=1, keepdims=True))
            first, second = weights @ centers, np.einsum('nr,nrj->nj', weights, after)
            x, y = np.moveaxis(centers - first[:, None], 2, 0)[:2]
            u, v = np.moveaxis(after - second[:, None], 2, 0)[:2]
            turns = np.arctan2((weights * (x * v - y * u)).sum(axis=1),
                               (weights * (x * u + y * v)).sum(axis=1))
            moves = _upright_moves(turns, first, second)
    steps = moves[:, :3, :3] @ position + moves[:, :3, 3] - position
    elsewhere = ((np.linalg.norm(steps, axis=1) > transforms.RIGHT_M)
                 | (moves[:, 0, 0] < _OWN_TURN))
    return moves[elsewhere], others[elsewhere], found[elsewhere]
