# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which landmarks an image should show at a pose, and which are no longer there.

An image should show the landmarks that are near, large, wholly in view and not hidden. Walls are
in no map, so an expected landmark may be hidden. If the image shows a landmark beside it, it is
not hidden. cliploc_ros.offline.mapping.evidence judges whole recordings.

A detector finds some landmarks in each image and others hardly ever. The share of looks that find
a landmark has a beta distribution, which each look narrows down. Then the probability of k misses
in a row is B(a, b + k) / B(a, b), if the landmark is there.
"""

from collections import deque
from collections.abc import Iterable
from math import exp, log
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaln

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.ellipsoid import (
    ellipse_bboxes,
    ellipses_in_pixels,
    project_ellipsoids,
)
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.core.map.landmark_map import LandmarkMap

# A detector finds landmarks up to here [m], with sides from here on [px], of which the image shows
# this share and nearer landmarks hide at most that share. Guesses, on the safe side.
_REACH_M, _LEAST_SIDE_PX, _SHOWN_SHARE, _HIDDEN_SHARE = 6.0, 20.0, 0.75, 0.4
# A landmark beside a shown one is within this angle of its direction, and not much further away.
_BESIDE_COSINE, _BESIDE_SHARE = np.cos(np.radians(20.0)), 0.8
#: Sides of a landmark, equal angles about the vertical.
SIDES = 8
# The share of looks that find a landmark which is there: its mean before any look, the looks that
# this mean stands for, and the looks that the share of all landmarks, or the seen_ratio of a map,
# stands for where one landmark is judged. Guesses.
_FOUND, _OF_FOUND, _OF_SHARE = 0.75, 10.0, 3.0
_SHARES = (0.1, 0.95)
# Probability that a landmark is gone before any look, and the share of looks in which something is
# matched with one that is gone by chance. Guesses.
_GONE, _BY_CHANCE = 0.05, 0.05
# Named from this probability on. Not more sightings than this are counted, so a landmark that is
# taken away after a day is soon missed.
_NAMED, _MOST_SEEN = 0.8, 15.0
# The map is out of date where this many landmarks and this share of those that the last looks
# expected are gone, by their probabilities.
_HERE, _LEAST_GONE, _LEAST_SHARE = 10, 2.0, 0.25


class Expected(NamedTuple):
    """The k landmarks that an image should show, and whether it shows each."""

    landmarks: NDArray[np.int64]  #: (k,): one of each object
    was_seen: NDArray[np.bool_]  #: (k,): whether a detection shows it
    #: (k,): whether a shown landmark beside it or behind it tells that no wall hides it
    in_sight: NDArray[np.bool_]
    sides: NDArray[np.int64]  #: (k,): from which of SIDES sides the camera looks at it


def expect(landmark_map: LandmarkMap, camera: Camera, map_from_camera: NDArray[np.float64],
           shown: NDArray[np.int64]) -> Expected:
    """Return the landmarks that an image should show.

    Parameters
    ----------
    map_from_camera : ndarray (4, 4)
    shown : ndarray (m,) of int
        The landmarks that its detections show.
    """
    near = np.sort(np.array(landmark_map.tree.query_ball_point(map_from_camera[:3, 3], _REACH_M),
                            dtype=np.int64))
    camera_from_map = invert_transform(map_from_camera)
    outlines = project_ellipsoids(camera_from_map, landmark_map.centers[near],
                                  landmark_map.shapes[near])
    in_front = np.isfinite(outlines[:, 0])
    near, boxes = near[in_front], ellipse_bboxes(ellipses_in_pixels(outlines[in_front], camera))
    offsets = landmark_map.centers[near] @ camera_from_map[:3, :3].T + camera_from_map[:3, 3]
    clipped = np.clip(boxes, 0.0, [camera.width, camera.height] * 2)
    sides, full = clipped[:, 2:] - clipped[:, :2], boxes[:, 2:] - boxes[:, :2]
    visible = (sides.min(axis=1, initial=np.inf) >= _LEAST_SIDE_PX) & (
        sides.prod(axis=1) >= _SHOWN_SHARE * full.prod(axis=1))
    # one nearer landmark hides a part
    shared = (np.minimum(clipped[:, None, 2:], clipped[:, 2:])
              - np.maximum(clipped[:, None, :2], clipped[:, :2])).clip(0.0).prod(axis=2)
    areas, depths = np.maximum(sides.prod(axis=1), 1e-9), offsets[:, 2]
    nearer = depths + landmark_map.semi_axes[near].max(axis=1) < depths[:, None]
    visible &= ~(nearer & (shared > _HIDDEN_SHARE * areas[:, None])).any(axis=1)
    was_seen = np.isin(landmark_map.objects[near], landmark_map.objects[shown])
    # beside a seen one or before it
    distances = np.linalg.norm(offsets, axis=1)
    directions = offsets / np.maximum(distances, 1e-9)[:, None]
    in_sight = ((directions @ directions[was_seen].T > _BESIDE_COSINE) & (
        distances[was_seen] > _BESIDE_SHARE * distances[:, None])).any(axis=1)
    rows = np.nonzero(visible)[0]
    rows = rows[np.unique(landmark_map.objects[near[rows]], return_index=True)[1]]
    x, y, _ = (landmark_map.centers[near[rows]] - map_from_camera[:3, 3]).T
    sides = np.floor(SIDES * (np.arctan2(y, x) / (2.0 * np.pi) + 0.5)).astype(np.int64) % SIDES
    return Expected(near[rows], was_seen[rows], in_sight[rows], sides)


class _Record(NamedTuple):
    """Looks that found a landmark and that missed it, by their weights."""

    found: float = 0.0
    missed: float = 0.0  #: Before it was seen last
    misses: float = 0.0  #: Since then
    seen_from: int = 0  #: The sides from which it was seen, a bit each

    def gone(self, share: float) -> float:
        """Return the probability that it is gone, where looks find a landmark at a share."""
        found = _OF_SHARE * share + self.found
        missed = _OF_SHARE * (1.0 - share) + self.missed
        there = betaln(found, missed + self.misses) - betaln(found, missed)
        odds = log(_GONE / (1.0 - _GONE)) + self.misses * log(1.0 - _BY_CHANCE) - there
        return float(1.0 / (1.0 + exp(-odds)))


class Missing:
    """What looks said of each landmark that they expected."""

    def __init__(self, landmark_map: LandmarkMap) -> None:
        self._details = landmark_map.details
        self._records: dict[int, _Record] = {}
        self._expected: deque[list[int]] = deque(maxlen=_HERE)

    def add(self, expected: Expected, weight: float) -> None:
        """Count a look at a right pose, 1 for one that shares no errors with earlier ones."""
        for landmark, was_seen, in_sight, side in zip(*(one.tolist() for one in expected),
                                                      strict=True):
            one = self._records.get(landmark, _Record())
            if was_seen:
                keep = min(1.0, _MOST_SEEN / (one.found + weight))
                self._records[landmark] = _Record(
                    keep * (one.found + weight), keep * (one.missed + one.misses),
                    seen_from=one.seen_from | 1 << side)
            # a television does not show from behind; one that was never seen may from everywhere
            elif in_sight and (not one.seen_from or any(
                    one.seen_from >> (side + step) % SIDES & 1 for step in (-1, 0, 1))):
                self._records[landmark] = one._replace(misses=one.misses + weight)
        if len(expected.landmarks):
            self._expected.append(expected.landmarks.tolist())

    def named(self) -> list[int]:
        """Return the landmarks that are missing, those first that are most certainly gone."""
        gone = self._gone(self._records)
        return sorted((one for one in gone if gone[one] >= _NAMED), key=lambda one: -gone[one])

    @property
    def is_outdated(self) -> bool:
        """Return whether the map is out of date at the place of the last looks."""
        here = {landmark for look in self._expected for landmark in look}
        gone = sum(self._gone(here).values())
        return bool(gone >= _LEAST_GONE and gone >= _LEAST_SHARE * len(here))

    def _gone(self, landmarks: Iterable[int]) -> dict[int, float]:
        """Return the probability that each of some landmarks is gone."""
        # of those that were seen, without the sighting that makes them so
        seen = [one for one in self._records.values() if one.found > 0.0]
        found = sum(max(0.0, one.found - 1.0) for one in seen)
        missed = sum(one.missed for one in seen)
        overall = (_OF_FOUND * _FOUND + found) / (_OF_FOUND + found + missed)
        result = {}
        for landmark in landmarks:
            ratio = self._details[landmark].seen_ratio if self._details else None
            share = overall if ratio is None else min(overall, ratio)
            result[landmark] = self._records.get(landmark, _Record()).gone(
                min(max(share, _SHARES[0]), _SHARES[1]))
        return result
