# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the demo's pictures and its page share: colours, words, and outlines of ellipses."""

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.demo.review import Judged

#: Blue and vermilion of Okabe and Ito, which the colour-blind can tell apart.
ACCEPTED, REFUSED = '#0072B2', '#D55E00'
_OUTLINE_POINTS = 64


def verdict(judged: Judged) -> str:
    """Return in words what became of a wake-up."""
    if not judged.wake_up.accepted:
        return 'refused' if judged.error is None else (
            f'refused, the best hypothesis is {judged.error[0]:.2f} m off')
    if judged.error is None:
        return 'accepted'
    return f'accepted, {judged.error[0]:.2f} m and {judged.error[1]:.1f}° from the truth'


def outline_points(ellipse: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points (n, 2) on an ellipse cx, cy, exx, exy, eyy, see cliploc_ros.core.ellipsoid."""
    cx, cy, exx, exy, eyy = ellipse
    root = np.linalg.cholesky(np.array([[exx, exy], [exy, eyy]]))
    angles = np.linspace(0.0, 2.0 * np.pi, _OUTLINE_POINTS, endpoint=False)
    return np.asarray(np.stack([np.cos(angles), np.sin(angles)], axis=1) @ root.T + (cx, cy))
