# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Camera poses of a robot: groups of five images while it turns or drives."""

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import make_transform
from studies.worlds.places import Objects, Place

#: Images of one group.
GROUP_SIZE = 5
# Focal lengths: 500 (demo), 525 (kitchen) and 535 (TUM fr3); robots have wider cameras.
_FOCAL_PX = (380.0, 620.0)
# Heights of hands and tripods: 1.28 to 1.64 (fr3), 1.12 to 1.35 (demo). That robots are lower is a
# guess.
_HEIGHT_M = (0.3, 1.8)
# Pitch: 20 to 39 down (fr3), 2 to 10 (demo). That low robots look up is a guess. Deviation of the
# roll: 4.4 (fr3, hand), 1.2 (demo).
_PITCH_DEG, _ROLL_DEG = (-20.0, 35.0), 3.0
# Motion in a second: 5 to 21 degrees and .12 to .36 m (fr3, hand).
_TURN_DEG, _STEP_M = (5.0, 20.0), 0.15
# Greatest motion of a driving robot between two looks 2 s apart. It is steadier than a hand.
_DRIVE_M, _MOST_TURN_DEG, _DRIVE_ROLL_DEG = 0.5, 30.0, 0.5
_ELBOW_ROOM_M = 0.2
# For a camera that is carried around a thing: its distance, and deviation of its direction.
_ABOUT_M, _AIM_DEG = (0.8, 3.0), 5.0
_TRIES = 100
# Number of looks to choose from. A look with more things ahead is more likely to be chosen.
_CHOICES, _AHEAD_COSINE, _AHEAD_M = 16, 0.85, 4.0


def make_camera(rng: np.random.Generator) -> Camera:
    """Return a camera of 640 x 480 pixels."""
    focal = rng.uniform(*_FOCAL_PX)
    return Camera(640, 480, focal, focal, 320.0, 240.0)


def make_groups(place: Place, objects: Objects, groups: int, rng: np.random.Generator
                ) -> NDArray[np.float64]:
    """Return the poses map_from_camera (groups, 5, 4, 4) of a robot in a place.

    Its height and pitch are constant. In each group it turns on the spot or drives while it turns.
    """
    height = rng.uniform(*_HEIGHT_M)
    pitch = np.radians(rng.uniform(*_PITCH_DEG))
    found = np.empty((groups, GROUP_SIZE, 4, 4))
    for group in range(groups):
        if place.focus is not None:
            found[group] = _about(np.array(place.focus), height, rng)
            continue
        position, yaw = _look(place, objects, rng)
        turn = np.radians(rng.uniform(*_TURN_DEG)) * rng.choice((-1.0, 1.0))
        drives = rng.random() < 0.5
        for number in range(GROUP_SIZE):
            roll, nod = np.radians(_ROLL_DEG) * rng.normal(size=2)
            found[group, number] = looking(np.array([*position, height]), yaw, pitch + nod, roll)
            yaw += turn
            if drives:
                step = _STEP_M * np.array([np.cos(yaw), np.sin(yaw)])
                position = np.clip(position + step, 0.1, (place.width - 0.1, place.depth - 0.1))
    return found


def _about(focus: NDArray[np.float64], height: float, rng: np.random.Generator
           ) -> NDArray[np.float64]:
    """Return the poses (5, 4, 4) of a camera that moves around a spot (3,) and looks at it."""
    distance, angle = rng.uniform(*_ABOUT_M), rng.uniform(-np.pi, np.pi)
    step, found = np.radians(rng.uniform(*_TURN_DEG)), np.empty((GROUP_SIZE, 4, 4))
    for number in range(GROUP_SIZE):
        away = np.array([np.cos(angle), np.sin(angle)])
        off, nod, roll = np.radians([_AIM_DEG, _AIM_DEG, _ROLL_DEG]) * rng.normal(size=3)
        found[number] = looking(
            np.array([*(focus[:2] + distance * away), height]), angle + np.pi + off,
            np.arctan2(height - focus[2], distance) + nod, roll)
        angle += step
    return found


def drive_about(place: Place, objects: Objects, images: int, rng: np.random.Generator
                ) -> NDArray[np.float64]:
    """Return the poses map_from_camera (images, 4, 4) of a robot that drives from spot to spot.

    Two images are one period of looks apart, and at most half a metre or 30 degrees. At each spot
    the robot looks around or waits.
    """
    height, pitch = rng.uniform(*_HEIGHT_M), np.radians(rng.uniform(*_PITCH_DEG))
    position, yaw = _look(place, objects, rng)
    steps: list[tuple[float, float]] = []  # turn [rad] and way [m], the last one first
    found = np.empty((images, 4, 4))
    for number in range(images):
        roll, nod = np.radians(_DRIVE_ROLL_DEG) * rng.normal(size=2)
        found[number] = looking(np.array([*position, height]), yaw, pitch + nod, roll)
        if not steps:
            offset = _free_spot(place, objects, rng) - position
            way, turn = float(np.hypot(*offset)), np.arctan2(offset[1], offset[0]) - yaw
            turn = (turn + np.pi) % (2.0 * np.pi) - np.pi
            about = rng.choice((-1.0, 0.0, 1.0)) * np.radians(_MOST_TURN_DEG)
            steps = [(about, 0.0)] * int(rng.integers(2, 6))
            drives = int(way / _DRIVE_M) + 1
            turns = int(abs(turn) / np.radians(_MOST_TURN_DEG)) + 1
            steps += [(0.0, way / drives)] * drives + [(turn / turns, 0.0)] * turns
        turn, way = steps.pop()
        yaw += turn
        position = position + way * np.array([np.cos(yaw), np.sin(yaw)])
    return found


def _look(place: Place, objects: Objects, rng: np.random.Generator
          ) -> tuple[NDArray[np.float64], float]:
    """Draw a spot (2,) and a viewing direction [rad], preferably towards many things."""
    spots = np.array([_free_spot(place, objects, rng) for _ in range(_CHOICES)])
    yaws = rng.uniform(-np.pi, np.pi, _CHOICES)
    offsets = objects.centers[:, :2] - spots[:, None]
    distances = np.linalg.norm(offsets, axis=2)
    ahead = np.einsum('cnd,cd->cn', offsets, np.stack([np.cos(yaws), np.sin(yaws)], axis=1))
    counts = ((ahead > _AHEAD_COSINE * distances) & (distances < _AHEAD_M)).sum(axis=1)
    chances = (0.5 + counts) ** 2.0
    chosen = rng.choice(_CHOICES, p=chances / chances.sum())
    return spots[chosen], float(yaws[chosen])


def _free_spot(place: Place, objects: Objects, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return a spot (2,) where no object stands, if there is one."""
    radii = objects.semi_axes[:, :2].max(axis=1) + _ELBOW_ROOM_M
    spots = rng.uniform(0.2, (place.width - 0.2, place.depth - 0.2), (_TRIES, 2))
    gaps = np.linalg.norm(spots[:, None] - objects.centers[:, :2], axis=2) - radii
    free = np.nonzero(gaps.min(axis=1) > 0.0)[0]
    return np.asarray(spots[free[0] if len(free) else int(np.argmax(gaps.min(axis=1)))])


def looking(position: NDArray[np.float64], yaw: float, pitch: float, roll: float = 0.0
          ) -> NDArray[np.float64]:
    """Return map_from_camera (4, 4) of a camera with a pitch downwards and a roll [rad]."""
    forward = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), -np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    down = np.cross(forward, right)
    cos, sin = np.cos(roll), np.sin(roll)
    return make_transform(np.stack([cos * right + sin * down, cos * down - sin * right, forward],
                                   axis=1), position)
