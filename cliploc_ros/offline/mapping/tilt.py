# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Estimate the vertical of a recording from the tilt of its cameras."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.errors import DatasetError

# Cameras look along the ground; one that only turns about its own x axis shows no vertical.
_LEAST_SPREAD = np.sin(np.radians(8.0)) ** 2
_MOST_SHARE = 0.25
_LEAST_UPRIGHT = 0.5
# Accuracy of a vertical that is estimated from the tilt of hand-held cameras.
_MOST_TILT_DEG = 5.0
# Images tilted by more show a camera that is mounted upside down, or poses whose z points down.
_UPSIDE_DOWN_DEG = 135.0


def find_vertical(poses: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return the direction (3,) that points up in the poses' coordinate frame.

    People hold a camera level, with its x axis horizontal. Up is therefore the direction along
    which the x axes have the least extent, and in which the upper edge of the image points on
    average.

    Parameters
    ----------
    poses : ndarray (n, 4, 4)

    Returns
    -------
    ndarray or None
        None if the vertical is unknown: the cameras never turn, or are held on their side.
    """
    level, image_up = poses[:, :3, 0], -poses[:, :3, 1]
    shares, directions = np.linalg.eigh(level.T @ level / len(level))
    up = directions[:, 0] * (np.sign(image_up.mean(axis=0) @ directions[:, 0]) or 1.0)
    if (shares[1] < _LEAST_SPREAD or shares[0] > _MOST_SHARE * shares[1]
            or np.mean(image_up @ up) < _LEAST_UPRIGHT):
        return None
    return np.asarray(up)


def rotation_to_z(up: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Return the least rotation (3, 3) of a direction to the z axis, and its angle [deg]."""
    angle = float(np.degrees(np.arccos(np.clip(up[2], -1.0, 1.0))))
    axis = np.cross(up, [0.0, 0.0, 1.0])
    if np.linalg.norm(axis) < 1e-9:
        axis = np.array([1.0, 0.0, 0.0])
    axis = axis / np.linalg.norm(axis)
    return Rotation.from_rotvec(np.radians(angle) * axis).as_matrix(), angle


def find_tilt(poses: NDArray[np.float64], of_robot: bool = False
              ) -> tuple[NDArray[np.float64], float] | None:
    """Return the rotation (3, 3) that turns z up, and its angle [deg].

    The z axis of a robot's map points up (REP 103), and its cameras may be mounted upside down.
    None if the vertical of the poses (n, 4, 4) is unknown, see find_vertical.
    """
    up = find_vertical(poses) if len(poses) else None
    return None if up is None else rotation_to_z(-up if of_robot and up[2] < 0.0 else up)


def tilt_note(poses: NDArray[np.float64], of_robot: bool = False) -> str:
    """Return a note if z is off the vertical of the cameras, '' otherwise.

    The mount of a robot's camera explains the tilt, see find_tilt.
    """
    found = find_tilt(poses, of_robot)
    if found is None or found[1] < _MOST_TILT_DEG:
        return ''
    if of_robot or found[1] > _UPSIDE_DOWN_DEG:
        return (f'by the poses, the cameras are tilted by {found[1]:.0f} degrees: right if they '
                'are mounted so, otherwise correct their mount; if they sway, set no gravity') + (
            '' if of_robot else '; if z of the poses points down, build_map --level turns it')
    return (f'z is {found[1]:.0f} degrees off the vertical of the cameras: heights and views from '
            'above are meaningless; build_map --level corrects it, where the map need not fit '
            "another one, such as AMCL's")


def find_levelling(poses: NDArray[np.float64], is_wanted: bool, of_robot: bool = False
                   ) -> tuple[NDArray[np.float64], str]:
    """Return the rotation (3, 3) that turns z up, the identity unless it is wanted, and a note.

    DatasetError: it is wanted, but the vertical of the poses (n, 4, 4) is unknown.
    """
    if not is_wanted:
        return np.eye(3), tilt_note(poses, of_robot)
    found = find_tilt(poses, of_robot)
    if found is None:
        raise DatasetError('the vertical is unknown: the cameras turn too little, or were held on '
                           'their side; leave out `level`')
    return found[0], f'levelled: the vertical of the cameras was {found[1]:.1f} degrees off z'
