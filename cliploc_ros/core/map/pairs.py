# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pairs of neighbouring landmarks by their appearance: find equal pairs elsewhere in a map.

A rotation about the vertical and a shift preserve the classes of two landmarks, their horizontal
distance and their difference in height. Landmarks whose pairs occur twice in a map may therefore
stand at places that look alike. The method is geometric hashing (Lamdan and Wolfson, "Geometric
Hashing: A General and Efficient Model-Based Recognition Scheme", 1988), with pairs as bases.
"""

from math import atan2, floor, pi, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cliploc_ros.core.kernels.compiled import compiled

# Number of neighbours that form pairs with a landmark, and range of their distances [m]. Closer
# neighbours do not determine the rotation. 100,000 landmarks take 30 MB.
_NEIGHBOURS = 10
_LENGTH_M = (0.3, 3.0)
# In larger maps, each landmark has fewer neighbours, down to two: a repeat requires two.
_MOST_PAIRS, _LEAST_NEIGHBOURS = 2_000_000, 2
# Pairs are alike if distance and height differ by less than this, which is also the bin width [m].
_ALIKE_M = 0.25
_LENGTH_BINS, _RISE_BINS = 14, 28
_MIDDLE_BIN = 13
# Rotations are counted in bins that are twice as wide as their spacing.
_TURN_BINS = 24
_TURN_STEP = 2.0 * pi / _TURN_BINS
_LEAST_VOTES = 2
# Maximum number of classes that keys can distinguish.
_CLASSES = 1 << 20
# Limits on memory and time: number of slots for votes, a power of 2, and of compared pairs.
_SLOTS, _MOST_COMPARED = 1 << 15, 100_000


class LandmarkPairs(NamedTuple):
    """Pairs of a landmark and a neighbour: L landmarks, p pairs."""

    neighbours: NDArray[np.int32]  #: (L, k): neighbours of each landmark; -1 for none
    #: (L, 3), (L,): centre and class of each landmark
    centers: NDArray[np.float64]
    classes: NDArray[np.int64]
    keys: NDArray[np.int64]  #: (p,): key of the appearance of each pair, ascending
    landmarks: NDArray[np.int32]  #: (p,): first landmark of each pair
    #: (p, 3): horizontal distance and difference in height [m], and direction [rad] of each pair
    offsets: NDArray[np.float32]


class Repeats(NamedTuple):
    """r pairs of landmarks that a rotation and a shift may map onto each other."""

    #: (r,), (r,)
    landmarks: NDArray[np.int64]
    others: NDArray[np.int64]
    turns: NDArray[np.float64]  #: (r,): rotation about the vertical, from landmark to other [rad]
    votes: NDArray[np.int64]  #: (r,): number of agreeing neighbours


def make_pairs(centers: NDArray[np.float64], classes: NDArray[np.int64], tree: cKDTree
               ) -> LandmarkPairs:
    """Find the pairs of landmarks at centers (L, 3) with classes (L,), given their tree."""
    count = len(centers)
    columns = max(_LEAST_NEIGHBOURS, min(_NEIGHBOURS, _MOST_PAIRS // max(count, 1)))
    neighbours = np.full((count, columns), count, dtype=np.int32)
    ranks = np.arange(2, min(columns + 1, count) + 1)
    if len(ranks):
        neighbours[:, :len(ranks)] = tree.query(centers, ranks,
                                                distance_upper_bound=_LENGTH_M[1])[1]
    first, column = np.nonzero(neighbours < count)
    second = neighbours[first, column]
    steps = centers[second] - centers[first]
    offsets = np.stack([np.hypot(steps[:, 0], steps[:, 1]), steps[:, 2],
                        np.arctan2(steps[:, 1], steps[:, 0])], axis=1)
    short = offsets[:, 0] < _LENGTH_M[0]
    neighbours[first[short], column[short]] = count
    bins = np.floor(offsets[:, :2] / _ALIKE_M).astype(np.int64).T
    keys = np.where(short, -1, _key(classes[first], classes[second], *bins))
    order = np.argsort(keys, kind='stable')[int(short.sum()):]
    return LandmarkPairs(np.where(neighbours < count, neighbours, np.int32(-1)), centers, classes,
                         keys[order], first[order].astype(np.int32),
                         offsets[order].astype(np.float32))


@compiled
def _key(first, second, length_bin, rise_bin):
    """Return the key of a pair of classes, a length bin and a height bin."""
    return (((first * _CLASSES + second) * _LENGTH_BINS + length_bin) * _RISE_BINS
            + rise_bin + _MIDDLE_BIN)


@compiled
def find_repeats(pairs, landmarks):
    """Return the Repeats of landmarks (n,): what they may be mistaken for, turned and shifted.

    A landmark with two agreeing neighbours is a repeat: three landmarks of equal classes then have
    the same arrangement. The votes of pairs for a repeat and a rotation are counted in an
    open-addressing hash table. The work is limited: with too many landmarks, the last are skipped.
    """
    count, columns = pairs.neighbours.shape
    slots = np.full(_SLOTS, -1, dtype=np.int64)
    votes, turns = np.zeros(_SLOTS, dtype=np.int64), np.zeros(_SLOTS)
    compared, used = 0, 0
    for number in range(landmarks.shape[0]):
        first = landmarks[number]
        for column in range(columns):
            second = pairs.neighbours[first, column]
            if second < 0:
                continue
            length, rise, angle = _offset(pairs.centers, first, second)
            shortest = floor(length / _ALIKE_M - 0.5)
            lowest = floor(rise / _ALIKE_M - 0.5)
            for length_bin in range(shortest, shortest + 2):
                key = _key(pairs.classes[first], pairs.classes[second], length_bin, lowest)
                row = np.searchsorted(pairs.keys, key)
                while row < pairs.keys.shape[0] and pairs.keys[row] <= key + 1:
                    other = np.int64(pairs.landmarks[row])
                    compared += 1
                    if (other != first and abs(pairs.offsets[row, 0] - length) < _ALIKE_M
                            and abs(pairs.offsets[row, 1] - rise) < _ALIKE_M):
                        turn = (pairs.offsets[row, 2] - angle) % (2.0 * pi)
                        used += _vote(slots, votes, turns, number * count + other, turn)
                    if compared > _MOST_COMPARED or used > _SLOTS // 2:
                        return _elected(slots, votes, turns, landmarks, count)
                    row += 1
    return _elected(slots, votes, turns, landmarks, count)


@compiled
def _vote(slots, votes, turns, candidate, turn):
    """Add a vote to the two bins that contain a rotation; return the number of new slots."""
    new = 0
    nearest = int(turn / _TURN_STEP)
    for turn_bin in range(nearest, nearest + 2):
        vote = candidate * _TURN_BINS + turn_bin % _TURN_BINS
        slot = (vote * 0x9E3779B1 >> 12) % _SLOTS
        while slots[slot] >= 0 and slots[slot] != vote:
            slot = (slot + 1) % _SLOTS
        if slots[slot] < 0:
            slots[slot] = vote
            new += 1
        votes[slot] += 1
        turns[slot] += turn - turn_bin * _TURN_STEP
    return new


@compiled
def _offset(centers, first, second):
    """Return horizontal distance, height difference and direction of a pair."""
    x, y = centers[second, 0] - centers[first, 0], centers[second, 1] - centers[first, 1]
    return sqrt(x * x + y * y), centers[second, 2] - centers[first, 2], atan2(y, x)


@compiled
def _elected(slots, votes, turns, landmarks, count):
    """Return the Repeats of the bins with enough votes."""
    rows = np.nonzero(votes >= _LEAST_VOTES)[0]
    found = slots[rows] // _TURN_BINS
    middles = slots[rows] % _TURN_BINS * _TURN_STEP
    return Repeats(landmarks[found // count], found % count, middles + turns[rows] / votes[rows],
                   votes[rows])
