# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the attitude of a camera says against its pose: robots seldom carry it upside down.

Three objects fix a pose without the vertical, so many wrong poses are upside down or lie on their
side: 30 % of those found on TUM fr3 are tilted by more than 90 degrees. A normal distribution of
the tilt describes real cameras, a uniform one on the sphere wrong poses. The ratio of their
densities is the evidence. It never counts in favour of a pose.
"""

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.calibration import CALIBRATION


def tilt_handicaps(map_from_cameras: NDArray[np.float64], deviation_deg: float
                   ) -> NDArray[np.float64]:
    """Return the log odds (m,) that the tilt of each camera takes from its pose, 0 to 4.6.

    Parameters
    ----------
    map_from_cameras : ndarray (m, 4, 4)
        Poses in a map whose third axis is up.
    deviation_deg : float
        Standard deviation of the tilt [deg], see RelocalizerOptions; 0 for none.
    """
    if deviation_deg == 0.0:
        return np.zeros(len(map_from_cameras))
    deviation = np.radians(deviation_deg)
    # the optical frame's second axis is down
    tilts = np.arccos(np.clip(-map_from_cameras[:, 2, 1], -1.0, 1.0))
    against = 0.5 * (tilts / deviation) ** 2 - np.log(2.0 / deviation ** 2)
    return np.clip(against, 0.0, CALIBRATION.attitude.wrong_mount)
