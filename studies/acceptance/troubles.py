# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Simulated errors of a map or a detector, applied to recorded queries."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.maps.landmark_details import LandmarkDetails
from cliploc_ros.core.maps.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.evaluation.trials import Query

_BOX_SIDE_PX = (20.0, 200.0)
_MOVED_M = (0.3, 3.0)

World = tuple[LandmarkMap, Sequence[Query]]
Change = Callable[[LandmarkMap, Sequence[Query], float, np.random.Generator], World]


def remove_landmarks(landmark_map: LandmarkMap, queries: Sequence[Query], share: float,
                     rng: np.random.Generator) -> World:
    """Remove a share of the landmarks from the map; their detections stay."""
    count = len(landmark_map)
    kept = np.sort(rng.permutation(count)[:max(1, count - round(share * count))])
    fewer = replace(landmark_map, landmark_ids=tuple(landmark_map.landmark_ids[row]
                                                     for row in kept),
                    labels=tuple(landmark_map.labels[row] for row in kept),
                    class_ids=tuple(landmark_map.class_ids[row] for row in kept),
                    centers=landmark_map.centers[kept], semi_axes=landmark_map.semi_axes[kept],
                    quats_xyzw=landmark_map.quats_xyzw[kept],
                    details=_of_rows(landmark_map.details, kept))
    return fewer, [_with_similarities(query, np.asarray(query.observation.similarities)[:, kept])
                   for query in queries]


def move_landmarks(landmark_map: LandmarkMap, queries: Sequence[Query], distance_m: float,
                   rng: np.random.Generator) -> World:
    """Move a third of the landmarks by a distance, in random directions."""
    steps = rng.normal(size=landmark_map.centers.shape)
    steps *= distance_m / np.linalg.norm(steps, axis=1, keepdims=True)
    steps[rng.random(len(steps)) > 1 / 3] = 0.0
    return replace(landmark_map, centers=landmark_map.centers + steps), queries


def exchange_landmarks(landmark_map: LandmarkMap, queries: Sequence[Query], share: float,
                       rng: np.random.Generator) -> World:
    """Exchange the places of a share of the landmarks; all of them make another place."""
    count = len(landmark_map)
    chosen = rng.permutation(count)[:round(share * count)]
    centers = landmark_map.centers.copy()
    centers[chosen] = centers[np.roll(chosen, 1)]
    return replace(landmark_map, centers=centers), queries


def mirror_landmarks(landmark_map: LandmarkMap, queries: Sequence[Query], share: float,
                     rng: np.random.Generator) -> World:
    """Mirror the map left to right, as a robot sees a room in a mirror; the share is ignored."""
    return replace(landmark_map, centers=landmark_map.centers * (-1.0, 1.0, 1.0),
                   quats_xyzw=landmark_map.quats_xyzw * (1.0, -1.0, -1.0, 1.0)), queries


def mislabel_landmarks(landmark_map: LandmarkMap, queries: Sequence[Query], share: float,
                       rng: np.random.Generator) -> World:
    """Exchange labels and classes of a share of the landmarks."""
    count = len(landmark_map)
    chosen = rng.permutation(count)[:round(share * count)]
    source = np.arange(count)
    source[chosen] = np.roll(chosen, 1)
    wrong = replace(landmark_map, labels=tuple(landmark_map.labels[row] for row in source),
                    class_ids=tuple(landmark_map.class_ids[row] for row in source),
                    details=_of_rows(landmark_map.details, source))
    return wrong, [_with_similarities(query, np.asarray(query.observation.similarities)[:, source])
                   for query in queries]


def move_objects(landmark_map: LandmarkMap, queries: Sequence[Query], share: float,
                 rng: np.random.Generator) -> World:
    """Move a share of the landmarks to other spots at their height, 0.3 to 3 m away."""
    count = len(landmark_map)
    chosen = rng.permutation(count)[:round(share * count)]
    angles, steps = rng.uniform(0.0, 2.0 * np.pi, count), rng.uniform(*_MOVED_M, count)
    moved = landmark_map.centers.copy()
    moved[chosen, :2] += (steps * np.stack([np.cos(angles), np.sin(angles)])).T[chosen]
    return replace(landmark_map, centers=moved), queries


def double_landmarks(landmark_map: LandmarkMap, queries: Sequence[Query], distance_m: float,
                     rng: np.random.Generator) -> World:
    """Add a second landmark of the same object next to each one, in random directions."""
    steps = rng.normal(size=landmark_map.centers.shape)
    steps *= distance_m / np.linalg.norm(steps, axis=1, keepdims=True)
    return _with_copies(landmark_map, queries, steps)


def add_equal_room(landmark_map: LandmarkMap, queries: Sequence[Query], gap_m: float,
                   rng: np.random.Generator) -> World:
    """Add a room that equals the mapped one, beside it."""
    width = float(np.ptp(landmark_map.centers[:, 0]))
    return _with_copies(landmark_map, queries, np.array([width + gap_m, 0.0, 0.0]))


def random_detections(landmark_map: LandmarkMap, queries: Sequence[Query], count: float,
                      rng: np.random.Generator) -> World:
    """Replace the boxes of each query by random ones of the map's classes."""
    return landmark_map, [replace(query, observation=_random_boxes(
        query.observation, landmark_map, int(count), rng), neighbours=tuple(
            _random_boxes(one, landmark_map, int(count), rng) for one in query.neighbours))
        for query in queries]


def drop_detections(landmark_map: LandmarkMap, queries: Sequence[Query], share: float,
                    rng: np.random.Generator) -> World:
    """Drop a share of the boxes."""
    return landmark_map, [_without_boxes(query, share, rng) for query in queries]


def invent_detections(landmark_map: LandmarkMap, queries: Sequence[Query], share: float,
                      rng: np.random.Generator) -> World:
    """Add random boxes, a number for each true one, that look like random landmarks."""
    return landmark_map, [_with_invented(query, share, rng) for query in queries]


def _with_copies(landmark_map: LandmarkMap, queries: Sequence[Query], steps: NDArray[np.float64]
                 ) -> World:
    """Return a map with a copy of each landmark, steps (L, 3) or (3,) away."""
    count = len(landmark_map)
    rows = [*range(count), *range(count)]
    copies = landmark_map.select(rows)
    ids = (*landmark_map.landmark_ids, *(f'{one}_copy' for one in landmark_map.landmark_ids))
    centers = np.concatenate([landmark_map.centers, landmark_map.centers + steps])
    return replace(copies, landmark_ids=ids, centers=centers), [
        replace(query, observation=_of_columns(query.observation, rows),
                neighbours=tuple(_of_columns(one, rows) for one in query.neighbours))
        for query in queries]


def _of_columns(observation: Observation, columns: list[int]) -> Observation:
    """Return an observation with the similarities of some landmarks."""
    return observation if observation.similarities is None else replace(
        observation, similarities=np.ascontiguousarray(
            np.asarray(observation.similarities)[:, columns]))


def _random_boxes(observation: Observation, landmark_map: LandmarkMap, count: int,
                  rng: np.random.Generator) -> Observation:
    """Return an observation of random boxes, each of which looks like a random landmark."""
    camera, similarities = observation.camera, observation.similarities
    corners = rng.uniform(0, (camera.width, camera.height), (count, 2))
    boxes = np.hstack([corners, corners + rng.uniform(*_BOX_SIDE_PX, (count, 2))])
    shown = rng.integers(len(landmark_map), size=count)
    looks = None
    if similarities is not None:
        known = np.asarray(similarities)
        rows = known[rng.integers(len(known), size=count)] if len(known) \
            else np.zeros((count, len(landmark_map)), dtype=np.float32)
        looks = np.ascontiguousarray(rng.permuted(rows, axis=1))
    return replace(observation, detections=Detections(
        boxes, tuple(landmark_map.class_ids[row] for row in shown), np.full(count, 0.8)),
        similarities=looks)


def _of_rows(details: tuple[LandmarkDetails, ...], rows: NDArray[np.int64]
             ) -> tuple[LandmarkDetails, ...]:
    """Return the details of some landmarks of a map; none where it has none."""
    return tuple(details[row] for row in rows) if details else ()


def _without_boxes(query: Query, share: float, rng: np.random.Generator) -> Query:
    """Return a query without a random share of its boxes."""
    observation = query.observation
    rows = np.nonzero(rng.random(len(observation.detections)) >= share)[0]
    similarities = observation.similarities
    return replace(query, observation=replace(
        observation, detections=observation.detections.select(rows),
        similarities=None if similarities is None else np.asarray(similarities)[rows]))


def _with_similarities(query: Query, similarities: np.ndarray) -> Query:
    return replace(query, observation=replace(
        query.observation, similarities=np.ascontiguousarray(similarities)))


def _with_invented(query: Query, share: float, rng: np.random.Generator) -> Query:
    """Return a query with random boxes, whose similarities are permuted ones of its own."""
    observation, true = query.observation, query.observation.detections
    count = int(rng.binomial(len(true), share)) if len(true) else 0
    camera, similarities = observation.camera, np.asarray(observation.similarities)
    corners = rng.uniform(0, (camera.width, camera.height), (count, 2))
    boxes = np.hstack([corners, corners + rng.uniform(*_BOX_SIDE_PX, (count, 2))])
    rows = rng.integers(len(true), size=count) if count else np.empty(0, dtype=np.int64)
    looks = rng.permuted(similarities[rows], axis=1)
    detections = Detections(
        np.vstack([true.bboxes_xyxy, boxes]),
        true.class_ids + tuple(true.class_ids[row] for row in rng.permutation(rows)),
        np.concatenate([true.scores, true.scores[rows]]))
    return replace(query, observation=replace(
        observation, detections=detections,
        similarities=np.ascontiguousarray(np.vstack([similarities, looks]))))
