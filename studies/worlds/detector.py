# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Detector and encoder in a simulated world.

The detector has misses, false boxes, jitter, split boxes and confused classes. An encoder, weak or
strong, represents an object by a vector with a part for its class and a part for its model, which
is its look. A crop is the vector of its object plus noise, see cliploc_ros.offline.simulation.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.core.map.visibility import boxes_in_image, is_hidden
from cliploc_ros.offline.simulation import CLASS_SHARE, shared_noise, similarities_of
from studies.worlds.places import CLASS_NAMES, Objects, rows_of

_LEAST_SIDE_PX, _RANGE_M = 12.0, 8.0
_SHOWN_SHARE, _HIDDEN_SHARE = 0.4, 0.6
_FALSE_SIDE_PX = (15.0, 150.0)
# The ranges below come from YOLOv3 on TUM fr3, YOLOv8n on the kitchen and the demo's detector.
# They were measured by compare.py and, for rates of single objects, by hand.
# An object that is seen half a second before and after is found at a rate of .55, .76, .89 and
# .97 (quantiles .1, .25, .5 and .9 of the objects of fr3; the kitchen's: .74 to .83, -, .93, .99).
_FOUND_A, _FOUND_B = (2.0, 5.0), (0.3, 1.2)  # of a beta distribution
# Median distance of edges from the map's outlines: .053 (fr3), .050 (kitchen), .034 (demo); nine
# tenths are below .18, .20 and .14. That includes the map's own errors.
_BIAS = (0.01, 0.03)
# Change from one frame to the next: .016 after 33 ms and .032 after .17 s (fr3), .026 (kitchen),
# .011 (demo), with long tails: nine tenths are below .07, .11, .10 and .04.
_JITTER, _TAIL = (0.006, 0.025), 3
# Share of the objects that are ever classified wrongly: .50 (fr3), .30 to .50 (kitchen), .52
# (demo). The median rate of these objects is .11 to .20; for a tenth of them it is above .30 to
# .58.
_CONFUSED, _CONFUSION_BETA = (0.1, 0.5), (0.6, 3.4)
# Boxes in an image that no landmark explains: .3 to .7 (fr3), .2 to .4 (kitchen). Some of them
# show objects that the map lacks.
_FALSE_BOXES = (0.0, 0.4)
# Chosen, since half objects and neighbours cannot be distinguished in recordings.
_SPLIT = (0.0, 0.05)
# Size of vectors, and share of their squared length that distinguishes objects of one model.
_SIZE, _OWN_SHARE = 128, 0.1
# This noise gives top-1 rates of .85 to .4. The demo's CLIP, trained on similar rooms, has .91.
# The simulated similarities of TUM fr3 have .52 to .54, like a weak encoder.
_NOISE = (0.15, 0.6)


class Detector(NamedTuple):
    """A detector, with its properties for each of n objects."""

    chances: NDArray[np.float64]  #: (n,): probability that an object in view is found
    #: (n, 2, 4): systematic errors of the edges of an object's box, as shares of its sides:
    #: amplitudes of the cosine and the sine of the direction from which it is seen
    biases: NDArray[np.float64]
    #: Random error of each edge in each image, as a share of the box's side: the scale of
    #: Student's t
    jitter: float
    confused: tuple[str, ...]  #: The wrong class that each object is sometimes assigned
    confusion: NDArray[np.float64]  #: (n,): probability of the wrong class
    split: float  #: Probability that an object gives two boxes
    false_boxes: float  #: Mean number of boxes without an object in an image

    @staticmethod
    def random(objects: Objects, rng: np.random.Generator) -> 'Detector':
        """Draw a detector from the ranges of recorded detectors."""
        count = len(objects.class_ids)
        is_confused = rng.random(count) < rng.uniform(*_CONFUSED)
        return Detector(
            rng.beta(rng.uniform(*_FOUND_A), rng.uniform(*_FOUND_B), count),
            rng.uniform(*_BIAS) * rng.standard_t(4, (count, 2, 4)), rng.uniform(*_JITTER),
            tuple(map(str, rng.choice(CLASS_NAMES, count))),
            np.where(is_confused, rng.beta(*_CONFUSION_BETA, count), 0.0),
            rng.uniform(*_SPLIT), rng.uniform(*_FALSE_BOXES))


class Boxes(NamedTuple):
    """The boxes of one image: edges (m, 4) [px], classes, and the object of each, -1 for none."""

    bboxes_xyxy: NDArray[np.float64]
    class_ids: tuple[str, ...]
    shown: NDArray[np.int64]


def detect(detector: Detector, objects: Objects, shapes: NDArray[np.float64], camera: Camera,
           map_from_camera: NDArray[np.float64], rng: np.random.Generator) -> Boxes:
    """Simulate the detections in one image.

    Parameters
    ----------
    objects : Objects
        The n objects of the world.
    shapes : ndarray (n, 6)
        Shape matrices of the objects.
    map_from_camera : ndarray (4, 4)
    """
    rows, full = _in_view(objects, shapes, camera, map_from_camera)
    found = rng.random(len(rows)) < detector.chances[rows]
    rows, full = rows[found], full[found]
    offset = objects.centers[rows] - map_from_camera[:3, 3]
    azimuth = np.arctan2(offset[:, 1], offset[:, 0])
    waves = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
    shares = np.einsum('nw,nwe->ne', waves, detector.biases[rows])
    shares += detector.jitter * rng.standard_t(_TAIL, shares.shape)
    sides = full[:, 2:] - full[:, :2]
    boxes = full + np.tile(sides, 2) * shares + rng.normal(size=full.shape)
    names = np.where(rng.random(len(rows)) < detector.confusion[rows],
                     np.array(detector.confused, dtype=object)[rows],
                     np.array(objects.class_ids, dtype=object)[rows])
    # Some objects get a second box around their upper half.
    twice = np.nonzero(rng.random(len(rows)) < detector.split)[0]
    halves = boxes[twice]
    halves[:, 3] = 0.5 * (halves[:, 1] + halves[:, 3])
    boxes, names, rows = (np.concatenate([boxes, halves]), np.concatenate([names, names[twice]]),
                          np.concatenate([rows, rows[twice]]))
    count = rng.poisson(detector.false_boxes)
    corners = rng.uniform(0.0, (camera.width, camera.height), (count, 2))
    extra = np.c_[corners, corners + rng.uniform(*_FALSE_SIDE_PX, (count, 2))]
    boxes = np.clip(np.concatenate([boxes, extra]), 0.0, [camera.width, camera.height] * 2)
    names = np.concatenate([names, rng.choice(np.array(CLASS_NAMES, dtype=object), len(extra))])
    rows = np.concatenate([rows, np.full(len(extra), -1)])
    sound = (boxes[:, 2:] - boxes[:, :2] >= _LEAST_SIDE_PX).all(axis=1)
    return Boxes(boxes[sound], tuple(map(str, names[sound])), rows[sound])


def _in_view(objects: Objects, shapes: NDArray[np.float64], camera: Camera,
             map_from_camera: NDArray[np.float64]
             ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the objects in view (k,), nearest first, and their boxes (k, 4) [px]."""
    distances = np.linalg.norm(objects.centers - map_from_camera[:3, 3], axis=1)
    near = np.argsort(distances)[:np.count_nonzero(distances < _RANGE_M)]
    found = boxes_in_image(camera, invert_transform(map_from_camera), objects.centers[near],
                           shapes[near], _SHOWN_SHARE, _LEAST_SIDE_PX)
    seen = np.nonzero(found.is_shown)[0]
    near, full, wholes = near[seen], found.boxes[seen], objects.wholes[near[seen]]
    # parts of the same thing do not occlude each other
    is_part = (wholes[:, None] == wholes) & (wholes > 0)
    is_nearer = np.tri(len(seen), k=-1, dtype=np.bool_) & ~is_part
    free = ~is_hidden(found.shown[seen], is_nearer, _HIDDEN_SHARE)
    return near[free], full[free]


class Encoder(NamedTuple):
    """A simulated encoder: the vectors of classes (C, D), and the noise of its crops."""

    classes: NDArray[np.float64]
    noise: float

    @staticmethod
    def random(rng: np.random.Generator) -> 'Encoder':
        """Draw an encoder, from weak to strong."""
        return Encoder(_directions(len(CLASS_NAMES), rng), rng.uniform(*_NOISE))

    def vectors(self, class_ids: tuple[str, ...], models: NDArray[np.int64],
                rng: np.random.Generator) -> NDArray[np.float64]:
        """Return the vectors (n, D) of n objects, of unit length."""
        looks = {kind: _directions(1, rng)[0]
                 for kind in dict.fromkeys(zip(class_ids, models.tolist(), strict=True))}
        rows = rows_of(class_ids)
        shared = np.array([looks[kind] for kind in zip(class_ids, models.tolist(), strict=True)])
        found = (np.sqrt(CLASS_SHARE) * self.classes[rows]
                 + np.sqrt(1.0 - CLASS_SHARE - _OWN_SHARE) * shared
                 + np.sqrt(_OWN_SHARE) * _directions(len(rows), rng))
        return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True))

    def unknown(self, class_ids: tuple[str, ...]) -> NDArray[np.float64]:
        """Return the vectors (n, D) of crops that show no object but resemble a class."""
        return np.asarray(np.sqrt(CLASS_SHARE) * self.classes[rows_of(class_ids)])

    def similarities(self, boxes: 'Boxes', vectors: NDArray[np.float64],
                     biases: NDArray[np.float64], labels: NDArray[np.float64],
                     rng: np.random.Generator) -> NDArray[np.float32]:
        """Return the similarities (m, L) of the crops of m boxes and L labels.

        ``vectors`` (n, D) are those of the objects, ``biases`` (n, D) the common difference of all
        crops of an object from its vector.
        """
        known = boxes.shown >= 0
        # crops that show no object resemble a class
        crops = np.sqrt(CLASS_SHARE) * self.classes[rows_of(boxes.class_ids)]
        crops[known] = vectors[boxes.shown[known]]
        own = draw_biases(len(known), rng)
        own[known] = biases[boxes.shown[known]]
        return similarities_of(crops, self.noise, shared_noise(own, rng.normal(size=crops.shape)),
                               boxes.bboxes_xyxy, labels)


def draw_biases(count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw the common difference of all crops of each object from its vector (n, D)."""
    return np.asarray(rng.normal(size=(count, _SIZE)))


def _directions(count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return random unit vectors (count, D)."""
    found = rng.normal(size=(count, _SIZE))
    return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True))
