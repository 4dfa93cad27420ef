# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Check that a recognized place is genuine: neither a picture of the place nor a changed place.

Objects and points in a picture of a place agree on where the picture was taken. They cannot check
each other, because they come from the same pixels. A picture differs from the place by its
surroundings, by its size and aspect, which look like other intrinsics, and by its motion.

A picture of a room shows the same points as the room, but it moves as a plane: if the robot drives
sideways, the poses from its keyframes turn instead. Two looks of a moving robot reveal this.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from cliploc_ros.core.calibration import CALIBRATION
from cliploc_ros.core.fit.covariance import odometry_deviations
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import move_covariance, pose_difference
from cliploc_ros.core.keyframes.localization import PER_RADIAN
from cliploc_ros.core.keyframes.places import RecognizedPlace
from cliploc_ros.core.keyframes.point_pose import find_pose

_TERMS = CALIBRATION.genuine
#: Largest plausible squared Mahalanobis distance between right poses and odometry (dof 6).
SURE_MOTION = float(chdtri(6, 1.0 - _TERMS.sure_motion))


class Motion(NamedTuple):
    """Agreement of two looks with odometry: squared Mahalanobis distances with dof 6."""

    square: float  #: Squared distance between the motion of the two poses and odometry
    #: The least squared distance that a picture of the place, 1 to 3 m away, would have. If it is
    #: small, the motion does not distinguish a picture from the place. For a camera that only
    #: turns, both move alike.
    picture: float


def compare_motion(deviation_per_metre: float, first: RecognizedPlace, second: RecognizedPlace,
                   first_from_second: NDArray[np.float64]) -> Motion:
    """Compare the poses of two looks with odometry.

    Parameters
    ----------
    deviation_per_metre : float
        Error of a pose for each metre from its keyframe, see KeyframeLayer [m / m].
    first, second : RecognizedPlace
        The places that the two looks recognized.
    first_from_second : ndarray (4, 4)
        Motion of the camera by odometry.
    """
    # An error in the pose of a keyframe shifts both looks equally, so it is not counted to the
    # extent that both looks use the same keyframes. Errors that grow with the distance from a
    # keyframe are counted for the distance between the looks.
    shares = dict(zip(second.keyframes, second.shares, strict=True))
    same = sum(min(share, shares.get(keyframe, 0.0))
               for keyframe, share in zip(first.keyframes, first.shares, strict=True))
    way, turn = first_from_second[:3, 3], Rotation.from_matrix(first_from_second[:3, :3])
    grown = (deviation_per_metre * np.linalg.norm(way), PER_RADIAN * turn.magnitude())
    before, after = (place.covariance - same * place.shared for place in (first, second))
    information = np.linalg.inv(
        move_covariance(before, first.map_from_camera[:3, :3] @ way) + after + np.diag(
            odometry_deviations(first_from_second) ** 2 + same * np.repeat(grown, 3) ** 2))
    expected = first.map_from_camera @ first_from_second

    def square(pose: NDArray[np.float64]) -> float:
        step = pose_difference(expected, pose)
        return float(step @ information @ step)
    # the pose of the second image if both images show a picture that faces the first camera
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
    """Signs that a place is genuine and unchanged."""

    points: float  #: Logarithm of the number of features that agree, limited to 40 features
    confirmed: float  #: See RecognizedPlace
    #: Log ratios, 0 to 0.25, between the focal length and aspect that fit the points and those of
    #: the camera
    focal: float
    aspect: float
    #: Extent of the agreeing points and boxes as a share of the image's width or height, whichever
    #: share is greater. A picture ends within the image.
    reach: float
    apart: float  #: See RecognizedPlace, limited to 1: next to a keyframe, all surroundings match
    #: Number of landmarks in sight that no detection shows, except one, at most the number of
    #: detections that no landmark explains. Either alone is no sign: detectors miss objects, and
    #: most objects of a room are never mapped. It counts less the more points agree.
    contradicted: float


def signs_of(place: RecognizedPlace, boxes: NDArray[np.float64], camera: Camera,
             contradicted: float) -> Signs:
    """Return the signs that a recognized place is genuine and unchanged.

    Parameters
    ----------
    boxes : ndarray (b, 4)
        Boxes of the detections that the pose explains: left, top, right, bottom [px].
    contradicted : float
        See Signs; before points are counted.
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
        min(1.0, place.apart),
        contradicted * max(0.0, 1.0 - place.inliers / _TERMS.sure_points))


def chance_genuine(signs: Signs, motion: Motion | None = None) -> float:
    """Return the probability that a place is genuine and unchanged."""
    odds = _TERMS.none + sum(getattr(_TERMS, name) * sign
                             for name, sign in signs._asdict().items())
    if motion is not None:
        odds -= 0.5 * max(0.0, motion.square - SURE_MOTION)
        if motion.square < SURE_MOTION:
            odds += min(_TERMS.most_motion, 0.5 * max(0.0, motion.picture - SURE_MOTION))
    return 1.0 / (1.0 + math.exp(-min(max(odds, -50.0), 50.0)))


def _error(ratio: float, deviation: float) -> float:
    """Return the absolute log ratio minus the part that its standard deviation explains."""
    return min(max(abs(math.log(ratio)) - _TERMS.sure_deviations * deviation, 0.0),
               _TERMS.most_error)
