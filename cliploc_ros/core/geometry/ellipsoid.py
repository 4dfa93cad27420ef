# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Ellipsoids and their outlines in the image.

The outline of an ellipsoid is an ellipse. With the dual quadric Q* = [S + c c^T, c; c^T, 1] up to
sign, P Q* P^T is the outline's dual conic (Rubino, Crocco and Del Bue, "3D Object Localisation
from Multi-view Image Detections", PAMI 2018).

A shape matrix S = R diag(a^2, b^2, c^2) R^T is stored as its upper triangle
(xx, xy, xz, yy, yz, zz), an ellipse as its centre c and the upper triangle of E in
(x - c)^T E^-1 (x - c) <= 1.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.kernels.compiled import compiled

_UPPER = np.triu_indices(3)

_OUTLINE_POINTS = 64


def shape_matrices(semi_axes: NDArray[np.float64], quats_xyzw: NDArray[np.float64]
                   ) -> NDArray[np.float64]:
    """Return the shape matrices (n, 6) of ellipsoids as upper triangles.

    From their semi-axes (n, 3) [m] and the rotations (n, 4) from their axes into the map's.
    """
    rotations = Rotation.from_quat(quats_xyzw).as_matrix().reshape(-1, 3, 3)
    shapes = np.einsum('nij,nj,nkj->nik', rotations, np.square(semi_axes), rotations)
    return np.ascontiguousarray(shapes[:, _UPPER[0], _UPPER[1]])


@compiled
def project_ellipsoid(rotation, translation, center, shape):
    """Return the outline of an ellipsoid on the plane z = 1.

    Parameters
    ----------
    rotation, translation : ndarray (3, 3), (3,)
        Of camera_from_map.
    center, shape : ndarray (3,), (6,)
        Of the ellipsoid in the map.

    Returns
    -------
    visible : bool
        Whether the ellipsoid lies wholly in front of the camera; if not, the rest is 0.
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
        Of the ellipsoids in the map. Rows of those not wholly in front are NaN.
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


def ellipses_in_pixels(ellipses: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
    """Return ellipses (n, 5) of the plane z = 1 as ellipses of the undistorted image [px]."""
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
