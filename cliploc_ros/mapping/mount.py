# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Correct the mount of the camera: one small motion that all frames share.

The correction is fitted next to a free correction of each landmark, as in
cliploc_ros.mapping.checking.systematic, with a prior about zero. Some motions do not show every
part of it: a robot that turns about the vertical only cannot tell a higher camera from a lower
floor. Such a part stays with the prior, near zero, and the report names it.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.transforms import invert_transform, make_transform
from cliploc_ros.mapping.checking.systematic import (
    cost_of,
    linearize_boxes,
    move_map,
    refit_landmarks,
    without_landmarks,
)
from cliploc_ros.mapping.fitting import LOSS_SCALE
from cliploc_ros.mapping.landmarks import Landmarks
from cliploc_ros.mapping.views import Views

# Standard deviations of a mount that somebody measured with a ruler: 5 cm, 3 degrees. A guess.
_PRIOR = np.repeat([0.05, np.radians(3.0)], 3)
# A part that the boxes leave more uncertain than this share of the prior is not observable.
_OBSERVABLE = 0.5
_STEPS = 10
_MAX_BOXES = 8_000
_NAMES = ('x (right)', 'y (down)', 'z (forward)', 'rotation about x', 'rotation about y',
          'rotation about z')


class MountCorrection(NamedTuple):
    """A correction of the mount."""

    views: Views  #: With the correction applied
    #: (4, 4): pose of the corrected camera in the camera that the given poses describe
    given_from_corrected: NDArray[np.float64]
    #: (6,): standard deviations of x, y, z [m] and of the rotations about them [rad]
    deviations: NDArray[np.float64]

    def lines(self) -> list[str]:
        """Return what was corrected, and what this motion does not show."""
        values = np.concatenate([
            self.given_from_corrected[:3, 3] * 100.0,
            np.degrees(Rotation.from_matrix(self.given_from_corrected[:3, :3]).as_rotvec())])
        deviations = np.concatenate([self.deviations[:3] * 100.0,
                                     np.degrees(self.deviations[3:])])
        seen = self.deviations < _OBSERVABLE * _PRIOR
        units = ('cm',) * 3 + ('degrees',) * 3
        rows = [f'mount corrected: {name} {value:+.2f} +- {deviation:.2f} {unit}'
                for name, value, deviation, unit, is_seen
                in zip(_NAMES, values, deviations, units, seen, strict=True) if is_seen]
        if hidden := [name for name, is_seen in zip(_NAMES, seen, strict=True) if not is_seen]:
            rows.append(f'mount not observable from this motion: {", ".join(hidden)}; turn the '
                        'camera about another axis')
        return rows


def refine_mount(given: Views, landmarks: Landmarks, shown: NDArray[np.int64], start: Views
                 ) -> MountCorrection:
    """Return the correction of the mount that fits the boxes best.

    Parameters
    ----------
    given : Views
        With the given poses.
    landmarks : Landmarks
        Fitted to the poses of start.
    shown : ndarray (n,) of int
        The landmark that each box shows, -1 for none.
    start : Views
        The given views, or those of an earlier correction.
    """
    rows = np.nonzero(shown >= 0)[0]
    rows = rows[::max(1, -(-len(rows) // _MAX_BOXES))]
    numbers, frames = shown[rows], len(given.rotations)
    values, views = _motion(given, start), start
    linear = linearize_boxes(views, rows, numbers, landmarks)
    cost = cost_of(linear) + _penalty(values)
    for _ in range(_STEPS):
        information, gradient, _ = _normal_equations(views, rows, numbers, landmarks)
        step = np.linalg.solve(information + np.diag(_PRIOR ** -2),
                               -gradient - values / _PRIOR ** 2)
        moved = move_map(given, np.tile(values + step, (frames, 1)))
        refitted = refit_landmarks(moved, landmarks, rows, numbers)
        trial = cost_of(linearize_boxes(moved, rows, numbers, refitted)) + _penalty(values + step)
        if trial >= cost:
            break
        values, views, landmarks, cost = values + step, moved, refitted, trial
    information, _, spread = _normal_equations(views, rows, numbers, landmarks)
    prior = np.diag(_PRIOR ** -2)
    inverse = np.linalg.inv(information + prior)
    deviations = np.sqrt(np.diag(inverse @ (spread + prior) @ inverse))
    motion = make_transform(Rotation.from_rotvec(values[3:]).as_matrix(), values[:3])
    return MountCorrection(views, invert_transform(motion), deviations)


def _motion(given: Views, moved: Views) -> NDArray[np.float64]:
    """Return by how much the map was moved in the cameras (6,): translation, rotation."""
    turn = moved.rotations[0] @ given.rotations[0].T
    return np.concatenate([moved.translations[0] - turn @ given.translations[0],
                           Rotation.from_matrix(turn).as_rotvec()])


def _penalty(values: NDArray[np.float64]) -> float:
    """Return the prior's cost on the scale of cost_of, whose residuals have LOSS_SCALE."""
    return float(np.square(values / _PRIOR).sum()) / LOSS_SCALE ** 2


def _normal_equations(views: Views, rows: NDArray[np.int64], numbers: NDArray[np.int64],
                      landmarks: Landmarks
                      ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return information (6, 6), gradient (6,), and the gradient's covariance (6, 6).

    Boxes of one viewpoint err alike: the covariance adds up the squares of their sums.
    """
    linear = linearize_boxes(views, rows, numbers, landmarks)
    free, residuals = without_landmarks(linear.by_pose, linear, numbers)
    information = np.einsum('meg,me,meh->gh', free, linear.weights, free)
    viewpoints = views.viewpoints[views.frames[rows]]
    gradients = np.zeros((viewpoints.max() + 1, 6))
    np.add.at(gradients, viewpoints, np.einsum('meg,me->mg', free, linear.weights * residuals))
    return information, gradients.sum(axis=0), gradients.T @ gradients
