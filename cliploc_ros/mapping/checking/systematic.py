# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Systematic residuals of box edges.

Do other intrinsics, another mount or another clock fit better?

Each cause is a small correction x that all boxes share, next to a free correction of each
landmark, which would hide it. With J the derivatives of the edges by x, those by the landmarks
projected out, and robust weights W,

    x = -S^-1 J^T W r,   S = J^T W J,   cov x = S^-1 (sum of g g^T) S^-1,

where g are the gradients J^T W r of single viewpoints: edges of one viewpoint err alike, and the
sum takes that into account (the sandwich estimator, White 1980).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.compiled import compiled
from cliploc_ros.mapping.evidence import group_boxes
from cliploc_ros.mapping.fitting import edge_residual, robust_weight
from cliploc_ros.mapping.landmarks import Landmarks
from cliploc_ros.mapping.posed_detections import PosedDetections
from cliploc_ros.mapping.projection import LANDMARK_SIZE, POSE_SIZE, linearize_box
from cliploc_ros.mapping.views import Views

_MIN_BOXES = 100
_MAX_BOXES = 40_000
# Deviations from zero that count, with at least this effect on the images [px]. Guesses.
_SIGNIFICANT = 5.0
_NOTABLE_PX = 1.0


@dataclass(frozen=True)
class Correction:
    """A number that all boxes share.

    Parameters
    ----------
    cause : str
        'intrinsics', 'mount' or 'stamps'.
    name, unit : str
    value, deviation : float
        The correction that fits best, and its standard deviation, in the unit.
    effect_px : float
        By how much the correction moves a point 300 px off the middle, or at 2 m [px].
    is_significant : bool
    """

    cause: str
    name: str
    unit: str
    value: float
    deviation: float
    effect_px: float
    is_significant: bool


class _Linear(NamedTuple):
    """m boxes: residuals (m, 4), their weights, and derivatives by landmark and pose."""

    residuals: NDArray[np.float64]
    weights: NDArray[np.float64]
    by_landmark: NDArray[np.float64]
    by_pose: NDArray[np.float64]


class _Cause(NamedTuple):
    """A cause of residuals: derivatives (m, 4, G) by its G numbers, and what these are."""

    cause: str
    derivatives: NDArray[np.float64]
    names: tuple[str, ...]
    units: tuple[str, ...]
    factors: tuple[float, ...]    # from the numbers' own units to those shown
    effects_px: tuple[float, ...]  # of one shown unit


def find_corrections(detections: PosedDetections, views: Views, landmarks: Landmarks,
                     shown: NDArray[np.int64]) -> list[Correction]:
    """Return the corrections that fit the edges best; none with too few boxes.

    Parameters
    ----------
    detections : PosedDetections
    views : Views
    landmarks : Landmarks
        Fitted to these boxes.
    shown : ndarray (n,) of int
        The landmark that each box shows, -1 for none.
    """
    rows = np.nonzero(shown >= 0)[0]
    rows = rows[::max(1, -(-len(rows) // _MAX_BOXES))]
    if len(rows) < _MIN_BOXES:
        return []
    linear = _linearize(views, rows, shown[rows], landmarks)
    viewpoints = views.viewpoints[views.frames[rows]]
    return [one for cause in _causes(detections, views, rows, linear)
            for one in _solve(cause, linear, shown[rows], viewpoints)]


def _linearize(views: Views, rows: NDArray[np.int64], numbers: NDArray[np.int64],
               landmarks: Landmarks) -> _Linear:
    count = len(rows)
    linear = _Linear(np.zeros((count, 4)), np.zeros((count, 4)),
                     np.zeros((count, 4, LANDMARK_SIZE)), np.zeros((count, 4, POSE_SIZE)))
    _linearize_all(views, rows, numbers, landmarks.centers, landmarks.bases, *linear)
    return linear


@compiled
def _linearize_all(views, rows, numbers, centers, bases, residuals, weights, by_landmark,
                   by_pose):
    """Write residuals, weights and derivatives, in standard deviations; open edges weigh 0."""
    box = np.empty(4)
    for place in range(len(rows)):
        row, number = rows[place], numbers[place]
        frame = views.frames[row]
        if not linearize_box(views.rotations[frame], views.translations[frame], centers[number],
                             bases[number], box, by_landmark[place], by_pose[place]):
            continue
        for edge in range(4):
            if views.is_open[row, edge]:
                continue
            residuals[place, edge] = edge_residual(views, row, edge, box)
            weights[place, edge] = robust_weight(residuals[place, edge])
            by_landmark[place, edge] *= views.stiffness[row, edge]
            by_pose[place, edge] *= views.stiffness[row, edge]


def _causes(detections: PosedDetections, views: Views, rows: NDArray[np.int64], linear: _Linear
            ) -> Iterator[_Cause]:
    camera = detections.camera
    stiffness, edges = views.stiffness[rows], views.edges[rows]
    intrinsics = np.zeros((len(rows), 4, 4))
    for axis, focal in enumerate((camera.fx, camera.fy)):
        # a measured edge e = (px - c) / f gets smaller with f and c, its residual greater
        sides = [axis, axis + 2]
        intrinsics[:, sides, axis] = edges[:, sides] * stiffness[:, sides]
        intrinsics[:, sides, 2 + axis] = stiffness[:, sides] / focal
    yield _Cause('intrinsics', intrinsics, ('focal length fx', 'focal length fy',
                                            'principal point cx', 'principal point cy'),
                 ('%', '%', 'px', 'px'), (100.0, 100.0, 1.0, 1.0), (3.0, 3.0, 1.0, 1.0))
    focal = 0.5 * (camera.fx + camera.fy)
    degree = float(np.radians(1.0)) * focal
    yield _Cause('mount', linear.by_pose,
                 ('mount x (right)', 'mount y (down)', 'mount z (forward)',
                  'mount rotation about x', 'mount rotation about y', 'mount rotation about z'),
                 ('cm', 'cm', 'cm', 'deg', 'deg', 'deg'),
                 # by_pose moves the map in the camera: the camera moves against it
                 (-100.0,) * 3 + (-float(np.degrees(1.0)),) * 3,
                 (focal / 200.0, focal / 200.0, 1.5, degree, degree, 300.0 * degree / focal))
    twists = _twists(views)[views.frames[rows]]
    speeds = np.abs(twists[:, 3:]).max(axis=1) + np.abs(twists[:, :3]).max(axis=1) / 2.0
    yield _Cause('stamps', np.einsum('mep,mp->me', linear.by_pose, twists)[:, :, None],
                 ('stamps of the images',), ('ms',), (1000.0,),
                 (focal * float(np.quantile(speeds, 0.9)) / 1000.0,))


def _twists(views: Views) -> NDArray[np.float64]:
    """Return how the map moves in the camera (F, 6) [m/s] [rad/s], by central differences."""
    rotations, translations = views.rotations, views.translations
    later = np.minimum(np.arange(len(rotations)) + 1, len(rotations) - 1)
    earlier = np.maximum(np.arange(len(rotations)) - 1, 0)
    seconds = (views.stamps_s[later] - views.stamps_s[earlier])[:, None]
    turns = np.einsum('fij,fkj->fik', rotations[later], rotations[earlier])
    # x_later = turn x_earlier + shift, linearized about the frame
    shifts = translations[later] - np.einsum('fij,fj->fi', turns, translations[earlier])
    twists = np.concatenate([shifts, Rotation.from_matrix(turns).as_rotvec()], axis=1)
    smooth = (seconds > 0.0) & (seconds < 0.5)
    return np.where(smooth, twists / np.where(smooth, seconds, 1.0), 0.0)


def _solve(cause: _Cause, linear: _Linear, numbers: NDArray[np.int64],
           viewpoints: NDArray[np.int64]) -> Iterator[Correction]:
    free, residuals = _without_landmarks(cause.derivatives, linear, numbers)
    weights = linear.weights
    information = np.einsum('meg,me,meh->gh', free, weights, free)
    scale = np.sqrt(np.maximum(np.diag(information), 1e-12))
    scaled = information / np.outer(scale, scale) + 1e-9 * np.eye(len(scale))
    inverse = np.linalg.inv(scaled) / np.outer(scale, scale)
    values = -inverse @ np.einsum('meg,me,me->g', free, weights, residuals)
    left = residuals + free @ values
    gradients = np.zeros((viewpoints.max() + 1, len(values)))
    np.add.at(gradients, viewpoints, np.einsum('meg,me->mg', free, weights * left))
    deviations = np.sqrt(np.maximum(np.diag(inverse @ gradients.T @ gradients @ inverse), 1e-24))
    for value, deviation, name, unit, factor, effect in zip(
            values, deviations, cause.names, cause.units, cause.factors, cause.effects_px,
            strict=True):
        effect_px = abs(float(value) * factor) * effect
        yield Correction(cause.cause, name, unit, float(value) * factor,
                         float(deviation) * abs(factor), effect_px,
                         bool(abs(value) > _SIGNIFICANT * deviation and effect_px > _NOTABLE_PX))


def _without_landmarks(derivatives: NDArray[np.float64], linear: _Linear,
                       numbers: NDArray[np.int64]
                       ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return derivatives and residuals, less what corrections of the landmarks explain."""
    free, residuals = derivatives.copy(), linear.residuals.copy()
    for rows in group_boxes(numbers, int(numbers.max()) + 1):
        if len(rows) == 0:
            continue
        by_landmark, weights = linear.by_landmark[rows], linear.weights[rows]
        normal = np.einsum('mei,me,mej->ij', by_landmark, weights, by_landmark)
        normal += 0.5 * np.eye(LANDMARK_SIZE)  # weak, as the prior on the axes
        mixed = np.einsum('mei,me,meg->ig', by_landmark, weights, free[rows])
        pull = np.einsum('mei,me,me->i', by_landmark, weights, residuals[rows])
        free[rows] -= by_landmark @ np.linalg.solve(normal, mixed)
        residuals[rows] -= by_landmark @ np.linalg.solve(normal, pull)
    return free, residuals
