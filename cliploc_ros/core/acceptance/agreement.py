# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which poses agree: they are the same answer to where the camera is."""

import numpy as np
from numpy.typing import NDArray

#: A right pose is within this distance of the truth [m].
RIGHT_M = 1.0
# Two poses turned by more than 45 degrees are never both right.
_AGREEING_TRACE = 1.0 + 2.0 * np.cos(np.radians(45.0))


def agreeing_poses(poses: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return a mask (m, m): which of the poses (m, 4, 4) agree to 1 m and 45 degrees."""
    positions, rotations = poses[:, :3, 3], poses[:, :3, :3]
    near = np.linalg.norm(positions[:, None] - positions, axis=2) < RIGHT_M
    traces = np.einsum('iab,jab->ij', rotations, rotations)
    return np.asarray(near & (traces > _AGREEING_TRACE))
