# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How a camera is turned against its stated mount: a constant angle over looks at right poses.

Each look gives the turn from the given pose to the fitted pose, with its information. The given
pose is off by decimetres and its yaw by degrees, which changes along the way, while the turn of
the camera stays. So looks are averaged by their information and by how much they scatter, far ones
with less weight (Cauchy). A yaw error of the localizer that never changes is the same as a camera
that is turned about the vertical: the images cannot tell which.
"""

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.watch.alignment import Alignment

# Looks that are averaged, and from how many on a turn is named. Objects that a look must match.
_MOST_LOOKS, _LEAST_LOOKS, _LEAST_MATCHED = 40, 8, 3
# Standard deviations of a localizer: of x, y and height [m], and of the yaw [deg].
_DRIFT_M, _YAW_DEG = (0.15, 0.15, 0.03), 2.0
# A turn is significant from this angle [deg] and this many deviations on.
_LEAST_DEG, _LEAST_SIGMAS = 1.5, 3.0
_ROUNDS = 10
# A turn whose axis has this cosine with the vertical is about it.
_YAW_SHARE = 0.8


@dataclass(frozen=True)
class CameraTurn:
    """The camera is turned against its stated mount."""

    #: (3,): rotation vector that turns the stated axes of the camera into the true ones [deg];
    #: optical axes: x right, y down, z forward
    rotvec_deg: NDArray[np.float64]
    sigma_deg: float  #: Standard deviation on each axis
    #: Whether it is about the vertical: a constant yaw error of the localizer looks the same
    is_yaw: bool = False

    @property
    def stated_from_true(self) -> NDArray[np.float64]:
        """Return the turn as a transform (4, 4)."""
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_rotvec(self.rotvec_deg, degrees=True).as_matrix()
        return turn

    def in_words(self) -> str:
        """Return the turn as text: 'turned by 3.1 degrees about y'."""
        angle = float(np.linalg.norm(self.rotvec_deg))
        shares = np.abs(self.rotvec_deg) / max(angle, 1e-9)
        names = [name for name, share in zip('xyz', shares, strict=True) if share > 0.4]
        found = f'turned by {angle:.1f} degrees about {" and ".join(names)}'
        return f'{found}, or the yaw of the localizer is off' if self.is_yaw else found


class _Turn(NamedTuple):
    """A turn that one look shows [rad], its information, and the vertical, in the camera."""

    rotvec: NDArray[np.float64]
    information: NDArray[np.float64]
    up: NDArray[np.float64]


class TurnEstimate:
    """The turns of the last looks. One from the spot of the last one replaces it."""

    def __init__(self) -> None:
        self._turns: deque[_Turn] = deque(maxlen=_MOST_LOOKS)
        #: None before it is known, or where it may be chance
        self.turn: CameraTurn | None = None

    def add(self, alignment: Alignment, given: NDArray[np.float64], is_new: bool) -> None:
        """Take in a look at a right pose (4, 4)."""
        fit = alignment.fit
        information = fit.finalist.information
        if fit.support.inliers < _LEAST_MATCHED or information is None or not information.any():
            return
        if self._turns and not is_new:
            self._turns.pop()
        self._turns.append(_turn_of(fit.pose, information, given))
        if len(self._turns) >= _LEAST_LOOKS:
            self.turn = self._significant()

    def _significant(self) -> CameraTurn | None:
        mean, covariance = _robust_mean(self._turns)
        angle = float(np.linalg.norm(mean))
        axis = mean / max(angle, 1e-12)
        deviation = math.sqrt(float(axis @ covariance @ axis))
        if math.degrees(angle) < max(_LEAST_DEG, _LEAST_SIGMAS * math.degrees(deviation)):
            return None
        return CameraTurn(
            np.degrees(mean), math.degrees(math.sqrt(np.linalg.eigvalsh(covariance)[-1])),
            bool(abs(axis @ self._turns[-1].up) > _YAW_SHARE))


def _turn_of(pose: NDArray[np.float64], information: NDArray[np.float64],
             given: NDArray[np.float64]) -> _Turn:
    """Return the turn from a given pose (4, 4) to the fitted pose, at the likeliest position.

    The given position is right to within _DRIFT_M, so what moves the fit away from it is in part
    a turn: the least squares of the fit and of the given position together.
    """
    back = given[:3, 3] - pose[:3, 3]
    prior = np.diag(1.0 / np.square(_DRIFT_M))
    of_step, mixed, of_turn = information[:3, :3], information[:3, 3:], information[3:, 3:]
    marginal = of_turn - mixed.T @ np.linalg.solve(of_step + prior, mixed)
    # of position and turn together, with the prior of the position
    joint = information.copy()
    joint[:3, :3] += prior
    step = np.linalg.solve(joint, np.concatenate([prior @ back, np.zeros(3)]))
    turned = Rotation.from_rotvec(step[3:]).as_matrix() @ pose[:3, :3]
    axes = given[:3, :3]
    up = axes[2]
    covariance = (axes.T @ np.linalg.inv(marginal + 1e-6 * np.eye(3)) @ axes
                  + math.radians(_YAW_DEG) ** 2 * np.outer(up, up))
    return _Turn(Rotation.from_matrix(axes.T @ turned).as_rotvec(), np.linalg.inv(covariance), up)


def _robust_mean(turns: deque[_Turn]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the mean of some turns (3,) and its covariance (3, 3), by their scatter."""
    vectors = np.array([one.rotvec for one in turns])
    informations = np.array([one.information for one in turns])
    mean = np.median(vectors, axis=0)
    for _ in range(_ROUNDS):
        off = vectors - mean
        weights = 1.0 / (1.0 + np.einsum('ni,nij,nj->n', off, informations, off) / 3.0)
        weighted = weights[:, None, None] * informations
        total = np.linalg.inv(weighted.sum(axis=0))
        mean = total @ np.einsum('nij,nj->i', weighted, vectors)
    pulls = np.einsum('nij,nj->ni', weighted, vectors - mean)
    # errors of neighbouring looks are alike: those of two in a row count together
    pulls = pulls + np.roll(pulls, 1, axis=0) * (np.arange(len(pulls)) > 0)[:, None]
    scatter = total @ (pulls.T @ pulls) @ total
    return mean, np.asarray(np.maximum(scatter, 0.0) * np.eye(3) + total)
