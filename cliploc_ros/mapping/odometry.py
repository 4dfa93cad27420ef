# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Odometry between frames: how the camera moved from each frame to the next one.

Odometry measures the second of two cameras from the first, R and t. With their rotations R_k into
the map and centres c_k, it is off in the map's axes by

    p = c_k+1 - c_k - R_k t,   q = log(R_k+1 (R_k R)'),

whose errors are those of a random walk: their variances grow with the way. The loss is Huber's,
which is convex: given poses with independent errors contradict odometry at first. Where wheels
slip, its pull is bounded. What contradicts the given poses beyond the errors of both is left out.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.mapping.landmarks import POSE_SIZE
from cliploc_ros.mapping.options import OdometryErrors, PoseErrors
from cliploc_ros.mapping.views import Views, camera_centers

# From this length on, in standard deviations, the loss is linear.
_LOSS_SCALE = 3.0
# Odometry and poses contradict each other from this length on, in standard deviations of both.
# Three numbers are longer once in a thousand times.
_CONTRADICTION = 4.0
# Between successive frames, odometry jumps beyond this length. Estimated deviations of the poses
# may be half of the true ones: a lower limit leaves out what odometry corrects most. A guess.
_JUMP = 8.0
# Wrong units, mounts and clocks show over windows of time, more than this share of which then
# contradict the poses. A guess.
_WINDOW_S, _MAX_CONTRADICTIONS = 5.0, 0.3
# Odometry that is longer or shorter by more than this share is left out. A guess: on TUM fr3,
# a tenth did no harm to a map of poses off by 5 cm, three tenths doubled its errors.
_MAX_SCALE_ERROR = 0.15


class StepEquations(NamedTuple):
    """What odometry adds to the normal equations of F poses."""

    cost: float
    #: (F, 6, 6): a block for each pose, and the block below it: the rows of the next pose
    of_poses: NDArray[np.float64]
    of_steps: NDArray[np.float64]
    gradient: NDArray[np.float64]  #: (F, 6)


class Steps(NamedTuple):
    """How the camera moved between m pairs of successive frames, by odometry."""

    frames: NDArray[np.int64]  #: (m,): the first frame of each pair
    #: (m, 3), (m, 3, 3): origin [m] and axes of the second camera in the first
    shifts: NDArray[np.float64]
    turns: NDArray[np.float64]
    #: (m, 2): inverse standard deviations on each axis of shift [1/m] and turn [1/rad]
    stiffness: NDArray[np.float64]

    def linearize(self, views: Views) -> StepEquations:
        """Return cost and normal equations at the present poses."""
        count, firsts, seconds = len(views.rotations), self.frames, self.frames + 1
        residuals = np.stack(_residuals(views, firsts, seconds, self.shifts, self.turns), axis=1)
        lengths = np.linalg.norm(residuals, axis=2) * self.stiffness
        linear = np.maximum(lengths, _LOSS_SCALE)
        # by the square up to the scale, by the length beyond it
        cost = float((_LOSS_SCALE * (lengths - 0.5 * _LOSS_SCALE))[lengths > _LOSS_SCALE].sum()
                     + 0.5 * np.square(lengths[lengths <= _LOSS_SCALE]).sum())
        weights = np.repeat(_LOSS_SCALE / linear * self.stiffness ** 2, 3, axis=1)
        jacobian = self._jacobian(views)
        weighted = jacobian * weights[:, :, None]
        blocks = weighted.transpose(0, 2, 1) @ jacobian
        pulls = np.einsum('mij,mi->mj', weighted, residuals.reshape(-1, POSE_SIZE))
        of_poses = np.zeros((count, POSE_SIZE, POSE_SIZE))
        of_steps, gradient = of_poses.copy(), np.zeros((count, POSE_SIZE))
        of_poses[firsts] += blocks[:, :POSE_SIZE, :POSE_SIZE]
        of_poses[seconds] += blocks[:, POSE_SIZE:, POSE_SIZE:]
        of_steps[firsts] = blocks[:, POSE_SIZE:, :POSE_SIZE]
        gradient[firsts] += pulls[:, :POSE_SIZE]
        gradient[seconds] += pulls[:, POSE_SIZE:]
        return StepEquations(cost, of_poses, of_steps, gradient)

    def _jacobian(self, views: Views) -> NDArray[np.float64]:
        """Return the derivatives (m, 6, 12) of p and q by both poses, for small q.

        The gradient is exact for any q: the left Jacobian of a rotation leaves its axis alone.
        """
        jacobian = np.zeros((len(self.frames), POSE_SIZE, 2 * POSE_SIZE))
        axes = np.arange(POSE_SIZE)
        jacobian[:, axes, axes], jacobian[:, axes, POSE_SIZE + axes] = -1.0, 1.0
        x, y, z = np.einsum('fji,fj->if', views.rotations[self.frames], self.shifts)
        jacobian[:, 0, 4], jacobian[:, 0, 5] = -z, y
        jacobian[:, 1, 3], jacobian[:, 1, 5] = z, -x
        jacobian[:, 2, 3], jacobian[:, 2, 4] = -y, x
        return jacobian


def link_frames(given: Views, odom_from_camera: NDArray[np.float64], errors: PoseErrors,
                noise: OdometryErrors) -> tuple[Steps | None, str]:
    """Return the steps of odometry that do not contradict the given poses, and a note on them.

    Parameters
    ----------
    odom_from_camera : ndarray (F, 4, 4)
        NaN where unknown.
    errors : PoseErrors
        Of the given poses.

    Returns
    -------
    Steps or None
        None where odometry as a whole contradicts the poses, or joins no frames.
    str
    """
    with np.errstate(over='ignore', invalid='ignore'):  # NaN contradicts the poses, too
        return _link(_Known.of(given, odom_from_camera), errors, noise)


def _link(known: '_Known', errors: PoseErrors, noise: OdometryErrors) -> tuple[Steps | None, str]:
    """Return what link_frames returns."""
    before = np.nonzero(np.diff(known.frames) == 1)[0]
    if len(before) == 0:
        return None, 'odometry is left out: no two successive frames have it'
    if complaint := _contradiction(known, errors, noise):
        return None, complaint
    pairs = known.compare(before, before + 1, errors, noise)
    kept = pairs.excess <= _JUMP
    if not kept.any():
        return None, 'odometry is left out: it contradicts the poses between all frames'
    pairs_of_frames = len(known.given.rotations) - 1
    note = f'odometry joins {np.count_nonzero(kept)} of {pairs_of_frames} pairs of frames'
    if not kept.all():
        first_s = known.stamps_s[before[~kept][0]]
        note += (f'; it jumps {np.count_nonzero(~kept)} times, first at {first_s:.2f} s, which is '
                 'left out')
    return Steps(known.frames[before[kept]], pairs.shifts[kept], pairs.turns[kept],
                 1.0 / pairs.sigmas[kept]), note


def _contradiction(known: '_Known', errors: PoseErrors, noise: OdometryErrors) -> str:
    """Return how odometry as a whole contradicts the poses; '' where it does not."""
    starts = np.arange(len(known.frames) - 1)
    ends = np.searchsorted(known.stamps_s, known.stamps_s[:-1] + _WINDOW_S)
    windows = known.compare(starts, np.clip(ends, starts + 1, len(starts)), errors, noise)
    is_far = ~(windows.excess <= _CONTRADICTION)
    tells = is_far | windows.is_motion.any(axis=1)
    if np.count_nonzero(is_far) <= _MAX_CONTRADICTIONS * np.count_nonzero(tells):
        scale = windows.scale(windows.is_motion[:, 0] & ~is_far)
        return '' if abs(scale - 1.0) <= _MAX_SCALE_ERROR else (
            f'odometry is left out: it contradicts the poses in its scale; by the poses the '
            f'camera moves {scale:.2f} times as far; check its wheel radius or unit')
    by_odometry, by_poses = np.median(windows.motions_m[:, is_far], axis=1)
    return (f'odometry is left out: it contradicts the poses in {is_far.sum() / tells.sum():.0%} '
            f'of the windows of {_WINDOW_S:.0f} s; the camera moves {by_odometry:.2f} m by '
            f'odometry and {by_poses:.2f} m by the poses there (medians); check unit, clock and '
            'mount of the odometry, and the noise of the poses')


class _Compared(NamedTuple):
    """Odometry against poses for m pairs of frames."""

    #: (m, 3), (m, 3, 3), (m, 2): of odometry, as in Steps; standard deviations [m] [rad]
    shifts: NDArray[np.float64]
    turns: NDArray[np.float64]
    sigmas: NDArray[np.float64]
    excess: NDArray[np.float64]  #: (m,): how far the two differ, in standard deviations of both
    #: (m, 2): these deviations alone do not explain that the camera shifts, or turns
    is_motion: NDArray[np.bool_]
    #: (2, m): how far the camera moves by odometry and by the poses [m]
    motions_m: NDArray[np.float64]
    #: (m,): how far it moves by the poses in the direction of odometry [m]
    along_m: NDArray[np.float64]

    def scale(self, pairs: NDArray[np.bool_]) -> float:
        """Return the motion by the poses as a multiple of odometry's; 1 without any pairs."""
        far_m = self.motions_m[0, pairs]
        return float(far_m @ self.along_m[pairs] / (far_m @ far_m)) if len(far_m) else 1.0


class _Known(NamedTuple):
    """The frames with odometry: m of F."""

    given: Views  #: Of all F frames
    #: (m,)
    frames: NDArray[np.int64]
    stamps_s: NDArray[np.float64]
    poses: NDArray[np.float64]  #: (m, 4, 4): odom_from_camera
    #: (m,): by odometry since the first frame, along the way [m] [rad]
    distances_m: NDArray[np.float64]
    angles: NDArray[np.float64]

    @staticmethod
    def of(given: Views, odom_from_camera: NDArray[np.float64]) -> '_Known':
        frames = np.nonzero(np.isfinite(odom_from_camera).all(axis=(1, 2)))[0]
        poses = odom_from_camera[frames]
        steps_m = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
        turns = poses[:-1, :3, :3].transpose(0, 2, 1) @ poses[1:, :3, :3]
        return _Known(given, frames, given.stamps_s[frames], poses,
                      np.cumsum([0.0, *steps_m]), np.cumsum([0.0, *_angles(turns)]))

    def compare(self, firsts: NDArray[np.int64], seconds: NDArray[np.int64], errors: PoseErrors,
                noise: OdometryErrors) -> _Compared:
        """Compare the motions between pairs of these frames."""
        axes = self.poses[firsts, :3, :3].transpose(0, 2, 1)
        offsets = self.poses[seconds, :3, 3] - self.poses[firsts, :3, 3]
        shifts, turns = np.einsum('mij,mj->mi', axes, offsets), axes @ self.poses[seconds, :3, :3]
        far_m = np.linalg.norm(offsets, axis=1)
        sigmas = noise.sigmas(self.distances_m[seconds] - self.distances_m[firsts],
                              self.angles[seconds] - self.angles[firsts])
        residuals = _residuals(self.given, self.frames[firsts], self.frames[seconds], shifts,
                               turns)
        of_both = _with_pose_errors(sigmas, self.stamps_s[seconds] - self.stamps_s[firsts], far_m,
                                    errors)
        by_poses = (camera_centers(self.given, self.frames[seconds])
                    - camera_centers(self.given, self.frames[firsts]))
        # p is the rest of the motion by the poses after that by odometry
        ahead = (by_poses * (by_poses - residuals[0])).sum(axis=1)
        motions_m = np.stack([far_m, np.linalg.norm(by_poses, axis=1)])
        lengths = np.linalg.norm(residuals, axis=2).T
        motions = np.column_stack([motions_m.max(axis=0), _angles(turns)])
        return _Compared(shifts, turns, sigmas, (lengths / of_both).max(axis=1),
                         motions > _CONTRADICTION * of_both, motions_m,
                         ahead / np.maximum(far_m, 1e-9))


def _with_pose_errors(sigmas: NDArray[np.float64], seconds_s: NDArray[np.float64],
                      far_m: NDArray[np.float64], errors: PoseErrors) -> NDArray[np.float64]:
    """Return deviations (m, 2) of motions by odometry and by given poses, some time apart."""
    kept = (np.exp(-seconds_s / errors.correlation_s) if errors.correlation_s > 0.0
            else np.zeros(len(seconds_s)))
    sigma_m, sigma_rad = errors.sigmas[[0, 3]]
    of_turns = np.square(sigmas[:, 1]) + 2.0 * sigma_rad ** 2 * (1.0 - kept)
    # a rotation that is off moves what is far away
    of_shifts = (np.square(sigmas[:, 0]) + 2.0 * sigma_m ** 2 * (1.0 - kept)
                 + np.square(far_m) * (np.square(sigmas[:, 1]) + sigma_rad ** 2))
    return np.sqrt(np.column_stack([of_shifts, of_turns]))


def _residuals(views: Views, firsts: NDArray[np.int64], seconds: NDArray[np.int64],
               shifts: NDArray[np.float64], turns: NDArray[np.float64]
               ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return p and q (m, 3) for measured motions from first to second frames."""
    axes = views.rotations[firsts].transpose(0, 2, 1)
    offsets = (camera_centers(views, seconds) - camera_centers(views, firsts)
               - np.einsum('mij,mj->mi', axes, shifts))
    rotations = views.rotations[seconds].transpose(0, 2, 1) @ (axes @ turns).transpose(0, 2, 1)
    return offsets, Rotation.from_matrix(rotations).as_rotvec()


def _angles(turns: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(Rotation.from_matrix(turns).magnitude()) if len(turns) else np.empty(0)
