# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Trajectories of a camera: poses over time, with interpolation between them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.transforms import transform_from_pose

#: A stamp has a pose only if a sample lies this close to it.
MAX_SAMPLE_DISTANCE_NS = 20_000_000


@dataclass(frozen=True)
class Trajectory:
    """Camera poses in a map, in order of time."""

    #: (t,) of int64: time of each sample [ns], strictly increasing. May be empty.
    stamps_ns: NDArray[np.int64]
    positions_xyz: NDArray[np.float64]  #: (t, 3): camera centre in the map [m]
    quats_xyzw: NDArray[np.float64]  #: (t, 4): rotation of camera axes into map axes, unit norm

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.stamps_ns)

    def pose_at(self, stamp_ns: int, max_gap_ns: int = 0) -> NDArray[np.float64] | None:
        """Interpolate the pose at a stamp: positions linearly, rotations by slerp.

        Parameters
        ----------
        stamp_ns : int
            Time [ns].
        max_gap_ns : int
            Two samples around the stamp may lie this far apart [ns]. One sample within 20 ms is
            always enough.

        Returns
        -------
        ndarray (4, 4) or None
            ``map_from_camera``; None if no sample is near enough. Just outside the trajectory
            it is the first or last sample, without extrapolation.
        """
        if len(self) == 0:
            return None
        after = int(np.searchsorted(self.stamps_ns, stamp_ns))
        low, high = max(after - 1, 0), min(after, len(self) - 1)
        gap_before = abs(stamp_ns - int(self.stamps_ns[low]))
        gap_after = abs(int(self.stamps_ns[high]) - stamp_ns)
        is_between = self.stamps_ns[low] <= stamp_ns <= self.stamps_ns[high]
        if (min(gap_before, gap_after) > MAX_SAMPLE_DISTANCE_NS
                and not (is_between and gap_before + gap_after <= max_gap_ns)):
            return None
        fraction = 0.0 if low == high else gap_before / (gap_before + gap_after)
        start, end = self.positions_xyz[low], self.positions_xyz[high]
        quat_xyzw = slerp(self.quats_xyzw[low], self.quats_xyzw[high], fraction)
        return transform_from_pose(start + fraction * (end - start), quat_xyzw)


def slerp(
    start_xyzw: NDArray[np.float64], end_xyzw: NDArray[np.float64], fraction: float
) -> NDArray[np.float64]:
    """Interpolate between two unit quaternions along the shorter great arc.

    Parameters
    ----------
    start_xyzw, end_xyzw : ndarray (4,)
        Unit quaternions.
    fraction : float
        0 gives the first, 1 the second (up to sign).

    Returns
    -------
    ndarray (4,)
        Unit quaternion, x y z w (Shoemake 1985).
    """
    cosine = float(start_xyzw @ end_xyzw)
    if cosine < 0:  # q and -q are the same rotation: take the nearer one
        end_xyzw, cosine = -end_xyzw, -cosine
    if cosine > 0.9995:  # dividing by the sine would lose precision
        mixed = (1 - fraction) * start_xyzw + fraction * end_xyzw
        return np.asarray(mixed / np.linalg.norm(mixed))
    angle = np.arccos(cosine)
    weights = np.sin([(1 - fraction) * angle, fraction * angle]) / np.sin(angle)
    return np.asarray(weights[0] * start_xyzw + weights[1] * end_xyzw)
