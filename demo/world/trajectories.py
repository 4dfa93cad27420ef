# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Camera poses in the synthetic world."""

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import make_transform
from demo.world.room import LENGTH_M, WIDTH_M, Room

#: Pixel centres have integer coordinates, as everywhere in the package.
CAMERA = Camera(640, 480, 500.0, 500.0, 319.5, 239.5, 'plumb_bob')


def look_at(eye: npt.NDArray[np.float64], target: npt.NDArray[np.float64],
            roll: float = 0.0) -> npt.NDArray[np.float64]:
    """Return ``map_from_camera`` (4, 4) of a camera at `eye` [m] that looks at `target` [m]."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    transform = np.eye(4)
    transform[:3, 0] = np.cos(roll) * right + np.sin(roll) * down
    transform[:3, 1] = -np.sin(roll) * right + np.cos(roll) * down
    transform[:3, 2], transform[:3, 3] = forward, eye
    return transform


def draw_views(room: Room, count: int, rng: np.random.Generator) -> npt.NDArray[np.float64]:
    """Draw random poses (count, 4, 4) in the room that look at objects."""
    views: list[npt.NDArray[np.float64]] = []
    while len(views) < count:
        target = np.array(room.objects[int(rng.integers(len(room.objects)))].slot.position)
        eye = np.array([rng.uniform(0.7, LENGTH_M - 0.7), rng.uniform(0.7, WIDTH_M - 0.7),
                        rng.uniform(0.8, 1.8)])
        if 0.9 < np.linalg.norm(target - eye) < 3.6:
            target = target + rng.normal(0, 0.15, 3)
            views.append(look_at(eye, target, rng.normal(0, 0.05)))
    return np.array(views)


def walk(count: int, way_points: npt.ArrayLike, targets: npt.ArrayLike) -> \
        npt.NDArray[np.float64]:
    """Return poses (count, 4, 4) of a smooth walk through way points that looks at targets.

    Parameters
    ----------
    count : int
        Number of poses, spread evenly over the walk.
    way_points, targets : (n, 3) array_like
        Points that the camera passes, and the points that it looks at there [m].
    """
    way_points = np.asarray(way_points, dtype=float)
    knots = np.linspace(0, 1, len(way_points))
    eyes = CubicSpline(knots, way_points)(np.linspace(0, 1, count))
    gazes = CubicSpline(knots, np.asarray(targets, dtype=float))(np.linspace(0, 1, count))
    rolls = 0.03 * np.sin(np.arange(count))
    return np.array([look_at(*pose) for pose in zip(eyes, gazes, rolls, strict=True)])


def true_map_walk(count: int) -> npt.NDArray[np.float64]:
    """Return the walk behind the demo's map of true boxes: around the centre, looking outwards.

    It shows most objects from one side only. That suffices there: the fit starts at the truth.
    """
    turn = np.linspace(0, 2 * np.pi, 13)
    eyes = np.c_[3.0 + 0.9 * np.cos(turn), 2.5 + 0.6 * np.sin(turn), np.full(13, 1.45)]
    gazes = np.c_[3.0 + 3.2 * np.cos(turn), 2.5 + 2.6 * np.sin(turn),
                  0.95 + 0.25 * np.sin(3 * turn)]
    return walk(count, eyes, gazes)


def mapping_walk(count: int) -> npt.NDArray[np.float64]:
    """Return the mapping walk: sideways past each shelf and table, two metres away.

    Each object is seen from directions that are at least 20 degrees apart.
    """
    eyes = [(0.9, 2.1, 1.4), (1.5, 2.3, 1.5), (2.2, 2.2, 1.4), (2.8, 1.9, 1.5),  # shelf
            (3.6, 2.0, 1.5), (4.3, 2.3, 1.4), (5.1, 2.1, 1.4),  # table
            (4.2, 2.2, 1.5), (3.8, 3.1, 1.4), (4.1, 4.0, 1.4), (4.2, 3.4, 1.5),  # table, turn
            (3.7, 2.9, 1.5), (2.8, 2.7, 1.4), (2.0, 3.0, 1.4), (2.0, 3.6, 1.4),  # table, turn
            (2.1, 4.1, 1.5), (2.3, 3.4, 1.4), (2.3, 2.6, 1.5), (1.9, 1.9, 1.4)]  # shelf
    gazes = [(1.3, 0.2, 1.1), (1.4, 0.2, 1.0), (1.5, 0.2, 1.1), (1.7, 0.2, 1.0),
             (4.5, 0.5, 0.75), (4.7, 0.5, 0.75), (4.8, 0.5, 0.75),
             (5.5, 2.8, 0.75), (5.5, 3.1, 0.75), (5.5, 3.3, 0.75), (4.3, 4.7, 0.75),
             (2.9, 4.6, 0.75), (2.8, 4.6, 0.75), (2.6, 4.6, 0.75), (1.0, 4.8, 0.9),
             (0.2, 3.4, 1.0), (0.2, 3.1, 1.1), (0.2, 2.9, 1.0), (0.2, 2.7, 1.1)]
    return walk(count, eyes, gazes)


#: The cameras of a robot that does not turn, each with its angle to the right of the first [deg].
RIG_DEG = {'front': 0.0, 'left': -90.0, 'back': 180.0, 'right': 90.0}


def rig_mounts() -> dict[str, npt.NDArray[np.float64]]:
    """Return front_from_camera (4, 4) of each camera of a rig, 15 cm around its middle."""
    mounts = {}
    for name, turn_deg in RIG_DEG.items():
        rotation = Rotation.from_euler('y', turn_deg, degrees=True).as_matrix()
        mounts[name] = make_transform(rotation, rotation @ [0.0, 0.0, 0.15] - [0.0, 0.0, 0.15])
    return mounts


def rig_walk() -> npt.NDArray[np.float64]:
    """Return poses (n, 4, 4) of a rig's front camera, which keeps its viewing direction."""
    eyes = np.array([(1.6, 2.0, 1.2), (2.2, 2.6, 1.2), (2.9, 3.1, 1.2), (3.5, 2.4, 1.2),
                     (4.1, 1.9, 1.2), (4.4, 2.9, 1.2)])
    return np.array([look_at(eye, eye + np.array([0.9, 0.4, 0.0])) for eye in eyes])


def query_walk(count: int) -> npt.NDArray[np.float64]:
    """Return the walk of the wake-ups (count, 4, 4): lower, tilted, past a nearly empty wall."""
    eyes = [(4.2, 3.6, 1.3), (3.6, 3.6, 1.35), (3.0, 3.0, 1.2), (2.8, 2.2, 1.1), (3.2, 2.0, 1.3),
            (3.0, 2.2, 1.25), (2.8, 1.8, 1.3), (2.6, 1.6, 1.3), (2.6, 1.5, 1.3), (2.4, 1.8, 1.3),
            (2.6, 2.0, 1.3), (3.0, 2.6, 1.3), (3.2, 3.2, 1.25)]
    gazes = [(4.0, 0.2, 0.9), (2.5, 0.2, 1.0), (1.5, 0.2, 1.0), (0.9, 0.2, 1.0), (0.2, 2.2, 1.0),
             (0.2, 3.2, 1.0), (1.4, 4.6, 0.9), (2.8, 4.6, 0.8), (4.2, 4.6, 0.8), (5.7, 3.2, 0.8),
             (5.8, 1.6, 1.3), (4.9, 0.3, 0.8), (3.3, 0.2, 0.9)]
    return walk(count, eyes, gazes)
