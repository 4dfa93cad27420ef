# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Find the landmarks that an image should show at a pose, and landmarks that are gone.

An image should show the landmarks that are near, large, wholly in view and not hidden. Walls are
in no map, so an expected landmark may be hidden. If the image shows a landmark beside it, it is
not hidden. cliploc_ros.offline.mapping.evidence judges whole recordings by the same criteria, and
simulated detectors find what these let through, each with limits of its own.

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
    shared_areas,
)
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.core.map.landmark_map import LandmarkMap

#: A detector finds a landmark only if the image shows this share of its box.
SHOWN_SHARE = 0.6
#: A place is out of view if nearer things hide more than this share of it. A guess.
HIDDEN_SHARE = 0.4
# A detector surely finds landmarks up to here [m], with sides from here on [px], of which the
# image shows this share. Guesses, on the safe side.
_REACH_M, _LEAST_SIDE_PX, _SURE_SHARE = 6.0, 20.0, 0.75
# A landmark is beside a place within this angle of its direction, and before it if it is nearer
# than this share of the place's distance. Guesses.
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


def is_in_image(box: NDArray[np.float64], bounds: NDArray[np.float64], least_share: float
                ) -> NDArray[np.bool_]:
    """Return whether an image shows more than a share of a box (4,), or of each of n boxes (4, n).

    Box and bounds (4,) of the image are left, top, right, bottom.
    """
    width = np.minimum(box[2], bounds[2]) - np.maximum(box[0], bounds[0])
    height = np.minimum(box[3], bounds[3]) - np.maximum(box[1], bounds[1])
    return (width > 0.0) & (height > 0.0) & (
        width * height > least_share * (box[2] - box[0]) * (box[3] - box[1]))


def is_beside(cosine: NDArray[np.float64], distance: NDArray[np.float64],
              of_place: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return whether an image that shows a landmark also shows a place: no wall is before it.

    The landmark is beside the place or behind it, by the cosine between their directions, its
    distance and that of the place.
    """
    return (cosine > _BESIDE_COSINE) & (distance >= _BESIDE_SHARE * of_place)


class InImage(NamedTuple):
    """The boxes of n ellipsoids in an image [px]."""

    boxes: NDArray[np.float64]  #: (n, 4): NaN where not wholly in front of the camera
    shown: NDArray[np.float64]  #: (n, 4): the part in the image
    is_shown: NDArray[np.bool_]  #: (n,): whether that is a large enough share, and large enough


def boxes_in_image(camera: Camera, camera_from_map: NDArray[np.float64],
                   centers: NDArray[np.float64], shapes: NDArray[np.float64], least_share: float,
                   least_side_px: float) -> InImage:
    """Return the boxes of ellipsoids (n, 3), (n, 6) in an image."""
    boxes = ellipse_bboxes(ellipses_in_pixels(
        project_ellipsoids(camera_from_map, centers, shapes), camera))
    bounds = np.array([0.0, 0.0, camera.width, camera.height])
    shown = np.clip(boxes, 0.0, np.tile(bounds[2:], 2))
    return InImage(boxes, shown, is_in_image(boxes.T, bounds, least_share) & (
        (shown[:, 2:] - shown[:, :2]).min(axis=1) >= least_side_px))


def is_hidden(boxes: NDArray[np.float64], is_nearer: NDArray[np.bool_], most: float
              ) -> NDArray[np.bool_]:
    """Tell which boxes (n, 4) are hidden: a nearer box covers more than a share of them.

    Row i of is_nearer (n, n) marks the boxes that are nearer than box i.
    """
    areas = (boxes[:, 2:] - boxes[:, :2]).prod(axis=1)
    covers = shared_areas(boxes, boxes) > most * areas[:, None]
    return np.asarray((is_nearer & covers).any(axis=1))


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
    found = boxes_in_image(camera, camera_from_map, landmark_map.centers[near],
                           landmark_map.shapes[near], _SURE_SHARE, _LEAST_SIDE_PX)
    in_front = np.isfinite(found.boxes[:, 0])
    near, boxes, is_shown = near[in_front], found.shown[in_front], found.is_shown[in_front]
    offsets = landmark_map.centers[near] @ camera_from_map[:3, :3].T + camera_from_map[:3, 3]
    depths = offsets[:, 2]
    nearer = depths + landmark_map.semi_axes[near].max(axis=1) < depths[:, None]
    visible = is_shown & ~is_hidden(boxes, nearer, HIDDEN_SHARE)
    was_seen = np.isin(landmark_map.objects[near], landmark_map.objects[shown])
    distances = np.linalg.norm(offsets, axis=1)
    directions = offsets / np.maximum(distances, 1e-9)[:, None]
    in_sight = is_beside(directions @ directions[was_seen].T, distances[was_seen],
                         distances[:, None]).any(axis=1)
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
        """Return the probability that it is gone, where looks find a landmark at a share.

        Misses count up to the number that says most. Further ones would say that not even chance
        matches it, thus that it is there and hardly ever found: a landmark that is taken away
        would no longer be missed after some hundred looks.
        """
        found = _OF_SHARE * share + self.found
        missed = _OF_SHARE * (1.0 - share) + self.missed
        misses = min(self.misses, max(0.0, found / _BY_CHANCE - found - missed))
        there = betaln(found, missed + misses) - betaln(found, missed)
        odds = log(_GONE / (1.0 - _GONE)) + misses * log(1.0 - _BY_CHANCE) - there
        return float(1.0 / (1.0 + exp(-odds)))


class Missing:
    """Counts of looks for each landmark that they expected."""

    def __init__(self, landmark_map: LandmarkMap) -> None:
        self._details = landmark_map.details
        self._records: dict[int, _Record] = {}
        self._expected: deque[list[int]] = deque(maxlen=_HERE)

    def add(self, expected: Expected, weight: float) -> None:
        """Count a look at a right pose: 1 if it shares no errors with earlier looks, else less."""
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
        seen = [record for record in self._records.values() if record.found > 0.0]
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
