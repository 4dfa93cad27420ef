# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Corrections that all boxes share: other intrinsics, another mount or another clock.

Each cause is a small correction x that all boxes share, fitted on its own next to a free
correction of each landmark, which would hide it. With J the derivatives of the edges by x, those
by the landmarks projected out, and robust weights W, each step is

    dx = -S^-1 J^T W r,   S = J^T W J,   cov x = S^-1 (sum of g g^T) S^-1,

where g are the gradients J^T W r of single viewpoints: edges of one viewpoint err alike, and the
sum takes that into account (the sandwich estimator, White 1980).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import invert_transform, make_transform
from cliploc_ros.core.kernels.compiled import compiled
from cliploc_ros.offline.mapping.fitting import (
    LOSS_SCALE,
    edge_residual,
    fit_landmarks,
    robust_weight,
)
from cliploc_ros.offline.mapping.landmarks import (
    LANDMARK_SIZE,
    POSE_SIZE,
    Landmarks,
    group_boxes,
    linearize_box,
)
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.mapping.views import Views

_MIN_BOXES = 100
_MAX_BOXES = 8_000
_STEPS, _REFIT_STEPS = 8, 5
# Deviations from zero that count, with at least this effect on the images [px], if the cause
# removes this share of the robust cost. Guesses; on TUM fr3 the true camera removes 0.008.
_SIGNIFICANT = 5.0
_NOTABLE_PX = 1.0
_MIN_EXPLAINED = 0.015
# Beyond this, a change of the focal length is no small correction.
_MAX_STRETCH = 0.5
# Standard deviations of a mount that somebody measured with a ruler: 5 cm, 3 degrees. A guess.
_MOUNT_PRIOR = np.repeat([0.05, np.radians(3.0)], 3)
# A part that the boxes leave more uncertain than this share of the prior is not observable.
_OBSERVABLE = 0.5
_MOUNT_STEPS = 10


@dataclass(frozen=True)
class Correction:
    """A number that all boxes share."""

    cause: str  #: 'intrinsics', 'mount' or 'stamps'
    name: str
    unit: str
    #: The correction that fits best, and its standard deviation, in the unit
    value: float
    deviation: float
    #: By how much the correction moves a point 300 px off the middle, or at 2 m [px]
    effect_px: float
    is_significant: bool
    explained: float  #: Share of the robust cost of all edges that its cause removes, 0 to 1
    #: It is hardly significant any more once the cause that explains most is corrected
    follows: bool = False


class Linear(NamedTuple):
    """m boxes: residuals (m, 4), their weights, and derivatives by landmark and pose."""

    residuals: NDArray[np.float64]
    weights: NDArray[np.float64]
    by_landmark: NDArray[np.float64]
    by_pose: NDArray[np.float64]


class _Cause(NamedTuple):
    """A cause of residuals: G numbers."""

    cause: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    factors: tuple[float, ...]  # from the numbers' own units to those shown
    effects_px: tuple[float, ...]  # of one shown unit
    # returns the derivatives (m, 4, G) of the residuals of some rows
    differentiate: Callable[[Views, NDArray[np.int64], Linear], NDArray[np.float64]]
    # returns views with the numbers (G,) applied
    apply: Callable[[Views, NDArray[np.float64]], Views]


class _Fit(NamedTuple):
    """A cause that fits best: its numbers, and the views and landmarks with them."""

    corrections: tuple[Correction, ...]
    views: Views
    landmarks: Landmarks

    @property
    def is_significant(self) -> bool:
        return any(one.is_significant for one in self.corrections)


def find_corrections(detections: PosedDetections, views: Views, landmarks: Landmarks,
                     shown: NDArray[np.int64]) -> list[Correction]:
    """Return the corrections that fit the edges best; none of a camera with too few boxes.

    The landmarks are fitted to these boxes. Each camera is corrected on its own, while the
    landmarks fit the boxes of all.
    """
    rows, found = _sample(shown), list[Correction]()
    for number, camera in enumerate(detections.cameras):
        if np.count_nonzero(views.cameras[views.frames[rows]] == number) < _MIN_BOXES:
            continue
        name = f' of {detections.camera_names[number]}' if len(detections.cameras) > 1 else ''
        causes = _intrinsics(camera), _mount(camera), _stamps(camera, views, number)
        fits = [_fit(cause, number, views, landmarks, rows, shown[rows]) for cause in causes]
        best = max(fits, key=lambda one: one.is_significant * one.corrections[0].explained)
        for cause, fit in zip(causes, fits, strict=True):
            follows = False
            if fit is not best and fit.is_significant:
                again = _fit(cause, number, best.views, best.landmarks, rows, shown[rows])
                more = again.corrections[0].explained * (1.0 - best.corrections[0].explained)
                follows = not (again.is_significant and more > _MIN_EXPLAINED)
            found += [replace(one, name=one.name + name, follows=follows)
                      for one in fit.corrections]
    return found


def _intrinsics(camera: Camera) -> _Cause:
    focal = np.array([camera.fx, camera.fy, camera.fx, camera.fy])

    def differentiate(views: Views, rows: NDArray[np.int64], linear: Linear
                      ) -> NDArray[np.float64]:
        # a measured edge e = (px - c) / f gets smaller with f and c, its residual greater
        by_number = np.zeros((len(rows), 4, 4))
        for axis in (0, 1):
            sides = [axis, axis + 2]
            by_number[:, sides, axis] = (views.edges * views.stiffness)[rows][:, sides]
            by_number[:, sides, 2 + axis] = (views.stiffness / focal)[rows][:, sides]
        return by_number

    def apply(views: Views, values: NDArray[np.float64]) -> Views:
        scale = np.tile(1.0 + np.clip(values[:2], -_MAX_STRETCH, _MAX_STRETCH), 2)
        shift = np.tile(values[2:], 2)
        # deviations are in pixels: else a longer focal length would shrink all residuals
        return views._replace(edges=(views.edges - shift / focal) / scale,
                              stiffness=views.stiffness * scale)

    return _Cause('intrinsics', ('focal length fx', 'focal length fy', 'principal point cx',
                                 'principal point cy'),
                  ('%', '%', 'px', 'px'), (100.0, 100.0, 1.0, 1.0), (3.0, 3.0, 1.0, 1.0),
                  differentiate, apply)


def _mount(camera: Camera) -> _Cause:
    focal = 0.5 * (camera.fx + camera.fy)
    degree_px = float(np.radians(1.0)) * focal
    return _Cause('mount', ('mount x (right)', 'mount y (down)', 'mount z (forward)',
                            'mount rotation about x', 'mount rotation about y',
                            'mount rotation about z'),
                  ('cm', 'cm', 'cm', 'deg', 'deg', 'deg'),
                  # the numbers move the map in the camera: the camera moves against it
                  (-100.0,) * 3 + (-float(np.degrees(1.0)),) * 3,
                  (focal / 200.0, focal / 200.0, 1.5, degree_px, degree_px,
                   300.0 * degree_px / focal),
                  lambda views, rows, linear: linear.by_pose,
                  lambda views, values: _move_map(
                      views, np.tile(values, (len(views.rotations), 1))))


def _stamps(camera: Camera, views: Views, number: int) -> _Cause:
    # how the map moves in the camera (F, 6) [m/s] [rad/s], by central differences
    rotations, translations = views.rotations, views.translations
    own = np.nonzero(views.cameras == number)[0]
    later, earlier = np.arange(len(rotations)), np.arange(len(rotations))
    later[own[:-1]], earlier[own[1:]] = own[1:], own[:-1]
    seconds = (views.stamps_s[later] - views.stamps_s[earlier])[:, None]
    turns = np.einsum('fij,fkj->fik', rotations[later], rotations[earlier])
    # x_later = turn x_earlier + shift, linearized about the frame
    shifts = translations[later] - np.einsum('fij,fj->fi', turns, translations[earlier])
    twists = np.concatenate([shifts, Rotation.from_matrix(turns).as_rotvec()], axis=1)
    smooth = (seconds > 0.0) & (seconds < 0.5)
    twists = np.where(smooth, twists / np.where(smooth, seconds, 1.0), 0.0)
    speeds = np.abs(twists[:, 3:]).max(axis=1) + np.abs(twists[:, :3]).max(axis=1) / 2.0
    pixels_per_ms = 0.5 * (camera.fx + camera.fy) * float(np.quantile(speeds[own], 0.9)) / 1000.0
    return _Cause('stamps', ('stamps of the images',), ('ms',), (1000.0,), (pixels_per_ms,),
                  lambda views, rows, linear: np.einsum(
                      'mep,mp->me', linear.by_pose, twists[views.frames[rows]])[:, :, None],
                  lambda views, values: _move_map(views, values[0] * twists))


def _move_map(views: Views, motions: NDArray[np.float64]) -> Views:
    """Return the views with the map moved in the cameras by (F, 6): translation, rotation."""
    turns = Rotation.from_rotvec(motions[:, 3:]).as_matrix()
    return views._replace(
        rotations=np.ascontiguousarray(turns @ views.rotations),
        translations=np.einsum('fij,fj->fi', turns, views.translations) + motions[:, :3])


def _fit(cause: _Cause, camera: int, given: Views, landmarks: Landmarks, rows: NDArray[np.int64],
         numbers: NDArray[np.int64]) -> _Fit:
    """Return the numbers of a cause that fit one camera best."""
    values, views = np.zeros(len(cause.names)), given
    viewpoints = given.viewpoints[given.frames[rows]]
    frames = given.cameras == camera
    boxes = frames[given.frames]
    own = boxes[rows]
    linear = linearize_boxes(views, rows, numbers, landmarks)
    cost, own_before = _cost_of(linear), _cost_of(linear, own)
    for _ in range(_STEPS):
        step, deviations = _solve(cause.differentiate(views, rows, linear) * own[:, None, None],
                                  linear, numbers, viewpoints)
        applied = cause.apply(given, values + step)
        moved = given._replace(**{
            name: np.where(mine.reshape(-1, *[1] * (getattr(given, name).ndim - 1)),
                           getattr(applied, name), getattr(given, name))
            for name, mine in (('rotations', frames), ('translations', frames), ('edges', boxes),
                               ('stiffness', boxes))})
        refitted = _refit(moved, landmarks, rows, numbers)
        trial = linearize_boxes(moved, rows, numbers, refitted)
        if _cost_of(trial) >= cost:
            break
        values, views, landmarks, linear = values + step, moved, refitted, trial
        cost = _cost_of(linear)
        if (np.abs(step) < 0.2 * deviations).all():
            break
    explained = max(0.0, 1.0 - _cost_of(linear, own) / max(own_before, 1e-12))
    corrections = []
    for value, deviation, name, unit, factor, effect in zip(
            values, deviations, cause.names, cause.units, cause.factors, cause.effects_px,
            strict=True):
        effect_px = abs(float(value) * factor) * effect
        corrections.append(Correction(
            cause.cause, name, unit, float(value) * factor, float(deviation) * abs(factor),
            effect_px, bool(abs(value) > _SIGNIFICANT * deviation and effect_px > _NOTABLE_PX
                            and explained > _MIN_EXPLAINED), explained))
    return _Fit(tuple(corrections), views, landmarks)


def _refit(views: Views, landmarks: Landmarks, rows: NDArray[np.int64],
           numbers: NDArray[np.int64]) -> Landmarks:
    """Return the landmarks fitted to some rows, whose landmarks are numbers."""
    boxes = [rows[places] for places in group_boxes(numbers, len(landmarks.centers))]
    return fit_landmarks(views, landmarks, boxes, _REFIT_STEPS)


def _cost_of(linear: Linear, rows: NDArray[np.bool_] | slice = slice(None)) -> float:
    """Return the robust cost of residuals; their weight is 1 / (1 + r^2 / c^2)."""
    weights = linear.weights[rows]
    return float(-np.log(weights[weights > 0.0]).sum())


def linearize_boxes(views: Views, rows: NDArray[np.int64], numbers: NDArray[np.int64],
                    landmarks: Landmarks) -> Linear:
    """Return residuals and derivatives of some rows, whose landmarks are numbers."""
    count = len(rows)
    linear = Linear(np.zeros((count, 4)), np.zeros((count, 4)),
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


def _solve(derivatives: NDArray[np.float64], linear: Linear, numbers: NDArray[np.int64],
           viewpoints: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the step (G,) of a cause's numbers, and their standard deviations (G,)."""
    free, residuals = _without_landmarks(derivatives, linear, numbers)
    weights = linear.weights
    information = np.einsum('meg,me,meh->gh', free, weights, free)
    scale = np.sqrt(np.maximum(np.diag(information), 1e-12))
    scaled = information / np.outer(scale, scale) + 1e-9 * np.eye(len(scale))
    inverse = np.linalg.inv(scaled) / np.outer(scale, scale)
    step = -inverse @ np.einsum('meg,me,me->g', free, weights, residuals)
    left = residuals + free @ step
    gradients = np.zeros((viewpoints.max() + 1, len(step)))
    np.add.at(gradients, viewpoints, np.einsum('meg,me->mg', free, weights * left))
    return step, np.sqrt(np.maximum(np.diag(inverse @ gradients.T @ gradients @ inverse), 1e-24))


def _without_landmarks(derivatives: NDArray[np.float64], linear: Linear,
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


class MountCorrection(NamedTuple):
    """A correction of the mount of the camera: one small motion that all frames share.

    It has a prior about zero. Some motions do not show every part of it: a robot that turns about
    the vertical only cannot tell a higher camera from a lower floor. Such a part stays with the
    prior, near zero, and the report names it.
    """

    views: Views  #: With the correction applied
    #: (4, 4): pose of the corrected camera in the camera that the given poses describe
    given_from_corrected: NDArray[np.float64]
    #: (6,): standard deviations of x, y, z [m] and of the rotations about them [rad]
    deviations: NDArray[np.float64]

    def lines(self) -> list[str]:
        """Return the corrections, and the parts that this motion does not show."""
        turn = Rotation.from_matrix(self.given_from_corrected[:3, :3]).as_rotvec()
        factors = np.repeat([100.0, np.degrees(1.0)], 3)
        values = np.concatenate([self.given_from_corrected[:3, 3], turn]) * factors
        names = ('x (right)', 'y (down)', 'z (forward)', 'rotation about x', 'rotation about y',
                 'rotation about z')
        seen = self.deviations < _OBSERVABLE * _MOUNT_PRIOR
        rows = [f'mount corrected: {name} {value:+.2f} +- {deviation:.2f} {unit}'
                for name, value, deviation, unit, is_seen
                in zip(names, values, self.deviations * factors,
                       ('cm',) * 3 + ('degrees',) * 3, seen, strict=True) if is_seen]
        if hidden := [name for name, is_seen in zip(names, seen, strict=True) if not is_seen]:
            rows.append(f'mount not observable from this motion: {", ".join(hidden)}; turn the '
                        'camera about another axis')
        return rows


def refine_mount(given: Views, landmarks: Landmarks, shown: NDArray[np.int64], start: Views
                 ) -> MountCorrection:
    """Return the correction of the mount that fits the boxes best.

    The landmarks are fitted to the poses of start: the given views, or those of an earlier
    correction.
    """
    rows = _sample(shown)
    numbers, views, weights = shown[rows], start, _MOUNT_PRIOR ** -2
    viewpoints = given.viewpoints[given.frames[rows]]
    # by how much the map was moved in the cameras (6,): translation, rotation
    turn = start.rotations[0] @ given.rotations[0].T
    values = np.concatenate([start.translations[0] - turn @ given.translations[0],
                             Rotation.from_matrix(turn).as_rotvec()])

    def cost_of(linear: Linear, values: NDArray[np.float64]) -> float:
        # the prior's cost on the scale of _cost_of, whose residuals have LOSS_SCALE
        return _cost_of(linear) + float((weights * values ** 2).sum()) / LOSS_SCALE ** 2

    def equations() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return information (6, 6), and the gradients of single viewpoints."""
        free, residuals = _without_landmarks(linear.by_pose, linear, numbers)
        gradients = np.zeros((viewpoints.max() + 1, 6))
        np.add.at(gradients, viewpoints,
                  np.einsum('meg,me->mg', free, linear.weights * residuals))
        return np.einsum('meg,me,meh->gh', free, linear.weights, free), gradients

    linear = linearize_boxes(views, rows, numbers, landmarks)
    for _ in range(_MOUNT_STEPS):
        information, gradients = equations()
        trial = values - np.linalg.solve(information + np.diag(weights),
                                         gradients.sum(axis=0) + weights * values)
        moved = _move_map(given, np.tile(trial, (len(given.rotations), 1)))
        refitted = _refit(moved, landmarks, rows, numbers)
        trial_linear = linearize_boxes(moved, rows, numbers, refitted)
        if cost_of(trial_linear, trial) >= cost_of(linear, values):
            break
        values, views, landmarks, linear = trial, moved, refitted, trial_linear
    information, gradients = equations()
    inverse = np.linalg.inv(information + np.diag(weights))
    deviations = np.sqrt(np.diag(inverse @ (gradients.T @ gradients + np.diag(weights))
                                 @ inverse))
    motion = make_transform(Rotation.from_rotvec(values[3:]).as_matrix(), values[:3])
    return MountCorrection(views, invert_transform(motion), deviations)


def _sample(shown: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the boxes that show landmarks, evenly chosen where they are many."""
    rows = np.nonzero(shown >= 0)[0]
    return rows[::max(1, -(-len(rows) // _MAX_BOXES))]
