# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The covariance of a pose: how each source of error moves the pose, and how large it is.

Refinement solves H x = J^T W r. An error e of the residuals moves the pose by H^-1 J^T W e, so the
covariance is H^-1 M H^-1, and M is a sum over sources of error:

* the edges of an object. Its shape in the map and its look are wrong in all frames alike, so the
  errors of one edge are the same in all frames;
* the position of a landmark, the same in all frames that see it. A landmark that is displaced acts
  like cameras that are displaced the other way;
* the position of the map near the camera, the same for all landmarks: as if all cameras were
  displaced and turned together about the last one;
* the vertical, the same in all frames: one sensor on one mount;
* the calibration of a camera, the same in all of its frames: as if all of its boxes were scaled,
  stretched and shifted together;
* odometry, a random walk: the error of a step displaces all frames beyond it;
* the mounts of several cameras, between whose frames of one instant there is no such step.

Cauchy's weight w of an edge stands for a variance of 1 / w. Each object may also be wrong:
moved, or matched by mistake. Then the pose without this object is the right one, and how far it is
away, and how much less certain it is, adds to the covariance.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import gammainc

from cliploc_ros.core.calibration import CALIBRATION
from cliploc_ros.core.fit.camera_fit import ERRORS, camera_jacobian
from cliploc_ros.core.fit.refinement import (
    LEAST_DEVIATION,
    RELATIVE_DEVIATION,
    Inliers,
    one_to_one,
    residuals_of,
)
from cliploc_ros.core.fit.verification import Rig, verify_rig
from cliploc_ros.core.geometry.transforms import invert_transform, pose_difference

_TERMS = CALIBRATION.covariance
#: Variance of a direction that the boxes do not fix: m^2 and rad^2.
PRIOR_VARIANCES = np.repeat([_TERMS.unfixed_m2, _TERMS.unfixed_rad2], 3)
# A camera that moves less stands still: rounding [m and rad].
_STANDS_STILL = 1e-9
# Weights of the first pose that covariance intersection tries: steps of a search for a minimum.
_WEIGHTS = np.linspace(0.0, 1.0, 11)
#: Deviations of the errors of a perfect camera.
EXACT = np.zeros(ERRORS)
#: Covariance of a pose that the boxes do not fix.
POSE_UNKNOWN = np.diag(PRIOR_VARIANCES)


def odometry_deviations(first_from_second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the deviations (6,) of odometry between two frames: 0 if the camera did not move.

    On each axis, of position [m] and rotation [rad]; first_from_second (4, 4) is the camera's
    motion.
    """
    way_m = float(np.linalg.norm(first_from_second[:3, 3]))
    angle = float(Rotation.from_matrix(first_from_second[:3, :3]).magnitude())
    if way_m < _STANDS_STILL and angle < _STANDS_STILL:
        return np.zeros(6)
    return np.repeat([_TERMS.odometry_floor_m + _TERMS.odometry_drift * way_m,
                      np.radians(_TERMS.odometry_floor_deg) + _TERMS.odometry_drift * angle
                      + np.radians(_TERMS.odometry_deg_per_m) * way_m], 3)


def share_within(radius_m: float, covariance: NDArray[np.float64]) -> float:
    """Return the probability that a position is within a distance of the truth.

    The covariance (6, 6) is as of refined_covariance.
    """
    return float(shares_within(radius_m, covariance[None, :3, :3])[0])


def shares_within(radius_m: float, covariances: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the probability (k,) of each covariance (k, 3, 3) of a position, see share_within.

    The squared distance is a sum of squares with different variances. A scaled chi-squared
    distribution of the same mean and variance stands for it (Box, "Some Theorems on Quadratic
    Forms Applied in the Study of Analysis of Variance Problems", 1954).
    """
    means = np.trace(covariances, axis1=1, axis2=2)
    squares = np.sum(covariances ** 2, axis=(1, 2))
    return np.asarray(gammainc(0.5 * means ** 2 / squares, 0.5 * radius_m ** 2 * means / squares))


def normalized_square(map_from_camera: NDArray[np.float64], covariance: NDArray[np.float64],
                      truth: NDArray[np.float64]) -> float:
    """Return the normalized estimation error squared (NEES) of a pose (4, 4).

    Where covariances (6, 6), as of refined_covariance, are right, it follows the chi-squared
    distribution with six degrees of freedom (Bar-Shalom, Li and Kirubarajan 2001).
    """
    error = pose_difference(map_from_camera, truth)
    return float(error @ np.linalg.solve(covariance, error))


def moved_pose(pose: NDArray[np.float64], step: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a pose (4, 4) after a step (6,) of position and of rotation about fixed axes."""
    moved = pose.copy()
    moved[:3, :3] = Rotation.from_rotvec(step[3:]).as_matrix() @ pose[:3, :3]
    moved[:3, 3] += step[:3]
    return moved


def fuse(first: NDArray[np.float64], first_covariance: NDArray[np.float64],
         second: NDArray[np.float64], second_covariance: NDArray[np.float64]
         ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the weighted mean of two poses (4, 4) and its covariance (6, 6).

    Both share the errors of the map, to an unknown degree. Covariance intersection is right for
    any degree (Julier and Uhlmann, "A Non-divergent Estimation Algorithm in the Presence of
    Unknown Correlations", 1997). The weight gives the least variance of the position, so a pose
    that is better in every direction stays as it is. The covariances are in the order of
    core.fit.covariance.
    """
    informations = np.linalg.inv(first_covariance), np.linalg.inv(second_covariance)
    covariances = [np.linalg.inv(weight * informations[0] + (1.0 - weight) * informations[1])
                   for weight in _WEIGHTS]
    best = int(np.argmin([np.trace(one[:3, :3]) for one in covariances]))
    covariance = (covariances[best] + covariances[best].T) / 2
    moved = _WEIGHTS[best] * covariance @ informations[0] @ pose_difference(second, first)
    return moved_pose(second, moved), covariance


class _Fit(NamedTuple):
    """A fit, linearized in steps of the reference: F frames, m matches of n objects."""

    #: (m, r, 6): of the four edges of each match and, where any has depth, of that
    jacobian: NDArray[np.float64]
    #: (m, r), (m, r)
    residuals: NDArray[np.float64]
    weights: NDArray[np.float64]
    #: (m, r): share of each deviation apart from that of the landmark's position
    own: NDArray[np.float64]
    #: (m,): of each match
    objects: NDArray[np.int64]
    frames: NDArray[np.int64]
    sigmas: NDArray[np.float64]  #: (n,): of the objects' positions [m]
    numbers: NDArray[np.int64]  #: (n,): the objects' landmarks
    verticals: NDArray[np.float64]  #: (F, 6, 6): information of each frame's vertical
    cameras: NDArray[np.float64]  #: (F, 4, 4): map_from_camera
    #: (F, 6, 7): gradient of each frame by the errors of its camera, see camera_fit
    calibrations: NDArray[np.float64]

    @property
    def information(self) -> NDArray[np.float64]:
        """Return the information of each match (m, 6, 6)."""
        return np.asarray((self.jacobian * self.weights[:, :, None]).transpose(0, 2, 1)
                          @ self.jacobian)


def refined_covariance(rig: Rig, rotation: NDArray[np.float64], translation: NDArray[np.float64],
                       instants: NDArray[np.int64], shared: NDArray[np.float64] | None = None,
                       wrong_share: float = _TERMS.wrong_share,
                       mount_deviation: tuple[float, float] = (0.0, 0.0),
                       camera_deviations: NDArray[np.float64] = EXACT) -> NDArray[np.float64]:
    """Return the covariance (6, 6) of a pose that was refined on its inliers.

    Parameters
    ----------
    rotation, translation : ndarray (3, 3), (3,)
        Rotation and translation of camera_from_map, with information, see refine_rig.
    instants : ndarray (F,)
        Number of the instant of each frame, in which odometry joins them: greater for later ones,
        equal for several cameras.
    shared : ndarray (L, 2), optional
        Common displacement and turn of each landmark and its neighbours [m] [rad].
    wrong_share : float
        Probability that an object is not where its match says.
    mount_deviation : tuple of float
        Standard deviations of a camera's mount on each axis [m] [deg], against that of the last
        frame's camera.
    camera_deviations : ndarray (7,)
        Standard deviations of the errors of each camera, see cliploc_ros.core.fit.camera_fit.
    """
    found = verify_rig(rig, rotation, translation)
    fit = _linearize(one_to_one(rig, found, rotation, translation), rig.sigmas, rotation,
                     translation)
    of_matches, prior = fit.information, np.diag(1.0 / PRIOR_VARIANCES)
    of_objects = _sums(of_matches, fit.objects, len(fit.sigmas))
    verticals = fit.verticals.sum(axis=0)
    information = of_objects.sum(axis=0) + verticals + prior
    # The part of the edges' errors in M, for each object (n, 6, 6).
    # an edge is as far off as its weight says, in the same direction in all frames
    pulls = _sums(np.sqrt(fit.weights)[:, :, None] * fit.own[:, :, None] * fit.jacobian,
                  fit.objects, len(fit.sigmas))
    edge_noise = np.asarray(_mean_square(fit) * pulls.transpose(0, 2, 1) @ pulls)
    # that of the landmarks' positions, for each object
    moves = fit.sigmas[:, None, None] * of_objects[:, :, :3]
    noise_of_objects = edge_noise + moves @ moves.transpose(0, 2, 1)
    of_frames = _sums(of_matches, fit.frames, len(fit.cameras)) + fit.verticals
    known = max(1, int(fit.verticals.any(axis=(1, 2)).sum()))
    noise = (noise_of_objects.sum(axis=0) + known * verticals + prior
             + _odometry_noise(fit.cameras, of_frames, instants)
             + _mount_noise(fit.cameras, of_frames, instants, mount_deviation))
    matched = _sandwich(information, noise)
    # of all objects: also without one, the others share them
    common = _calibration_noise(fit.calibrations, instants, camera_deviations)
    if shared is not None:
        deviations = np.repeat(shared[fit.numbers], 3, axis=1)
        common += _squared((of_objects * deviations[:, None, :]).sum(axis=0))
    gradients = _sums(np.einsum('mei,me->mi', fit.jacobian, fit.weights * fit.residuals),
                      fit.objects, len(fit.sigmas))
    wrong = _change_without_each(information - of_objects, noise - noise_of_objects, gradients,
                                 matched)
    return np.asarray(matched + _sandwich(information, common) + wrong_share * wrong)


def moves_with_cameras(rig: Rig, inliers: Inliers, rotation: NDArray[np.float64],
                       translation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how a refined pose moves (F, 6, 7) with the errors of each frame, see camera_fit.

    Those of a camera move it by the sum over its frames. See refined_covariance for the others.
    """
    fit = _linearize(inliers, rig.sigmas, rotation, translation)
    information = (fit.information.sum(axis=0) + fit.verticals.sum(axis=0)
                   + np.diag(1.0 / PRIOR_VARIANCES))
    return np.asarray(-np.linalg.inv(information) @ fit.calibrations)


def _change_without_each(information: NDArray[np.float64], noise: NDArray[np.float64],
                         gradients: NDArray[np.float64], matched: NDArray[np.float64]
                         ) -> NDArray[np.float64]:
    """Return the sum of the gains of the covariance with each of n objects left out in turn.

    Without an object, a pose is not surer: only a gain counts. The limit would be a loss where
    boxes fix next to nothing.
    """
    limit = np.diag(np.repeat([_TERMS.without_m ** -2, _TERMS.without_rad ** -2], 3))
    inverses = np.linalg.inv(information + limit)
    shifts = np.einsum('nij,nj->ni', inverses, gradients)
    without = inverses @ (noise + limit) @ inverses
    values, vectors = np.linalg.eigh((without - matched).sum(axis=0) + shifts.T @ shifts)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


def _sandwich(information: NDArray[np.float64], noise: NDArray[np.float64]
              ) -> NDArray[np.float64]:
    inverse = np.linalg.inv(information)
    covariance = inverse @ noise @ inverse
    return np.asarray((covariance + covariance.T) / 2)


def _linearize(inliers: Inliers, sigmas: NDArray[np.float64], rotation: NDArray[np.float64],
               translation: NDArray[np.float64]) -> _Fit:
    count, frames = len(inliers.pairs), len(inliers.cameras)
    jacobian, residuals = np.empty((count, 5, 6)), np.empty((count, 5))
    verticals, cameras = np.zeros((frames, 6, 6)), np.tile(np.eye(4), (frames, 1, 1))
    calibrations = np.empty((frames, 6, ERRORS))
    center = -rotation.T @ translation
    for frame, (first, last) in enumerate(pairwise(inliers.starts)):
        camera, vertical = inliers.cameras[frame], inliers.verticals[frame]
        own_rotation = camera[:, :3] @ rotation
        own_translation = camera[:, :3] @ translation + camera[:, 3]
        cameras[frame, :3, :3] = own_rotation.T
        cameras[frame, :3, 3] = -own_rotation.T @ own_translation
        pairs = inliers.pairs[first:last]
        own, rows = np.empty(5 * len(pairs) + 3), 5 * len(pairs)
        residuals_of(pairs, vertical, own_rotation, own_translation, own)
        steps = camera_jacobian(pairs, vertical, np.zeros(ERRORS), own_rotation, own_translation,
                                own)
        # a turn of the reference about itself moves this camera
        steps[:, 3:6] -= steps[:, :3] @ _cross(cameras[frame, :3, 3] - center)
        weighted = steps / (1.0 + own[:, None] ** 2)
        calibrations[frame] = weighted[:, :6].T @ steps[:, 6:]
        verticals[frame] = weighted[rows:, :6].T @ steps[rows:, :6]
        jacobian[first:last], residuals[first:last] = (steps[:rows, :6].reshape(-1, 5, 6),
                                                       own[:rows].reshape(-1, 5))
    numbers, objects = np.unique(inliers.landmarks, return_inverse=True)
    pairs = inliers.pairs
    edges = (RELATIVE_DEVIATION * (pairs[:, 2] + pairs[:, 3]) + LEAST_DEVIATION) / pairs[:, 13]
    depths = np.sqrt(1.0 - (sigmas[inliers.landmarks] / np.maximum(pairs[:, 15], 1e-9)) ** 2,
                     out=np.zeros(count), where=pairs[:, 15] > 0.0)
    kinds = 5 if depths.any() else 4
    jacobian, residuals = np.ascontiguousarray(jacobian[:, :kinds]), residuals[:, :kinds].copy()
    return _Fit(jacobian, residuals, 1.0 / (1.0 + residuals ** 2),
                np.column_stack([edges, edges, edges, edges, depths])[:, :kinds], objects,
                np.repeat(np.arange(frames), np.diff(inliers.starts)), sigmas[numbers], numbers,
                verticals, cameras, calibrations)


def _cross(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrix (3, 3) of the cross product with a vector (3,)."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _sums(rows: NDArray[np.float64], groups: NDArray[np.int64], count: int
          ) -> NDArray[np.float64]:
    """Return the sums (count, ...) of the rows of each group."""
    sums = np.zeros((count, *rows.shape[1:]))
    np.add.at(sums, groups, rows)
    return sums


def _mean_square(fit: _Fit) -> float:
    """Return the mean square of the residuals, at least that of the deviations assumed.

    All views of an object count as one. Six residuals are zero by construction.
    """
    views = len(fit.objects) / max(1, len(fit.sigmas))
    squares = np.minimum(np.abs(fit.residuals), _TERMS.most_residual) ** 2
    measured = np.bincount(fit.objects, fit.jacobian[:, 4:].any(axis=(1, 2))) > 0.0
    freedom = max(0, 4 * len(fit.sigmas) + int(measured.sum()) - 6)
    prior = _TERMS.prior_residuals * _TERMS.prior_square
    return max(1.0, float((squares.sum() / max(views, 1.0) + prior)
                          / (freedom + _TERMS.prior_residuals)))


def _odometry_noise(cameras: NDArray[np.float64], information: NDArray[np.float64],
                    instants: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the part of the errors of odometry in M (6, 6)."""
    noise = np.zeros((6, 6))
    numbers, instants = np.unique(instants, return_inverse=True)
    # the way between two instants is that of the last camera of each
    ends = [int(np.nonzero(instants == number)[0][-1]) for number in range(len(numbers))]
    for step, (before, after) in enumerate(pairwise(ends)):
        deviations = odometry_deviations(invert_transform(cameras[before]) @ cameras[after])
        is_before = step < instants[-1]
        beyond = instants <= step if is_before else instants > step
        noise += _squared(_about(information[beyond].sum(axis=0), cameras,
                                 after if is_before else before) * deviations)
    return noise


def _mount_noise(cameras: NDArray[np.float64], information: NDArray[np.float64],
                 instants: NDArray[np.int64], mount_deviation: tuple[float, float]
                 ) -> NDArray[np.float64]:
    """Return the part of the errors of the mounts of several cameras in M (6, 6)."""
    deviations = np.repeat([mount_deviation[0], np.radians(mount_deviation[1])], 3)
    # the mount of the last camera of an instant is that of the pose
    others = [row for row in range(len(cameras) - 1) if instants[row] in instants[row + 1:]]
    return np.asarray(sum((_squared(_about(information[row], cameras, row) * deviations)
                           for row in others), np.zeros((6, 6))))


def _calibration_noise(calibrations: NDArray[np.float64], instants: NDArray[np.int64],
                       deviations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the part of the errors of the cameras' calibrations in M (6, 6)."""
    # cameras follow each other in one order at each instant
    cameras = np.array([list(instants[row + 1:]).count(number)
                        for row, number in enumerate(instants)])
    return np.asarray(sum((_squared(calibrations[cameras == number].sum(axis=0) * deviations)
                           for number in set(cameras.tolist())), np.zeros((6, 6))))


def _about(information: NDArray[np.float64], cameras: NDArray[np.float64], row: int
           ) -> NDArray[np.float64]:
    """Return what turns about a camera, not about the last one, do to the gradient (6, 6)."""
    moved = information.copy()
    moved[:, 3:] += moved[:, :3] @ _cross(cameras[row, :3, 3] - cameras[-1, :3, 3])
    return moved


def _squared(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(matrix @ matrix.T)
