# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Simulated detector and CLIP of a robot, for check_map, the studio and studies.

The errors of the detector's boxes are assumed or measured. CLIP's similarities of crops and labels
are simulated. A label is a vector: the sum of a part of its class and a part of its words, each
word a random direction. Labels of equal text are therefore equal, and labels that share words are
similar. A crop is the vector of the object that it shows, with noise, which is stronger for small
boxes. Level and spread of the similarities are those of the simulation behind the project's
figures (top-1 about 0.6 on TUM fr3); they are not fitted to the user's images.
"""

import re
import zlib
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.visibility import SHOWN_SHARE, boxes_in_image
from cliploc_ros.core.observation import Detections

#: Standard deviations of a box's edge: [px], and as a share of the box's extent; their variances
#: are added.
EDGE_SIGMA_PX, EDGE_SIGMA_SHARE = 2.0, 0.04
# Frames count for a pose if their direction to the landmark differs by less than this angle.
_NEAR_COSINE = np.cos(np.radians(30.0))
# Weight of the landmark's overall ratio, in frames; it matters where few frames count.
_PRIOR_FRAMES = 3.0
_SCORE = 0.8
# Assumptions without a recording; not measured.
_GUESSED_RATIO = 0.6
_GUESSED_REACH_M = 5.0
GUESSED_MIN_SIDE_PX = 12.0
_GUESSED_CAMERA = Camera(640, 480, 525.0, 525.0, 320.0, 240.0)
# Length of the vectors of labels and crops.
_SIZE = 256
#: Share of a vector's squared length that all objects of a class have in common.
CLASS_SHARE = 0.3
_NOISE = 0.43
# Share of the noise's variance that all crops of a landmark have in common.
_SHARED_NOISE = 0.3
_STOP_WORDS = frozenset((
    'a', 'an', 'and', 'at', 'by', 'from', 'in', 'is', 'of', 'on', 'or', 'seen', 'standing', 'the',
    'to', 'with'))


class Sightings(NamedTuple):
    """Frames with a landmark in view: its direction (k, 3), and whether it was detected (k,)."""

    directions: NDArray[np.float64]
    was_seen: NDArray[np.bool_]


@dataclass(frozen=True)
class DetectorModel:
    """A detector's misses and errors: L landmarks."""

    landmark_map: LandmarkMap  #: The landmarks to detect
    camera: Camera
    sightings: tuple[Sightings, ...]  #: Sightings of each landmark; empty without a recording
    #: (L,): detection ratio of each landmark in the frames that have it in view, and the greatest
    #: distance at which it can be detected [m]
    ratios: NDArray[np.float64]
    reach_m: NDArray[np.float64]
    edge_scale: float  #: Scale of the standard deviations of edges
    min_side_px: float  #: Smaller boxes are not detected
    #: Boxes (k, 4) [px] that belong to no landmark, and their classes, frame by frame
    clutter: tuple[tuple[NDArray[np.float64], tuple[str, ...]], ...]

    def in_view(self, map_from_camera: NDArray[np.float64]
                ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the landmarks (k,) that a camera could detect, and their boxes (k, 4) [px]."""
        centers = self.landmark_map.centers
        found = boxes_in_image(self.camera, invert_transform(map_from_camera), centers,
                               self.landmark_map.shapes, SHOWN_SHARE, self.min_side_px)
        distances = np.linalg.norm(centers - map_from_camera[:3, 3], axis=1)
        rows = np.nonzero(found.is_shown & (distances <= self.reach_m))[0]
        return rows, found.shown[rows]

    def detect(self, map_from_camera: NDArray[np.float64], rng: np.random.Generator
               ) -> tuple[Detections, NDArray[np.int64]]:
        """Simulate n detections; also return the landmark (n,) of each box, -1 for none."""
        rows, boxes = self.in_view(map_from_camera)
        chances = np.array([self._chance(row, map_from_camera) for row in rows])
        seen = rng.random(len(rows)) < chances
        rows, boxes = rows[seen], boxes[seen]
        extents = np.tile(boxes[:, 2:] - boxes[:, :2], 2)
        deviations = np.hypot(EDGE_SIGMA_PX, EDGE_SIGMA_SHARE * extents)
        noisy = boxes + self.edge_scale * deviations * rng.normal(size=boxes.shape)
        noisy = np.clip(noisy, 0.0, [self.camera.width, self.camera.height] * 2)
        sound = (noisy[:, 2:] - noisy[:, :2]).min(axis=1, initial=np.inf) >= 1.0
        rows, noisy = rows[sound], noisy[sound]
        class_ids = tuple(self.landmark_map.class_ids[row] for row in rows)
        if self.clutter:
            false_boxes, false_classes = self.clutter[rng.integers(len(self.clutter))]
            noisy = np.concatenate([noisy, false_boxes])
            class_ids += false_classes
            rows = np.concatenate([rows, np.full(len(false_boxes), -1, dtype=np.int64)])
        return Detections(noisy, class_ids, np.full(len(rows), _SCORE)), rows

    def _chance(self, row: int, map_from_camera: NDArray[np.float64]) -> float:
        """Return the probability that a landmark in view is detected."""
        ratio = float(self.ratios[row])
        if not self.sightings:
            return ratio
        offset = self.landmark_map.centers[row] - map_from_camera[:3, 3]
        sightings = self.sightings[row]
        near = sightings.directions @ (offset / np.linalg.norm(offset)) > _NEAR_COSINE
        return float((sightings.was_seen[near].sum() + _PRIOR_FRAMES * ratio)
                     / (near.sum() + _PRIOR_FRAMES))


def guess_detector(landmark_map: LandmarkMap) -> DetectorModel:
    """Return a detector with assumed errors, for a map without a recording."""
    ratios = np.array([_GUESSED_RATIO if detail.seen_ratio is None else detail.seen_ratio
                       for detail in landmark_map.every_detail])
    return DetectorModel(landmark_map, _GUESSED_CAMERA, (), ratios,
                         np.full(len(ratios), _GUESSED_REACH_M), 1.0, GUESSED_MIN_SIDE_PX, ())


@dataclass(frozen=True)
class LabelModel:
    """Labels of L landmarks as vectors of length D."""

    labels: NDArray[np.float64]  #: (L, D): unit vectors
    biases: NDArray[np.float64]  #: (L, D): noise that all crops of a landmark have in common

    @staticmethod
    def of(landmark_map: LandmarkMap) -> 'LabelModel':
        """Make the model of a map's labels."""
        vectors = np.array([
            np.sqrt(CLASS_SHARE) * _direction(f'class {class_id}')
            + np.sqrt(1.0 - CLASS_SHARE) * _label_vector(landmark_map, row)
            for row, class_id in enumerate(landmark_map.class_ids)]).reshape(-1, _SIZE)
        vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
        biases = [np.sqrt(_SIZE) * _direction(f'crops of {name}')
                  for name in landmark_map.landmark_ids]
        return LabelModel(vectors, np.reshape(biases, (-1, _SIZE)))

    def similarities(self, shown: NDArray[np.int64], class_ids: tuple[str, ...],
                     bboxes_xyxy: NDArray[np.float64], rng: np.random.Generator
                     ) -> NDArray[np.float32]:
        """Simulate the similarities (n, L) of n crops and the labels.

        Parameters
        ----------
        shown : ndarray (n,) of int
            The landmark that each box shows, -1 for none.
        class_ids : tuple of str
            Detector class of each box.
        bboxes_xyxy : ndarray (n, 4)
            [px].
        """
        count, known = len(shown), shown >= 0
        crops = np.array([np.sqrt(CLASS_SHARE) * _direction(f'class {name}')
                          for name in class_ids]).reshape(count, _SIZE)
        crops[known] = self.labels[shown[known]]
        noise = rng.normal(size=(count, _SIZE))
        noise[known] = shared_noise(self.biases[shown[known]], noise[known])
        return similarities_of(crops, _NOISE, noise, bboxes_xyxy, self.labels)


def shared_noise(biases: NDArray[np.float64], noise: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the noise (n, D) of crops; all crops of an object share a part of it."""
    return np.asarray(np.sqrt(1.0 - _SHARED_NOISE) * noise + np.sqrt(_SHARED_NOISE) * biases)


def similarities_of(crops: NDArray[np.float64], strength: float, noise: NDArray[np.float64],
                    bboxes_xyxy: NDArray[np.float64], labels: NDArray[np.float64]
                    ) -> NDArray[np.float32]:
    """Return the similarities (n, L) of crops (n, D) with labels (L, D).

    `strength` is the factor of the noise (n, D) for a box with sides of 64 px. Smaller boxes have
    more noise, and lower similarities.
    """
    sizes = np.sqrt(np.prod(np.maximum(bboxes_xyxy[:, 2:] - bboxes_xyxy[:, :2], 1.0), axis=1))
    levels = np.log2(sizes / 64.0)[:, None]
    seen = crops + strength * np.clip(1.0 - 0.45 * levels, 0.4, 2.2) * noise
    raised = (seen @ labels.T - 0.35) * 1.1 + 0.55 * levels
    return np.asarray(0.15 + 0.17 / (1.0 + np.exp(-raised)), dtype=np.float32)


def _label_vector(landmark_map: LandmarkMap, row: int) -> NDArray[np.float64]:
    """Return the mean vector of a landmark's labels."""
    labels = landmark_map.details[row].labels if landmark_map.details else None
    vectors = []
    for text, weight in labels or ((landmark_map.labels[row], 1.0),):
        words = [word for word in re.findall(r'\w+', text.lower()) if word not in _STOP_WORDS]
        vectors.append(weight * _unit(np.sum([*map(_direction, words or [text])], axis=0)))
    return _unit(np.sum(vectors, axis=0))


def _direction(text: str) -> NDArray[np.float64]:
    """Return the unit vector (D,) of a text: random, but equal for equal texts."""
    rng = np.random.default_rng(zlib.crc32(text.encode('utf-8', 'replace')))
    return _unit(rng.normal(size=_SIZE))


def _unit(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-12))
