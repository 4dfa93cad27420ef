# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The places of a map: a grid of camera positions, and pairs of places that look alike."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cliploc_ros.core.acceptance.look_alikes import find_alike
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.offline.mapping.options import CheckOptions

_MARGIN_M = 0.5
# Without a recording. Chosen.
_GUESSED_MARGIN_M = 1.5
_GUESSED_HEIGHT_M = 0.3   # above the median landmark
_GUESSED_PITCH_DEG = -10.0
# The outermost landmarks, this share on each side, do not widen the grid.
_OUTLYING = 0.03
# Positions within this distance of the recording's path are near it [m].
_NEAR_M = 1.0
#: A place is the area within this radius of a landmark [m].
RADIUS_M = 2.0
# Places that share fewer landmarks look alike by chance, and labels tell them
# apart. With the share of find_alike, which only proposes rivals of a pose, most offices and shops
# would be reported.
_LEAST_SHARE = 0.6


@dataclass(frozen=True)
class Grid:
    """P positions with H headings each."""

    positions: NDArray[np.float64]  #: (P, 3): [m]
    is_near: NDArray[np.bool_]  #: (P,): near the path of the recording, if there is one
    #: (P * H, 4, 4): map_from_camera, heading by heading of each position
    poses: NDArray[np.float64]
    spacing_m: float


def make_grid(landmark_map: LandmarkMap, recorded: NDArray[np.float64] | None,
              options: CheckOptions) -> Grid:
    """Return the grid of camera positions for a map.

    Parameters
    ----------
    recorded : ndarray (F, 4, 4), optional
        Poses map_from_camera of a recording, which determine height, pitch and extent.
    """
    low, high = np.quantile(landmark_map.centers, [_OUTLYING, 1.0 - _OUTLYING], axis=0)
    if recorded is None:
        margin, pitch_deg = _GUESSED_MARGIN_M, _GUESSED_PITCH_DEG
        height = float(np.median(landmark_map.centers[:, 2])) + _GUESSED_HEIGHT_M
        path = None
    else:
        path = recorded[:, :3, 3]
        low, high = np.minimum(low, path.min(axis=0)), np.maximum(high, path.max(axis=0))
        margin, height = _MARGIN_M, float(np.median(path[:, 2]))
        pitch_deg = float(np.degrees(np.arcsin(np.clip(np.median(recorded[:, 2, 2]), -1, 1))))
    if options.camera_height_m is not None:
        height = options.camera_height_m
    positions, spacing = _positions(low[:2] - margin, high[:2] + margin, height, options)
    # positions inside a landmark are left out
    inside = np.zeros(len(positions), dtype=np.bool_)
    for center, upper in zip(landmark_map.centers, landmark_map.shapes, strict=True):
        xx, xy, xz, yy, yz, zz = upper
        shape = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        offsets = positions - center
        inside |= np.einsum('pi,pi->p', offsets, np.linalg.solve(shape, offsets.T).T) < 1.0
    positions = positions[~inside]
    near = np.ones(len(positions), dtype=np.bool_)
    if path is not None:
        near = cKDTree(path[:, :2]).query(positions[:, :2])[0] <= max(_NEAR_M, spacing)
    # a level camera has its x axis to the right and its z axis forward
    headings = 2.0 * np.pi * np.arange(options.headings) / options.headings
    cosine, sine, pitch = np.cos(headings), np.sin(headings), np.radians(pitch_deg)
    forward = np.stack([cosine * np.cos(pitch), sine * np.cos(pitch),
                        np.full(len(headings), np.sin(pitch))], axis=1)
    right = np.stack([sine, -cosine, np.zeros(len(headings))], axis=1)
    poses = np.tile(np.eye(4), (len(positions), len(headings), 1, 1))
    poses[:, :, :3, :3] = np.stack([right, np.cross(forward, right), forward], axis=2)
    poses[:, :, :3, 3] = positions[:, None]
    return Grid(positions, near, poses.reshape(-1, 4, 4), spacing)


def _positions(low: NDArray[np.float64], high: NDArray[np.float64], height: float,
               options: CheckOptions) -> tuple[NDArray[np.float64], float]:
    """Return positions between two corners, and their spacing, which is increased if needed."""
    spacing = options.spacing_m
    while (counts := np.maximum(1, np.ceil((high - low) / spacing)).astype(int)
           ).prod() > options.max_positions:
        spacing *= 1.1
    first = (low + high) / 2 - spacing * (counts - 1) / 2
    x, y = (first[axis] + spacing * np.arange(counts[axis]) for axis in (0, 1))
    columns = np.meshgrid(x, y, height, indexing='ij')
    return np.stack([column.ravel() for column in columns], axis=1), spacing


@dataclass(frozen=True)
class LookAlike:
    """A pair of places that look alike."""

    #: The middles of the places [m]
    first: tuple[float, float, float]
    second: tuple[float, float, float]
    #: Pairs of a landmark of the first place and the landmark of the second that it looks like
    matched: tuple[tuple[str, str], ...]
    landmarks: int  #: Number of landmarks of the first place
    share: float  #: Share of these that are matched, 0 to 1
    same_labels: int  #: Number of pairs with equal labels, which no crop tells apart
    turn_deg: float  #: Rotation about the vertical, from the first place to the second [deg]


def find_look_alikes(landmark_map: LandmarkMap) -> list[LookAlike]:
    """Return the pairs of places that look alike, the most alike first.

    A place that looks the same after a rotation by more than 45 degrees counts as well.
    """
    ids, labels = landmark_map.landmark_ids, landmark_map.labels
    found: list[LookAlike] = []
    left = np.ones(len(landmark_map), dtype=np.bool_)
    for row, position in enumerate(landmark_map.centers):
        if not left[row]:
            continue
        left[landmark_map.tree.query_ball_point(position, RADIUS_M)] = False
        alike = find_alike(landmark_map, position)
        for move, others, matched in zip(alike.moves, alike.others, alike.found, strict=True):
            if matched.mean() < _LEAST_SHARE:
                continue
            pairs = list(zip(alike.landmarks[matched].tolist(), others[matched].tolist(),
                             strict=True))
            found.append(LookAlike(
                tuple(position.tolist()), tuple((move[:3, :3] @ position + move[:3, 3]).tolist()),
                tuple((ids[first], ids[second]) for first, second in pairs), len(alike.landmarks),
                float(matched.mean()),
                sum(labels[first] == labels[second] for first, second in pairs),
                float(np.degrees(np.arctan2(move[1, 0], move[0, 0])))))
    kept: list[LookAlike] = []
    for pair in sorted(found, key=lambda pair: (-len(pair.matched) * pair.share, -pair.share)):
        if not any((_near(pair.first, other.first) and _near(pair.second, other.second))
                   or (_near(pair.first, other.second) and _near(pair.second, other.first))
                   for other in kept):
            kept.append(pair)
    return kept


def _near(first: tuple[float, float, float], second: tuple[float, float, float]) -> bool:
    return float(np.hypot(first[0] - second[0], first[1] - second[1])) < RADIUS_M
