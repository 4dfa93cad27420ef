# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The pose near a given one that fits the detections best; nothing else of the map is searched.

A localizer drifts by decimetres and a few degrees, and a camera may be turned on its robot. Then
outlines miss the boxes of small objects. So a grid of turns and shifts about the given pose is
scored, and the best few are refined.
"""

from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.acceptance.contenders import (
    Contender,
    JoinedFrames,
    contenders_of,
    join_frames,
    refined,
    unrefined,
)
from cliploc_ros.core.fit.verification import scores_of
from cliploc_ros.core.geometry.transforms import SAME_NEIGHBOURHOOD, Tolerance, pose_error
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.search.candidates import match_frame
from cliploc_ros.core.search.frame_search import SearchedFrame
from cliploc_ros.core.search.scene import VERTICAL_UNKNOWN
from cliploc_ros.core.search.strategies import Leaders, Progress

# Turns about x and y of the camera, and about z [deg]; shifts along x and z [m]. A box of 45 px
# overlaps its outline by more than .2 if a pose of the grid is within 2 degrees (focal length 525
# px). Near objects move by as much where the pose is off by decimetres.
_TURNS_DEG, _ROLLS_DEG, _SHIFTS_M = (-8.0, -4.0, 0.0, 4.0, 8.0), (-6.0, 6.0), (-0.25, 0.0, 0.25)
_STEPS = np.array([*product(_TURNS_DEG, _TURNS_DEG, (0.0,), _SHIFTS_M, _SHIFTS_M),
                   *product(_TURNS_DEG, _TURNS_DEG, _ROLLS_DEG, (0.0,), (0.0,))])
# Poses (k, 4, 4) of the grid, in the camera at the given pose.
_GRID = np.tile(np.eye(4), (len(_STEPS), 1, 1))
_GRID[:, :3, :3] = Rotation.from_rotvec(_STEPS[:, :3], degrees=True).as_matrix()
_GRID[:, [0, 2], 3] = _STEPS[:, 3:]
# Poses of the grid that are refined, and how far apart they are at least [m] [deg].
_REFINED, _APART = 4, Tolerance(0.3, 5.0)
# A pose of the neighbourhood leads over one nearer to the given pose by this much [log odds] at
# least, where it is this far away [m] [deg].
_PULL_M, _PULL_DEG = 0.3, 6.0


class Alignment(NamedTuple):
    """The best pose near a given one."""

    joined: JoinedFrames  #: The frame, without its vertical
    fit: Contender
    away_m: float  #: From the given pose
    away_deg: float


def look_at(landmark_map: LandmarkMap, observation: Observation, options: RelocalizerOptions
            ) -> JoinedFrames:
    """Return an observation as a frame that poses are compared on.

    Its vertical comes by the stated mount, which may be wrong, so it must not bend the fit.
    """
    if observation.similarities is None:
        options = replace(options, matching='class')
    free = replace(observation, up_in_camera=None, odom_from_camera=None)
    scene, _ = match_frame(landmark_map, free, options)
    none = Leaders.none_yet(1)
    return join_frames(landmark_map, options, [SearchedFrame(
        free, scene, VERTICAL_UNKNOWN, none, none, Progress(0, 1.0))])


def align(joined: JoinedFrames, map_from_camera: NDArray[np.float64]) -> Alignment:
    """Return the best pose near a given one (4, 4)."""
    starts = map_from_camera @ _GRID
    rotations = np.ascontiguousarray(starts[:, :3, :3].transpose(0, 2, 1))
    translations = -np.einsum('kij,kj->ki', rotations, starts[:, :3, 3])
    scores = scores_of(joined.rig, rotations, translations)
    some = [unrefined(map_from_camera), *(unrefined(one) for one in _apart(starts, scores))]
    if len(some) > 1:
        some += [refined(joined, one) for one in some]
    return _best(contenders_of(joined, some, [True] * len(some)), joined, map_from_camera)


def _apart(poses: NDArray[np.float64], scores: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Return the best of k poses (k, 4, 4) by their scores, none near another one."""
    chosen: list[NDArray[np.float64]] = []
    for row in np.argsort(-scores, kind='stable'):
        if len(chosen) == _REFINED or not scores[row] > 0.0:
            break
        if not any(_APART.agree(poses[row], one) for one in chosen):
            chosen.append(poses[row])
    return chosen


def _best(found: list[Contender], joined: JoinedFrames, given: NDArray[np.float64]) -> Alignment:
    """Return the best of some contenders in the neighbourhood of the given pose (4, 4)."""
    errors = [pose_error(one.pose, given) for one in found]
    near = [row for row, error in enumerate(errors)
            if error[0] < SAME_NEIGHBOURHOOD.distance_m
            and error[1] < SAME_NEIGHBOURHOOD.angle_deg]
    odds = [one.odds - 0.5 * ((away_m / _PULL_M) ** 2 + (away_deg / _PULL_DEG) ** 2)
            for one, (away_m, away_deg) in zip(found, errors, strict=True)]
    fit = max(near, key=lambda row: odds[row])
    return Alignment(joined, found[fit], *errors[fit])
