# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rigid transforms as 4x4 matrices, named ``a_from_b``: ``x_a = a_from_b @ x_b``.

Every tolerance by which two poses agree has a name here.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation


def make_transform(rotation: NDArray[np.float64], translation: NDArray[np.float64]
                   ) -> NDArray[np.float64]:
    """Return the 4x4 transform of a rotation (3, 3) and a translation (3,) [m]."""
    transform = np.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = translation
    return transform


def invert_transform(a_from_b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return b_from_a (4, 4)."""
    rotation_t = a_from_b[:3, :3].T
    return make_transform(rotation_t, -rotation_t @ a_from_b[:3, 3])


def is_rigid(transform: NDArray[np.float64], tolerance: float = 1e-4) -> bool:
    """Return whether an array is a finite rigid transform (4, 4)."""
    return transform.shape == (4, 4) and bool(are_rigid(transform[None], tolerance)[0])


def are_rigid(transforms: NDArray[np.float64], tolerance: float = 1e-3) -> NDArray[np.bool_]:
    """Return which arrays (k, 4, 4) are finite rigid transforms."""
    finite = np.isfinite(transforms).all(axis=(1, 2))
    # no element of a rotation exceeds 1, and squares of huge numbers overflow
    rotations = np.clip(np.where(finite[:, None, None], transforms[:, :3, :3], 0.0), -2.0, 2.0)
    errors = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    return np.asarray((errors <= tolerance) & (np.linalg.det(rotations) > 0.0)
                      & (transforms[:, 3] == [0.0, 0.0, 0.0, 1.0]).all(axis=1))


def transform_from_pose(position: NDArray[np.float64], quat_xyzw: NDArray[np.float64]
                        ) -> NDArray[np.float64]:
    """Return the 4x4 transform of a position (3,) [m] and a quaternion x, y, z, w."""
    return make_transform(Rotation.from_quat(quat_xyzw).as_matrix(), position)


def quaternion_from_transform(a_from_b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the quaternion x, y, z, w (4,) of a transform's rotation, with w >= 0."""
    quat_xyzw = Rotation.from_matrix(a_from_b[:3, :3]).as_quat()
    return quat_xyzw if quat_xyzw[3] >= 0.0 else -quat_xyzw


def move_poses(poses: NDArray[np.float64], scale: float, rotation: NDArray[np.float64]
               ) -> NDArray[np.float64]:
    """Return poses (n, 4, 4) with positions times a scale, then turned by a rotation (3, 3)."""
    moved = poses.copy()
    moved[:, :3, 3] *= scale
    moved[:, :3] = rotation @ moved[:, :3]
    return moved


def rotation_angle_deg(rotation: NDArray[np.float64]) -> float:
    """Return the angle [deg] by which a rotation (3, 3) turns."""
    return float(np.degrees(Rotation.from_matrix(rotation).magnitude()))


def pose_error(estimate: NDArray[np.float64], truth: NDArray[np.float64]) -> tuple[float, float]:
    """Return the distance [m] and the angle [deg] between two poses (4, 4)."""
    distance = float(np.linalg.norm(estimate[:3, 3] - truth[:3, 3]))
    return distance, rotation_angle_deg(estimate[:3, :3].T @ truth[:3, :3])


def pose_difference(one: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the step (6,) from one pose to another: position [m], rotation about fixed axes."""
    turn = Rotation.from_matrix(other[:3, :3] @ one[:3, :3].T).as_rotvec()
    return np.concatenate([other[:3, 3] - one[:3, 3], turn])


def move_covariance(covariance: NDArray[np.float64], lever: NDArray[np.float64]
                    ) -> NDArray[np.float64]:
    """Return a pose's covariance after its origin moved rigidly by a lever.

    Parameters
    ----------
    covariance : ndarray (6, 6)
        Covariance of x, y, z [m] and the rotations about the fixed X, Y, Z axes [rad] (ROS order).
    lever : ndarray (3,)
        From the old origin to the new one, in the fixed frame [m].
    """
    x, y, z = lever
    jacobian = np.eye(6)
    jacobian[:3, 3:] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
    return jacobian @ covariance @ jacobian.T


def first_of_each(same: NDArray[np.bool_], most: int | None = None) -> list[int]:
    """Return the first of m rows that are not the same (m, m) as one before, up to a number."""
    rows = list[int]()
    for row in range(len(same)):
        if len(rows) == most:
            break
        if not same[row, rows].any():
            rows.append(row)
    return rows


class Tolerance(NamedTuple):
    """Two poses agree if they are nearer than this to each other, in both [m] [deg]."""

    distance_m: float
    angle_deg: float

    @property
    def least_trace(self) -> float:
        """Return the trace of a rotation by the angle; a smaller turn has a greater trace."""
        return float(1.0 + 2.0 * np.cos(np.radians(self.angle_deg)))

    def agree(self, one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
        """Return whether two poses (4, 4) agree."""
        return bool(self.agreeing(one[None], other[None])[0, 0])

    def agreeing(self, poses: NDArray[np.float64], others: NDArray[np.float64] | None = None
                 ) -> NDArray[np.bool_]:
        """Return which poses (m, 4, 4) agree with which others (k, 4, 4), or with each other."""
        others = poses if others is None else others
        near = np.linalg.norm(poses[:, None, :3, 3] - others[:, :3, 3], axis=2) < self.distance_m
        traces = np.einsum('iab,jab->ij', poses[:, :3, :3], others[:, :3, :3])
        return np.asarray(near & (traces > self.least_trace))

    def distinct(self, poses: NDArray[np.float64], most: int | None = None) -> list[int]:
        """Return the row of the first of m poses (m, 4, 4) at each place, up to a number."""
        return first_of_each(self.agreeing(poses), most)

    def wider(self, distance_m: float, angle_deg: float) -> 'Tolerance':
        """Return a tolerance that allows more by these amounts."""
        return Tolerance(self.distance_m + distance_m, min(180.0, self.angle_deg + angle_deg))


#: Two poses count as the same answer, and a pose this near to the truth as right.
SAME_ANSWER = Tolerance(1.0, 45.0)
#: A pose further from the truth than this is wrong [m].
RIGHT_M = SAME_ANSWER.distance_m
#: Two hypotheses of a search are at one place: the better one stands for both.
SAME_PLACE = Tolerance(0.5, 20.0)
#: Two looks, linked by odometry, lead to the same pose.
SAME_LOOK = Tolerance(0.5, 20.0)
#: A localizer drifts by less, and the mount of a camera is off by less.
SAME_NEIGHBOURHOOD = Tolerance(0.7, 20.0)
#: Two refined poses are the same minimum of the cost.
SAME_MINIMUM = Tolerance(0.05, 2.0)
#: A camera that moved less sees the same again.
SAME_VIEW = Tolerance(0.05, 3.0)
#: Boxes of an object share their errors between poses this near to each other.
SAME_BOXES = Tolerance(0.25, 10.0)
#: A keyframe sees what a camera sees; the shares of both tolerances add up.
SAME_SIGHT = Tolerance(2.0, 40.0)
#: A robot that moved less since its image is still where its pose says.
SAME_SPOT = Tolerance(0.1, 5.0)
#: A localizer that shows a pose this near to the given pose has taken it. Its particles scatter by
#: the given covariance, so the tolerance is wider by three standard deviations.
TAKEN = Tolerance(0.3, 10.0)
#: Two moves of a place onto another place that differ by less are the same move.
SAME_MOVE = Tolerance(1.0, 30.0)
