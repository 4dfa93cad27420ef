# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Simulated errors of map, detector, sensors and priors, applied to queries."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.acceptance.look_alikes import find_alike
from cliploc_ros.core.geometry.transforms import RIGHT_M, make_transform
from cliploc_ros.core.localizer import by_classes
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import OPTICAL_FROM_BODY, Detections, Observation, Region
from cliploc_ros.offline.evaluation.trials import with_vertical
from cliploc_ros.offline.posed_query import PosedQuery
from studies import wrong_sensors
from studies.acceptance.places import ALL, FIVE, LEVEL, ONE, VERTICAL, VERTICAL_DEG
from studies.worlds.cameras import GROUP_SIZE
from studies.worlds.world import make_world

_BOX_SIDE_PX = (20.0, 200.0)
_MOVED_M = (0.3, 3.0)
# For an object under two classes: the share of its boxes that are doubled, the difference between
# the edges of both boxes as a share of the sides, and the distance between its landmarks [m].
_SEEN_TWICE, _JITTER, _APART_M = 0.7, 0.02, 0.03
_ELSEWHERE_M = np.array([1e3, 0.0, 0.0])
# Least distance of a wrong region from the truth if the map is large enough [m], and number of
# draws.
_WRONG_M, _TRIES = 2.5, 50
# Differences between two runs of a detector on images of the same view. Chosen.
_MISSED_SHARE = 0.2
_SHIFT_SHARE = 0.02  # of the box's sides, standard deviation
# Probability of a given region; deviations of its x and y [m] and of its yaw [rad].
_PROBABILITY = 0.9
_REGION, _POSE = (1.0, 1.0, 10.0), (0.3, 0.3, np.radians(15.0))

World = tuple[LandmarkMap, Sequence[PosedQuery]]
#: A function that changes map and queries by a level, with a random generator.
Change = Callable[[LandmarkMap, Sequence[PosedQuery], float, np.random.Generator], World]


def unchanged(landmark_map: LandmarkMap, queries: Sequence[PosedQuery], level: float,
              rng: np.random.Generator) -> World:
    """Change nothing."""
    return landmark_map, queries


def exchange_landmarks(landmark_map: LandmarkMap, queries: Sequence[PosedQuery], share: float,
                       rng: np.random.Generator) -> World:
    """Exchange the places of a share of the landmarks; a share of 1 makes another place."""
    count = len(landmark_map)
    chosen = rng.permutation(count)[:round(share * count)]
    centers = landmark_map.centers.copy()
    centers[chosen] = centers[np.roll(chosen, 1)]
    return replace(landmark_map, centers=centers), queries


def move_objects(landmark_map: LandmarkMap, queries: Sequence[PosedQuery], share: float,
                 rng: np.random.Generator) -> World:
    """Move a share of the landmarks to other spots at their height, 0.3 to 3 m away."""
    count = len(landmark_map)
    chosen = rng.permutation(count)[:round(share * count)]
    angles, steps = rng.uniform(0.0, 2.0 * np.pi, count), rng.uniform(*_MOVED_M, count)
    moved = landmark_map.centers.copy()
    moved[chosen, :2] += (steps * np.stack([np.cos(angles), np.sin(angles)])).T[chosen]
    return replace(landmark_map, centers=moved), queries


def double_landmarks(landmark_map: LandmarkMap, queries: Sequence[PosedQuery], distance_m: float,
                     rng: np.random.Generator) -> World:
    """Add a second landmark of the same object next to each one, in random directions."""
    steps = rng.normal(size=landmark_map.centers.shape)
    steps *= distance_m / np.linalg.norm(steps, axis=1, keepdims=True)
    return _with_copies(landmark_map, queries, steps)


def add_equal_room(landmark_map: LandmarkMap, queries: Sequence[PosedQuery], gap_m: float,
                   rng: np.random.Generator) -> World:
    """Add a copy of the mapped room beside it."""
    width = float(np.ptp(landmark_map.centers[:, 0]))
    return _with_copies(landmark_map, queries, np.array([width + gap_m, 0.0, 0.0]))


def age_half(landmark_map: LandmarkMap, queries: Sequence[PosedQuery], share: float,
             rng: np.random.Generator) -> World:
    """Make the map of one of two adjacent rooms out of date; keep the queries in one room.

    Half of a share of the landmarks in the queries' room are elsewhere, the other half are
    missing. A negative share applies to the other room.
    """
    middle = 0.5 * (landmark_map.centers[:, 0].min() + landmark_map.centers[:, 0].max())
    is_right = queries[int(rng.integers(len(queries)))].map_from_camera[0, 3] > middle
    is_own = (landmark_map.centers[:, 0] > middle) == is_right
    rows = rng.permutation(np.nonzero(is_own == (share > 0.0))[0])
    changed = rows[:round(abs(share) * len(rows))]
    kept = np.setdiff1d(np.arange(len(landmark_map)), changed[1::2])
    aged = landmark_map.centers.copy()
    aged[changed[::2]] = move_objects(landmark_map, (), 1.0, rng)[0].centers[changed[::2]]
    return (replace(landmark_map, centers=aged).select(kept.tolist()), _with_columns(
        [query for query in queries if (query.map_from_camera[0, 3] > middle) == is_right], kept))


def add_aged_twin(landmark_map: LandmarkMap, queries: Sequence[PosedQuery], share: float,
                  rng: np.random.Generator) -> World:
    """Add an equal room, then change one of the two, see age_half."""
    return age_half(*add_equal_room(landmark_map, queries, 2.0, rng), share, rng)


def confuse_landmarks(landmark_map: LandmarkMap, queries: Sequence[PosedQuery], copies: float,
                      rng: np.random.Generator) -> World:
    """Add landmarks of other classes at each landmark, and boxes of these classes at most boxes.

    A detector that consistently confuses the same classes produces such a map.
    """
    names: list[str] = rng.permutation(sorted(set(landmark_map.class_ids))).tolist()
    steps = np.arange(1 + int(copies))

    def renamed(class_ids: Sequence[str], step: NDArray[np.int64]) -> tuple[str, ...]:
        return tuple(names[(names.index(name) + by) % len(names)] if name in names else name
                     for name, by in zip(class_ids, step, strict=True))

    def confused(observation: Observation) -> Observation:
        step = np.repeat(steps, len(observation.detections))
        seen = (step == 0) | (rng.random(len(step)) < _SEEN_TWICE)
        found = of_rows(observation, np.tile(np.arange(len(observation.detections)),
                                             len(steps))[seen])
        boxes = found.detections.bboxes_xyxy
        sides = np.tile(boxes[:, 2:] - boxes[:, :2], 2)
        return replace(found, detections=replace(
            found.detections, class_ids=renamed(found.detections.class_ids, step[seen]),
            bboxes_xyxy=boxes + _JITTER * (step[seen] > 0)[:, None] * sides * rng.normal(
                size=sides.shape)))

    rows, step = np.tile(np.arange(len(landmark_map)), len(steps)), np.repeat(
        steps, len(landmark_map))
    offsets = _APART_M * (step > 0)[:, None] * rng.normal(size=(len(rows), 3))
    return (replace(landmark_map.select(rows.tolist()),
                    landmark_ids=tuple(f'{landmark_map.landmark_ids[row]}_{by}'
                                       for row, by in zip(rows, step, strict=True)),
                    class_ids=renamed([landmark_map.class_ids[row] for row in rows], step),
                    centers=landmark_map.centers[rows] + offsets),
            _each_frame(_with_columns(queries, rows), confused))


def unmapped_desk(landmark_map: LandmarkMap, queries: Sequence[PosedQuery], level: float,
                  rng: np.random.Generator) -> World:
    """Place the robot at a desk that the map lacks, so every pose is wrong. Matches by class."""
    desk = make_world('one desk', int(rng.integers(1 << 30)), groups=len(queries)).queries
    shifted = [replace(query, map_from_camera=make_transform(
        query.map_from_camera[:3, :3], query.map_from_camera[:3, 3] + _ELSEWHERE_M),
        observation=by_classes(query.observation, len(landmark_map)))
        for query in desk[::GROUP_SIZE]]
    has_vertical = queries[0].observation.up_in_camera is not None
    return landmark_map, with_vertical(shifted, VERTICAL_DEG) if has_vertical else shifted


def _distorted(change: Callable[[NDArray[np.float64], float, np.random.Generator],
                                NDArray[np.float64]]) -> Change:
    """Return a change of the landmarks' positions (L, 3), relative to their mean, by a level."""
    def changed(landmark_map: LandmarkMap, queries: Sequence[PosedQuery], level: float,
                rng: np.random.Generator) -> World:
        middle = landmark_map.centers.mean(axis=0)
        return replace(landmark_map, centers=middle + change(
            landmark_map.centers - middle, level, rng)), queries

    return changed


def _half_moved(offsets: NDArray[np.float64], distance_m: float, rng: np.random.Generator
                ) -> NDArray[np.float64]:
    angle = rng.uniform(0.0, 2.0 * np.pi)
    return offsets + distance_m * (offsets[:, :1] > np.median(offsets[:, 0])) * [
        np.cos(angle), np.sin(angle), 0.0]


def _half_turned(offsets: NDArray[np.float64], angle_deg: float, rng: np.random.Generator
                 ) -> NDArray[np.float64]:
    half = offsets[:, 0] > np.median(offsets[:, 0])
    turned = offsets.copy()
    turned[half] = Rotation.from_euler('z', angle_deg, degrees=True).apply(offsets[half])
    return turned


def carry(landmark_map: LandmarkMap, queries: Sequence[PosedQuery], frames: float,
          rng: np.random.Generator) -> World:
    """Give each query some frames of another query, as if odometry linked them to its image."""
    step = int(rng.integers(1, max(2, len(queries))))
    others = [*queries[step:], *queries[:step]]
    return landmark_map, [replace(
        query, neighbours=other.neighbours[:int(frames)], observation=replace(
            query.observation, odom_from_camera=other.observation.odom_from_camera))
        for query, other in zip(queries, others, strict=True)]


def random_detections(landmark_map: LandmarkMap, queries: Sequence[PosedQuery], count: float,
                      rng: np.random.Generator) -> World:
    """Replace the boxes of each query by random boxes, each of a random landmark's class."""
    def drawn(observation: Observation) -> Observation:
        corners = rng.uniform(0, (observation.camera.width, observation.camera.height),
                              (int(count), 2))
        boxes = np.hstack([corners, corners + rng.uniform(*_BOX_SIDE_PX, (int(count), 2))])
        shown, looks = rng.integers(len(landmark_map), size=int(count)), None
        if observation.similarities is not None:
            known = np.asarray(observation.similarities)
            rows = known[rng.integers(len(known), size=int(count))] if len(known) \
                else np.zeros((int(count), len(landmark_map)), dtype=np.float32)
            looks = np.ascontiguousarray(rng.permuted(rows, axis=1))
        return replace(observation, similarities=looks, depths=None, detections=Detections(
            boxes, tuple(landmark_map.class_ids[row] for row in shown), np.full(len(boxes), 0.8)))

    return landmark_map, _each_frame(queries, drawn)


def _each_frame(queries: Sequence[PosedQuery], change: Callable[[Observation], Observation]
                ) -> list[PosedQuery]:
    return [replace(query, observation=change(query.observation),
                    neighbours=tuple(map(change, query.neighbours))) for query in queries]


def of_rows(observation: Observation, rows: NDArray[np.int64]) -> Observation:
    """Return an observation with some of its boxes."""
    similarities, depths = observation.similarities, observation.depths
    return replace(
        observation, detections=observation.detections.select(rows),
        depths=None if depths is None else depths[rows], similarities=None
        if similarities is None else np.ascontiguousarray(np.asarray(similarities)[rows]))


def flickering(observation: Observation, rng: np.random.Generator) -> Observation:
    """Return an observation with some boxes missing and the others shifted."""
    detections = observation.detections
    rows = np.nonzero(rng.random(len(detections)) > _MISSED_SHARE)[0]
    sides = np.tile(np.diff(detections.bboxes_xyxy.reshape(-1, 2, 2), axis=1)[:, 0], 2)
    shifted = detections.bboxes_xyxy + _SHIFT_SHARE * sides * rng.normal(size=sides.shape)
    return of_rows(replace(observation, detections=replace(detections, bboxes_xyxy=shifted)),
                   rows)


def _with_columns(queries: Sequence[PosedQuery], columns: NDArray[np.int64]) -> list[PosedQuery]:
    """Return queries with only the similarities of some landmarks."""
    def chosen(observation: Observation) -> Observation:
        return observation if observation.similarities is None else replace(
            observation, similarities=np.ascontiguousarray(
                np.asarray(observation.similarities)[:, columns]))

    return _each_frame(queries, chosen)


def _with_copies(landmark_map: LandmarkMap, queries: Sequence[PosedQuery],
                 steps: NDArray[np.float64]) -> World:
    """Return a map with a copy of each landmark, steps (L, 3) or (3,) away."""
    rows = np.tile(np.arange(len(landmark_map)), 2)
    ids = landmark_map.landmark_ids
    ids = (*ids, *(f'{landmark_id}_copy' for landmark_id in ids))
    centers = np.concatenate([landmark_map.centers, landmark_map.centers + steps])
    return (replace(landmark_map.select(rows.tolist()), landmark_ids=ids, centers=centers),
            _with_columns(queries, rows))


def _told(landmark_map: LandmarkMap, query: PosedQuery, spot: NDArray[np.float64],
          deviations: Sequence[float], rng: np.random.Generator) -> PosedQuery:
    """Return a query with a region near a spot (3,) of x, y, yaw; deviations give its error."""
    region = Region(landmark_map.frame_id, spot + rng.normal(size=3) * deviations,
                    np.diag(deviations) ** 2, _PROBABILITY)
    return replace(query, observation=replace(query.observation, region=region))


def _spot_of(map_from_camera: NDArray[np.float64]) -> NDArray[np.float64]:
    body = map_from_camera @ OPTICAL_FROM_BODY
    return np.array([*body[:2, 3], np.arctan2(body[1, 0], body[0, 0])])


def tell(landmark_map: LandmarkMap, queries: Sequence[PosedQuery], wrong: float,
         rng: np.random.Generator, deviations: Sequence[float]) -> World:
    """Give each query a region; for a share of them the region is at a wrong spot of the map."""
    low, high = landmark_map.centers[:, :2].min(axis=0), landmark_map.centers[:, :2].max(axis=0)
    found = []
    for query in queries:
        spot = _spot_of(query.map_from_camera)
        if rng.random() < wrong:
            others = np.c_[rng.uniform(low, high, (_TRIES, 2)), rng.uniform(-np.pi, np.pi, _TRIES)]
            away = np.linalg.norm(others[:, :2] - spot[:2], axis=1)
            far = np.nonzero(away > _WRONG_M)[0]
            spot = others[far[0] if len(far) else int(away.argmax())]
        found.append(_told(landmark_map, query, spot, deviations, rng))
    return landmark_map, found


def tell_twin(landmark_map: LandmarkMap, queries: Sequence[PosedQuery], wrong: float,
              rng: np.random.Generator, deviations: Sequence[float] = ()) -> World:
    """Keep the queries whose place has a twin; with ``deviations``, give each a region there.

    This is the worst case: the map cannot distinguish the two places, and the region is wrong.
    """
    found = []
    for query in queries:
        alike = find_alike(landmark_map, query.map_from_camera[:3, 3])
        twins = [move @ query.map_from_camera for move in alike.moves]
        twins = [twin for twin in twins if np.linalg.norm(
            twin[:2, 3] - query.map_from_camera[:2, 3]) > RIGHT_M]
        if twins and len(deviations):
            found.append(_told(landmark_map, query, _spot_of(twins[0]), deviations, rng))
        elif twins:
            found.append(query)
    return landmark_map, found


class Trouble(NamedTuple):
    """A change, its levels, and the modes in which it matters."""

    change: Change
    levels: tuple[float, ...] = (0.0,)
    modes: tuple[str, ...] = (ONE, LEVEL, ALL)
    kinds: tuple[str, ...] = ('room', 'office', 'shop')  #: Kinds of worlds, see families
    in_order: bool = False  #: Whether it concerns a camera, so several looks may detect it


def _of_sensor(change: wrong_sensors.Change, levels: tuple[float, ...], modes: tuple[str, ...],
               in_order: bool = False) -> Trouble:
    """Return the trouble of a wrong sensor."""
    return Trouble(lambda landmark_map, queries, level, rng: (
        landmark_map, change(queries, level)), levels, modes, in_order=in_order)


_of_depth = partial(_of_sensor, modes=(ONE, LEVEL))
#: Errors that are unknown to the robot.
TROUBLES = {
    'none': Trouble(unchanged, modes=(ONE, LEVEL, FIVE, ALL)),
    'share of the landmarks that have exchanged places': Trouble(exchange_landmarks,
                                                                 (0.2, 0.4, 0.6, 1.0)),
    'random boxes': Trouble(random_detections, (10,)),
    'every landmark twice, apart by [m]': Trouble(double_landmarks, (0.01, 0.1)),
    'two identical rooms, apart by [m]': Trouble(add_equal_room, (2.0,)),
    'share of the objects moved by .3 to 3 m': Trouble(move_objects, (0.4,)),
    'mount off by [degrees]': _of_sensor(wrong_sensors.wrong_mount, (5.0,), (LEVEL, FIVE, ALL)),
    'vertical off by [degrees]': _of_sensor(wrong_sensors.tilted_vertical, (10.0,), (LEVEL, ALL)),
    'depth too large by a factor': _of_depth(wrong_sensors.scaled_depth,
                                             (1000.0, 1.15, 1.0 / 1.15)),
    'share of the depths that are random': _of_depth(wrong_sensors.random_depth, (1.0,)),
    'share of the depths of something else': _of_depth(wrong_sensors.depth_elsewhere, (1.0,)),
    'share of the depths that are missing': _of_depth(wrong_sensors.missing_depth, (0.5, 1.0)),
    'odometry too long by a factor': _of_sensor(
        wrong_sensors.scaled_odometry, (1.2, 0.8), (FIVE, ALL))}
_BOTH = (ONE, VERTICAL)
_of_camera = partial(_of_sensor, modes=_BOTH, in_order=True)
#: Errors that many objects share. Their names begin with their kind: A is an error in the map of
#: one thing, B in the input, C in the whole map.
FAMILIES = {
    'plain': Trouble(unchanged, (0.0,), _BOTH, (
        'room', 'office', 'shop', 'bare room', 'corridor', 'hall', 'two rooms')),
    'A things about one axis': Trouble(unchanged, (0.0,), _BOTH, ('arrangement',)),
    'A the same under other classes, copies': Trouble(confuse_landmarks, (1, 2), _BOTH,
                                                      ('arrangement',)),
    'A things on one line': Trouble(unchanged, (0.0,), _BOTH, ('row',)),
    'A landmarks under other classes, copies': Trouble(confuse_landmarks, (1, 2, 3), _BOTH),
    'A unmapped desk': Trouble(unmapped_desk, (0.0,), _BOTH, ('one desk', 'office', 'room')),
    'B boxes in pixels of a middle crop of [px]': _of_camera(wrong_sensors.middle_crop,
                                                             (300.0, 416.0)),
    'B boxes scaled by': _of_camera(wrong_sensors.scaled_boxes, (0.5, 1.5, 2.0)),
    'B boxes shifted by a share of the width': _of_camera(wrong_sensors.shifted_boxes,
                                                          (0.05, 0.15)),
    'B boxes turned by [degrees]': _of_camera(wrong_sensors.turned_boxes, (90.0, 180.0)),
    'B boxes mirrored': _of_camera(wrong_sensors.mirrored_boxes, (0.0, 1.0)),
    'B boxes of convention': _of_camera(wrong_sensors.of_convention, tuple(
        map(float, range(len(wrong_sensors.CONVENTIONS))))),
    'B K scaled by': _of_camera(wrong_sensors.scaled_camera, (2.0, 0.5)),
    'B focal length off by a factor': _of_camera(wrong_sensors.scaled_focal, (1.5, 0.7)),
    'B principal point off by a share of the width': _of_camera(wrong_sensors.shifted_center,
                                                                (0.2, -0.2)),
    'B fisheye taken for a pinhole': _of_camera(wrong_sensors.fisheye_boxes, (0.0,)),
    'B odometry too long by a factor': _of_sensor(
        wrong_sensors.scaled_odometry, (1.2, 0.8), (FIVE,)),
    'B carried after so many images': Trouble(carry, (1.0, 3.0), (FIVE,)),
    'B mount off by [degrees]': _of_sensor(wrong_sensors.wrong_mount, (5.0,), (VERTICAL, FIVE)),
    'C equal rooms, own out of date by a share': Trouble(add_aged_twin, (0.1, 0.2, 0.3), _BOTH),
    'C equal rooms, other out of date by a share': Trouble(add_aged_twin, (-0.2,), _BOTH),
    'C like rooms, own out of date by a share': Trouble(age_half, (0.1, 0.2, 0.3), _BOTH,
                                                        ('two rooms',)),
    'C map scaled by': Trouble(_distorted(lambda offsets, factor, rng: factor * offsets),
                               (1.1, 1.05, 0.9), _BOTH),
    'C map sheared by': Trouble(_distorted(lambda offsets, share, rng: offsets + share * (
        offsets[:, [1]] * [1.0, 0.0, 0.0])), (0.1,), _BOTH),
    'C half of the map moved by [m]': Trouble(_distorted(_half_moved), (0.5, 0.9), _BOTH),
    'C half of the map turned by [degrees]': Trouble(_distorted(_half_turned), (10.0,), _BOTH)}
#: Families in which matching by class accepts too few poses for a result.
BY_LABELS = [name for name in FAMILIES if name.startswith('C')]
#: Priors of the pose, and the shares of queries for which they are wrong.
PRIORS = {
    'nothing told': Trouble(unchanged),
    'region of 1 m': Trouble(partial(tell, deviations=_REGION), (0.0, 0.1, 1.0)),
    'pose to .3 m and 15 degrees': Trouble(partial(tell, deviations=_POSE), (0.0, 0.1, 1.0)),
    'a twin exists, nothing told': Trouble(tell_twin),
    'a twin exists, told the twin': Trouble(partial(tell_twin, deviations=_POSE), (1.0,))}
