# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bring the recording's poses into the coordinate frame of the old map.

The recording may have a coordinate frame of its own, a little off, and its poses may have errors:
they may come from the relocalizer. The landmarks that are still in their places tell both.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from cliploc_ros.mapping.joint import Anchors, pose_errors, refine_jointly
from cliploc_ros.mapping.updating.known import Known, Refits, find_known, refit
from cliploc_ros.mapping.updating.options import UpdateOptions
from cliploc_ros.mapping.views import Views, camera_from_map, map_from_cameras

_ROUNDS = 4
# The first association tolerates an offset.
_LOOSE_IOU = 0.1
# How large an offset may be: the deviations of a weak prior. Guesses.
_OFFSET_SIGMA_M, _OFFSET_SIGMA_DEG = 0.5, 5.0
# Objects that were nudged by this much do not disturb it [m]. A guess.
_NUDGE_M = 0.02
_SETTLED_M = 1e-3
_LOSS_SCALE = 2.0
# The median length of a normal vector of three numbers, and the square that one of six exceeds
# once in a thousand times: a smaller offset is none.
_MEDIAN_LENGTH, _SIGNIFICANT = 1.54, 22.5


class Alignment(NamedTuple):
    """The recording in the coordinate frame of the map."""

    views: Views
    #: How far the recording's coordinate frame was off, in the middle of the landmarks
    offset_m: float
    offset_deg: float
    #: Root mean square by which the poses were refined after that
    change_m: float
    change_deg: float


def align(given: Views, known: Known, options: UpdateOptions) -> Alignment:
    """Return the views with poses in the coordinate frame of the old map."""
    views, total = given, np.eye(4)
    for number in range(_ROUNDS):
        min_iou = options.mapping.association_iou if number else _LOOSE_IOU
        found = refit(views, known.landmarks, find_known(views, known, min_iou),
                      options.mapping.min_viewpoints)
        if np.count_nonzero(found.is_known) < options.min_confirmed:
            break
        step = _offset(known, found)
        rotations, translations = camera_from_map(step @ map_from_cameras(views))
        moved = views._replace(rotations=rotations, translations=translations)
        views, total = moved, step @ total
        middle = known.landmarks.centers[found.is_known].mean(axis=0)
        if np.linalg.norm(step[:3, :3] @ middle + step[:3, 3] - middle) < _SETTLED_M:
            break
    middle = known.landmarks.centers.mean(axis=0)
    offset_m = float(np.linalg.norm(total[:3, :3].T @ (middle - total[:3, 3]) - middle))
    offset_deg = float(np.degrees(Rotation.from_matrix(total[:3, :3]).magnitude()))
    refined = views if options.mapping.pose_errors is None else _refine(views, known, options)
    changes = np.square(pose_errors(views, refined))
    return Alignment(refined, offset_m, offset_deg,
                     float(np.sqrt(changes[:, :3].sum(axis=1).mean())),
                     float(np.degrees(np.sqrt(changes[:, 3:].sum(axis=1).mean()))))


def _offset(known: Known, refits: Refits) -> NDArray[np.float64]:
    """Return map_from_recording (4, 4): the rigid motion of fitted landmarks onto old ones."""
    rows = refits.is_known
    fitted, old = refits.landmarks.centers[rows], known.landmarks.centers[rows]
    middle = fitted.mean(axis=0)
    own = np.square(known.sigmas[rows]) + _NUDGE_M ** 2
    whiten = np.linalg.inv(np.linalg.cholesky(
        refits.covariances[rows] + own[:, None, None] * np.eye(3)))
    scales = np.repeat([_OFFSET_SIGMA_M, np.radians(_OFFSET_SIGMA_DEG)], 3)

    def residuals(motion: NDArray[np.float64]) -> NDArray[np.float64]:
        turned = Rotation.from_rotvec(motion[3:]).apply(fitted - middle) + middle + motion[:3]
        # the loss sees one number for each landmark, so that it leaves out those that moved
        lengths = np.linalg.norm(np.einsum('lij,lj->li', whiten, turned - old), axis=1)
        return np.concatenate([lengths, motion / scales])

    found = least_squares(residuals, np.zeros(6), loss='cauchy', f_scale=_LOSS_SCALE)
    lengths, step = found.fun[:-6], np.eye(4)
    # positions err more than their deviations say: objects are no ellipsoids
    inflation = max(1.0, float(np.median(lengths)) / _MEDIAN_LENGTH)
    if float(found.x @ (found.jac.T @ found.jac) @ found.x) < _SIGNIFICANT * inflation ** 2:
        return step
    motion = found.x
    step[:3, :3] = Rotation.from_rotvec(motion[3:]).as_matrix()
    step[:3, 3] = middle + motion[:3] - step[:3, :3] @ middle
    return step


def _refine(aligned: Views, known: Known, options: UpdateOptions) -> Views:
    """Return the views with poses refined against the old landmarks that are in their place."""
    assert options.mapping.pose_errors is not None
    views, min_iou = aligned, options.mapping.association_iou
    anchors = Anchors(known.landmarks.centers, known.sigmas)
    for _ in range(options.mapping.refinements):
        shown = find_known(views, known, min_iou)
        found = refit(views, known.landmarks, shown, options.mapping.min_viewpoints)
        away = has_moved(known, found, options)
        shown[np.isin(shown, np.nonzero(away)[0])] = -1
        if not (shown >= 0).any():
            return views
        views, _ = refine_jointly(aligned, views, known.landmarks, shown,
                                  options.mapping.pose_errors, anchors=anchors)
    return views


def has_moved(known: Known, found: Refits, options: UpdateOptions) -> NDArray[np.bool_]:
    """Tell which landmarks (L,) the recording puts so far away that they must have moved."""
    offsets = found.landmarks.centers - known.landmarks.centers
    far = found.is_known & (np.linalg.norm(offsets, axis=1) > options.least_move_m)
    rows = np.nonzero(far)[0]
    bases, others = known.landmarks.bases[rows], found.landmarks.bases[rows]
    shapes = bases @ bases.transpose(0, 2, 1) + others @ others.transpose(0, 2, 1)
    far[rows] = ((_lengths(offsets[rows], shapes) > options.least_move_shapes)
                 & (deviations(known, found, rows) > options.least_move_sigmas))
    return far


def deviations(known: Known, found: Refits, rows: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return by how many standard deviations (k,) old and new positions of landmarks differ."""
    offsets = found.landmarks.centers[rows] - known.landmarks.centers[rows]
    covariances = (found.covariances[rows]
                   + np.square(known.sigmas[rows])[:, None, None] * np.eye(3))
    return _lengths(offsets, covariances)


def _lengths(offsets: NDArray[np.float64], shapes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the lengths (k,) of offsets (k, 3) in units of shape matrices (k, 3, 3)."""
    return np.asarray(np.sqrt(np.einsum(
        'li,li->l', offsets, np.linalg.solve(shapes, offsets[..., None])[..., 0])))
