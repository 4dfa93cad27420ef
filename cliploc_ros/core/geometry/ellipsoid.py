# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Ellipsoids and their outlines in the image.

The outline of an ellipsoid is an ellipse. With the dual quadric Q* = [S + c c^T, c; c^T, 1] up to
sign, P Q* P^T is the dual conic of the outline (Rubino, Crocco and Del Bue, "3D Object
Localisation from Multi-view Image Detections", PAMI 2018).

A shape matrix S = R diag(a^2, b^2, c^2) R^T is stored as its upper triangle
(xx, xy, xz, yy, yz, zz). An ellipse is stored as its centre c and the upper triangle of E in
(x - c)^T E^-1 (x - c) <= 1.
"""

from math import inf, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.kernels.compiled import compiled

_UPPER = np.triu_indices(3)

_OUTLINE_POINTS = 64
#: Two ellipsoids whose centres are nearer than this, in units of their summed shapes, intersect
#: substantially. The distance is at most 1.41 for ellipsoids that touch, and 1 for a small
#: ellipsoid whose centre lies on the surface of a large one.
STANDS_IN = 1.0


def shape_matrices(semi_axes: NDArray[np.float64], quats_xyzw: NDArray[np.float64]
                   ) -> NDArray[np.float64]:
    """Return the shape matrices (n, 6) of ellipsoids as upper triangles [m^2].

    The arguments are their semi-axes (n, 3) [m] and the quaternions (n, 4) that rotate their axes
    to those of the map.
    """
    rotations = Rotation.from_quat(quats_xyzw).as_matrix().reshape(-1, 3, 3)
    shapes = np.einsum('nij,nj,nkj->nik', rotations, np.square(semi_axes), rotations)
    return np.ascontiguousarray(shapes[:, _UPPER[0], _UPPER[1]])


def normalized_lengths(offsets: NDArray[np.float64], shapes: NDArray[np.float64]
                       ) -> NDArray[np.float64]:
    """Return the lengths (n,) of offsets (n, 3) in units of shape matrices (n, 3, 3)."""
    return np.asarray(np.sqrt(np.einsum(
        'ni,ni->n', offsets, np.linalg.solve(shapes, offsets[..., None])[..., 0])))


@compiled
def project_ellipsoid(rotation, translation, center, shape):
    """Return the outline of an ellipsoid on the plane z = 1.

    Parameters
    ----------
    rotation, translation : ndarray (3, 3), (3,)
        Rotation and translation of camera_from_map.
    center, shape : ndarray (3,), (6,)
        Centre and shape of the ellipsoid in the map.

    Returns
    -------
    visible : bool
        Whether the ellipsoid lies completely in front of the camera. If not, the ellipse is 0.
    cx, cy, exx, exy, eyy : float
        The ellipse.
    """
    sxx, sxy, sxz, syy, syz, szz = shape
    r = rotation
    z = r[2, 0] * center[0] + r[2, 1] * center[1] + r[2, 2] * center[2] + translation[2]
    if not z > 0.0:
        return False, 0.0, 0.0, 0.0, 0.0, 0.0
    # S times the optical axis; its products with the rows of R are a row of R S R^T
    z0 = sxx * r[2, 0] + sxy * r[2, 1] + sxz * r[2, 2]
    z1 = sxy * r[2, 0] + syy * r[2, 1] + syz * r[2, 2]
    z2 = sxz * r[2, 0] + syz * r[2, 1] + szz * r[2, 2]
    weight = z * z - (r[2, 0] * z0 + r[2, 1] * z1 + r[2, 2] * z2)
    if not weight > 0.0:
        return False, 0.0, 0.0, 0.0, 0.0, 0.0
    x = r[0, 0] * center[0] + r[0, 1] * center[1] + r[0, 2] * center[2] + translation[0]
    y = r[1, 0] * center[0] + r[1, 1] * center[1] + r[1, 2] * center[2] + translation[1]
    x0 = sxx * r[0, 0] + sxy * r[0, 1] + sxz * r[0, 2]
    x1 = sxy * r[0, 0] + syy * r[0, 1] + syz * r[0, 2]
    x2 = sxz * r[0, 0] + syz * r[0, 1] + szz * r[0, 2]
    y0 = sxx * r[1, 0] + sxy * r[1, 1] + sxz * r[1, 2]
    y1 = sxy * r[1, 0] + syy * r[1, 1] + syz * r[1, 2]
    y2 = sxz * r[1, 0] + syz * r[1, 1] + szz * r[1, 2]
    cx = (x * z - (r[0, 0] * z0 + r[0, 1] * z1 + r[0, 2] * z2)) / weight
    cy = (y * z - (r[1, 0] * z0 + r[1, 1] * z1 + r[1, 2] * z2)) / weight
    exx = cx * cx + (r[0, 0] * x0 + r[0, 1] * x1 + r[0, 2] * x2 - x * x) / weight
    exy = cx * cy + (r[0, 0] * y0 + r[0, 1] * y1 + r[0, 2] * y2 - x * y) / weight
    eyy = cy * cy + (r[1, 0] * y0 + r[1, 1] * y1 + r[1, 2] * y2 - y * y) / weight
    if not (exx > 0.0 and eyy > 0.0):
        return False, 0.0, 0.0, 0.0, 0.0, 0.0
    return True, cx, cy, exx, exy, eyy


@compiled
def _project_all(rotation, translation, centers, shapes, ellipses):
    for i in range(centers.shape[0]):
        visible, cx, cy, exx, exy, eyy = project_ellipsoid(rotation, translation, centers[i],
                                                           shapes[i])
        ellipses[i, 0], ellipses[i, 1] = cx, cy
        ellipses[i, 2], ellipses[i, 3], ellipses[i, 4] = exx, exy, eyy
        if not visible:
            ellipses[i, :] = np.nan


def project_ellipsoids(camera_from_map: NDArray[np.float64], centers: NDArray[np.float64],
                       shapes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the outlines (n, 5) of ellipsoids on the plane z = 1: cx, cy, exx, exy, eyy.

    Parameters
    ----------
    camera_from_map : ndarray (4, 4)
        Pose of the map in the camera's optical frame.
    centers, shapes : ndarray (n, 3), (n, 6)
        Centres and shapes of the ellipsoids in the map. Outlines of ellipsoids that are not
        completely in front of the camera are NaN.
    """
    ellipses = np.empty((len(centers), 5))
    _project_all(np.ascontiguousarray(camera_from_map[:3, :3]),
                 np.ascontiguousarray(camera_from_map[:3, 3]),
                 np.ascontiguousarray(centers), np.ascontiguousarray(shapes), ellipses)
    return ellipses


def ellipse_bboxes(ellipses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the bounding boxes x, y, x, y (n, 4) of ellipses (n, 5)."""
    half = np.sqrt(ellipses[:, [2, 4]])
    return np.concatenate([ellipses[:, :2] - half, ellipses[:, :2] + half], axis=1)


def shared_areas(boxes: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the areas (n, m) that boxes (n, 4) share with other boxes (m, 4)."""
    low = np.maximum(boxes[:, None, :2], others[:, :2])
    high = np.minimum(boxes[:, None, 2:], others[:, 2:])
    return np.asarray(np.maximum(high - low, 0.0).prod(axis=2))


def box_ious(boxes: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the IoU (n, m) of boxes (n, 4) with other boxes (m, 4); 0 for boxes without area."""
    shared = shared_areas(boxes, others)
    areas, of_others = (np.maximum(corners[:, 2:] - corners[:, :2], 0.0).prod(axis=1)
                        for corners in (boxes, others))
    return np.asarray(shared / np.maximum(areas[:, None] + of_others - shared, 1e-12))


def ellipses_in_pixels(ellipses: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
    """Convert ellipses (n, 5) on the plane z = 1 to ellipses in the undistorted image [px]."""
    fx, fy = camera.fx, camera.fy
    scaled = ellipses * (fx, fy, fx * fx, fx * fy, fy * fy)
    scaled[:, :2] += (camera.cx, camera.cy)
    return scaled


def outline_points(ellipse: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points (n, 2) on an ellipse cx, cy, exx, exy, eyy."""
    cx, cy, exx, exy, eyy = ellipse
    root = np.linalg.cholesky(np.array([[exx, exy], [exy, eyy]]))
    angles = np.linspace(0.0, 2.0 * np.pi, _OUTLINE_POINTS, endpoint=False)
    return np.asarray(np.stack([np.cos(angles), np.sin(angles)], axis=1) @ root.T + (cx, cy))


class Poses(NamedTuple):
    """Poses camera_from_map, as written by a minimal solver."""

    #: (p, 3, 3), (p, 3): rotations and translations [m]
    rotations: NDArray[np.float64]
    translations: NDArray[np.float64]


@compiled
def project(landmarks, first, last, poses, which, outlines, out):
    """Write the outlines of landmarks `first` to `last`, exclusive, into rows from `out` on.

    The formulas are those of project_ellipsoid, in one loop without function calls, which is
    several times faster.

    Parameters
    ----------
    landmarks : ndarray (u, 9)
        Centre and shape of each landmark.
    poses, which : Poses, int
        The poses, and the index of the pose to use.
    outlines : ndarray (o, 6)
        Centre x and y, half extents x and y, exy, and the product of the semi-axes. The half
        extents are minus infinity if an ellipsoid is not completely in front of the camera.
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
