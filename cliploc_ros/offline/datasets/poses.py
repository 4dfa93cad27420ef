# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Poses of a camera over time, with interpolation between them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.transforms import transform_from_pose
from cliploc_ros.errors import DatasetError
from cliploc_ros.offline.datasets.parsing import unit_quaternion
from cliploc_ros.units import NS_PER_S

#: Default: a stamp has a pose only if a sample lies this close to it.
STAMP_TOLERANCE_NS = 20_000_000
#: Greatest deviation of a quaternion's norm from 1.
MAX_NORM_ERROR = 0.01
# A smaller offset is taken for a late start of the recording, a larger one for another clock.
_OTHER_CLOCK_S = 60.0
# Delayed messages are out of order by less than this; a clock that restarts jumps back by more
# [s].
_BACK_S = 1.0


class Poses(Protocol):
    """A source of a camera's poses over time."""

    def pose_at(self, stamp_ns: int) -> NDArray[np.float64] | None:
        """Return ``map_from_camera`` (4, 4) at a stamp [ns]; None if it is not known."""

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """Return the first and last stamp with a pose [ns]; None without any."""


@dataclass(frozen=True)
class TimedPoses:
    """Pose samples of a camera, or of the body on which it is mounted, in order of time."""

    #: (t,) of int64: time of each sample [ns], strictly increasing. May be empty.
    stamps_ns: NDArray[np.int64]
    positions_xyz: NDArray[np.float64]  #: (t, 3): in the map [m]
    quats_xyzw: NDArray[np.float64]  #: (t, 4): rotation into map axes, unit norm
    #: Greatest gap between two samples to interpolate over [ns]. A single sample within the
    #: tolerance is always sufficient.
    max_gap_ns: int = 0
    #: (4, 4): the mount of the camera; None: the poses are those of the camera
    body_from_camera: NDArray[np.float64] | None = None
    tolerance_ns: int = STAMP_TOLERANCE_NS

    @classmethod
    def from_samples(cls, stamps_ns: Sequence[int], rows: Sequence[Sequence[float]], where: str,
                     tolerance: float = MAX_NORM_ERROR) -> 'TimedPoses':
        """Make poses from unsorted samples (x, y, z, qx, qy, qz, qw).

        Of samples with equal stamps, the first is used. DatasetError: a sample is not finite or
        has no unit quaternion.
        """
        stamps, order = np.unique(np.array(stamps_ns, dtype=np.int64), return_index=True)
        samples = np.array(rows, dtype=np.float64).reshape(-1, 7)[order]
        with np.errstate(over='ignore', invalid='ignore'):
            norms = np.linalg.norm(samples[:, 3:], axis=1)
            sound = np.isfinite(samples).all(axis=1) & (np.abs(norms - 1.0) <= tolerance)
        if not sound.all():
            raise DatasetError(f'{where}: {int((~sound).sum())} of {len(sound)} poses are not '
                               'finite or have no unit quaternion')
        return cls(stamps, samples[:, :3], samples[:, 3:] / norms[:, None])

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.stamps_ns)

    def part(self, first: int, end: int) -> 'TimedPoses':
        """Return the samples from the first one to the one before the end."""
        return replace(self, **{name: getattr(self, name)[first:end] for name in (
            'stamps_ns', 'positions_xyz', 'quats_xyzw')})

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """Return the first and last stamp with a pose [ns]; None without any."""
        return (int(self.stamps_ns[0]), int(self.stamps_ns[-1])) if len(self) else None

    def pose_at(self, stamp_ns: int) -> NDArray[np.float64] | None:
        """Return ``map_from_camera`` (4, 4) at a stamp; None if no sample is near enough.

        Positions are interpolated linearly, rotations by slerp. There is no extrapolation: before
        the first or after the last sample, the pose of that sample is returned.
        """
        if len(self) == 0:
            return None
        after = int(np.searchsorted(self.stamps_ns, stamp_ns))
        low, high = max(after - 1, 0), min(after, len(self) - 1)
        gap_before = abs(stamp_ns - int(self.stamps_ns[low]))
        gap_after = abs(int(self.stamps_ns[high]) - stamp_ns)
        is_between = self.stamps_ns[low] <= stamp_ns <= self.stamps_ns[high]
        if (min(gap_before, gap_after) > self.tolerance_ns
                and not (is_between and gap_before + gap_after <= self.max_gap_ns)):
            return None
        fraction = 0.0 if low == high else gap_before / (gap_before + gap_after)
        start, end = self.positions_xyz[low], self.positions_xyz[high]
        pose = transform_from_pose(start + fraction * (end - start), slerp(
            self.quats_xyzw[low], self.quats_xyzw[high], fraction))
        return pose if self.body_from_camera is None else np.asarray(pose @ self.body_from_camera)


def slerp(start_xyzw: NDArray[np.float64], end_xyzw: NDArray[np.float64], fraction: float
          ) -> NDArray[np.float64]:
    """Interpolate between two unit quaternions along the shorter great arc (Shoemake 1985).

    SciPy's Slerp differs in the last digits, and would change the maps of recordings.
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


def mount_from_numbers(numbers: Sequence[float]) -> NDArray[np.float64]:
    """Convert a mount x y z [m] qx qy qz qw to a transform (4, 4).

    DatasetError: a number is not finite, or the norm of the quaternion is not 1.
    """
    if not np.isfinite(numbers).all():
        raise DatasetError(f'mount {list(numbers)}: needs x y z and a unit quaternion '
                           'qx qy qz qw')
    return transform_from_pose(np.array(numbers[:3]), unit_quaternion(
        numbers[3:], f'mount {list(numbers)}', MAX_NORM_ERROR))


def check_forward(stamps_ns: Sequence[int], where: str) -> None:
    """Refuse stamps, in order of recording, that jump back, as when a recording has two runs.

    DatasetError: they jump back; the message gives the stamps.
    """
    stamps = np.array(stamps_ns, dtype=np.int64)
    latest = np.maximum.accumulate(stamps)
    again = np.nonzero(latest - stamps > _BACK_S * NS_PER_S)[0]
    if len(again):
        raise DatasetError(
            f'{where}: the stamps jump back: {stamps[again[0]] / NS_PER_S:.3f} s comes after '
            f'{latest[again[0]] / NS_PER_S:.3f} s; split two runs with `ros2 bag convert`')


def check_clock(poses: Poses, first_ns: int, last_ns: int, where: str) -> None:
    """Refuse poses that do not overlap the time of the images.

    DatasetError: there are no poses, or their time span does not overlap that of the images; the
    message gives the offset.
    """
    span = poses.span_ns
    if span is None:
        raise DatasetError(f'{where}: there are no poses; give the topic, tf or file that has '
                           'them')
    if span[0] <= last_ns and first_ns <= span[1]:
        return
    gap_s = max(span[0] - last_ns, first_ns - span[1]) / NS_PER_S
    offset_s = (span[0] - first_ns) / NS_PER_S
    remedy = ('they use different clocks: record all nodes with the same use_sim_time'
              if gap_s > _OTHER_CLOCK_S else 'record images and poses at the same time')
    raise DatasetError(
        f'{where}: images begin at {first_ns / NS_PER_S:.3f} s, poses at '
        f'{span[0] / NS_PER_S:.3f} s, {offset_s:+.3f} s apart, and do not overlap; {remedy}')
