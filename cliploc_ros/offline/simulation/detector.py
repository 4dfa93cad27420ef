# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a detector would see of a map from a pose, with guessed or measured errors."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.ellipsoid import (
    ellipse_bboxes,
    ellipses_in_pixels,
    project_ellipsoids,
)
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Detections

#: A landmark is detected only if the image shows this share of its box.
SHOWN_SHARE = 0.6
# Frames count for a pose if they saw the landmark from within this angle of its direction.
_NEAR_COSINE = np.cos(np.radians(30.0))
# Frames that the landmark's overall ratio stands for, where few frames are near.
_PRIOR_FRAMES = 3.0
_SCORE = 0.8
# Without a recording; guesses.
_GUESSED_RATIO = 0.6
_GUESSED_REACH_M = 5.0
GUESSED_MIN_SIDE_PX = 12.0
_GUESSED_CAMERA = Camera(640, 480, 525.0, 525.0, 320.0, 240.0)


class Sightings(NamedTuple):
    """Frames that should show a landmark: its direction (k, 3) from them, and if it was seen."""

    directions: NDArray[np.float64]
    was_seen: NDArray[np.bool_]


@dataclass(frozen=True)
class DetectorModel:
    """A detector's misses and errors: L landmarks."""

    landmark_map: LandmarkMap  #: What there is to see
    camera: Camera
    sightings: tuple[Sightings, ...]  #: Of each landmark; empty without a recording
    #: (L,): share of the expected frames in which each landmark was detected, and from how far
    #: away it can be [m]
    ratios: NDArray[np.float64]
    reach_m: NDArray[np.float64]
    #: Standard deviation of edges: [px], and as a share of the box's extent; and their scale
    edge_sigma: tuple[float, float]
    edge_scale: float
    min_side_px: float  #: Smaller boxes are not detected
    #: tuple of ((k, 4), tuple of str): boxes [px] of no landmark in single frames, and their
    #: classes
    clutter: tuple[tuple[NDArray[np.float64], tuple[str, ...]], ...]

    def in_view(self, map_from_camera: NDArray[np.float64]
                ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the landmarks (k,) that a camera could detect, and their boxes (k, 4) [px]."""
        one = self.landmark_map
        outlines = project_ellipsoids(invert_transform(map_from_camera), one.centers, one.shapes)
        boxes = ellipse_bboxes(ellipses_in_pixels(outlines, self.camera))
        size = [self.camera.width, self.camera.height] * 2
        with np.errstate(invalid='ignore'):
            clipped = np.clip(boxes, 0.0, size)
            extent, shown = boxes[:, 2:] - boxes[:, :2], clipped[:, 2:] - clipped[:, :2]
            distances = np.linalg.norm(one.centers - map_from_camera[:3, 3], axis=1)
            visible = (shown.prod(axis=1) > SHOWN_SHARE * extent.prod(axis=1)) \
                & (shown.min(axis=1) >= self.min_side_px) & (distances <= self.reach_m)
        rows = np.nonzero(visible)[0]
        return rows, clipped[rows]

    def expected_detections(self, map_from_camera: NDArray[np.float64]) -> float:
        """Return how many landmarks the detector finds on average."""
        rows, _ = self.in_view(map_from_camera)
        return sum(self._chance(row, map_from_camera) for row in rows)

    def detect(self, map_from_camera: NDArray[np.float64], rng: np.random.Generator
               ) -> tuple[Detections, NDArray[np.int64]]:
        """Return what the detector might find, and the landmark that each box shows."""
        rows, boxes = self.in_view(map_from_camera)
        chances = np.array([self._chance(row, map_from_camera) for row in rows])
        seen = rng.random(len(rows)) < chances
        rows, boxes = rows[seen], boxes[seen]
        extents = np.tile(boxes[:, 2:] - boxes[:, :2], 2)
        deviations = np.hypot(self.edge_sigma[0], self.edge_sigma[1] * extents)
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


def guess_detector(landmark_map: LandmarkMap, edge_sigma: tuple[float, float]) -> DetectorModel:
    """Return a detector without any measurement."""
    count = len(landmark_map)
    ratios = np.full(count, _GUESSED_RATIO)
    for row, one in enumerate(landmark_map.details):
        if one.seen_ratio is not None:
            ratios[row] = one.seen_ratio
    return DetectorModel(landmark_map, _GUESSED_CAMERA, (), ratios,
                         np.full(count, _GUESSED_REACH_M), edge_sigma, 1.0, GUESSED_MIN_SIDE_PX,
                         ())
