# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Outlines of many landmarks at one pose: of given ones, and of those that the pose may see."""

from math import inf, sqrt

from cliploc_ros.core.association.culling import visible_members
from cliploc_ros.core.compiled import compiled


@compiled
def project(rotations, translations, which, landmarks, first, last, reach, outlines, out):
    """Write the outlines of landmarks first to last at one pose into rows from out on.

    As project_ellipsoid, in one loop without calls, which is several times faster; of ellipsoids
    that are not wholly in front, or deeper than reach times their radius, the half extents
    are minus infinity.
    """
    square = reach * reach
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
        if not (z > 0.0 and z * z <= landmarks[row, 9] * square):
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


@compiled
def project_groups(landmarks, groups, rotations, translations, which, seen, outlines, owners, out):
    """Project what a pose may see of the groups into rows from out on; return where they end."""
    members, reaches = groups.members, groups.reaches
    for place in range(visible_members(groups, rotations, translations, which, seen)):
        row, group = members[seen[0, place], 0], members[seen[0, place], 1]
        project(rotations, translations, which, landmarks, row, row + 1, reaches[group],
                outlines, out)
        if outlines[out, 2] > 0.0:
            owners[out] = group
            out += 1
    return out
