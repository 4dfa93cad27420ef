# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A track: the pose by all answers of one run of odometry, and what a new answer adds to it.

Answers of a place share images, landmarks and their errors, so ten answers are not ten independent
measurements. The error of an answer is therefore the sum of a white part and of a part that all
answers of the track may share. In each direction, an answer reduces the variance of the track at
most to the shared part of its own, and a rough answer does not change a better track. The rest is
a Kalman filter. Such split covariances are those of Julier and Uhlmann, "Using Covariance
Intersection for SLAM", 2007; here, all shared parts count as one error.

An answer that contradicts the track does not change it: one of the two is wrong, and the track is
in doubt. The next answer decides. If it agrees with the track, the doubt is over; if it agrees
with the contradicting answer, the robot was carried, and a new track begins.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from cliploc_ros.core.fit.covariance import moved_pose, odometry_deviations
from cliploc_ros.core.geometry.transforms import (
    SAME_ANSWER,
    invert_transform,
    move_covariance,
    pose_difference,
)

# None of these numbers is in calibration.yaml, because a track affects no decision about a pose.
# They were chosen on simulated drives and on recordings, python -m studies.tracks.
# Share of the variance of an answer that is white.
_WHITE = 0.6
# Squared distances from the track: an accepted answer further away contradicts it, and a refused
# pose further away is not used.
_CONTRADICTION, _AGREEMENT = float(chdtri(6, 0.001)), float(chdtri(6, 0.05))
# A refused pose with a lower confidence is not used.
_LEAST_CONFIDENCE = 0.05
# The share of its information that an answer keeps in directions without new information, because
# a covariance must be finite.
_LEAST_SHARE = 1e-4


class Answered(NamedTuple):
    """The pose of one answer."""

    odom_from_camera: NDArray[np.float64]  #: (4, 4)
    map_from_camera: NDArray[np.float64]  #: (4, 4): from this answer alone
    covariance: NDArray[np.float64]  #: (6, 6): see Relocalization
    confidence: float = 1.0  #: Of a refused pose
    is_accepted: bool = True


@dataclass(frozen=True, eq=False)
class Track:
    """The pose of a camera by all answers so far."""

    #: (4, 4), (4, 4): the camera by odometry, and by the track
    odom_from_camera: NDArray[np.float64]
    map_from_camera: NDArray[np.float64]
    covariance: NDArray[np.float64]  #: (6, 6): covariance of the pose, see Relocalization
    #: (6, 6): covariance of the last accepted answer for a filter that takes answers as
    #: independent. With it, the filter becomes as certain as the track, if it fuses the same
    #: answers and odometry.
    for_filter: NDArray[np.float64]
    #: The last accepted answer if it contradicts the track
    contradicting: Answered | None = None

    def carried(self, odom_from_camera: NDArray[np.float64]) -> 'Track':
        """Return the track after a motion, given the pose (4, 4) by odometry after it."""
        motion = invert_transform(self.odom_from_camera) @ odom_from_camera
        pose = self.map_from_camera @ motion
        covariance = move_covariance(self.covariance, pose[:3, 3] - self.map_from_camera[:3, 3])
        return replace(self, odom_from_camera=odom_from_camera, map_from_camera=pose,
                       covariance=covariance + np.diag(odometry_deviations(motion) ** 2))


def follow(track: Track | None, answer: Answered) -> Track | None:
    """Return the track after an answer; None before the first accepted answer.

    A refused pose is used if it agrees with the track. Its covariance is divided by its
    confidence.
    """
    if track is None:
        return _begin(answer) if answer.is_accepted else None
    track = track.carried(answer.odom_from_camera)
    if not answer.is_accepted and answer.confidence < _LEAST_CONFIDENCE:
        return track
    covariance = answer.covariance / (1.0 if answer.is_accepted else answer.confidence)
    innovation = pose_difference(track.map_from_camera, answer.map_from_camera)
    square = float(innovation @ np.linalg.solve(track.covariance + covariance, innovation))
    if square > (_CONTRADICTION if answer.is_accepted else _AGREEMENT):
        if not answer.is_accepted:
            return track
        if _agree(track.contradicting, answer):
            return _begin(answer)
        # with this covariance, they would just agree
        return replace(track, contradicting=answer,
                       for_filter=square / _CONTRADICTION * covariance)
    # along axes on which both covariances are diagonal; the variances of the track are 1 there
    root = np.linalg.cholesky(track.covariance)
    whitened = np.linalg.solve(root, np.linalg.solve(root, covariance).T)
    variances, axes = np.linalg.eigh((whitened + whitened.T) / 2)
    own = np.maximum(0.0, 1.0 - (1.0 - _WHITE) * variances)  # not shared with the answer
    gains, axes = own / (own + _WHITE * variances), root @ axes
    left = 1.0 - gains * own
    track = replace(
        track, covariance=(axes * left) @ axes.T, map_from_camera=moved_pose(
            track.map_from_camera, axes @ (gains * np.linalg.solve(axes, innovation))))
    if not answer.is_accepted:
        return track
    information = np.maximum(1.0 / left - 1.0, _LEAST_SHARE / variances)
    return replace(track, contradicting=None, for_filter=(axes / information) @ axes.T)


def _begin(answer: Answered) -> Track:
    """Return the track of one answer."""
    return Track(answer.odom_from_camera, answer.map_from_camera, answer.covariance,
                 answer.covariance)


def _agree(one: Answered | None, other: Answered) -> bool:
    """Return whether two answers agree, given the motion between them."""
    return one is not None and SAME_ANSWER.agree(
        one.map_from_camera @ invert_transform(one.odom_from_camera) @ other.odom_from_camera,
        other.map_from_camera)
