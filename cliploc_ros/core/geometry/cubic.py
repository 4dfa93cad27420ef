# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The largest real root of a cubic, which both conic pencils need (P3P and overlap)."""

from math import acos, copysign, cos, sqrt

import numpy as np

from cliploc_ros.core.kernels.compiled import compiled

_DOUBLE_ROOT = 1e-12
_ROUNDING = 4e-16


@compiled
def largest_cubic_root(c2: float, c1: float, c0: float) -> float:
    """Return the largest real root of x^3 + c2 x^2 + c1 x + c0.

    Closed form (Viete for three real roots, Cardano for one), then two Newton steps.
    """
    shift = c2 / 3.0
    p = c1 - c2 * shift
    q = c0 + shift * (2.0 * shift * shift - c1)
    discriminant = 0.25 * q * q + p * p * p / 27.0
    if discriminant < 0.0:
        radius = sqrt(-p / 3.0)
        cosine = min(1.0, max(-1.0, -0.5 * q / (radius * radius * radius)))
        root = 2.0 * radius * cos(acos(cosine) / 3.0) - shift
    else:
        # Start with the cube root of larger magnitude: the other follows without cancellation.
        u = np.cbrt(-0.5 * q - copysign(sqrt(discriminant), q))
        depressed = u - p / (3.0 * u) if u != 0.0 else 0.0
        if depressed < 0.0 and discriminant <= _DOUBLE_ROOT * q * q:
            depressed *= -0.5  # the other two roots coincide, up to rounding, and are larger
        root = depressed - shift
    for _ in range(2):
        value = ((root + c2) * root + c1) * root + c0
        terms = ((abs(root) + abs(c2)) * abs(root) + abs(c1)) * abs(root) + abs(c0)
        if abs(value) <= _ROUNDING * terms:
            break  # near a double root, the next step would be arbitrary
        root -= value / ((3.0 * root + 2.0 * c2) * root + c1)
    return root
