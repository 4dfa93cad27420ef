# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A floor of rooms along corridors, and what a robot sees of it on its way through: simulated.

Walls hide all but the objects of the room or corridor in which the camera is; nearer objects hide
farther ones. Boxes have noise, are missed more often the farther away they are, carry a wrong
class at times, and some show nothing.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.ellipsoid import ellipse_bboxes, project_ellipsoids
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from studies.worlds.cameras import looking
from studies.worlds.detector import hidden
from studies.worlds.things import CLASS_NAMES, TYPICAL

CAMERA = Camera(640, 480, 420.0, 420.0, 320.0, 240.0)
FRAMES_PER_S = 10.0
# Objects of a room, and of the corridor before it.
_IN_ROOM, _IN_CORRIDOR = 46, 4
_ROOM_M = np.array([6.0, 5.0])
_CORRIDOR_M = 2.0
_ROOMS_A_ROW = 20
# Shares of a room's time: it is entered, the way round it is done, the door is behind.
_ENTERED, _LEAVING, _LEFT = 0.06, 0.7, 0.76
_LEAST_GAP_M = 0.05
# Guesses about a detector.
_NOISE_PX, _NOISE_SHARE = 1.0, 0.015
_MISSED_NEAR, _MISSED_A_METRE = 0.08, 0.04
_WRONG_CLASS, _FALSE_BOXES = 0.03, 0.2
_LEAST_EXTENT_PX, _RANGE_M, _HIDDEN_SHARE = 12.0, 8.0, 0.5


@dataclass(frozen=True)
class Floor:
    """Objects of R rooms, with the corridor before each room as a place of its own."""

    landmark_map: LandmarkMap  #: The true map
    #: (L,): the place of each object: 2 r for room r, 2 r + 1 for the corridor before it
    places: NDArray[np.int64]
    room_centers: NDArray[np.float64]  #: (R, 2): [m]


@dataclass(frozen=True)
class SeenFloor:
    """What a detector saw, and the object (n,) that each box shows, -1 for none."""

    detections: PosedDetections
    true_landmarks: NDArray[np.int64]


def make_floor(objects: int, seed: int = 0) -> Floor:
    """Return a floor with some number of objects, which grows with it in rooms."""
    rng = np.random.default_rng(seed)
    rooms = -(-objects // (_IN_ROOM + _IN_CORRIDOR))
    pitch = _ROOM_M + np.array([0.2, _CORRIDOR_M])
    room_centers = np.array([_grid_place(room) for room in range(rooms)]) * pitch
    places = np.repeat(np.arange(2 * rooms), np.tile([_IN_ROOM, _IN_CORRIDOR], rooms))[:objects]
    typical = np.array([TYPICAL[name] for name in CLASS_NAMES])
    shares = 1.0 / (0.1 + typical[:, :3].max(axis=1))  # fewer large things
    classes = rng.choice(len(CLASS_NAMES), objects, p=shares / shares.sum())
    sizes = typical[classes]
    sizes[:, :3] *= rng.uniform(0.85, 1.15, (objects, 3))
    centers = np.c_[_scatter(places, room_centers, sizes[:, :2].max(axis=1), rng), sizes[:, 3]]
    names = tuple(CLASS_NAMES[number] for number in classes)
    quats = Rotation.from_euler('z', rng.uniform(0.0, np.pi, (objects, 1))).as_quat()
    ids = tuple(f'{name.replace(" ", "_")}_{row}' for row, name in enumerate(names))
    return Floor(LandmarkMap('map', ids, names, names, centers, sizes[:, :3], quats),
                 places, room_centers)


def _grid_place(room: int) -> tuple[int, int]:
    """Return column and row of a room; each row is walked against the one before it."""
    row, column = divmod(room, _ROOMS_A_ROW)
    return (column, row) if row % 2 == 0 else (_ROOMS_A_ROW - 1 - column, row)


def _scatter(places: NDArray[np.int64], room_centers: NDArray[np.float64],
             radii: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Return where objects stand (L, 2): apart from one another, as far as there is room."""
    found = np.empty((len(places), 2))
    for place in np.unique(places):
        rows = np.nonzero(places == place)[0]
        middle, half = room_centers[place // 2], 0.5 * _ROOM_M - 0.1
        if place % 2:
            middle = middle - [0.0, 0.5 * (_ROOM_M[1] + _CORRIDOR_M)]
            half = np.array([half[0], 0.5 * _CORRIDOR_M - 0.1])
        for number, row in enumerate(rows):
            reach = np.maximum(half - radii[row], 0.0)
            tries = middle + reach * rng.uniform(-1.0, 1.0, (50, 2))
            others = rows[:number]
            gaps = (np.linalg.norm(tries[:, None] - found[others], axis=2)
                    - radii[others] - radii[row]).min(axis=1, initial=np.inf)
            free = np.nonzero(gaps > _LEAST_GAP_M)[0]
            found[row] = tries[free[0] if len(free) else np.argmax(gaps)]
    return found


def walk_floor(floor: Floor, frames: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the poses map_from_camera (F, 4, 4) of a way through all rooms, and the places (F,).

    From the corridor the camera enters a room, goes round its middle looking across it, leaves,
    and goes on along the corridor to the next door.
    """
    rooms = len(floor.room_centers)
    along = np.arange(frames) * rooms / frames
    room = along.astype(np.int64)
    turn = np.linspace(0.0, 2.0 * np.pi, 33)
    shares = np.concatenate([[0.0], np.linspace(_ENTERED, _LEAVING, len(turn)), [_LEFT]])
    door = [0.0, -0.5 * (_ROOM_M[1] + _CORRIDOR_M)]
    x_y = np.concatenate([[door], np.c_[2.1 * np.sin(turn), -1.7 * np.cos(turn)], [door]])
    yaw = 0.5 * np.pi + np.concatenate([[0.0], turn + 0.4 * np.sin(3.0 * turn), [3.0 * np.pi]])
    knots = (np.arange(rooms)[:, None] + shares).ravel()
    stops = (floor.room_centers[:, None] + x_y).reshape(-1, 2)
    headings = np.unwrap(np.tile(yaw, rooms))
    position = [np.interp(along, knots, stops[:, axis]) for axis in range(2)]
    height = 1.3 + 0.15 * np.sin(40.0 * along)
    poses = np.array([looking(np.array(where), heading, 0.2) for *where, heading in zip(
        *position, height, np.interp(along, knots, headings), strict=True)])
    inside = (along - room > 0.5 * _ENTERED) & (along - room < 0.5 * (_LEAVING + _LEFT))
    return poses, np.where(inside, 2 * room, 2 * room + 1)


def see_floor(floor: Floor, frames: int, seed: int = 0) -> SeenFloor:
    """Return what a detector sees on a way through a floor."""
    rng = np.random.default_rng(seed)
    poses, places = walk_floor(floor, frames)
    bounds = np.searchsorted(floor.places, np.arange(floor.places[-1] + 3))
    classes = np.searchsorted(CLASS_NAMES, floor.landmark_map.class_ids)
    boxes, shown = [], []
    for pose, place in zip(poses, places, strict=True):
        rows = np.arange(bounds[place], bounds[place + 1])
        clipped, seen = _see(floor.landmark_map, pose, rows, rng)
        # Boxes that show nothing.
        count = rng.poisson(_FALSE_BOXES)
        corners = rng.uniform([0.0, 0.0], [560.0, 400.0], (count, 2))
        extra = np.c_[corners, corners + rng.uniform(20.0, 80.0, (count, 2))]
        boxes.append(np.concatenate([clipped, extra]))
        shown.append(np.concatenate([seen, np.full(len(extra), -1)]))
    true = np.concatenate(shown)
    wrong = (true < 0) | (rng.random(len(true)) < _WRONG_CLASS)
    seen_classes = np.where(wrong, rng.integers(0, len(CLASS_NAMES), len(true)), classes[true])
    detections = PosedDetections(
        (CAMERA,), poses, np.arange(frames) / FRAMES_PER_S, np.cumsum([0, *map(len, shown)]),
        np.concatenate(boxes), CLASS_NAMES, seen_classes, rng.uniform(0.3, 1.0, len(true)))
    return SeenFloor(detections, true)


def _see(true_map: LandmarkMap, pose: NDArray[np.float64], rows: NDArray[np.int64],
         rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return boxes (m, 4) of the objects of a place that a detector finds, and these (m,)."""
    size = np.array([CAMERA.width, CAMERA.height] * 2)
    distances = np.linalg.norm(true_map.centers[rows] - pose[:3, 3], axis=1)
    rows = rows[np.argsort(distances)]
    distances = np.sort(distances)
    outlines = ellipse_bboxes(project_ellipsoids(invert_transform(pose), true_map.centers[rows],
                                                 true_map.shapes[rows]))
    full = outlines * CAMERA.fx + [CAMERA.cx, CAMERA.cy] * 2
    clipped = np.clip(full, 0.0, size)
    extents = clipped[:, 2:] - clipped[:, :2]
    seen = (extents > _LEAST_EXTENT_PX).all(axis=1) & (distances < _RANGE_M)  # never true of NaN
    seen &= extents.prod(axis=1) > _HIDDEN_SHARE * (full[:, 2:] - full[:, :2]).prod(axis=1)
    seen[seen] = ~hidden(clipped[seen], _HIDDEN_SHARE,
                          np.zeros(int(seen.sum()), dtype=np.int64))
    seen &= rng.random(len(rows)) > _MISSED_NEAR + _MISSED_A_METRE * distances
    deviations = np.hypot(_NOISE_PX, _NOISE_SHARE * np.tile(extents[seen], 2))
    noisy = np.clip(clipped[seen] + deviations * rng.normal(size=deviations.shape), 0.0, size)
    return noisy, rows[seen]
