# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rigid transforms as 4x4 matrices, named ``a_from_b``: ``x_a = a_from_b @ x_b``.

All tolerances within which two poses agree are defined here.
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
    """Return whether an array is a rigid transform (4, 4) with finite elements."""
    return transform.shape == (4, 4) and bool(are_rigid(transform[None], tolerance)[0])


def are_rigid(transforms: NDArray[np.float64], tolerance: float = 1e-3) -> NDArray[np.bool_]:
    """Return which arrays (k, 4, 4) are rigid transforms with finite elements."""
    finite = np.isfinite(transforms).all(axis=(1, 2))
    # clip to avoid overflow: no element of a rotation exceeds 1
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
    """Scale the positions of poses (n, 4, 4), then rotate the poses by a rotation (3, 3)."""
    moved = poses.copy()
    moved[:, :3, 3] *= scale
    moved[:, :3] = rotation @ moved[:, :3]
    return moved


def rotation_angle_deg(rotation: NDArray[np.float64]) -> float:
    """Return the angle [deg] of a rotation (3, 3)."""
    return float(np.degrees(Rotation.from_matrix(rotation).magnitude()))


def pose_error(estimate: NDArray[np.float64], truth: NDArray[np.float64]) -> tuple[float, float]:
    """Return the distance [m] and the angle [deg] between two poses (4, 4)."""
    distance = float(np.linalg.norm(estimate[:3, 3] - truth[:3, 3]))
    return distance, rotation_angle_deg(estimate[:3, :3].T @ truth[:3, :3])


def pose_difference(one: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the step (6,) between two poses: position [m], rotation about fixed axes [rad]."""
    turn = Rotation.from_matrix(other[:3, :3] @ one[:3, :3].T).as_rotvec()
    return np.concatenate([other[:3, 3] - one[:3, 3], turn])


def move_covariance(covariance: NDArray[np.float64], lever: NDArray[np.float64]
                    ) -> NDArray[np.float64]:
    """Return the covariance of a pose after its origin is moved by a rigid lever.

    Parameters
    ----------
    covariance : ndarray (6, 6)
        Covariance of x, y, z [m] and the rotations about the fixed X, Y, Z axes [rad] (ROS order).
    lever : ndarray (3,)
        Vector from the old origin to the new origin, in the fixed coordinate frame [m].
    """
    x, y, z = lever
    jacobian = np.eye(6)
    jacobian[:3, 3:] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
    return jacobian @ covariance @ jacobian.T


def first_of_each(same: NDArray[np.bool_], most: int | None = None) -> list[int]:
    """Return the first row of each group of equal rows, in order, and `most` rows at most.

    same (m, m) states which rows are equal. A row is skipped if it equals a row returned before.
    """
    rows = list[int]()
    for row in range(len(same)):
        if len(rows) == most:
            break
        if not same[row, rows].any():
            rows.append(row)
    return rows


class Tolerance(NamedTuple):
    """Two poses agree if both their distance [m] and their angle [deg] are smaller than this."""

    distance_m: float
    angle_deg: float

    @property
    def least_trace(self) -> float:
        """Return the trace of a rotation by the angle. Smaller rotations have a greater trace."""
        return float(1.0 + 2.0 * np.cos(np.radians(self.angle_deg)))

    def agree(self, one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
        """Return whether two poses (4, 4) agree."""
        return bool(self.agreeing(one[None], other[None])[0, 0])

    def agreeing(self, poses: NDArray[np.float64], others: NDArray[np.float64] | None = None
                 ) -> NDArray[np.bool_]:
        """Return which poses (m, 4, 4) agree with which other poses (k, 4, 4), as (m, k).

        By default, the poses are compared with each other.
        """
        others = poses if others is None else others
        near = np.linalg.norm(poses[:, None, :3, 3] - others[:, :3, 3], axis=2) < self.distance_m
        traces = np.einsum('iab,jab->ij', poses[:, :3, :3], others[:, :3, :3])
        return np.asarray(near & (traces > self.least_trace))

    def distinct(self, poses: NDArray[np.float64], most: int | None = None) -> list[int]:
        """Return the row of the first pose (m, 4, 4) at each place, and `most` rows at most."""
        return first_of_each(self.agreeing(poses), most)

    def wider(self, distance_m: float, angle_deg: float) -> 'Tolerance':
        """Return a tolerance that is wider by these amounts."""
        return Tolerance(self.distance_m + distance_m, min(180.0, self.angle_deg + angle_deg))


#: Within this, two poses count as the same answer, and a pose near the truth counts as right.
SAME_ANSWER = Tolerance(1.0, 45.0)
#: A pose further from the truth than this is wrong [m].
RIGHT_M = SAME_ANSWER.distance_m
#: Within this, two hypotheses of a search are at one place, and only the better one is kept.
SAME_PLACE = Tolerance(0.5, 20.0)
#: Within this, two looks that odometry links lead to the same pose.
SAME_LOOK = Tolerance(0.5, 20.0)
#: The drift of a localizer and the error of a camera's mount are smaller than this.
SAME_NEIGHBOURHOOD = Tolerance(0.7, 20.0)
#: Within this, two refined poses are the same minimum of the cost.
SAME_MINIMUM = Tolerance(0.05, 2.0)
#: A camera that moves less than this has the same view.
SAME_VIEW = Tolerance(0.05, 3.0)
#: Within this, the boxes of an object at two poses have the same errors.
SAME_BOXES = Tolerance(0.25, 10.0)
#: Within this, a keyframe has the view of a camera; the shares of both tolerances are added.
SAME_SIGHT = Tolerance(2.0, 40.0)
#: If a robot has moved less than this since its image, its pose is still valid.
SAME_SPOT = Tolerance(0.1, 5.0)
#: A localizer has accepted a given pose if it shows a pose within this. Its particles scatter by
#: the given covariance, so the tolerance is increased by three standard deviations.
TAKEN = Tolerance(0.3, 10.0)
#: Within this, two moves of a place onto another place are the same move.
SAME_MOVE = Tolerance(1.0, 30.0)
