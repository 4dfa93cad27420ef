# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Whether a place is where the camera is, and as it was mapped: not a picture, and not changed.

Objects and points that lie in a picture of a place agree on where it was taken. Neither judges
the other: they see the same pixels. What tells is what lies around the picture, its size and
aspect, which other intrinsics would explain, and how it moves.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.calibration import CALIBRATION, Calibration
from cliploc_ros.core.acceptance.motion import SURE_MOTION, Motion
from cliploc_ros.core.acceptance.support import Support
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.keyframes.places import RecognizedPlace

# Errors of the intrinsics count from so many deviations on, and no further than this.
_SURE_DEVIATIONS, _MOST_ERROR = 2.0, 0.25
# Of the points, the part whose extent counts: a few wrong ones lie anywhere [%].
_CENTRAL = (5.0, 95.0)
# Pictures that are recognized show many features, places also a few. More than these say no more:
# the rooms of the fit have few features.
_MANY = 40


class Signs(NamedTuple):
    """Signs that a place is there, and as it was mapped."""

    points: float  #: Logarithm of the number of features that agree, of 40 at most
    confirmed: float  #: See RecognizedPlace
    #: How far the focal length and the aspect that the points suggest are from the camera's, as
    #: logarithms of ratios: 0 to 0.25
    focal: float
    aspect: float
    #: Share of the image's width or height, the greater one, over which the points and the boxes
    #: lie that agree: a picture ends within the image
    reach: float
    #: Share of the detected objects of the map's classes that the pose does not explain
    unexplained: float
    #: Number of features that agree with another place, as a share of those that agree here
    rival: float


def signs_of(place: RecognizedPlace, support: Support, boxes: NDArray[np.float64],
             camera: Camera, rival: int) -> Signs:
    """Return the signs at a recognized place.

    Parameters
    ----------
    boxes : ndarray (b, 4)
        That the pose explains: left, top, right, bottom [px].
    """
    size = np.array([camera.width, camera.height], dtype=np.float64)
    corners = np.clip(boxes.reshape(-1, 2), 0.0, size)
    ends = np.vstack([corners, np.percentile(place.pixels, _CENTRAL, axis=0)]) \
        if len(place.pixels) else corners
    return Signs(
        math.log(min(max(1, place.inliers), _MANY)), place.confirmed,
        _error(place.focal_ratio, place.focal_deviation),
        _error(place.aspect_ratio, place.aspect_deviation),
        float((np.ptp(ends, axis=0) / size).max()) if len(ends) else 0.0,
        support.unexplained / (support.unexplained + support.inliers + 1.0),
        min(1.0, rival / max(1, place.inliers)))


def chance_genuine(signs: Signs, motion: Motion | None = None,
                   calibration: Calibration = CALIBRATION) -> float:
    """Return the probability that a place is there, and as it was mapped."""
    terms = calibration.genuine
    odds = terms.none + sum(getattr(terms, name) * sign for name, sign in signs._asdict().items())
    if motion is not None:
        odds -= 0.5 * max(0.0, motion.square - SURE_MOTION)
        if motion.square < SURE_MOTION:
            odds += min(terms.most_motion, 0.5 * max(0.0, motion.picture - SURE_MOTION))
    return 1.0 / (1.0 + math.exp(-min(max(odds, -50.0), 50.0)))


def _error(ratio: float, deviation: float) -> float:
    """Return the logarithm of a ratio beyond what its deviation explains."""
    return min(max(abs(math.log(ratio)) - _SURE_DEVIATIONS * deviation, 0.0), _MOST_ERROR)
