# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One simulated world: a map with errors, and what a robot sees there."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.evaluation.trials import Query
from cliploc_ros.evaluation.worlds.appearance import Encoder
from cliploc_ros.evaluation.worlds.cameras import GROUP_SIZE, make_camera, make_groups
from cliploc_ros.evaluation.worlds.detector import Detector, detect
from cliploc_ros.evaluation.worlds.places import KINDS
from cliploc_ros.evaluation.worlds.surveyor import MapErrors, Survey, survey
from cliploc_ros.evaluation.worlds.things import Objects, make_objects
from cliploc_ros.units import NS_PER_S

_FRAME_S = 1.0
_SCORE = 0.8


@dataclass(frozen=True)
class World:
    """A simulated world.

    Parameters
    ----------
    kind : str
        One of KINDS.
    landmark_map : LandmarkMap
        With errors.
    queries : tuple of Query
        All images, five of each group in order of time. They know neither vertical nor odometry.
    """

    kind: str
    landmark_map: LandmarkMap
    queries: tuple[Query, ...]

    @property
    def groups(self) -> tuple[int, ...]:
        """Return the group of each query."""
        return tuple(query.number // GROUP_SIZE for query in self.queries)


class _Scene(NamedTuple):
    """Everything that the images of a world show."""

    objects: Objects
    shapes: NDArray[np.float64]
    found: Survey
    detector: Detector
    encoder: Encoder
    vectors: NDArray[np.float64]
    biases: NDArray[np.float64]


def make_world(kind: str, seed: int, groups: int = 4) -> World:
    """Return a world; equal seeds give equal worlds.

    Parameters
    ----------
    kind : str
        One of KINDS.
    seed : int
    groups : int
        Places from which the robot looks, five images each.
    """
    rng = np.random.default_rng([seed, list(KINDS).index(kind)])
    place = KINDS[kind](rng)
    objects = make_objects(place.things, rng)
    encoder = Encoder.random(rng)
    scene = _Scene(objects, objects.shapes, survey(objects, MapErrors.random(rng), rng),
                   Detector.random(objects, rng), encoder,
                   encoder.vectors(objects.class_ids, objects.models, rng),
                   encoder.biases(len(objects.class_ids), rng))
    camera = make_camera(rng)
    poses = make_groups(place, objects, groups, rng).reshape(-1, 4, 4)
    return World(kind, scene.found.landmark_map, tuple(
        Query(number, _look(scene, camera, pose, number, rng), pose)
        for number, pose in enumerate(poses)))


def _look(scene: _Scene, camera: Camera, pose: NDArray[np.float64], number: int,
          rng: np.random.Generator) -> Observation:
    boxes = detect(scene.detector, scene.objects, scene.shapes, camera, pose, rng)
    known = boxes.shown >= 0
    crops = scene.encoder.unknown(boxes.class_ids)
    crops[known] = scene.vectors[boxes.shown[known]]
    biases = scene.encoder.biases(len(known), rng)
    biases[known] = scene.biases[boxes.shown[known]]
    similarities = scene.encoder.similarities(crops, biases, boxes.bboxes_xyxy,
                                              scene.vectors[scene.found.described], rng)
    return Observation(
        camera, Detections(boxes.bboxes_xyxy, boxes.class_ids, np.full(len(known), _SCORE)),
        similarities, round(number * _FRAME_S * NS_PER_S))
