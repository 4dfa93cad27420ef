# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How a camera is turned against its stated mount."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class CameraTurn:
    """The camera is turned against its stated mount."""

    #: (3,): rotation vector that turns the stated axes of the camera into the true ones [deg];
    #: optical axes: x right, y down, z forward
    rotvec_deg: NDArray[np.float64]
    sigma_deg: float  #: Standard deviation on each axis

    def in_words(self) -> str:
        """Return the turn as text: 'turned by 3.1 degrees about y'."""
        angle = float(np.linalg.norm(self.rotvec_deg))
        shares = np.abs(self.rotvec_deg) / max(angle, 1e-9)
        names = [name for name, share in zip('xyz', shares, strict=True) if share > 0.4]
        return f'turned by {angle:.1f} degrees about {" and ".join(names)}'
