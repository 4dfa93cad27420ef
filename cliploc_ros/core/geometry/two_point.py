# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The pose of a camera from two points, where the vertical is known.

The vertical leaves a rotation about itself and a translation unknown. In coordinate frames whose
third axis is up, camera and map differ by a yaw: ``d2 b2 - d1 b1 = Rz(yaw) (X2 - X1)``, with
depths d along the bearings b. The third row and the length do not depend on the yaw:

    d2 b2z - d1 b1z = Dz   and   |d2 b2 - d1 b1|^2 = |D|^2.

These are a line and a conic, which share up to two points; yaw and translation follow (after
Kukelova, Bujnak and Pajdla, "Closed-form Solutions to Minimal Absolute Pose Problems with Known
Vertical Direction", ACCV 2010).
"""

from math import sqrt

from cliploc_ros.core.kernels.compiled import ZERO, compiled

# Relative limit below which a baseline is vertical or bearings are level.
_MIN_SINE = 1e-9
_ROUNDING = 1e-12


@compiled
def two_point(bearings, points, verticals, rotations, translations):
    """Write the poses with a known vertical from which two points are seen along two bearings.

    Parameters
    ----------
    bearings, points : ndarray (2, 3)
        Unit vectors in the camera's optical frame, and points in the map frame [m], one a row.
    verticals : ndarray (6,) or more
        Up in the camera and up in the map, unit vectors.
    rotations, translations : ndarray (2, 3, 3), (2, 3)
        Of camera_from_map [m]. Both points lie in front of the camera along their bearings.

    Returns
    -------
    int
        Number of poses, 0 to 2.
    """
    b10, b11, b12 = bearings[0, 0], bearings[0, 1], bearings[0, 2]
    b20, b21, b22 = bearings[1, 0], bearings[1, 1], bearings[1, 2]
    u0, u1, u2 = verticals[0], verticals[1], verticals[2]
    w0, w1, w2 = verticals[3], verticals[4], verticals[5]
    e0, e1, e2 = (points[1, 0] - points[0, 0], points[1, 1] - points[0, 1],
                  points[1, 2] - points[0, 2])
    square = e0 * e0 + e1 * e1 + e2 * e2
    height = e0 * w0 + e1 * w1 + e2 * w2
    level_square = square - height * height
    if not level_square > _MIN_SINE * square:
        return 0  # one point is above the other: the yaw is free
    rise1 = b10 * u0 + b11 * u1 + b12 * u2
    rise2 = b20 * u0 + b21 * u1 + b22 * u2
    cosine = b10 * b20 + b11 * b21 + b12 * b22
    # The line d2 rise2 - d1 rise1 = height as d = base + s direction, with base its point nearest
    # to zero. The conic d1^2 + d2^2 - 2 d1 d2 cosine = square is a quadratic in s.
    steepness = rise1 * rise1 + rise2 * rise2
    if not steepness > _MIN_SINE * _MIN_SINE:
        return 0  # both points are level with the camera: the depths are free
    base1, base2 = -rise1 * height / steepness, rise2 * height / steepness
    quadratic = steepness - 2.0 * rise1 * rise2 * cosine
    half = base1 * rise2 + base2 * rise1 - cosine * (base1 * rise1 + base2 * rise2)
    constant = base1 * base1 + base2 * base2 - 2.0 * base1 * base2 * cosine - square
    discriminant = half * half - quadratic * constant
    # Rounding may make a double root complex; it still is one pose.
    if not (discriminant >= -_ROUNDING * (half * half + abs(quadratic * constant))
            and quadratic > 0.0):
        return 0
    discriminant = max(0.0, discriminant)
    q = -half - sqrt(discriminant) if half > 0.0 else -half + sqrt(discriminant)
    count = ZERO
    for which in range(2):
        if which == 1 and (q == 0.0 or discriminant == 0.0):
            break
        s = q / quadratic if which == 0 else constant / q
        d1, d2 = base1 + s * rise2, base2 + s * rise1
        if d1 > 0.0 and d2 > 0.0:
            f0, f1, f2 = d2 * b20 - d1 * b10, d2 * b21 - d1 * b11, d2 * b22 - d1 * b12
            if _upright_rotation((e0, e1, e2), (f0, f1, f2), (u0, u1, u2), (w0, w1, w2),
                                 rotations, count):
                for row in range(3):
                    translations[count, row] = d1 * bearings[0, row] - (
                        rotations[count, row, 0] * points[0, 0]
                        + rotations[count, row, 1] * points[0, 1]
                        + rotations[count, row, 2] * points[0, 2])
                count += 1
    return count


@compiled
def _upright_rotation(e, f, u, w, rotations, which):
    """Write the rotation that maps the vertical w to u, and e to f, which have equal heights."""
    e0, e1, e2 = e
    f0, f1, f2 = f
    u0, u1, u2 = u
    w0, w1, w2 = w
    # a and g are the level parts of e and f; c and h are up x level part
    height = e0 * w0 + e1 * w1 + e2 * w2
    a0, a1, a2 = e0 - height * w0, e1 - height * w1, e2 - height * w2
    length = sqrt(a0 * a0 + a1 * a1 + a2 * a2)
    a0, a1, a2 = a0 / length, a1 / length, a2 / length
    c0, c1, c2 = w1 * a2 - w2 * a1, w2 * a0 - w0 * a2, w0 * a1 - w1 * a0
    height = f0 * u0 + f1 * u1 + f2 * u2
    g0, g1, g2 = f0 - height * u0, f1 - height * u1, f2 - height * u2
    length = sqrt(g0 * g0 + g1 * g1 + g2 * g2)
    if not length > 0.0:
        return False
    g0, g1, g2 = g0 / length, g1 / length, g2 / length
    h0, h1, h2 = u1 * g2 - u2 * g1, u2 * g0 - u0 * g2, u0 * g1 - u1 * g0
    rotations[which, 0, 0] = g0 * a0 + h0 * c0 + u0 * w0
    rotations[which, 0, 1] = g0 * a1 + h0 * c1 + u0 * w1
    rotations[which, 0, 2] = g0 * a2 + h0 * c2 + u0 * w2
    rotations[which, 1, 0] = g1 * a0 + h1 * c0 + u1 * w0
    rotations[which, 1, 1] = g1 * a1 + h1 * c1 + u1 * w1
    rotations[which, 1, 2] = g1 * a2 + h1 * c2 + u1 * w2
    rotations[which, 2, 0] = g2 * a0 + h2 * c0 + u2 * w0
    rotations[which, 2, 1] = g2 * a1 + h2 * c1 + u2 * w1
    rotations[which, 2, 2] = g2 * a2 + h2 * c2 + u2 * w2
    return True
