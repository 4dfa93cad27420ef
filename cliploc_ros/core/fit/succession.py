# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A track: the pose by all answers of one run of odometry, and what a new answer adds to it.

Answers of a place share images, landmarks and their errors, so ten answers are not ten independent
measurements. The error of an answer is therefore the sum of two parts: a white part, and a shared
part that hardly changes until the camera sees something else. The shared part is estimated
together with the pose, as the state of a first-order Gauss-Markov process (Bar-Shalom, Li and
Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001, section 8.3). The
variance of a robot that stands still thus falls to that of the shared part, but not below it.

An answer that contradicts the track does not change it: one of the two is wrong, and the track is
in doubt. The next answer decides. If it agrees with the track, the doubt is over; if it agrees
with the contradicting answer, the robot was carried, and a new track begins.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from cliploc_ros.core.fit.covariance import moved_pose, odometry_deviations
from cliploc_ros.core.geometry.transforms import SAME_ANSWER, invert_transform, pose_difference

# None of these numbers is in calibration.yaml, because a track affects no decision about a pose.
# They were chosen on simulated drives and on recordings, python -m studies.tracks.
# Share of the variance of an answer that is white, and the way [m] and the turn [rad] after which
# the correlation of the shared errors has fallen to 1 / e.
_WHITE, _SHARED_M, _SHARED_RAD = 0.6, 2.0, 0.8
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
    #: (12, 12): covariance of the errors of the pose and of the shared errors
    joint: NDArray[np.float64]
    #: (6,): estimate of the shared errors, in their standard deviations
    shared: NDArray[np.float64]
    #: (6, 6): covariance of the last accepted answer for a filter that takes answers as
    #: independent. With it, the filter becomes as certain as the track, if it fuses the same
    #: answers and odometry.
    for_filter: NDArray[np.float64]
    #: The last accepted answer if it contradicts the track
    contradicting: Answered | None = None

    @property
    def covariance(self) -> NDArray[np.float64]:
        """Return the covariance (6, 6) of the pose, see Relocalization."""
        return self.joint[:6, :6]

    def carried(self, odom_from_camera: NDArray[np.float64]) -> 'Track':
        """Return the track after a motion, given the pose (4, 4) by odometry after it."""
        motion = invert_transform(self.odom_from_camera) @ odom_from_camera
        pose = self.map_from_camera @ motion
        x, y, z = pose[:3, 3] - self.map_from_camera[:3, 3]
        kept = math.exp(-float(np.linalg.norm(motion[:3, 3])) / _SHARED_M - float(
            Rotation.from_matrix(motion[:3, :3]).magnitude()) / _SHARED_RAD)
        transition = np.diag(np.repeat([1.0, kept], 6))
        transition[:3, 3:6] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
        added = np.append(odometry_deviations(motion) ** 2, np.full(6, 1.0 - kept ** 2))
        return replace(self, odom_from_camera=odom_from_camera, map_from_camera=pose,
                       joint=transition @ self.joint @ transition.T + np.diag(added),
                       shared=kept * self.shared)


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
    observed = np.hstack([np.eye(6), _shared_root(covariance)])
    innovation = (pose_difference(track.map_from_camera, answer.map_from_camera)
                  - observed[:, 6:] @ track.shared)
    expected = observed @ track.joint @ observed.T + _WHITE * covariance
    square = float(innovation @ np.linalg.solve(expected, innovation))
    if square > (_CONTRADICTION if answer.is_accepted else _AGREEMENT):
        if not answer.is_accepted:
            return track
        if _agree(track.contradicting, answer):
            return _begin(answer)
        # with this covariance, they would just agree
        return replace(track, contradicting=answer,
                       for_filter=square / _CONTRADICTION * covariance)
    gain = np.linalg.solve(expected, observed @ track.joint).T
    rest, step = np.eye(12) - gain @ observed, gain @ innovation
    # Joseph's form: the covariance stays positive definite
    joint = rest @ track.joint @ rest.T + gain @ (_WHITE * covariance) @ gain.T
    pose, shared = moved_pose(track.map_from_camera, step[:6]), track.shared + step[6:]
    if not answer.is_accepted:
        return replace(track, map_from_camera=pose, joint=joint, shared=shared)
    return Track(answer.odom_from_camera, pose, joint, shared,
                 _added(track.covariance, joint[:6, :6]))


def _added(before: NDArray[np.float64], after: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the covariance (6, 6) of the measurement that reduces one covariance to another."""
    root = np.linalg.cholesky(before)
    whitened = np.linalg.solve(root, np.linalg.solve(root, after).T)
    ratios, axes = np.linalg.eigh((whitened + whitened.T) / 2)
    information = np.maximum(1.0 / ratios - 1.0, _LEAST_SHARE / ratios)
    axes = root @ axes
    return np.asarray((axes / information) @ axes.T)


def _begin(answer: Answered) -> Track:
    """Return the track of one answer, whose error has a shared part."""
    root = _shared_root(answer.covariance)
    return Track(answer.odom_from_camera, answer.map_from_camera, np.block(
        [[answer.covariance, -root], [-root, np.eye(6)]]), np.zeros(6), answer.covariance)


def _shared_root(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the symmetric root (6, 6) of the shared part of a covariance."""
    variances, axes = np.linalg.eigh((1.0 - _WHITE) * covariance)
    return np.asarray((axes * np.sqrt(np.maximum(variances, 0.0))) @ axes.T)


def _agree(one: Answered | None, other: Answered) -> bool:
    """Return whether two answers agree, given the motion between them."""
    return one is not None and SAME_ANSWER.agree(
        one.map_from_camera @ invert_transform(one.odom_from_camera) @ other.odom_from_camera,
        other.map_from_camera)
