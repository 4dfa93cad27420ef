# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Check that a recognized place is genuine: neither a picture of the place nor changed.

Objects and points that lie in a picture of a place agree on where it was taken. Neither judges
the other: they see the same pixels. The differences lie around the picture, in its size and
aspect, which other intrinsics would explain, and how it moves.

A picture of the room shows the same points as the room, but moves as a plane: where the robot
drives sideways, the poses of its keyframes turn instead. Two looks of a moving robot show that.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from cliploc_ros.core.acceptance.confidence import Support
from cliploc_ros.core.calibration import CALIBRATION, Calibration
from cliploc_ros.core.fit.covariance import odometry_deviations
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import move_covariance, pose_difference
from cliploc_ros.core.keyframes.localization import PER_RADIAN
from cliploc_ros.core.keyframes.places import RecognizedPlace
from cliploc_ros.core.keyframes.point_pose import find_pose

_TERMS = CALIBRATION.genuine
#: Largest squared Mahalanobis distance of the motion between right poses (dof 6).
SURE_MOTION = float(chi2.ppf(_TERMS.sure_motion, 6))


class Motion(NamedTuple):
    """Agreement of two looks with odometry: squared Mahalanobis distances, dof 6."""

    square: float  #: Squared distance between the motion of the two poses and odometry
    #: The least that a picture of the place, 1 to 3 m away, would have. Where it is small, the
    #: motion does not tell a picture from the place: a camera that only turns sees both move
    #: alike.
    picture: float


def compare_motion(deviation_per_metre: float, first: RecognizedPlace, second: RecognizedPlace,
                   first_from_second: NDArray[np.float64]) -> Motion:
    """Compare the poses of two looks with odometry.

    Parameters
    ----------
    first_from_second : ndarray (4, 4)
        Motion of the camera by odometry.
    """
    # A wrong pose of a keyframe moves both looks at it alike, so it does not count where the same
    # keyframes are seen. What their points add with the distance counts for the way between.
    shares = dict(zip(second.keyframes, second.shares, strict=True))
    same = sum(min(share, shares.get(keyframe, 0.0))
               for keyframe, share in zip(first.keyframes, first.shares, strict=True))
    way, turn = first_from_second[:3, 3], Rotation.from_matrix(first_from_second[:3, :3])
    grown = (deviation_per_metre * np.linalg.norm(way), PER_RADIAN * turn.magnitude())
    before, after = (one.covariance - same * one.shared for one in (first, second))
    information = np.linalg.inv(
        move_covariance(before, first.map_from_camera[:3, :3] @ way) + after + np.diag(
            odometry_deviations(first_from_second) ** 2 + same * np.repeat(grown, 3) ** 2))
    expected = first.map_from_camera @ first_from_second

    def square(pose: NDArray[np.float64]) -> float:
        step = pose_difference(expected, pose)
        return float(step @ information @ step)
    # where the second image is recognized if both show a picture that faced the first
    points = first.points[::1 + len(first.points) // int(_TERMS.picture_points)]
    inside = (points - first.map_from_camera[:3, 3]) @ first.map_from_camera[:3, :3]
    picture = np.inf
    for away_m in (_TERMS.near_picture_m, _TERMS.picture_m, _TERMS.far_picture_m):
        moved = (away_m * inside / inside[:, 2:] - way) @ first_from_second[:3, :3]
        ahead = moved[:, 2] > _TERMS.ahead_m
        seen = find_pose(points[ahead], moved[ahead, :2] / moved[ahead, 2:])
        picture = min(picture, np.inf if seen is None else square(seen.map_from_camera))
    return Motion(square(second.map_from_camera), picture)


class Signs(NamedTuple):
    """Signs that a place is there, and as it was mapped."""

    points: float  #: Logarithm of the number of features that agree, of 40 at most
    confirmed: float  #: See RecognizedPlace
    #: How far the focal length and the aspect that the points suggest are from the camera's, as
    #: logarithms of ratios: 0 to 0.25
    focal: float
    aspect: float
    #: Extent of the agreeing points and boxes, as a share of the image's width or height,
    #: whichever is greater: a picture ends within the image
    reach: float
    #: Share of the detected objects of the map's classes that the pose does not explain
    unexplained: float


def signs_of(place: RecognizedPlace, support: Support, boxes: NDArray[np.float64],
             camera: Camera) -> Signs:
    """Return the signs at a recognized place.

    Parameters
    ----------
    boxes : ndarray (b, 4)
        Boxes that the pose explains: left, top, right, bottom [px].
    """
    size = np.array([camera.width, camera.height], dtype=np.float64)
    corners = np.clip(boxes.reshape(-1, 2), 0.0, size)
    central = _TERMS.central_from, _TERMS.central_to
    ends = np.vstack([corners, np.percentile(place.pixels, central, axis=0)]) \
        if len(place.pixels) else corners
    return Signs(
        math.log(min(max(1, place.inliers), _TERMS.most_features)), place.confirmed,
        _error(place.focal_ratio, place.focal_deviation),
        _error(place.aspect_ratio, place.aspect_deviation),
        float((np.ptp(ends, axis=0) / size).max()) if len(ends) else 0.0,
        support.unexplained / (support.unexplained + support.inliers + _TERMS.further_object))


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
    """Return the logarithm of a ratio, less the part that its deviation explains."""
    return min(max(abs(math.log(ratio)) - _TERMS.sure_deviations * deviation, 0.0),
               _TERMS.most_error)
