# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where keyframes can help: the views and places that have one near enough.

A keyframe is within reach of a view if it would be matched there: the nearer it is, the more it
may look another way. Walls are not considered, nor whether the features are found again.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.core.keyframes.localization import NEAR_DEG, NEAR_M

if TYPE_CHECKING:
    from cliploc_ros.mapping.checking.report import GridCheck


@dataclass(frozen=True)
class KeyframeCheck:
    """What the keyframes next to a map reach.

    Parameters
    ----------
    keyframes, points : int
    recorded : ndarray (F,) of bool
        Recorded frames within reach of a keyframe; empty without a recording.
    headings : ndarray (P,) of int
        Headings of each grid position within reach.
    positions : ndarray (P, 3)
        Of the grid [m].
    is_near : ndarray (P,) of bool
        See GridCheck.
    """

    keyframes: int
    points: int
    recorded: NDArray[np.bool_]
    headings: NDArray[np.int64]
    positions: NDArray[np.float64]
    is_near: NDArray[np.bool_]

    @property
    def without(self) -> NDArray[np.int64]:
        """Return the rows of the grid positions near the recording that no keyframe reaches."""
        return np.nonzero(self.is_near & (self.headings == 0))[0]

    @property
    def reached_positions(self) -> float:
        """Return the share of the grid positions near the recording with a heading in reach."""
        near = int(self.is_near.sum())
        return 1.0 - len(self.without) / near if near else 0.0

    def as_dict(self) -> dict[str, Any]:
        """Return the check as plain values, for JSON."""
        return {
            'keyframes': self.keyframes, 'points': self.points,
            'recorded_frames_in_reach': float(self.recorded.mean()) if len(self.recorded)
            else None,
            'positions_in_reach_near_recording': self.reached_positions,
            'positions_without': self.positions[self.without].round(3).tolist()}


def check_keyframes(layer: KeyframeLayer, grid: 'GridCheck',
                    recorded: NDArray[np.float64] | None) -> KeyframeCheck:
    """Return what keyframes reach.

    Parameters
    ----------
    layer : KeyframeLayer
    grid : GridCheck
    recorded : ndarray (F, 4, 4), optional
        Poses map_from_camera of a recording.
    """
    poses = np.empty((0, 4, 4)) if recorded is None else recorded
    reached = in_reach(layer, np.array([one.position for one in grid.trials]),
                       np.array([one.forward for one in grid.trials]))
    return KeyframeCheck(
        len(layer), int(layer.offsets[-1]), in_reach(layer, poses[:, :3, 3], poses[:, :3, 2]),
        reached.reshape(-1, grid.headings).sum(axis=1), grid.positions, grid.is_near)


def in_reach(layer: KeyframeLayer, positions: NDArray[np.float64],
             forward: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which views (n,) have a keyframe within reach.

    Parameters
    ----------
    layer : KeyframeLayer
    positions, forward : ndarray (n, 3)
        Of the cameras: where they are [m], and the unit vectors along which they look.
    """
    places, axes = layer.map_from_camera[:, :3, 3], layer.map_from_camera[:, :3, 2]
    found = np.zeros(len(positions), dtype=np.bool_)
    for row, (position, axis) in enumerate(zip(positions, forward, strict=True)):
        angles = np.degrees(np.arccos(np.clip(axes @ axis, -1.0, 1.0)))
        costs = np.linalg.norm(places - position, axis=1) / NEAR_M + angles / NEAR_DEG
        found[row] = bool((costs < 1.0).any())
    return found
