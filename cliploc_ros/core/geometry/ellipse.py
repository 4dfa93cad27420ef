# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The exact overlap of two ellipses.

A conic pencil reduces the problem to one cubic. The plane is scaled so that the first ellipse is
the unit circle, and rotated so that the second ellipse is parallel to the axes:

    x^2 + y^2 = 1   and   a (x - h)^2 + b (y - k)^2 = 1,   a <= b.

Consider the conics (second) + lambda (first). At the largest root lambda in [-b, -a] of the
determinant, the conic is a pair of real lines, which connect the common points of both outlines in
pairs and do not cross inside them. Each line cuts a cap off both ellipses, and one cap lies inside
the other. The shared area is one whole ellipse minus the difference of the caps.
"""

from math import acos, copysign, pi, sqrt

from cliploc_ros.core.geometry.minimal_solvers import largest_cubic_root
from cliploc_ros.core.kernels.compiled import compiled

# Minimum relative difference of the squared semi-axes, because the pencil of two circles has no
# pair of finite lines. The relative change of the area is less than 1e-9.
_MIN_ELONGATION = 1e-9
# Margin of upper bounds, larger than the rounding errors of an IoU or a sum of IoUs.
_ROUNDING = 1e-9


@compiled
def _cap_area(distance: float) -> float:
    """Return the area that a line with signed distance from the centre cuts off the unit disc."""
    if distance >= 1.0:
        return 0.0
    if distance <= -1.0:
        return pi
    return acos(distance) - distance * sqrt(1.0 - distance * distance)


@compiled
def unit_circle_overlap(h: float, k: float, p: float, q: float) -> float:
    """Return the area shared by the unit disc and an ellipse parallel to the axes.

    Parameters
    ----------
    h, k : float
        Centre of the ellipse.
    p, q : float
        Semi-axes of the ellipse along x and y, p >= q > 0.
    """
    a = 1.0 / (p * p)
    b = max(1.0 / (q * q), a * (1.0 + _MIN_ELONGATION))
    c = a * h * h + b * k * k - 1.0
    # -det(second + lambda first), a monic cubic in lambda
    ah2, bk2 = a * a * h * h, b * b * k * k
    root = largest_cubic_root(a + b - c, a * b - (a + b) * c + ah2 + bk2, b * ah2 + a * bk2
                              - a * b * c)
    if root > -a:
        root = _root_between(a, b, c, ah2, bk2)
    root = min(-a, max(-b, root))
    # The pair of lines: (r y - s x + e1)(r y + s x + e2) = 0. Divide by the larger of r and s; the
    # other term follows from the product e1 e2 = c - lambda.
    s, r = sqrt(-a - root), sqrt(b + root)
    if r >= s:
        total = -2.0 * b * k / r
        difference = -copysign(sqrt(max(0.0, total * total - 4.0 * (c - root))), h)
    else:
        difference = -2.0 * a * h / s
        total = -copysign(sqrt(max(0.0, difference * difference + 4.0 * (c - root))), k)
    length = sqrt(b - a)
    s, r = s / length, r / length
    e1, e2 = 0.5 * (total + difference) / length, 0.5 * (total - difference) / length

    ellipse_area = pi * p * q
    cuts1, cuts2 = abs(e1) < 1.0, abs(e2) < 1.0
    if not (cuts1 or cuts2):
        # the outlines do not meet
        if ellipse_area < pi:
            return ellipse_area if h * h + k * k < 1.0 else 0.0
        return pi if a * h * h + b * k * k < 1.0 else 0.0
    # Outward means away from the other chord, whose midpoint on a line n.x + e = 0 is -e n. If
    # both lines coincide because the outlines touch twice, their outward sides are opposite.
    along = r * r - s * s
    side1, side2 = e1 - e2 * along, e2 - e1 * along
    sign1 = 1.0 if not cuts2 or side1 <= 0.0 else -1.0
    sign2 = 1.0 if not cuts1 or side2 < 0.0 or (side2 == 0.0 and along < 0.0) else -1.0
    # caps of the disc minus caps of the ellipse, one inside the other on each line
    surplus = 0.0
    width = sqrt(s * s * p * p + r * r * q * q)
    if cuts1:
        surplus += _cap_area(-sign1 * e1)
        surplus -= p * q * _cap_area(-sign1 * (r * k - s * h + e1) / width)
    if cuts2:
        surplus += _cap_area(-sign2 * e2)
        surplus -= p * q * _cap_area(-sign2 * (r * k + s * h + e2) / width)
    # If one ellipse touches the other from inside, the caps cancel: the smaller area is shared.
    shared = ellipse_area + surplus if surplus < 0.0 else pi - surplus
    return max(0.0, min(pi, ellipse_area, shared))


@compiled
def _root_between(a: float, b: float, c: float, ah2: float, bk2: float) -> float:
    """Return a root of the pencil's determinant in [-b, -a], where its sign changes."""
    low, high = -b, -a
    for _ in range(60):
        root = 0.5 * (low + high)
        value = (a + root) * (b + root) * (c - root) - (b + root) * ah2 - (a + root) * bk2
        if value > 0.0:
            low = root
        else:
            high = root
    return 0.5 * (low + high)


@compiled
def ellipse_iou(u: float, v: float, half_width: float, half_height: float,
                cx: float, cy: float, exx: float, exy: float, eyy: float) -> float:
    """Return the intersection over union of an axis-parallel ellipse and any other ellipse.

    Parameters
    ----------
    u, v, half_width, half_height : float
        Centre and semi-axes of the ellipse inscribed in a box.
    cx, cy, exx, exy, eyy : float
        The other ellipse: centre c, and the symmetric matrix E of (x - c)^T E^-1 (x - c) <= 1.

    Returns
    -------
    float
        0 to 1, exact to about 1e-9. Precision is lower if the outlines touch at one point to the
        last digit and cross at two others.
    """
    half_x, half_y = sqrt(exx), sqrt(eyy)
    if abs(cx - u) >= half_width + half_x or abs(cy - v) >= half_height + half_y:
        return 0.0
    # transform to the plane in which the first ellipse is the unit circle
    h, k = (cx - u) / half_width, (cy - v) / half_height
    fxx = exx / (half_width * half_width)
    fxy = exy / (half_width * half_height)
    fyy = eyy / (half_height * half_height)
    # principal axes of the second ellipse there
    mean, half_difference = 0.5 * (fxx + fyy), 0.5 * (fxx - fyy)
    deviation = sqrt(half_difference * half_difference + fxy * fxy)
    large = mean + deviation
    small = (fxx * fyy - fxy * fxy) / large
    if not small > 0.0:
        return 0.0
    cosine, sine = 1.0, 0.0
    if deviation > 0.0:
        cosine = sqrt(0.5 * (1.0 + abs(half_difference) / deviation))
        sine = 0.5 * fxy / (deviation * cosine)
        if half_difference < 0.0:
            cosine, sine = sine, cosine
            if cosine < 0.0:
                cosine, sine = -cosine, -sine
    p, q = sqrt(large), sqrt(small)
    shared = unit_circle_overlap(cosine * h + sine * k, cosine * k - sine * h, p, q)
    return shared / (pi + pi * p * q - shared)


@compiled
def iou_bound(u: float, v: float, half_width: float, half_height: float,
              cx: float, cy: float, half_x: float, half_y: float, axes: float) -> float:
    """Return an upper bound of ellipse_iou. It is much cheaper to compute.

    Parameters
    ----------
    u, v, half_width, half_height : float
        Centre and semi-axes of the ellipse inscribed in a box.
    cx, cy, half_x, half_y, axes : float
        Centre and half extents of the other ellipse, and the product of its semi-axes.
    """
    width = min(u + half_width, cx + half_x) - max(u - half_width, cx - half_x)
    height = min(v + half_height, cy + half_y) - max(v - half_height, cy - half_y)
    if not (width > 0.0 and height > 0.0):
        return 0.0
    # Areas in units of pi. The shared area lies in both ellipses and in the overlap of both boxes.
    box_axes = half_width * half_height
    shared = min(width * height * (1.0 / pi), min(axes, box_axes))
    return shared / (axes + box_axes - shared) + _ROUNDING
