# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bring the recording's poses into the coordinate frame of the old map.

The recording may have a slightly different coordinate frame, and its poses may have errors, as
they may come from the relocalizer. Both are estimated from the landmarks that are still in their
places.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.ellipsoid import normalized_lengths
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.offline.mapping import joint
from cliploc_ros.offline.mapping.association import ASSOCIATION_IOU, associate
from cliploc_ros.offline.mapping.building import REFINEMENTS
from cliploc_ros.offline.mapping.fitting import centre_covariance, fit_ellipsoid
from cliploc_ros.offline.mapping.landmarks import Landmarks, group_boxes, landmarks_of_map
from cliploc_ros.offline.mapping.options import MappingOptions, PoseErrors
from cliploc_ros.offline.mapping.views import Views

# Least deviation of a position [m]: objects are not ellipsoids. Chosen.
_LEAST_SIGMA_M = 0.01
# Deviation of a centre if the map does not give it [m]. Chosen.
_UNKNOWN_SIGMA_M = 0.05
# An object has moved if it is displaced by more than all three: [m], in units of its old and new
# shape (1: they touch), and in standard deviations of both positions. A smaller displacement only
# means a better fit. Chosen.
_LEAST_MOVE_M, LEAST_MOVE_SHAPES, LEAST_MOVE_SIGMAS = 0.1, 0.6, 4.0
#: A recording that confirms fewer landmarks does not belong to the map.
MIN_CONFIRMED = 3
_ROUNDS = 4
# Least IoU of the first association, which tolerates an offset.
_LOOSE_IOU = 0.1
# Deviations of the weak prior on an offset. Chosen.
_OFFSET_SIGMA_M, _OFFSET_SIGMA_DEG = 0.5, 5.0
# Objects that were nudged by this much do not disturb the alignment [m]. Chosen.
_NUDGE_M = 0.02
_SETTLED_M = 1e-3
_LOSS_SCALE = 2.0
# Median length of a normal vector of three numbers, and the squared length that a vector of six
# exceeds once in a thousand times: smaller offsets are ignored.
_MEDIAN_LENGTH, _SIGNIFICANT = 1.54, 22.5


class OldMap(NamedTuple):
    """L landmarks of the old map, with the recording's classes."""

    map: LandmarkMap  #: With details of each landmark
    landmarks: Landmarks  #: Class -1: no box of the recording has a class of this landmark
    sigmas: NDArray[np.float64]  #: (L,): deviations of the centres [m]

    @property
    def names(self) -> set[tuple[int, int]]:
        """Return all pairs of a landmark and one of its classes."""
        return {(row, name) for row, name in self.landmarks.names.tolist()}


def known_landmarks(old: LandmarkMap, class_names: tuple[str, ...]) -> OldMap:
    """Return the landmarks of a map, with the classes of a recording."""
    sigmas = np.array([_UNKNOWN_SIGMA_M if detail.position_sigma is None
                       else detail.position_sigma for detail in old.every_detail])
    return OldMap(replace(old, details=old.every_detail), landmarks_of_map(old, class_names),
                  np.maximum(sigmas, _LEAST_SIGMA_M))


class Refits(NamedTuple):
    """L landmarks fitted to the recording; unchanged if it has too few boxes."""

    landmarks: Landmarks
    #: (L, 3, 3): of the centres [m^2]; infinite for unchanged landmarks
    covariances: NDArray[np.float64]

    def select(self, rows: NDArray[np.int64]) -> 'Refits':
        """Return the landmarks in the given rows."""
        return Refits(self.landmarks.select(rows), self.covariances[rows])

    @property
    def is_known(self) -> NDArray[np.bool_]:
        """Return a mask of the landmarks (L,) that were fitted."""
        return np.isfinite(self.covariances[:, 0, 0])

    @property
    def sigmas(self) -> NDArray[np.float64]:
        """Return the deviations (L,) of the centres on the worst axis [m]."""
        sigmas = np.full(len(self.covariances), np.inf)
        own = self.covariances[self.is_known]
        sigmas[self.is_known] = np.sqrt(np.linalg.eigvalsh(own)[:, -1])
        return sigmas


def refit(views: Views, landmarks: Landmarks, shown: NDArray[np.int64], min_viewpoints: int
          ) -> Refits:
    """Fit landmarks to the boxes that show them from enough viewpoints."""
    centers, bases = landmarks.centers.copy(), landmarks.bases.copy()
    covariances = np.full((len(centers), 3, 3), np.inf)
    for number, rows in enumerate(group_boxes(shown, len(centers))):
        if len(np.unique(views.viewpoints[views.frames[rows]])) >= min_viewpoints:
            fit = fit_ellipsoid(views, rows, centers[number], bases[number])
            centers[number], bases[number] = fit.center, fit.basis
            covariances[number] = centre_covariance(views, rows, fit.center, fit.basis)
            covariances[number] += _LEAST_SIGMA_M ** 2 * np.eye(3)
    return Refits(landmarks._replace(centers=centers, bases=bases), covariances)


class Aligned(NamedTuple):
    """The recording in the coordinate frame of the map."""

    views: Views
    map_from_given: NDArray[np.float64]  #: (4, 4): the offset that was corrected
    #: Offset of the recording's coordinate frame, at the mean of the landmarks
    offset_m: float
    offset_deg: float
    #: Root mean square by which the poses were refined after that
    change_m: float
    change_deg: float
    changes: NDArray[np.float64]  #: (F, 6): change of each pose by refinement [m] [rad]
    estimated: PoseErrors | None  #: The errors of the poses, if they were estimated


def align(given: Views, known: OldMap, options: MappingOptions) -> Aligned:
    """Return the views with poses in the coordinate frame of the old map."""
    views, total = given, np.eye(4)
    for number in range(_ROUNDS):
        shown = associate(views, known.landmarks, ASSOCIATION_IOU if number else _LOOSE_IOU)
        found = refit(views, known.landmarks, shown, options.min_viewpoints)
        if np.count_nonzero(found.is_known) < MIN_CONFIRMED:
            break
        step = _offset(known, found)
        views = views.with_poses(step @ views.poses)
        total = step @ total
        middle = known.landmarks.centers[found.is_known].mean(axis=0)
        if np.linalg.norm(step[:3, :3] @ middle + step[:3, 3] - middle) < _SETTLED_M:
            break
    middle = known.landmarks.centers.mean(axis=0)
    offset_m = float(np.linalg.norm(total[:3, :3].T @ (middle - total[:3, 3]) - middle))
    offset_deg = float(np.degrees(Rotation.from_matrix(total[:3, :3]).magnitude()))
    errors, estimated = options.pose_errors, None
    if errors is None and options.estimate_pose_errors:
        shown = associate(views, known.landmarks)
        found = refit(views, known.landmarks, shown, options.min_viewpoints)
        errors = estimated = joint.significant_pose_errors(views, found.landmarks, shown)
    refined = views if errors is None else _refine(views, known, errors, options)
    return Aligned(refined, total, offset_m, offset_deg, *joint.pose_changes(views, refined),
                   joint.pose_errors(views, refined), estimated)


def _offset(known: OldMap, refits: Refits) -> NDArray[np.float64]:
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
        # one number for each landmark, so that the loss suppresses landmarks that moved
        lengths = np.linalg.norm(np.einsum('lij,lj->li', whiten, turned - old), axis=1)
        return np.concatenate([lengths, motion / scales])

    found = least_squares(residuals, np.zeros(6), loss='cauchy', f_scale=_LOSS_SCALE)
    lengths, step = found.fun[:-6], np.eye(4)
    # errors of positions exceed their deviations, as objects are not ellipsoids
    inflation = max(1.0, float(np.median(lengths)) / _MEDIAN_LENGTH)
    if float(found.x @ (found.jac.T @ found.jac) @ found.x) >= _SIGNIFICANT * inflation ** 2:
        step[:3, :3] = Rotation.from_rotvec(found.x[3:]).as_matrix()
        step[:3, 3] = middle + found.x[:3] - step[:3, :3] @ middle
    return step


def _refine(aligned: Views, known: OldMap, errors: PoseErrors, options: MappingOptions) -> Views:
    """Return the views with poses refined against the old landmarks that are in their place."""
    views = aligned
    anchors = joint.Anchors(known.landmarks.centers, known.sigmas)
    for _ in range(REFINEMENTS):
        shown = associate(views, known.landmarks)
        found = refit(views, known.landmarks, shown, options.min_viewpoints)
        away = has_moved(known.landmarks, known.sigmas, found)
        shown[np.isin(shown, np.nonzero(away)[0])] = -1
        if not (shown >= 0).any():
            return views
        views, _ = joint.refine_jointly(aligned, views, known.landmarks, shown, errors,
                                        anchors=anchors)
    return views


def has_moved(old: Landmarks, sigmas: NDArray[np.float64], found: Refits) -> NDArray[np.bool_]:
    """Return a mask of the landmarks (L,) that must have moved, as they are so far off."""
    offsets = found.landmarks.centers - old.centers
    far = found.is_known & (np.linalg.norm(offsets, axis=1) > _LEAST_MOVE_M)
    rows = np.nonzero(far)[0]
    bases, others = old.bases[rows], found.landmarks.bases[rows]
    shapes = bases @ bases.transpose(0, 2, 1) + others @ others.transpose(0, 2, 1)
    far[rows] = ((normalized_lengths(offsets[rows], shapes) > LEAST_MOVE_SHAPES)
                 & (deviations(old.select(rows), sigmas[rows], found.select(rows))
                    > LEAST_MOVE_SIGMAS))
    return far


def deviations(old: Landmarks, sigmas: NDArray[np.float64], found: Refits) -> NDArray[np.float64]:
    """Return the distance (L,) of old and new positions of landmarks, in standard deviations."""
    covariances = found.covariances + np.square(sigmas)[:, None, None] * np.eye(3)
    return normalized_lengths(found.landmarks.centers - old.centers, covariances)
