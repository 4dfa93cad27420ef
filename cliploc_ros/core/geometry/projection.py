# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Outlines of many ellipsoids at one pose, for the search."""

from math import inf, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.p3p import MAX_SOLUTIONS
from cliploc_ros.core.kernels.compiled import compiled


class Poses(NamedTuple):
    """Poses camera_from_map, as a minimal solver writes them."""

    #: (p, 3, 3), (p, 3)
    rotations: NDArray[np.float64]
    translations: NDArray[np.float64]

    @staticmethod
    def allocate() -> 'Poses':
        """Return memory for the solutions of one minimal sample."""
        return Poses(np.empty((MAX_SOLUTIONS, 3, 3)), np.empty((MAX_SOLUTIONS, 3)))


@compiled
def project(landmarks, first, last, poses, which, outlines, out):
    """Write the outlines of landmarks first to last at one pose into rows from out on.

    The numbers are those of project_ellipsoid, in one loop without calls, which is several times
    faster.

    Parameters
    ----------
    landmarks : ndarray (u, 9)
        Centre and shape of each.
    outlines : ndarray (o, 6)
        Centre x and y, half extents x and y, exy, and the product of the semi-axes. The half
        extents are minus infinity where an ellipsoid is not wholly in front of the camera.
    """
    rotations, translations = poses.rotations, poses.translations
    r00, r01, r02 = rotations[which, 0, 0], rotations[which, 0, 1], rotations[which, 0, 2]
    r10, r11, r12 = rotations[which, 1, 0], rotations[which, 1, 1], rotations[which, 1, 2]
    r20, r21, r22 = rotations[which, 2, 0], rotations[which, 2, 1], rotations[which, 2, 2]
    t0, t1, t2 = translations[which, 0], translations[which, 1], translations[which, 2]
    for row in range(first, last):
        px, py, pz = landmarks[row, 0], landmarks[row, 1], landmarks[row, 2]
        sxx, sxy, sxz = landmarks[row, 3], landmarks[row, 4], landmarks[row, 5]
        syy, syz, szz = landmarks[row, 6], landmarks[row, 7], landmarks[row, 8]
        x = r00 * px + r01 * py + r02 * pz + t0
        y = r10 * px + r11 * py + r12 * pz + t1
        z = r20 * px + r21 * py + r22 * pz + t2
        outlines[out, 2] = outlines[out, 3] = -inf
        if not z > 0.0:
            out += 1
            continue
        x0 = sxx * r00 + sxy * r01 + sxz * r02
        x1 = sxy * r00 + syy * r01 + syz * r02
        x2 = sxz * r00 + syz * r01 + szz * r02
        y0 = sxx * r10 + sxy * r11 + sxz * r12
        y1 = sxy * r10 + syy * r11 + syz * r12
        y2 = sxz * r10 + syz * r11 + szz * r12
        z0 = sxx * r20 + sxy * r21 + sxz * r22
        z1 = sxy * r20 + syy * r21 + syz * r22
        z2 = sxz * r20 + syz * r21 + szz * r22
        weight = z * z - (r20 * z0 + r21 * z1 + r22 * z2)
        if not weight > 0.0:
            out += 1
            continue
        inverse = 1.0 / weight
        cx = (x * z - (r00 * z0 + r01 * z1 + r02 * z2)) * inverse
        cy = (y * z - (r10 * z0 + r11 * z1 + r12 * z2)) * inverse
        exx = cx * cx + (r00 * x0 + r01 * x1 + r02 * x2 - x * x) * inverse
        exy = cx * cy + (r00 * y0 + r01 * y1 + r02 * y2 - x * y) * inverse
        eyy = cy * cy + (r10 * y0 + r11 * y1 + r12 * y2 - y * y) * inverse
        if exx > 0.0 and eyy > 0.0:
            outlines[out, 0], outlines[out, 1] = cx, cy
            outlines[out, 2], outlines[out, 3] = sqrt(exx), sqrt(eyy)
            outlines[out, 4] = exy
            outlines[out, 5] = sqrt(max(0.0, exx * eyy - exy * exy))
        out += 1
