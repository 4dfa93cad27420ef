# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A landmark from boxes that a person drew in two or more images."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.mapping.evidence import widest_angle_deg
from cliploc_ros.mapping.fitting import Fit, fit_ellipsoid
from cliploc_ros.mapping.options import MappingOptions
from cliploc_ros.mapping.posed_detections import PosedDetections
from cliploc_ros.mapping.views import Views, camera_centers, make_views
from cliploc_ros.studio.changes import EditError

#: Views nearer to one another leave the distance of the object open.
LEAST_ANGLE_DEG = 25.0
_MIN_BOX_PX = 4.0
_STRETCH = 2.0


class DrawnBox(NamedTuple):
    """A box in an image whose pose is known.

    Parameters
    ----------
    map_from_camera : ndarray (4, 4)
    bbox_xyxy : tuple of float
        Left, top, right, bottom [px], undistorted.
    """

    map_from_camera: NDArray[np.float64]
    bbox_xyxy: tuple[float, float, float, float]


class BoxFit(NamedTuple):
    """An ellipsoid that fits drawn boxes.

    Parameters
    ----------
    center, basis : ndarray (3,), (3, 3)
        The basis' columns are the semi-axes [m].
    angle_deg : float
        The widest angle between two views, seen from the landmark [deg].
    warning : str
        What is doubtful about it; empty if nothing is.
    """

    center: NDArray[np.float64]
    basis: NDArray[np.float64]
    angle_deg: float
    warning: str


def fit_boxes(camera: Camera, boxes: Sequence[DrawnBox]) -> BoxFit:
    """Return the ellipsoid that fits boxes of one object.

    Raises
    ------
    EditError
        There are fewer than two boxes, one is too small, or their rays do not meet in front of
        the cameras.
    """
    if len(boxes) < 2:
        raise EditError(f'create: {len(boxes)} boxes drawn; draw one in each of two images or '
                        'more, best three')
    for box in boxes:
        left, top, right, bottom = box.bbox_xyxy
        if not (right - left >= _MIN_BOX_PX and bottom - top >= _MIN_BOX_PX):
            raise EditError(f'create: the box {box.bbox_xyxy} is smaller than {_MIN_BOX_PX:g} '
                            'pixels; draw it around the whole object')
    views = _views_of(camera, boxes)
    center, radius = _meeting_point(views)
    rows = np.arange(len(boxes))
    fits = [fit_ellipsoid(views, rows, center, start) for start in _starts(radius)]
    best = min(fits, key=lambda fit: fit.cost)
    return _judge(views, best)


def _views_of(camera: Camera, boxes: Sequence[DrawnBox]) -> Views:
    count = len(boxes)
    views = make_views(PosedDetections(
        camera=camera, map_from_camera=np.array([box.map_from_camera for box in boxes]),
        stamps_s=np.arange(count, dtype=np.float64), frame_offsets=np.arange(count + 1),
        bboxes_xyxy=np.array([box.bbox_xyxy for box in boxes], dtype=np.float64),
        class_names=('drawn',), classes=np.zeros(count, dtype=np.int64),
        scores=np.ones(count)), MappingOptions())
    # each box was drawn for itself: none shares the error of a detector that stood still
    return views._replace(weights=np.ones(count))


def _meeting_point(views: Views) -> tuple[NDArray[np.float64], float]:
    """Return the point nearest to the rays of all boxes' centres, and the radius they suggest."""
    origins = camera_centers(views, np.arange(len(views.frames)))
    middles = 0.5 * (views.edges[:, :2] + views.edges[:, 2:])
    rays = np.column_stack([middles, np.ones(len(middles))])
    rays = np.einsum('fji,fj->fi', views.rotations, rays)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    try:
        point = np.linalg.solve(across.sum(axis=0), np.einsum('fij,fj->i', across, origins))
    except np.linalg.LinAlgError:
        raise EditError('create: the views look along one line; draw a box in a view from '
                        'another side') from None
    depths = np.einsum('fij,j->fi', views.rotations, point)[:, 2] + views.translations[:, 2]
    if not depths.min() > 0.05:
        raise EditError('create: the boxes do not show one object: their rays meet behind a '
                        'camera; draw the same object in all views')
    extents = views.edges[:, 2:] - views.edges[:, :2]
    return point, float(np.median(0.5 * np.sqrt(extents.prod(axis=1)) * depths))


def _starts(radius: float) -> list[NDArray[np.float64]]:
    """Return bases to start from: a sphere, and one stretched along each axis of the map."""
    sphere = radius * np.eye(3)
    return [sphere, *(sphere * np.where(np.arange(3) == axis, _STRETCH, 1.0 / np.sqrt(_STRETCH))
                      for axis in range(3)),
            Rotation.from_euler('z', 45, degrees=True).as_matrix()
            @ (sphere * (_STRETCH, 1.0 / _STRETCH, 1.0))]


def _judge(views: Views, fit: Fit) -> BoxFit:
    offsets = fit.center - camera_centers(views, np.arange(len(views.frames)))
    angle_deg = widest_angle_deg(offsets / np.linalg.norm(offsets, axis=1, keepdims=True))
    warning = ''
    if angle_deg < LEAST_ANGLE_DEG:
        warning = (f'the views are only {angle_deg:.0f} degrees apart, expected '
                   f'{LEAST_ANGLE_DEG:.0f} or more: distance and depth are uncertain; draw a box '
                   'in a view from another side')
    return BoxFit(fit.center, fit.basis, angle_deg, warning)
