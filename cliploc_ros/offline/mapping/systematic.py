# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Find corrections that all boxes share: of the intrinsics, the mount or the clock.

Each cause is a small correction x that all boxes share. It is fitted separately, together with
free corrections of the landmarks, which may have absorbed a part of it. With J the derivatives of
the edges by x, after projecting out those by the landmarks, and robust weights W, each step is

    dx = -S^-1 J^T W r,   S = J^T W J,   cov x = S^-1 (sum of g g^T) S^-1,

where g are the gradients J^T W r of single viewpoints. The errors of edges in one viewpoint are
correlated, which the sum takes into account (the sandwich estimator, White 1980).
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import invert_transform, make_transform
from cliploc_ros.offline.mapping.fitting import LOSS_SCALE, Linear, fit_landmarks, linearize_boxes
from cliploc_ros.offline.mapping.landmarks import LANDMARK_SIZE, POSE_SIZE, Landmarks, group_boxes
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.mapping.views import Views

_MIN_BOXES = 100
_MAX_BOXES = 8_000
_STEPS, _REFIT_STEPS = 8, 5
# A correction is significant at this many standard deviations from zero, with at least this effect
# on the images [px], if its cause removes this share of the robust cost. Chosen; on TUM fr3 with
# its true camera, 0.008 is removed.
_SIGNIFICANT = 5.0
_NOTABLE_PX = 1.0
_MIN_EXPLAINED = 0.015
# Greatest relative change of a focal length.
_MAX_STRETCH = 0.5
# Standard deviations of a mount that somebody measured with a ruler: 5 cm, 3 degrees. Chosen.
_MOUNT_PRIOR = np.repeat([0.05, np.radians(3.0)], 3)
# A component whose deviation is greater than this share of the prior's is not observable.
_OBSERVABLE = 0.5
_MOUNT = ('x (right)', 'y (down)', 'z (forward)', 'rotation about x', 'rotation about y',
          'rotation about z')
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
    #: Displacement by the correction of a point 300 px off the image centre, or at 2 m [px]
    effect_px: float
    is_significant: bool
    explained: float  #: Share of the robust cost of all edges that its cause removes, 0 to 1


class _Cause(NamedTuple):
    """A cause of residuals: G numbers."""

    cause: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    factors: tuple[float, ...]  # from the numbers' own units to those shown
    effects_px: tuple[float, ...]  # of one shown unit
    camera: Camera
    boxes: NDArray[np.bool_]  # (n,): those of the camera
    # (F, 6, G): motion of the map in the cameras per unit of each number; None: intrinsics
    motions: NDArray[np.float64] | None

    def differentiate(self, views: Views, linear: Linear) -> NDArray[np.float64]:
        """Return the derivatives (m, 4, G) of residuals."""
        if self.motions is not None:
            return np.einsum('mep,mpg->meg', linear.by_pose,
                             self.motions[views.frames[linear.rows]])
        # a measured edge e = (px - c) / f decreases with f and c, so its residual increases
        edges, stiffness = views.edges[linear.rows], views.stiffness[linear.rows]
        by_number = np.zeros((len(edges), 4, 4))
        for axis, focal in enumerate((self.camera.fx, self.camera.fy)):
            sides = [axis, axis + 2]
            by_number[:, sides, axis] = (edges * stiffness)[:, sides]
            by_number[:, sides, 2 + axis] = (stiffness / focal)[:, sides]
        return by_number * self.boxes[linear.rows, None, None]

    def apply(self, views: Views, values: NDArray[np.float64]) -> Views:
        """Return views with the numbers (G,) applied."""
        if self.motions is not None:  # translation, rotation
            motions = self.motions @ values
            turns = Rotation.from_rotvec(motions[:, 3:]).as_matrix()
            return views._replace(
                rotations=np.ascontiguousarray(turns @ views.rotations),
                translations=np.einsum('fij,fj->fi', turns, views.translations) + motions[:, :3])
        scale = np.tile(1.0 + np.clip(values[:2], -_MAX_STRETCH, _MAX_STRETCH), 2)
        shift = np.tile(values[2:] / [self.camera.fx, self.camera.fy], 2)
        own = self.boxes[:, None]
        # deviations are in pixels: otherwise, a longer focal length would shrink all residuals
        return views._replace(edges=np.where(own, (views.edges - shift) / scale, views.edges),
                              stiffness=views.stiffness * np.where(own, scale, 1.0))


def find_corrections(detections: PosedDetections, views: Views, landmarks: Landmarks,
                     shown: NDArray[np.int64]) -> list[Correction]:
    """Return the corrections that fit the edges best; none for cameras with too few boxes.

    The landmarks are fitted to these boxes. Each camera is corrected separately, while the
    landmarks fit the boxes of all cameras.
    """
    shown, found = _sample(shown), list[Correction]()
    for number, camera in enumerate(detections.cameras):
        if np.count_nonzero(views.cameras[views.frames[shown >= 0]] == number) < _MIN_BOXES:
            continue
        name = f' of {detections.camera_names[number]}' if len(detections.cameras) > 1 else ''
        found += [replace(correction, name=correction.name + name)
                  for cause in _causes(camera, views, number)
                  for correction in _fit(cause, views, landmarks, shown)]
    return found


def _causes(camera: Camera, views: Views, number: int) -> tuple[_Cause, ...]:
    """Return the possible causes of residuals of a camera, given its number among the cameras."""
    focal = 0.5 * (camera.fx + camera.fy)
    degree_px = float(np.radians(1.0)) * focal
    own = views.cameras == number
    twists, of_camera = _twists(views, own), (camera, own[views.frames])
    speeds = np.abs(twists[own, 3:]).max(axis=1) + np.abs(twists[own, :3]).max(axis=1) / 2.0
    return (
        _Cause('intrinsics', ('focal length fx', 'focal length fy', 'principal point cx',
                              'principal point cy'),
               ('%', '%', 'px', 'px'), (100.0, 100.0, 1.0, 1.0), (3.0, 3.0, 1.0, 1.0),
               *of_camera, None),
        # the numbers move the map in the camera, so the camera moves the opposite way
        _Cause('mount', tuple(f'mount {name}' for name in _MOUNT), ('cm',) * 3 + ('deg',) * 3,
               (-100.0,) * 3 + (-float(np.degrees(1.0)),) * 3,
               (focal / 200.0, focal / 200.0, 1.5, degree_px, degree_px,
                300.0 * degree_px / focal), *of_camera, own[:, None, None] * np.eye(POSE_SIZE)),
        _Cause('stamps', ('stamps of the images',), ('ms',), (1000.0,),
               (focal * float(np.quantile(speeds, 0.9)) / 1000.0,), *of_camera,
               twists[:, :, None]))


def _twists(views: Views, is_own: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the velocity of the map in a camera (F, 6) [m/s] [rad/s], by central differences."""
    rotations, translations = views.rotations, views.translations
    own = np.nonzero(is_own)[0]
    later, earlier = np.arange(len(rotations)), np.arange(len(rotations))
    later[own[:-1]], earlier[own[1:]] = own[1:], own[:-1]
    seconds = (views.stamps_s[later] - views.stamps_s[earlier])[:, None]
    turns = np.einsum('fij,fkj->fik', rotations[later], rotations[earlier])
    # x_later = turn x_earlier + shift, linearized about the frame
    shifts = translations[later] - np.einsum('fij,fj->fi', turns, translations[earlier])
    twists = np.concatenate([shifts, Rotation.from_matrix(turns).as_rotvec()], axis=1)
    smooth = (seconds > 0.0) & (seconds < 0.5)
    return np.where(smooth, twists / np.where(smooth, seconds, 1.0), 0.0)


def _descend(cause: _Cause, given: Views, landmarks: Landmarks, shown: NDArray[np.int64],
             start: NDArray[np.float64], prior: NDArray[np.float64], steps: int, precision: float
             ) -> tuple[NDArray[np.float64], NDArray[np.float64], Views, Linear]:
    """Return the best-fitting values (G,) of a cause, from a start, and their deviations (G,).

    Also return the corrected views and their residuals.
    The prior (G,) holds inverse variances about zero. The descent ends after a step below the
    precision times the deviations.
    """
    values, views = start, cause.apply(given, start) if start.any() else given
    linear = linearize_boxes(views, shown, landmarks)

    def cost_of(linear: Linear, values: NDArray[np.float64]) -> float:
        # the prior's cost on the scale of _cost_of, whose residuals are divided by LOSS_SCALE
        return _cost_of(linear) + float((prior * values ** 2).sum()) / LOSS_SCALE ** 2

    for _ in range(steps):
        step, deviations = _solve(views, cause.differentiate(views, linear), linear, values, prior)
        moved = cause.apply(given, values + step)
        refitted = fit_landmarks(moved, landmarks, shown, _REFIT_STEPS)
        trial = linearize_boxes(moved, shown, refitted)
        if cost_of(trial, values + step) >= cost_of(linear, values):
            break
        values, views, landmarks, linear = values + step, moved, refitted, trial
        if (np.abs(step) < precision * deviations).all():
            break
    return values, deviations, views, linear


def _fit(cause: _Cause, given: Views, landmarks: Landmarks, shown: NDArray[np.int64]
         ) -> list[Correction]:
    """Return the best-fitting values of a cause as corrections."""
    zeros = np.zeros(len(cause.names))
    values, deviations, _, linear = _descend(cause, given, landmarks, shown, zeros, zeros, _STEPS,
                                             0.2)
    own = cause.boxes[linear.rows]
    before = _cost_of(linearize_boxes(given, shown, landmarks), own)
    explained = max(0.0, 1.0 - _cost_of(linear, own) / max(before, 1e-12))
    corrections = []
    for value, deviation, name, unit, factor, effect in zip(
            values, deviations, cause.names, cause.units, cause.factors,
            cause.effects_px, strict=True):
        effect_px = abs(float(value) * factor) * effect
        corrections.append(Correction(
            cause.cause, name, unit, float(value) * factor, float(deviation) * abs(factor),
            effect_px, bool(abs(value) > _SIGNIFICANT * deviation and effect_px > _NOTABLE_PX
                            and explained > _MIN_EXPLAINED), explained))
    return corrections


def _cost_of(linear: Linear, rows: NDArray[np.bool_] | slice = slice(None)) -> float:
    """Return the robust cost of residuals, whose weights are 1 / (1 + r^2 / c^2)."""
    weights = linear.weights[rows]
    return float(-np.log(weights[weights > 0.0]).sum())


def _solve(views: Views, derivatives: NDArray[np.float64], linear: Linear,
           values: NDArray[np.float64], prior: NDArray[np.float64]
           ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the step (G,) of a cause's numbers, and their standard deviations (G,)."""
    free, residuals = _without_landmarks(derivatives, linear)
    information = np.einsum('meg,me,meh->gh', free, linear.weights, free) + np.diag(prior)
    scale = np.sqrt(np.maximum(np.diag(information), 1e-12))
    scaled = information / np.outer(scale, scale) + 1e-9 * np.eye(len(scale))
    inverse = np.linalg.inv(scaled) / np.outer(scale, scale)
    step = -inverse @ (np.einsum('meg,me,me->g', free, linear.weights, residuals) + prior * values)
    viewpoints = views.viewpoints[views.frames[linear.rows]]
    gradients = np.zeros((viewpoints.max() + 1, len(step)))
    np.add.at(gradients, viewpoints, np.einsum(
        'meg,me->mg', free, linear.weights * (residuals + free @ step)))
    covariance = (inverse @ gradients.T @ gradients @ inverse + inverse @ np.diag(prior) @ inverse)
    return step, np.sqrt(np.maximum(np.diag(covariance), 1e-24))


def _without_landmarks(derivatives: NDArray[np.float64], linear: Linear
                       ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Project corrections of the landmarks out of the derivatives and the residuals."""
    free, residuals = derivatives.copy(), linear.residuals.copy()
    for rows in group_boxes(linear.numbers, int(linear.numbers.max()) + 1):
        if len(rows) == 0:
            continue
        by_landmark, weights = linear.by_landmark[rows], linear.weights[rows]
        normal = np.einsum('mei,me,mej->ij', by_landmark, weights, by_landmark)
        normal += 0.5 * np.eye(LANDMARK_SIZE)  # as weak as the prior on the axes
        mixed = np.einsum('mei,me,meg->ig', by_landmark, weights, free[rows])
        pull = np.einsum('mei,me,me->i', by_landmark, weights, residuals[rows])
        free[rows] -= by_landmark @ np.linalg.solve(normal, mixed)
        residuals[rows] -= by_landmark @ np.linalg.solve(normal, pull)
    return free, residuals


class MountCorrection(NamedTuple):
    """A correction of the mount of the camera: one small motion that all frames share.

    It has a prior about zero. Some motions do not reveal every component: a robot that only turns
    about the vertical cannot distinguish a higher camera from a lower floor. The prior keeps such
    a component near zero, and the report names it.
    """

    views: Views  #: With the correction applied
    #: (4, 4): pose of the corrected camera in the camera that the given poses describe
    given_from_corrected: NDArray[np.float64]
    #: (6,): standard deviations of x, y, z [m] and of the rotations about them [rad]
    deviations: NDArray[np.float64]

    def lines(self) -> list[str]:
        """Return the corrections, and the components that this motion does not reveal, as text."""
        turn = Rotation.from_matrix(self.given_from_corrected[:3, :3]).as_rotvec()
        factors = np.repeat([100.0, np.degrees(1.0)], 3)
        values = np.concatenate([self.given_from_corrected[:3, 3], turn]) * factors
        seen = self.deviations < _OBSERVABLE * _MOUNT_PRIOR
        rows = [f'mount corrected: {name} {value:+.2f} +- {deviation:.2f} {unit}'
                for name, value, deviation, unit, is_seen
                in zip(_MOUNT, values, self.deviations * factors,
                       ('cm',) * 3 + ('degrees',) * 3, seen, strict=True) if is_seen]
        if hidden := [name for name, is_seen in zip(_MOUNT, seen, strict=True) if not is_seen]:
            rows.append(f'mount not observable from this motion: {", ".join(hidden)}; turn the '
                        'camera about another axis')
        return rows


def refine_mount(detections: PosedDetections, given: Views, landmarks: Landmarks,
                 shown: NDArray[np.int64], start: Views) -> MountCorrection:
    """Return the correction of the mount of the only camera that fits the boxes best.

    The landmarks are fitted to the poses of start: the given views, or the views of an earlier
    correction.
    """
    # motion of the map in the cameras from given to start (6,): translation, rotation
    turn = start.rotations[0] @ given.rotations[0].T
    values = np.concatenate([start.translations[0] - turn @ given.translations[0],
                             Rotation.from_matrix(turn).as_rotvec()])
    _, mount, _ = _causes(detections.cameras[0], given, 0)
    values, deviations, views, _ = _descend(mount, given, landmarks, _sample(shown), values,
                                            _MOUNT_PRIOR ** -2, _MOUNT_STEPS, 0.0)
    motion = make_transform(Rotation.from_rotvec(values[3:]).as_matrix(), values[:3])
    return MountCorrection(views, invert_transform(motion), deviations)


def _sample(shown: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the landmark that each of an even sample of boxes shows, -1 for all other boxes."""
    rows = np.nonzero(shown >= 0)[0]
    rows, sample = rows[::max(1, -(-len(rows) // _MAX_BOXES))], np.full(len(shown), -1)
    sample[rows] = shown[rows]
    return sample
