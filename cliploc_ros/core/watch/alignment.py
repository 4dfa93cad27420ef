# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The pose near a given one that fits the detections best; nothing else of the map is searched.

A localizer drifts by decimetres and a few degrees, and a camera may be turned on its robot. Then
outlines miss the boxes of small objects. So a grid of turns about the given pose is scored, and
the best few are refined.
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
from cliploc_ros.core.geometry.transforms import SAME_NEIGHBOURHOOD, pose_error
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.search.candidates import match_frame
from cliploc_ros.core.search.frame_search import SearchedFrame
from cliploc_ros.core.search.scene import VERTICAL_UNKNOWN
from cliploc_ros.core.search.strategies import Leaders, Progress

# Turns about the axes of the camera that are scored [deg]: x and y, and z. A box of 45 px overlaps
# its outline by more than .2 if a pose of the grid is within 2 degrees (focal length 525 px).
_TURNS_DEG, _ROLLS_DEG = (-8.0, -4.0, 0.0, 4.0, 8.0), (-6.0, 0.0, 6.0)
_TURNS = Rotation.from_rotvec([*product(_TURNS_DEG, _TURNS_DEG, _ROLLS_DEG)],
                              degrees=True).as_matrix()
# Poses of the grid that are refined.
_REFINED = 3
# A pose of the neighbourhood leads over one nearer to the given pose by this much [log odds] at
# least, where it is this far away [m] [deg].
_PULL_M, _PULL_DEG = 0.3, 6.0


class Alignment(NamedTuple):
    """The best pose near a given one."""

    joined: JoinedFrames  #: The frame, without its vertical
    fit: Contender
    away_m: float  #: From the given pose
    away_deg: float
    #: Log odds by which a pose that refinement moved out of the neighbourhood fits better
    rival: float


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


def align(joined: JoinedFrames, map_from_camera: NDArray[np.float64],
          likely_turn: NDArray[np.float64] | None = None) -> Alignment:
    """Return the best pose near a given one (4, 4).

    The likely turn (3, 3) is that of a camera whose mount is known to be wrong.
    """
    starts = np.tile(map_from_camera, (len(_TURNS) + (likely_turn is not None), 1, 1))
    starts[:len(_TURNS), :3, :3] = map_from_camera[:3, :3] @ _TURNS
    if likely_turn is not None:
        starts[-1, :3, :3] = map_from_camera[:3, :3] @ likely_turn
    rotations = np.ascontiguousarray(starts[:, :3, :3].transpose(0, 2, 1))
    translations = -np.einsum('kij,kj->ki', rotations, starts[:, :3, 3])
    scores = scores_of(joined.rig, rotations, translations)
    best = np.argsort(-scores, kind='stable')[:_REFINED]
    given = unrefined(map_from_camera)
    some = [given, *(unrefined(starts[row]) for row in best if scores[row] > 0.0)]
    if scores.any():
        some += [refined(joined, one) for one in some]
    return _best(contenders_of(joined, some, [True] * len(some)), joined, map_from_camera)


def _best(found: list[Contender], joined: JoinedFrames, given: NDArray[np.float64]) -> Alignment:
    """Return the best of some contenders, and how much better those further away fit."""
    errors = [pose_error(one.pose, given) for one in found]
    near = [row for row, error in enumerate(errors)
            if error[0] < SAME_NEIGHBOURHOOD.distance_m
            and error[1] < SAME_NEIGHBOURHOOD.angle_deg]
    odds = [one.odds - 0.5 * ((away_m / _PULL_M) ** 2 + (away_deg / _PULL_DEG) ** 2)
            for one, (away_m, away_deg) in zip(found, errors, strict=True)]
    fit = max(near, key=lambda row: odds[row])
    rival = max((one.odds for row, one in enumerate(found) if row not in near),
                default=-np.inf)
    return Alignment(joined, found[fit], *errors[fit], max(0.0, rival - found[fit].odds))
