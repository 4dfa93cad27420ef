# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Detect faults of a camera over several looks: in its images and in its mount's orientation.

Each sign of a fault must persist for several looks. A wall in front of a standing robot looks as
bare as a cloth over the lens and as smooth as an image out of focus. Blur and dirt are therefore
detected only over different views. An image that stays bitwise identical while the robot moves is
frozen.

If the stated orientation of the mount is wrong, it is off by the same angle in all looks at right
poses. Each look gives the turn from the given pose to the fitted pose, with its information. The
given pose is off by decimetres and its yaw by degrees; these errors change along the way, while
the turn of the camera is constant. The estimate is the mean of the turns, weighted by their
information, with smaller weights for outliers (Cauchy). Its covariance includes their scatter. A
constant yaw error of the localizer has the same effect as a camera that is turned about the
vertical: the images cannot distinguish the two.
"""

import math
import zlib
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.calibration import CALIBRATION
from cliploc_ros.core.geometry.transforms import SAME_VIEW
from cliploc_ros.core.watch.look import Alignment

_FAULTS = {'dark': 'the camera is in the dark or covered',
           'bare': 'the camera is covered or faces a bare wall',
           'frozen': 'the image is frozen',
           'smooth': 'the image is blurred or the lens is dirty'}
# Number of iterations of the weighted mean, a numerical bound.
_ROUNDS = 10


class ImageFaults:
    """Detects faults in the images of one camera."""

    def __init__(self) -> None:
        self._counts = dict.fromkeys(_FAULTS, 0)
        self._pose = np.full((4, 4), np.nan)
        self._checksum = -1

    def add(self, image: NDArray[np.uint8], pose: NDArray[np.float64]) -> str:
        """Add an image (h, w, 3) and its pose (4, 4); return the fault as text, empty if none.

        The pose should come from odometry if available.
        """
        terms = CALIBRATION.images
        width = int(terms.width_px)
        height = max(1, round(image.shape[0] * width / image.shape[1]))
        small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.float32)
        mean, deviation = grey.mean(), grey.std()
        is_dark = mean < terms.dark and np.quantile(grey, terms.dark_part) < terms.dark_high
        is_bare = deviation < terms.bare and not is_dark
        is_smooth = cv2.Laplacian(grey, cv2.CV_32F).std() < terms.smooth
        moved = not SAME_VIEW.agree(pose, self._pose)  # True for the first image: NaN
        for name, shown in (('dark', is_dark), ('bare', is_bare),
                            ('smooth', is_smooth and not (is_dark or is_bare))):
            if not shown:
                self._counts[name] = 0
            elif moved or name != 'smooth':
                self._counts[name] += 1
        checksum = zlib.crc32(np.ascontiguousarray(image))
        self._counts['frozen'] = self._counts['frozen'] + moved \
            if checksum == self._checksum else 0
        self._checksum = checksum
        if moved:
            self._pose = pose
        return next((words for name, words in _FAULTS.items()
                     if self._counts[name] >= terms[f'{name}_looks']), '')


@dataclass(frozen=True)
class CameraTurn:
    """Rotation of the camera relative to its stated mount."""

    #: (3,): rotation vector that turns the stated axes of the camera into the true axes [deg];
    #: optical axes: x right, y down, z forward
    rotvec_deg: NDArray[np.float64]
    sigma_deg: float  #: Standard deviation on each axis
    #: Whether the axis is vertical: a constant yaw error of the localizer looks the same
    is_yaw: bool = False

    @property
    def stated_from_true(self) -> NDArray[np.float64]:
        """Return the turn as a transform (4, 4)."""
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_rotvec(self.rotvec_deg, degrees=True).as_matrix()
        return turn

    def in_words(self) -> str:
        """Return the turn as text, such as 'turned by 3.1 degrees about y'."""
        angle = float(np.linalg.norm(self.rotvec_deg))
        shares = np.abs(self.rotvec_deg) / max(angle, 1e-9)
        names = [name for name, share in zip('xyz', shares, strict=True) if share > 0.4]
        found = f'turned by {angle:.1f} degrees about {" and ".join(names)}'
        return f'{found}, or the yaw of the localizer is off' if self.is_yaw else found


class _Turn(NamedTuple):
    """The turn that one look measured [rad], its information, and the vertical in the camera."""

    rotvec: NDArray[np.float64]
    information: NDArray[np.float64]
    up: NDArray[np.float64]


class TurnEstimate:
    """Estimate of the turn from the last looks; a look from the same spot replaces the last."""

    def __init__(self) -> None:
        self._turns: deque[_Turn] = deque(maxlen=int(CALIBRATION.turn.most_looks))
        #: None while it is unknown or not significant
        self.turn: CameraTurn | None = None

    def add(self, alignment: Alignment, given: NDArray[np.float64], is_new: bool) -> None:
        """Add a look at a right pose (4, 4)."""
        fit, terms = alignment.fit, CALIBRATION.turn
        information = fit.finalist.information
        if fit.support.inliers < terms.matched or information is None or not information.any():
            return
        if self._turns and not is_new:
            self._turns.pop()
        self._turns.append(_turn_of(fit.pose, information, given))
        if len(self._turns) < terms.least_looks:
            return
        mean, covariance = _robust_mean(self._turns)
        angle = float(np.linalg.norm(mean))
        axis = mean / max(angle, 1e-12)
        deviation = math.sqrt(float(axis @ covariance @ axis))
        is_sure = math.degrees(angle) >= max(terms.least_deg,
                                             terms.least_sigmas * math.degrees(deviation))
        self.turn = CameraTurn(
            np.degrees(mean), math.degrees(math.sqrt(np.linalg.eigvalsh(covariance)[-1])),
            bool(abs(axis @ self._turns[-1].up) > terms.yaw_share)) if is_sure else None


def _turn_of(pose: NDArray[np.float64], information: NDArray[np.float64],
             given: NDArray[np.float64]) -> _Turn:
    """Return the turn from a given pose (4, 4) to the fitted pose, at the most likely position.

    The given position is right up to the drift of a localizer, so part of the shift between the
    given and the fitted pose is caused by a turn. The turn is the least-squares solution of the
    fit and a prior on the position.
    """
    terms, back = CALIBRATION.turn, given[:3, 3] - pose[:3, 3]
    prior = np.diag(1.0 / np.square([terms.drift_m, terms.drift_m, terms.drift_up_m]))
    of_step, mixed, of_turn = information[:3, :3], information[:3, 3:], information[3:, 3:]
    marginal = of_turn - mixed.T @ np.linalg.solve(of_step + prior, mixed)
    # information of position and turn, with the prior on the position
    joint = information.copy()
    joint[:3, :3] += prior
    step = np.linalg.solve(joint, np.concatenate([prior @ back, np.zeros(3)]))
    turned = Rotation.from_rotvec(step[3:]).as_matrix() @ pose[:3, :3]
    axes = given[:3, :3]
    up = axes[2]
    covariance = (axes.T @ np.linalg.inv(marginal + 1e-6 * np.eye(3)) @ axes
                  + math.radians(terms.yaw_deg) ** 2 * np.outer(up, up))
    return _Turn(Rotation.from_matrix(axes.T @ turned).as_rotvec(), np.linalg.inv(covariance), up)


def _robust_mean(turns: deque[_Turn]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the robust mean of turns (3,) and its covariance (3, 3), including their scatter."""
    vectors = np.array([turn.rotvec for turn in turns])
    informations = np.array([turn.information for turn in turns])
    mean = np.median(vectors, axis=0)
    for _ in range(_ROUNDS):
        off = vectors - mean
        # divided by the 3 axes: an error of one standard deviation on each axis halves the weight
        weights = 1.0 / (1.0 + np.einsum('ni,nij,nj->n', off, informations, off) / 3.0)
        weighted = weights[:, None, None] * informations
        total = np.linalg.inv(weighted.sum(axis=0))
        mean = total @ np.einsum('nij,nj->i', weighted, vectors)
    pulls = np.einsum('nij,nj->ni', weighted, vectors - mean)
    # errors of consecutive looks are correlated: each is summed with its predecessor's
    pulls = pulls + np.roll(pulls, 1, axis=0) * (np.arange(len(pulls)) > 0)[:, None]
    scatter = total @ (pulls.T @ pulls) @ total
    return mean, np.asarray(np.maximum(scatter, 0.0) * np.eye(3) + total)
