# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The pose of a camera from three points, or from two points if the vertical is known.

**Three points (P3P).** The depths d of the three points along their bearings solve three quadratic
equations ``di^2 + dj^2 - 2 di dj cos_ij = |Xi - Xj|^2``. Two homogeneous combinations of the
equations are conics in (d1 : d2 : d3). A degenerate member of their pencil is a pair of lines
(Persson and Nordberg, "Lambda Twist", ECCV 2018), split as in Ding et al., "Revisiting the P3P
Problem", CVPR 2023. Each line meets a conic in up to two points, so there are up to four poses.
The depths are then refined with Newton's method on the three equations.

**Two points.** If the vertical is known, the rotation about it and the translation are unknown. In
coordinate frames with the third axis up, camera and map differ by a yaw: ``d2 b2 - d1 b1 = Rz(yaw)
D`` with ``D = X2 - X1`` and depths d along the bearings b. The third row and the length do not
depend on the yaw:

    d2 b2z - d1 b1z = Dz   and   |d2 b2 - d1 b1|^2 = |D|^2.

These are a line and a conic, which share up to two points. Yaw and translation follow from the
depths (after Kukelova, Bujnak and Pajdla, "Closed-form Solutions to Minimal Absolute Pose Problems
with Known Vertical Direction", ACCV 2010).
"""

from math import acos, copysign, cos, sqrt

import numpy as np

from cliploc_ros.core.kernels.compiled import ZERO, compiled

_DOUBLE_ROOT = 1e-12
_ROUNDING = 4e-16
MAX_SOLUTIONS = 4
_NEWTON_STEPS = 3
# Triangles are degenerate if their normalized cross product is below this. The same limit applies
# to baselines that are nearly vertical, and to bearings that are nearly level.
_MIN_SINE = 1e-9
# Tolerance for a double root of the quadratic, which rounding may make complex.
_DOUBLE_ROUNDING = 1e-12


@compiled
def largest_cubic_root(c2: float, c1: float, c0: float) -> float:
    """Return the largest real root of x^3 + c2 x^2 + c1 x + c0.

    It is computed in closed form, by Viete for three real roots and by Cardano for one, and then
    refined by two Newton steps.
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
        # Compute the cube root of larger magnitude; the other one follows without cancellation.
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


@compiled
def p3p(bearings, points, rotations, translations):
    """Write the poses at which three points have the given bearings.

    Parameters
    ----------
    bearings, points : ndarray (3, 3)
        Unit vectors in the camera's optical frame, and points in the map frame [m], one per row.
    rotations, translations : ndarray (4, 3, 3), (4, 3)
        Rotations and translations of camera_from_map [m]. All points lie in front of the camera.

    Returns
    -------
    int
        Number of poses, 0 to 4.
    """
    b1, b2, b3 = _row(bearings, 0), _row(bearings, 1), _row(bearings, 2)
    m12, m13, m23 = _dot(b1, b2), _dot(b1, b3), _dot(b2, b3)
    x1, x2, x3 = _row(points, 0), _row(points, 1), _row(points, 2)
    e12, e13, e23 = _minus(x1, x2), _minus(x1, x3), _minus(x2, x3)
    a12, a13, a23 = _dot(e12, e12), _dot(e13, e13), _dot(e23, e23)
    longest = max(a12, a13, a23)
    if not min(a12, a13, a23) > _MIN_SINE * _MIN_SINE * longest:
        return 0
    # lengths in units of the longest side, so that all thresholds below are relative
    scale = sqrt(longest)
    a12, a13, a23 = a12 / longest, a13 / longest, a23 / longest

    # the two conics, as upper triangles (d1d1, d1d2, d1d3, d2d2, d2d3, d3d3)
    first = (a23, -a23 * m12, 0.0, a23 - a12, a12 * m23, -a12)
    second = (a23, 0.0, -a23 * m13, -a13, a13 * m23, a23 - a13)
    line1, line2, real = _degenerate_lines(first, second)
    if not real:
        return 0

    frame, sound = _inverse_triangle_frame(points)
    if not sound:
        return 0
    count = ZERO
    for line in (line1, line2):
        roots, depths_a, depths_b = _meet_line_and_conic(line, first)
        for which in range(roots):
            d1, d2, d3 = depths_a if which == 0 else depths_b
            norm = d2 * d2 + d3 * d3 - 2.0 * d2 * d3 * m23
            if not (d1 > 0.0 and d2 > 0.0 and d3 > 0.0 and norm > 0.0):
                continue
            unit = sqrt(a23 / norm)
            d1, d2, d3 = _polish(d1 * unit, d2 * unit, d3 * unit, m12, m13, m23, a12, a13, a23)
            if not (d1 > 0.0 and d2 > 0.0 and d3 > 0.0):
                continue
            _pose_from_depths(d1 * scale, d2 * scale, d3 * scale, bearings, points, frame,
                              rotations, translations, count)
            count += 1
    return count


@compiled
def _row(rows, i):
    """Return a row of an array (n, 3) as a vector: a tuple of three numbers."""
    return rows[i, 0], rows[i, 1], rows[i, 2]


@compiled
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compiled
def _minus(a, b):
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@compiled
def _times(s, a):
    return s * a[0], s * a[1], s * a[2]


@compiled
def _cofactors(c):
    """Return the adjugate of a symmetric matrix; both are given as upper triangles."""
    xx, xy, xz, yy, yz, zz = c
    return (yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy,
            xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy)


@compiled
def _degenerate_lines(first, second):
    """Split a degenerate conic of the pencil into two lines, and return whether they are real."""
    # these are the coefficients of the cubic det(first + g second) in g (mixed determinants)
    adj1, adj2 = _cofactors(first), _cofactors(second)
    det1 = first[0] * adj1[0] + first[1] * adj1[1] + first[2] * adj1[2]
    det2 = second[0] * adj2[0] + second[1] * adj2[1] + second[2] * adj2[2]
    mixed1 = (adj1[0] * second[0] + adj1[3] * second[3] + adj1[5] * second[5]
              + 2.0 * (adj1[1] * second[1] + adj1[2] * second[2] + adj1[4] * second[4]))
    mixed2 = (adj2[0] * first[0] + adj2[3] * first[3] + adj2[5] * first[5]
              + 2.0 * (adj2[1] * first[1] + adj2[2] * first[2] + adj2[4] * first[4]))
    nowhere = (0.0, 0.0, 0.0)
    # Divide by the larger of the two end coefficients, so that the root, g or 1 / g, is finite.
    if abs(det2) >= abs(det1):
        if det2 == 0.0:
            return nowhere, nowhere, False
        w1, w2 = 1.0, largest_cubic_root(mixed2 / det2, mixed1 / det2, det1 / det2)
    else:
        w1, w2 = largest_cubic_root(mixed1 / det1, mixed2 / det1, det2 / det1), 1.0
    conic = (w1 * first[0] + w2 * second[0], w1 * first[1] + w2 * second[1],
             w1 * first[2] + w2 * second[2], w1 * first[3] + w2 * second[3],
             w1 * first[4] + w2 * second[4], w1 * first[5] + w2 * second[5])
    return _split_lines(conic)


@compiled
def _split_lines(c):
    """Return the two lines of a rank-two conic, and whether they are real.

    If p is the common point of the lines, [p]x + conic is the rank-one matrix l m^T of the lines.
    """
    adj = _cofactors(c)
    if adj[0] <= adj[3] and adj[0] <= adj[5]:
        px, py, pz = adj[0], adj[1], adj[2]
        pivot = adj[0]
    elif adj[3] <= adj[5]:
        px, py, pz = adj[1], adj[3], adj[4]
        pivot = adj[3]
    else:
        px, py, pz = adj[2], adj[4], adj[5]
        pivot = adj[5]
    if not pivot < 0.0:
        return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), False
    root = sqrt(-pivot)
    px, py, pz = px / root, py / root, pz / root
    xx, xy, xz, yy, yz, zz = c
    # the rank-one matrix l m^T, row by row
    r0 = (xx, xy - pz, xz + py)
    r1 = (xy + pz, yy, yz - px)
    r2 = (xz - py, yz + px, zz)
    columns = ((r0[0], r1[0], r2[0]), (r0[1], r1[1], r2[1]), (r0[2], r1[2], r2[2]))
    return _longest(r0, r1, r2), _longest(columns[0], columns[1], columns[2]), True


@compiled
def _longest(a, b, c):
    na, nb, nc = _dot(a, a), _dot(b, b), _dot(c, c)
    if na >= nb and na >= nc:
        return a
    return b if nb >= nc else c


@compiled
def _meet_line_and_conic(line, c):
    """Return the number (0 or 2) of common points of a line and a conic, and the points."""
    lx, ly, lz = line
    # two points that span the line, far from parallel
    if abs(lx) >= abs(ly) and abs(lx) >= abs(lz):
        u, v = (-ly, lx, 0.0), (-lz, 0.0, lx)
    elif abs(ly) >= abs(lz):
        u, v = (ly, -lx, 0.0), (0.0, -lz, ly)
    else:
        u, v = (lz, 0.0, -lx), (0.0, lz, -ly)
    quadratic, half, constant = _bilinear(c, u, u), _bilinear(c, u, v), _bilinear(c, v, v)
    discriminant = half * half - quadratic * constant
    if discriminant < 0.0:
        # A double root that rounding made complex is still a solution.
        if discriminant < -1e-12 * (half * half + abs(quadratic * constant)):
            return 0, u, v
        discriminant = 0.0
    q = -half - sqrt(discriminant) if half > 0.0 else -half + sqrt(discriminant)
    # roots q / quadratic and constant / q, homogeneous
    first = _combine(q, u, quadratic, v)
    second = _combine(constant, u, q, v)
    return 2, first, second


@compiled
def _bilinear(c, u, v):
    return (c[0] * u[0] * v[0] + c[3] * u[1] * v[1] + c[5] * u[2] * v[2]
            + c[1] * (u[0] * v[1] + u[1] * v[0]) + c[2] * (u[0] * v[2] + u[2] * v[0])
            + c[4] * (u[1] * v[2] + u[2] * v[1]))


@compiled
def _combine(s, u, t, v):
    """Return s u + t v, with its sign chosen so that the sum of its components is positive."""
    x, y, z = s * u[0] + t * v[0], s * u[1] + t * v[1], s * u[2] + t * v[2]
    if x + y + z < 0.0:
        return -x, -y, -z
    return x, y, z


@compiled
def _polish(d1, d2, d3, m12, m13, m23, a12, a13, a23):
    """Refine the depths by Newton steps on the three distance equations."""
    for _ in range(_NEWTON_STEPS):
        r1 = d1 * d1 + d2 * d2 - 2.0 * d1 * d2 * m12 - a12
        r2 = d1 * d1 + d3 * d3 - 2.0 * d1 * d3 * m13 - a13
        r3 = d2 * d2 + d3 * d3 - 2.0 * d2 * d3 * m23 - a23
        if abs(r1) + abs(r2) + abs(r3) < 1e-15:
            break
        j11, j12 = d1 - d2 * m12, d2 - d1 * m12
        j21, j23 = d1 - d3 * m13, d3 - d1 * m13
        j32, j33 = d2 - d3 * m23, d3 - d2 * m23
        determinant = -2.0 * (j11 * j23 * j32 + j12 * j21 * j33)
        if determinant == 0.0:
            break
        d1 += (j23 * j32 * r1 + j12 * j33 * r2 - j12 * j23 * r3) / determinant
        d2 += (j21 * j33 * r1 - j11 * j33 * r2 + j11 * j23 * r3) / determinant
        d3 += (-j21 * j32 * r1 + j11 * j32 * r2 + j12 * j21 * r3) / determinant
    return d1, d2, d3


@compiled
def _inverse_triangle_frame(points):
    """Return the rows of the inverse of [X1-X2, X1-X3, their cross product].

    Also returns whether the inverse exists: it does not if the points lie on a line.
    """
    u, v = _minus(_row(points, 0), _row(points, 1)), _minus(_row(points, 0), _row(points, 2))
    w = _cross(u, v)
    square = _dot(w, w)
    sound = square > _MIN_SINE * _MIN_SINE * (_dot(u, u) * _dot(v, v))
    scale = 1.0 / square if sound else 0.0
    return (_times(scale, _cross(v, w)), _times(scale, _cross(w, u)), _times(scale, w)), sound


@compiled
def _pose_from_depths(d1, d2, d3, bearings, points, inverse, rotations, translations, which):
    """Write camera_from_map, whose rotation maps the triangle in the map to that in the camera."""
    first = _times(d1, _row(bearings, 0))
    u = _minus(first, _times(d2, _row(bearings, 1)))
    v = _minus(first, _times(d3, _row(bearings, 2)))
    w = _cross(u, v)
    i, j, k = inverse
    for row in range(3):
        for column in range(3):
            rotations[which, row, column] = (u[row] * i[column] + v[row] * j[column]
                                             + w[row] * k[column])
        translations[which, row] = first[row] - (rotations[which, row, 0] * points[0, 0]
                                                 + rotations[which, row, 1] * points[0, 1]
                                                 + rotations[which, row, 2] * points[0, 2])


@compiled
def two_point(bearings, points, verticals, rotations, translations):
    """Write the poses with a known vertical at which two points have the given bearings.

    Parameters
    ----------
    bearings, points : ndarray (2, 3)
        Unit vectors in the camera's optical frame, and points in the map frame [m], one per row.
    verticals : ndarray (6,) or more
        Unit vectors up, in the camera's optical frame and in the map frame.
    rotations, translations : ndarray (2, 3, 3), (2, 3)
        Rotations and translations of camera_from_map [m]. Both points lie in front of the camera.

    Returns
    -------
    int
        Number of poses, 0 to 2.
    """
    first, second = _row(bearings, 0), _row(bearings, 1)
    up_in_camera = verticals[0], verticals[1], verticals[2]
    up_in_map = verticals[3], verticals[4], verticals[5]
    baseline = _minus(_row(points, 1), _row(points, 0))
    square, height = _dot(baseline, baseline), _dot(baseline, up_in_map)
    if not square - height * height > _MIN_SINE * square:
        return 0  # one point is above the other, so the yaw is undetermined
    rise1, rise2 = _dot(first, up_in_camera), _dot(second, up_in_camera)
    cosine = _dot(first, second)
    # The line d2 rise2 - d1 rise1 = height is written as d = base + s direction, where base is its
    # point nearest to zero. The conic d1^2 + d2^2 - 2 d1 d2 cosine = square is quadratic in s.
    steepness = rise1 * rise1 + rise2 * rise2
    if not steepness > _MIN_SINE * _MIN_SINE:
        return 0  # both points are level with the camera, so the depths are undetermined
    base1, base2 = -rise1 * height / steepness, rise2 * height / steepness
    quadratic = steepness - 2.0 * rise1 * rise2 * cosine
    half = base1 * rise2 + base2 * rise1 - cosine * (base1 * rise1 + base2 * rise2)
    constant = base1 * base1 + base2 * base2 - 2.0 * base1 * base2 * cosine - square
    discriminant = half * half - quadratic * constant
    # A double root that rounding made complex is still a solution.
    if not (discriminant >= -_DOUBLE_ROUNDING * (half * half + abs(quadratic * constant))
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
        if d1 > 0.0 and d2 > 0.0 and _upright_rotation(
                baseline, _minus(_times(d2, second), _times(d1, first)), up_in_camera, up_in_map,
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
    """Write the rotation that maps w to u, and e to f; False if f is parallel to u.

    The unit vectors w and u point up in the map and in the camera. The components of e along w and
    of f along u are equal.
    """
    # a and g are the horizontal directions of e and f; c and h are up x a and up x g
    a = _horizontal(e, w)
    g = _horizontal(f, u)
    if not _dot(g, g) > 0.0:
        return False
    c, h = _cross(w, a), _cross(u, g)
    for row in range(3):
        for column in range(3):
            rotations[which, row, column] = (g[row] * a[column] + h[row] * c[column]
                                             + u[row] * w[column])
    return True


@compiled
def _horizontal(vector, up):
    """Return the horizontal direction of a vector, a unit vector; 0 if it is vertical."""
    x, y, z = _minus(vector, _times(_dot(vector, up), up))
    length = sqrt(x * x + y * y + z * z)
    if not length > 0.0:
        return 0.0, 0.0, 0.0
    return x / length, y / length, z / length
