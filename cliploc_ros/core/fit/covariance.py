# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The covariance of a pose, from the size of each source of error and its effect on the pose.

Refinement solves H x = J^T W r. An error e of the residuals moves the pose by H^-1 J^T W e. The
covariance is therefore H^-1 M H^-1, where M is a sum over these sources of error:

* the edges of an object. Its shape in the map and its appearance are wrong in all frames alike, so
  the error of an edge is the same in all frames;
* the position of a landmark, with the same error in all frames that see it. A displaced landmark
  acts like cameras that are displaced in the opposite direction;
* the position of the map near the camera, with the same error for all landmarks, as if all cameras
  were displaced together and turned about the last camera;
* the vertical, with the same error in all frames, because it comes from one sensor on one mount;
* the calibration of a camera, with the same error in all of its frames, as if all of its boxes
  were scaled, stretched and shifted together;
* odometry, as a random walk. The error of a step displaces all frames beyond it;
* the mounts of several cameras, between whose frames of one instant there is no step of odometry.

Cauchy's weight w of an edge stands for a variance of 1 / w. Each object may also be wrong, that
is, moved or matched by mistake. Then the pose without this object is right. The shift to this pose
and its loss of certainty are therefore added to the covariance.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import gammainc

from cliploc_ros.core.calibration import CALIBRATION
from cliploc_ros.core.fit import refinement
from cliploc_ros.core.fit.camera_fit import ERRORS, camera_jacobian
from cliploc_ros.core.fit.verification import Rig, verify_rig
from cliploc_ros.core.geometry.transforms import invert_transform, pose_difference

_TERMS = CALIBRATION.covariance
#: (6,): variance in directions that the boxes do not determine [m^2] [rad^2].
PRIOR_VARIANCES = np.repeat([_TERMS.unfixed_m2, _TERMS.unfixed_rad2], 3)
# A camera that moves less than this stands still; the motion is a rounding error [m] [rad].
_STANDS_STILL = 1e-9
# Grid of weights of the first pose on which covariance intersection searches for the minimum.
_WEIGHTS = np.linspace(0.0, 1.0, 11)
#: Covariance of a pose that the boxes do not determine.
POSE_UNKNOWN = np.diag(PRIOR_VARIANCES)


def odometry_deviations(first_from_second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the standard deviations (6,) of odometry between two frames.

    The first three are those of the position [m], the others those of the rotation [rad]. All are
    0 if the camera did not move. The motion of the camera is first_from_second (4, 4).
    """
    way_m = float(np.linalg.norm(first_from_second[:3, 3]))
    angle = float(Rotation.from_matrix(first_from_second[:3, :3]).magnitude())
    if way_m < _STANDS_STILL and angle < _STANDS_STILL:
        return np.zeros(6)
    return np.repeat([_TERMS.odometry_floor_m + _TERMS.odometry_drift * way_m,
                      np.radians(_TERMS.odometry_floor_deg) + _TERMS.odometry_drift * angle
                      + np.radians(_TERMS.odometry_deg_per_m) * way_m], 3)


def shares_within(radius_m: float, covariances: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the probability (k,) that a position is within a distance, for k covariances.

    The squared distance is a sum of squares with different variances. It is approximated by a
    scaled chi-squared distribution with the same mean and variance (Box, "Some Theorems on
    Quadratic Forms Applied in the Study of Analysis of Variance Problems", 1954).

    Parameters
    ----------
    radius_m : float
        The distance [m].
    covariances : ndarray (k, 3, 3)
        Covariances of the position [m^2].
    """
    means = np.trace(covariances, axis1=1, axis2=2)
    squares = np.sum(covariances ** 2, axis=(1, 2))
    return np.asarray(gammainc(0.5 * means ** 2 / squares, 0.5 * radius_m ** 2 * means / squares))


def normalized_square(map_from_camera: NDArray[np.float64], covariance: NDArray[np.float64],
                      truth: NDArray[np.float64]) -> float:
    """Return the normalized estimation error squared (NEES) of a pose (4, 4).

    If the covariances (6, 6), see refined_covariance, are right, it follows the chi-squared
    distribution with six degrees of freedom (Bar-Shalom, Li and Kirubarajan 2001).
    """
    error = pose_difference(map_from_camera, truth)
    return float(error @ np.linalg.solve(covariance, error))


def moved_pose(pose: NDArray[np.float64], step: NDArray[np.float64]) -> NDArray[np.float64]:
    """Move a pose (4, 4) by a step (6,) of position [m] and rotation about fixed axes [rad]."""
    moved = pose.copy()
    moved[:3, :3] = Rotation.from_rotvec(step[3:]).as_matrix() @ pose[:3, :3]
    moved[:3, 3] += step[:3]
    return moved


def fuse(first: NDArray[np.float64], first_covariance: NDArray[np.float64],
         second: NDArray[np.float64], second_covariance: NDArray[np.float64]
         ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the weighted mean of two poses (4, 4) and its covariance (6, 6).

    Both share the errors of the map to an unknown degree. Covariance intersection is consistent
    for any correlation (Julier and Uhlmann, "A Non-divergent Estimation Algorithm in the Presence
    of Unknown Correlations", 1997). The weights minimize the variance of the position, so a pose
    that is better in every direction is returned unchanged. Covariances are those of position [m]
    and rotation about the map's axes [rad].
    """
    informations = np.linalg.inv(first_covariance), np.linalg.inv(second_covariance)
    covariances = [np.linalg.inv(weight * informations[0] + (1.0 - weight) * informations[1])
                   for weight in _WEIGHTS]
    best = int(np.argmin([np.trace(fused[:3, :3]) for fused in covariances]))
    covariance = (covariances[best] + covariances[best].T) / 2
    moved = _WEIGHTS[best] * covariance @ informations[0] @ pose_difference(second, first)
    return moved_pose(second, moved), covariance


class _Fit(NamedTuple):
    """A fit, linearized in steps of the reference: F frames, m matches of n objects."""

    #: (m, r, 6): derivatives of the r residuals of each match: the four edges and, if any match
    #: has depth, the depth
    jacobian: NDArray[np.float64]
    #: (m, r), (m, r): residuals in standard deviations, and Cauchy's weights
    residuals: NDArray[np.float64]
    weights: NDArray[np.float64]
    #: (m, r): share of the standard deviations that is not due to the landmark's position
    own: NDArray[np.float64]
    #: (m,), (m,): object and frame of each match
    objects: NDArray[np.int64]
    frames: NDArray[np.int64]
    sigmas: NDArray[np.float64]  #: (n,): standard deviation of each object's position [m]
    numbers: NDArray[np.int64]  #: (n,): landmark of each object
    verticals: NDArray[np.float64]  #: (F, 6, 6): information of each frame's vertical
    cameras: NDArray[np.float64]  #: (F, 4, 4): map_from_camera
    #: (F, 6, 7): change of each frame's gradient with the errors of its camera, see camera_fit
    calibrations: NDArray[np.float64]

    @property
    def information(self) -> NDArray[np.float64]:
        """Return the information of each match (m, 6, 6)."""
        return np.asarray((self.jacobian * self.weights[:, :, None]).transpose(0, 2, 1)
                          @ self.jacobian)


def refined_covariance(rig: Rig, rotation: NDArray[np.float64], translation: NDArray[np.float64],
                       instants: NDArray[np.int64], shared: NDArray[np.float64],
                       wrong_share: float, mount_deviation: tuple[float, float],
                       camera_deviations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the covariance (6, 6) of a pose that was refined on its inliers.

    Parameters
    ----------
    rotation, translation : ndarray (3, 3), (3,)
        Rotation and translation of camera_from_map, a pose with information, see refine_rig.
    instants : ndarray (F,)
        Number of the instant of each frame, in the order of odometry: greater for later instants,
        equal for several cameras at one instant.
    shared : ndarray (L, 2)
        Standard deviations of the common displacement and turn of each landmark and its neighbours
        [m] [rad].
    wrong_share : float
        Probability that an object is not at the place of its landmark.
    mount_deviation : tuple of float
        Standard deviations of a camera's mount on each axis [m] [deg], relative to the mount of
        the last frame's camera.
    camera_deviations : ndarray (7,)
        Standard deviations of the errors of each camera, see cliploc_ros.core.fit.camera_fit.
    """
    found = verify_rig(rig, rotation, translation)
    fit = _linearize(refinement.one_to_one(rig, found, rotation, translation), rig.sigmas,
                     rotation, translation)
    of_matches, prior = fit.information, np.diag(1.0 / PRIOR_VARIANCES)
    of_objects = _sums(of_matches, fit.objects, len(fit.sigmas))
    verticals = fit.verticals.sum(axis=0)
    information = of_objects.sum(axis=0) + verticals + prior
    # the part of the edges in M, for each object (n, 6, 6): the weight of an edge gives the size
    # of its error, which has the same direction in all frames
    pulls = _sums(np.sqrt(fit.weights)[:, :, None] * fit.own[:, :, None] * fit.jacobian,
                  fit.objects, len(fit.sigmas))
    edge_noise = np.asarray(_mean_square(fit) * pulls.transpose(0, 2, 1) @ pulls)
    # the part of the landmarks' positions in M, for each object
    moves = fit.sigmas[:, None, None] * of_objects[:, :, :3]
    noise_of_objects = edge_noise + moves @ moves.transpose(0, 2, 1)
    of_frames = _sums(of_matches, fit.frames, len(fit.cameras)) + fit.verticals
    known = max(1, int(fit.verticals.any(axis=(1, 2)).sum()))
    noise = (noise_of_objects.sum(axis=0) + known * verticals + prior
             + _odometry_noise(fit.cameras, of_frames, instants))
    # mounts are relative to the last camera of each instant
    mounts = np.repeat([mount_deviation[0], np.radians(mount_deviation[1])], 3)
    noise += sum((_squared(_about(of_frames[row], fit.cameras, row) * mounts)
                  for row in range(len(instants) - 1) if instants[row] in instants[row + 1:]),
                 np.zeros((6, 6)))
    matched = _sandwich(information, noise)
    # errors common to all objects, which remain if an object is left out
    # cameras have the same order at each instant
    cameras = np.array([list(instants[row + 1:]).count(number)
                        for row, number in enumerate(instants)])
    common = np.asarray(sum((_squared(fit.calibrations[cameras == number].sum(axis=0)
                                      * camera_deviations)
                             for number in set(cameras.tolist())), np.zeros((6, 6))))
    deviations = np.repeat(shared[fit.numbers], 3, axis=1)
    common += _squared((of_objects * deviations[:, None, :]).sum(axis=0))
    gradients = _sums(np.einsum('mei,me->mi', fit.jacobian, fit.weights * fit.residuals),
                      fit.objects, len(fit.sigmas))
    wrong = _change_without_each(information - of_objects, noise - noise_of_objects, gradients,
                                 matched)
    return np.asarray(matched + _sandwich(information, common) + wrong_share * wrong)


def moves_with_cameras(rig: Rig, inliers: refinement.Inliers, rotation: NDArray[np.float64],
                       translation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the Jacobian (F, 6, 7) of a refined pose for the camera errors of each frame.

    The Jacobian for the errors of a camera, see camera_fit, is the sum over its frames. For the
    parameters see refined_covariance.
    """
    fit = _linearize(inliers, rig.sigmas, rotation, translation)
    information = (fit.information.sum(axis=0) + fit.verticals.sum(axis=0)
                   + np.diag(1.0 / PRIOR_VARIANCES))
    return np.asarray(-np.linalg.inv(information) @ fit.calibrations)


def _change_without_each(information: NDArray[np.float64], noise: NDArray[np.float64],
                         gradients: NDArray[np.float64], matched: NDArray[np.float64]
                         ) -> NDArray[np.float64]:
    """Return by how much the covariance grows if each of n objects is left out, as a sum.

    A pose does not get more certain without an object, so only growth counts. Otherwise, the prior
    `limit` would reduce the covariance if the boxes hardly determine the pose.
    """
    limit = np.diag(np.repeat([_TERMS.without_m ** -2, _TERMS.without_rad ** -2], 3))
    inverses = np.linalg.inv(information + limit)
    shifts = np.einsum('nij,nj->ni', inverses, gradients)
    without = inverses @ (noise + limit) @ inverses
    values, vectors = np.linalg.eigh((without - matched).sum(axis=0) + shifts.T @ shifts)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


def _sandwich(information: NDArray[np.float64], noise: NDArray[np.float64]) -> NDArray[np.float64]:
    inverse = np.linalg.inv(information)
    covariance = inverse @ noise @ inverse
    return np.asarray((covariance + covariance.T) / 2)


def _linearize(inliers: refinement.Inliers, sigmas: NDArray[np.float64],
               rotation: NDArray[np.float64], translation: NDArray[np.float64]) -> _Fit:
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
        refinement.residuals_of(pairs, vertical, own_rotation, own_translation, own)
        steps = camera_jacobian(pairs, vertical, np.zeros(ERRORS), own_rotation, own_translation,
                                own)
        # a rotation of the reference about its own centre moves this camera
        steps[:, 3:6] -= steps[:, :3] @ _cross(cameras[frame, :3, 3] - center)
        weighted = steps / (1.0 + own[:, None] ** 2)
        calibrations[frame] = weighted[:, :6].T @ steps[:, 6:]
        verticals[frame] = weighted[rows:, :6].T @ steps[rows:, :6]
        jacobian[first:last], residuals[first:last] = (steps[:rows, :6].reshape(-1, 5, 6),
                                                       own[:rows].reshape(-1, 5))
    numbers, objects = np.unique(inliers.landmarks, return_inverse=True)
    pairs = inliers.pairs
    edges = (refinement.RELATIVE_DEVIATION * (pairs[:, 2] + pairs[:, 3])
             + refinement.LEAST_DEVIATION) / pairs[:, 13]
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


def _sums(rows: NDArray[np.float64], groups: NDArray[np.int64], count: int) -> NDArray[np.float64]:
    """Return the sums (count, ...) of the rows of each group."""
    sums = np.zeros((count, *rows.shape[1:]))
    np.add.at(sums, groups, rows)
    return sums


def _mean_square(fit: _Fit) -> float:
    """Return the mean square of the residuals, at least 1, as for the assumed deviations.

    All views of an object count as one view. The fit takes six degrees of freedom.
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
    """Return the part of M (6, 6) that errors of odometry cause."""
    noise = np.zeros((6, 6))
    numbers, instants = np.unique(instants, return_inverse=True)
    # the motion between two instants is that of the last camera of each
    ends = [int(np.nonzero(instants == number)[0][-1]) for number in range(len(numbers))]
    for step, (before, after) in enumerate(pairwise(ends)):
        deviations = odometry_deviations(invert_transform(cameras[before]) @ cameras[after])
        is_before = step < instants[-1]
        beyond = instants <= step if is_before else instants > step
        noise += _squared(_about(information[beyond].sum(axis=0), cameras,
                                 after if is_before else before) * deviations)
    return noise


def _about(information: NDArray[np.float64], cameras: NDArray[np.float64], row: int
           ) -> NDArray[np.float64]:
    """Return information (6, 6) for rotations about a camera instead of the last camera."""
    moved = information.copy()
    moved[:, 3:] += moved[:, :3] @ _cross(cameras[row, :3, 3] - cameras[-1, :3, 3])
    return moved


def _squared(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(matrix @ matrix.T)
