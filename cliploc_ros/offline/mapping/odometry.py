# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Odometry between frames: the motion of the camera from each frame to the next one.

Odometry measures the pose R, t of the second of two cameras in the first. With their rotations R_k
into the map and centres c_k, its residuals in the map's axes are

    p = c_k+1 - c_k - R_k t,   q = log(R_k+1 (R_k R)'),

whose errors are those of a random walk: their variances grow with the distance. The loss is
Huber's. It is convex, because the given poses, with independent errors, contradict odometry at
first. It also bounds the effect of slipping wheels. Steps that contradict the given poses by more
than the errors of both are left out.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.offline.mapping.landmarks import POSE_SIZE
from cliploc_ros.offline.mapping.options import OdometryErrors, PoseErrors
from cliploc_ros.offline.mapping.views import Views

# The loss is linear beyond this length, in standard deviations.
_LOSS_SCALE = 3.0
# Odometry and poses contradict each other beyond this length, in standard deviations of both.
# Three normal variables exceed it once in a thousand times.
_CONTRADICTION = 4.0
# A step between successive frames is a jump of odometry beyond this length. Estimated deviations
# of the poses may be half of the true ones: a lower limit would drop the steps that correct the
# poses most. Chosen.
_JUMP = 8.0
# Wrong units, mounts and clocks show over windows of time: more than this share of the windows
# then contradicts the poses. Chosen.
_WINDOW_S, _MAX_CONTRADICTIONS = 5.0, 0.3
# Odometry with a greater error of scale is left out. Chosen: on TUM fr3 with poses off by 5 cm,
# an error of 0.1 did not harm the map, an error of 0.3 doubled its errors.
_MAX_SCALE_ERROR = 0.15


class Steps(NamedTuple):
    """Motions of the camera between m pairs of successive frames, by odometry."""

    frames: NDArray[np.int64]  #: (m,): the first frame of each pair
    #: (m, 3), (m, 3, 3): origin [m] and axes of the second camera in the first
    shifts: NDArray[np.float64]
    turns: NDArray[np.float64]
    #: (m, 2): inverse standard deviations on each axis of shift [1/m] and turn [1/rad]
    stiffness: NDArray[np.float64]

    def linearize(self, views: Views) -> tuple[float, NDArray[np.float64], NDArray[np.float64],
                                               NDArray[np.float64]]:
        """Return cost and normal equations at the current F poses.

        The equations are a block for each pose (F, 6, 6), the block below it (F, 6, 6), whose rows
        belong to the next pose, and the gradient (F, 6). The derivatives assume a small q. The
        gradient is exact for any q, since the left Jacobian of a rotation preserves its axis.
        """
        firsts, seconds = self.frames, self.frames + 1
        residuals = np.stack(_residuals(views, firsts, seconds, self.shifts, self.turns), axis=1)
        lengths = np.linalg.norm(residuals, axis=2) * self.stiffness
        linear = np.maximum(lengths, _LOSS_SCALE)
        # quadratic up to the scale, linear beyond it
        cost = float((_LOSS_SCALE * (lengths - 0.5 * _LOSS_SCALE))[lengths > _LOSS_SCALE].sum()
                     + 0.5 * np.square(lengths[lengths <= _LOSS_SCALE]).sum())
        weights = np.repeat(_LOSS_SCALE / linear * self.stiffness ** 2, 3, axis=1)
        jacobian = np.zeros((len(firsts), POSE_SIZE, 2 * POSE_SIZE))
        axes = np.arange(POSE_SIZE)
        jacobian[:, axes, axes], jacobian[:, axes, POSE_SIZE + axes] = -1.0, 1.0
        # rotating the rig displaces both cameras, and the predicted position of the second one
        ahead = np.einsum('fji,fj->fi', views.rotations[firsts], self.shifts)
        for column, arms in ((3, ahead + views.levers[firsts]),
                             (POSE_SIZE + 3, -views.levers[seconds])):
            jacobian[:, :3, column:column + 3] = np.cross(np.eye(3), arms[:, None])
        weighted = jacobian * weights[:, :, None]
        blocks = weighted.transpose(0, 2, 1) @ jacobian
        pulls = np.einsum('mij,mi->mj', weighted, residuals.reshape(-1, POSE_SIZE))
        of_poses = np.zeros((len(views.rotations), POSE_SIZE, POSE_SIZE))
        of_steps, gradient = of_poses.copy(), np.zeros((len(of_poses), POSE_SIZE))
        of_poses[firsts] += blocks[:, :POSE_SIZE, :POSE_SIZE]
        of_poses[seconds] += blocks[:, POSE_SIZE:, POSE_SIZE:]
        of_steps[firsts] = blocks[:, POSE_SIZE:, :POSE_SIZE]
        gradient[firsts] += pulls[:, :POSE_SIZE]
        gradient[seconds] += pulls[:, POSE_SIZE:]
        return cost, of_poses, of_steps, gradient


def link_frames(given: Views, odom_from_camera: NDArray[np.float64], errors: PoseErrors,
                noise: OdometryErrors) -> tuple[Steps | None, str]:
    """Return the steps of odometry that do not contradict the given poses, and a note on them.

    Odometry (F, 4, 4) is NaN where unknown. The camera with the most frames decides whether all of
    odometry contradicts the poses. In this case, and if odometry joins no frames, there are no
    steps.
    """
    frames = np.nonzero(np.isfinite(odom_from_camera).all(axis=(1, 2)))[0]
    before = np.nonzero(np.diff(frames) == 1)[0]
    if len(before) == 0:
        return None, 'odometry is left out: no two successive frames have it'
    with np.errstate(over='ignore', invalid='ignore'):  # NaN counts as a contradiction
        known = _Known(given, frames, odom_from_camera[frames], errors, noise)
        if complaint := known.contradiction():
            return None, complaint
        pairs = known.compare(before, before + 1)
    kept = pairs.excess <= _JUMP
    if not kept.any():
        return None, 'odometry is left out: it contradicts the poses between all frames'
    note = f'odometry joins {np.count_nonzero(kept)} of {len(given.rotations) - 1} pairs of frames'
    if not kept.all():
        first_s = given.stamps_s[frames[before[~kept][0]]]
        note += f'; jumps left out: {np.count_nonzero(~kept)}, the first at {first_s:.2f} s'
    return Steps._make(column[kept] for column in pairs.steps), note


class _Compared(NamedTuple):
    """Comparison of odometry with poses for m pairs of frames."""

    steps: Steps  #: By odometry
    excess: NDArray[np.float64]  #: (m,): how far the two differ, in standard deviations of both
    #: (m, 2): the camera shifts, or turns, by more than these deviations explain
    is_motion: NDArray[np.bool_]
    #: (2, m): distance that the camera moves by odometry, and by the poses [m]
    motions_m: NDArray[np.float64]
    #: (m,): distance that it moves by the poses in the direction of odometry [m]
    along_m: NDArray[np.float64]


class _Known:
    """The frames with odometry: m of F."""

    def __init__(self, given: Views, frames: NDArray[np.int64], poses: NDArray[np.float64],
                 errors: PoseErrors, noise: OdometryErrors):
        self._given, self._frames, self._poses = given, frames, poses
        self._errors, self._noise = errors, noise
        self._stamps_s = given.stamps_s[frames]
        cameras = given.cameras[frames]
        self._is_leading = cameras == np.argmax(np.bincount(cameras))
        # distance and angle travelled since the first frame [m] [rad], by odometry of the camera
        # with
        # the most frames: the offset between two cameras is no motion
        own, times = poses[self._is_leading], self._stamps_s[self._is_leading]
        steps_m = np.linalg.norm(np.diff(own[:, :3, 3], axis=0), axis=1)
        turns = own[:-1, :3, :3].transpose(0, 2, 1) @ own[1:, :3, :3]
        self._distances_m, self._angles = (
            np.interp(self._stamps_s, times, np.cumsum([0.0, *steps]))
            for steps in (steps_m, Rotation.from_matrix(turns).magnitude()))

    def contradiction(self) -> str:
        """Return how odometry of the camera with the most frames contradicts the poses overall.

        '' if it does not.
        """
        rows = np.nonzero(self._is_leading)[0]
        starts, stamps_s = np.arange(len(rows) - 1), self._stamps_s[rows]
        ends = np.clip(np.searchsorted(stamps_s, stamps_s[:-1] + _WINDOW_S), starts + 1,
                       len(starts))
        windows = self.compare(rows[:-1], rows[ends])
        is_far = ~(windows.excess <= _CONTRADICTION)
        tells = is_far | windows.is_motion.any(axis=1)
        if np.count_nonzero(is_far) <= _MAX_CONTRADICTIONS * np.count_nonzero(tells):
            # the motion by the poses as a multiple of odometry's
            moving = windows.is_motion[:, 0] & ~is_far
            far_m = windows.motions_m[0, moving]
            scale = float(far_m @ windows.along_m[moving] / (far_m @ far_m)) if len(far_m) else 1.0
            return '' if abs(scale - 1.0) <= _MAX_SCALE_ERROR else (
                'odometry is left out: its scale contradicts the poses, by which the camera moves '
                f'{scale:.2f} times as far; check its wheel radius or unit')
        by_odometry, by_poses = np.median(windows.motions_m[:, is_far], axis=1)
        return (f'odometry is left out: it contradicts the poses in '
                f'{is_far.sum() / tells.sum():.0%} of the windows of {_WINDOW_S:.0f} s, with '
                f'{by_odometry:.2f} m against {by_poses:.2f} m; check its unit, clock and mount')

    def compare(self, firsts: NDArray[np.int64], seconds: NDArray[np.int64]) -> _Compared:
        """Compare the motions between pairs of these frames."""
        frames, errors = self._frames, self._errors
        axes = self._poses[firsts, :3, :3].transpose(0, 2, 1)
        offsets = self._poses[seconds, :3, 3] - self._poses[firsts, :3, 3]
        shifts, turns = np.einsum('mij,mj->mi', axes, offsets), axes @ self._poses[seconds, :3, :3]
        far_m = np.linalg.norm(offsets, axis=1)
        sigmas = self._noise.sigmas(self._distances_m[seconds] - self._distances_m[firsts],
                                    self._angles[seconds] - self._angles[firsts])
        # deviations of motions by odometry and by given poses
        seconds_s = self._stamps_s[seconds] - self._stamps_s[firsts]
        kept = errors.kept(seconds_s)
        sigma_m, sigma_rad = errors.sigmas[[0, 3]]
        of_turns = np.square(sigmas[:, 1]) + 2.0 * sigma_rad ** 2 * (1.0 - kept)
        # errors of rotation grow with distance
        of_shifts = (np.square(sigmas[:, 0]) + 2.0 * sigma_m ** 2 * (1.0 - kept)
                     + np.square(far_m) * (np.square(sigmas[:, 1]) + sigma_rad ** 2))
        of_both = np.sqrt(np.column_stack([of_shifts, of_turns]))
        residuals = _residuals(self._given, frames[firsts], frames[seconds], shifts, turns)
        by_poses = (self._given.centers[frames[seconds]] - self._given.centers[frames[firsts]])
        # p is the motion by the poses minus that by odometry
        ahead = (by_poses * (by_poses - residuals[0])).sum(axis=1)
        motions_m = np.stack([far_m, np.linalg.norm(by_poses, axis=1)])
        lengths = np.linalg.norm(residuals, axis=2).T
        motions = np.column_stack([motions_m.max(axis=0), Rotation.from_matrix(turns).magnitude()])
        return _Compared(Steps(frames[firsts], shifts, turns, 1.0 / sigmas),
                         (lengths / of_both).max(axis=1), motions > _CONTRADICTION * of_both,
                         motions_m, ahead / np.maximum(far_m, 1e-9))


def _residuals(views: Views, firsts: NDArray[np.int64], seconds: NDArray[np.int64],
               shifts: NDArray[np.float64], turns: NDArray[np.float64]
               ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return p and q (m, 3) for measured motions from first to second frames."""
    axes = views.rotations[firsts].transpose(0, 2, 1)
    offsets = (views.centers[seconds] - views.centers[firsts]
               - np.einsum('mij,mj->mi', axes, shifts))
    rotations = views.rotations[seconds].transpose(0, 2, 1) @ (axes @ turns).transpose(0, 2, 1)
    return offsets, Rotation.from_matrix(rotations).as_rotvec()
