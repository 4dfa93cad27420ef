# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Landmarks from measured depth: one box is enough for a hypothesis, without parallax.

Depth is measured to the surface in the middle of a box. The centre of the object lies deeper, by
about half of the object's extent, which its box tells. This is uncertain by as much, so depth only
begins the fit and keeps it from sliding along the rays where parallax is small.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.errors import MappingError
from cliploc_ros.mapping.landmarks import Landmarks, group_boxes
from cliploc_ros.mapping.options import MappingOptions
from cliploc_ros.mapping.posed_detections import PosedDetections
from cliploc_ros.mapping.views import Views, with_depths

# How far the centre lies behind the surface, in radii that the box suggests, and the standard
# deviation of this share. Guesses: 1 for a ball, 0 for a picture on a wall.
_CENTER_SHARE, _CENTER_SIGMA = 0.6, 0.5
# Error of the measured depth itself, as a share of it.
_DEPTH_SIGMA = 0.05
# Landmarks with this much parallax tell the scale of depth without it.
_LEAST_BASELINE_DEG = 20.0
_LEAST_LANDMARKS = 3
# A scale this far from 1 is a wrong unit, not an error of calibration.
_UNIT_FACTOR = 1.6
# A smaller error of scale is below what this estimate can tell.
_LEAST_CORRECTION = 0.02

# With depth a landmark may deviate this much [m]: along the rays, which its boxes hardly show.
# Chosen on the kitchen's frames, where .05 m leaves out a sixth of the explained boxes.
_MAX_POSITION_SIGMA_M = 0.1


def options_with_depth(options: MappingOptions) -> MappingOptions:
    """Return options for boxes with depth: the deviation of a position replaces parallax."""
    return replace(options, min_baseline_deg=0.0, max_position_sigma_m=max(
        options.max_position_sigma_m, _MAX_POSITION_SIGMA_M))


def add_depths(views: Views, detections: PosedDetections, scale: float = 1.0) -> Views:
    """Return views that know how deep the centre of each box's object lies.

    Parameters
    ----------
    views : Views
    detections : PosedDetections
        The same boxes. Without depth the views stay as they are.
    scale : float
        True depth divided by measured depth.
    """
    if detections.depths is None:
        return views
    surfaces = scale * detections.depths.astype(np.float64)
    spreads = (np.zeros_like(surfaces) if detections.depth_spreads is None
               else scale * detections.depth_spreads)
    radii = box_radii(views, np.arange(len(surfaces)))
    # the half extent of a box at the centre's depth, which lies deeper by a share of it
    centers = surfaces / np.maximum(0.2, 1.0 - _CENTER_SHARE * radii)
    sigmas = np.sqrt(np.square(_DEPTH_SIGMA * centers) + np.square(spreads)
                     + np.square(_CENTER_SIGMA * radii * centers))
    known = np.isfinite(centers) & np.isfinite(sigmas)
    return with_depths(views, np.where(known, centers, 0.0),
                       np.where(known, 1.0 / np.where(known, sigmas, 1.0), 0.0))


def box_radii(views: Views, rows: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the half extents (m,) of boxes on the plane z = 1, geometric means of both."""
    extents = views.edges[rows, 2:] - views.edges[rows, :2]
    return np.asarray(0.5 * np.sqrt(np.prod(np.maximum(extents, 0.0), axis=1)))


def depth_hypotheses(views: Views, rows: NDArray[np.int64]
                     ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return centres (h, 3) and bases (h, 3, 3) of spheres where depth says that objects are."""
    rows = rows[views.depth_stiffness[rows] > 0.0]
    edges, depths, frames = views.edges[rows], views.depths[rows], views.frames[rows]
    points = np.concatenate([0.5 * (edges[:, :2] + edges[:, 2:]), np.ones((len(rows), 1))], axis=1)
    in_camera = points * depths[:, None]
    centers = np.einsum('fji,fj->fi', views.rotations[frames],
                        in_camera - views.translations[frames])
    radii = np.maximum(box_radii(views, rows), 1e-3) * depths
    return centers, radii[:, None, None] * np.eye(3)


def depth_scale(views: Views, landmarks: Landmarks, shown: NDArray[np.int64],
                baselines_deg: NDArray[np.float64]) -> float | None:
    """Return true depth divided by measured depth, by landmarks that need no depth.

    Parameters
    ----------
    views : Views
    landmarks : Landmarks
        Fitted to boxes only.
    shown : ndarray (n,) of int
        The landmark that each box shows, -1 for none.
    baselines_deg : ndarray (L,)
        Of the landmarks.

    Returns
    -------
    float or None
        None where too few landmarks tell.
    """
    ratios = []
    for number, rows in enumerate(group_boxes(shown, len(landmarks.centers))):
        rows = rows[views.depth_stiffness[rows] > 0.0]
        if len(rows) == 0 or baselines_deg[number] < _LEAST_BASELINE_DEG:
            continue
        frames = views.frames[rows]
        depths = (views.rotations[frames, 2] @ landmarks.centers[number]
                  + views.translations[frames, 2])
        ratios.append(float(np.median(depths / views.depths[rows])))
    return float(np.median(ratios)) if len(ratios) >= _LEAST_LANDMARKS else None


def correct_scale(views: Views, detections: PosedDetections, scale: float | None
                  ) -> tuple[Views, list[str]]:
    """Return the views with depth of the right scale, and notes.

    Raises
    ------
    MappingError
        The scale is so far off that depth must have another unit.
    """
    if scale is None or abs(scale - 1.0) < _LEAST_CORRECTION:
        return views, []
    if not 1.0 / _UNIT_FACTOR < scale < _UNIT_FACTOR:
        raise MappingError(
            f'measured depth is {1.0 / scale:.3g} times what boxes and poses say: wrong unit? '
            f'multiply --depth-unit by {scale:.3g}, check the poses are in metres, or leave '
            'depth out')
    note = (f'measured depth is {1.0 / scale:.3f} times what boxes and poses say; it is corrected '
            'by that')
    return add_depths(views, detections, scale), [note]
