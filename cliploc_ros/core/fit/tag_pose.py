# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Poses of a camera by the corners of tags, with one or several cameras of one instant.

A planar square has up to two poses that fit its corners nearly as well, its flips (Collins and
Bartoli, "Infinitesimal Plane-based Pose Estimation", 2014). Both are refined, alone and together
with all other tags that agree.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import SAME_MINIMUM, invert_transform, make_transform
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.tags import Tag
from cliploc_ros.core.search.frame_search import SearchedFrame

# Deviation of a corner: pixels, and a share of the tag's side, as paper bends. Deviation of the
# place of a tag in the map [m] [rad], and relative error of the focal length. Chosen.
_CORNER_PX, _BENT, _TAG_M, _TAG_RAD, _FOCAL = 0.5, 0.005, 0.01, np.radians(0.5), 0.005
# Tags agree if their corners are off by at most these pixels and metres at the tag.
_AGREE_PX, _AGREE_M = 2.0, 0.03
# Least squares: steps, the first damping, and the change of the cost that ends it. Corners behind
# a camera are treated as in front of it.
_STEPS, _DAMPING, _SMALL_GAIN, _LEAST_DEPTH_M = 20, 1e-3, 1e-3, 1e-3
_DELTA = 1e-6  # on the plane z = 1
# Number of tags that are the first of a pose, and of tags tried as the second one.
_FIRSTS, _SECONDS = 6, 4


class Sight(NamedTuple):
    """A tag of the map that a camera sees."""

    tag: Tag
    points: NDArray[np.float64]  #: (4, 3): its corners in the map [m]
    bearings: NDArray[np.float64]  #: (4, 2): the corners in the image, on the plane z = 1
    scales: NDArray[np.float64]  #: (4, 2, 2): change of their pixels with the bearings
    side_px: float  #: Mean length of the sides [px]
    camera_from_last: NDArray[np.float64]  #: (4, 4): from the camera to localize

    @property
    def pixels_per_metre(self) -> float:
        """Return the scale of the image at the tag."""
        return self.side_px / self.tag.size


class TagPlace(NamedTuple):
    """A pose that tags give."""

    map_from_camera: NDArray[np.float64]  #: (4, 4)
    covariance: NDArray[np.float64]  #: (6, 6): in the order of core.fit.covariance
    names: tuple[str, ...]  #: Names of the tags that agree, each once
    others: tuple[str, ...]  #: Names of the tags of the map that are seen and do not agree
    misfit: float  #: Half the sum of squares by which other poses fit the same corners better


def sights_of(landmark_map: LandmarkMap, frames: Sequence[SearchedFrame],
              cameras_from_last: NDArray[np.float64]) -> list[Sight]:
    """Return the tags of the map that frames of one instant see, those largest in view first."""
    by_name: dict[str, list[Tag]] = {}
    for tag in landmark_map.tags:
        by_name.setdefault(tag.name, []).append(tag)
    return sorted((
        sight for frame, camera_from_last in zip(frames, cameras_from_last, strict=True)
        if (seen := frame.observation.tags) is not None
        for name, pixels in zip(seen.names, seen.corners_px, strict=True)
        for tag in by_name.get(name, ())
        if (sight := sight_of(tag, pixels, frame.observation.camera, camera_from_last))),
        key=lambda sight: -sight.side_px)


def sight_of(tag: Tag, pixels: NDArray[np.float64], camera: Camera,
             camera_from_last: NDArray[np.float64]) -> Sight | None:
    """Return the sight of a tag with corners (4, 2) [px]; None where a lens has no inverse."""
    bearings = camera.normalize_points(pixels)
    around = camera.project_normalized(np.concatenate(
        [bearings, *(bearings + step for step in _DELTA * np.eye(2))])).reshape(3, 4, 2)
    scales = ((around[1:] - around[0]) / _DELTA).transpose(1, 2, 0)
    if not (np.isfinite(bearings).all() and np.isfinite(scales).all()):
        return None
    side = np.linalg.norm(pixels - np.roll(pixels, 1, axis=0), axis=1).mean()
    return Sight(tag, tag.corners, bearings, scales, float(side), camera_from_last)


def find_tag_places(sights: Sequence[Sight]) -> list[TagPlace]:
    """Return the distinct poses that tags give, those with most tags first."""
    found = list[tuple[_Fit, tuple[int, ...]]]()
    firsts = 0
    for first, sight in enumerate(sights):
        if firsts == _FIRSTS or any(first in kept and len(kept) > 1 for _, kept in found):
            continue
        firsts += 1
        for start in planar_poses(sight):
            fit, kept = _joined(start, first, sights)
            if not any(SAME_MINIMUM.agree(fit.map_from_last, other.map_from_last)
                       for other, _ in found):
                found.append((fit, kept))
    best = {kept: min(fit.cost for fit, own in found if own == kept) for _, kept in found}
    every = [sight.tag.name for sight in sights]
    places = [TagPlace(
        fit.map_from_last, fit.covariance, tuple(dict.fromkeys(every[row] for row in kept)),
        tuple({*every} - {every[row] for row in kept}), 0.5 * (fit.cost - best[kept]))
        for fit, kept in found]
    return sorted(places, key=lambda place: (-len(place.names), place.misfit))


def planar_poses(sight: Sight) -> list[NDArray[np.float64]]:
    """Return the poses (4, 4), map_from_last, that the corners of one tag allow; best first."""
    half = 0.5 * sight.tag.size
    square = half * np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0],
                              [-1.0, -1.0, 0.0]])
    _, turns, shifts, _ = cv2.solvePnPGeneric(square, sight.bearings[:, None], np.eye(3), None,
                                              flags=cv2.SOLVEPNP_IPPE_SQUARE)
    poses = [make_transform(cv2.Rodrigues(turn)[0], shift.ravel())
             for turn, shift in zip(turns, shifts, strict=True)]
    return [sight.tag.map_from_tag @ invert_transform(pose) @ sight.camera_from_last
            for pose in poses if np.isfinite(pose).all() and pose[2, 3] > 0.0]


class _Fit(NamedTuple):
    """A least squares fit to the corners of sights."""

    map_from_last: NDArray[np.float64]
    cost: float  #: Sum of squares of the residuals in standard deviations
    off: NDArray[np.float64]  #: (s,): root mean square distance of the corners of each sight [px]
    covariance: NDArray[np.float64]


def _joined(start: NDArray[np.float64], first: int, sights: Sequence[Sight]
            ) -> tuple[_Fit, tuple[int, ...]]:
    """Fit a pose to a sight, and to all others that agree; return their rows, too."""
    kept, fit = [first], _fitted(start, [sights[first]])
    most = np.array([_AGREE_PX + _AGREE_M * sight.pixels_per_metre for sight in sights])

    def off_at(pose: NDArray[np.float64]) -> NDArray[np.float64]:
        return _off(_linearized(invert_transform(pose), sights)[0])
    # the second tag settles the pose, which then says which others agree
    for row in [row for row in np.argsort(off_at(fit.map_from_last)).tolist()
                if row != first][:_SECONDS]:
        pair = _fitted(fit.map_from_last, [sights[first], sights[row]])
        if (pair.off <= most[[first, row]]).all():
            off = off_at(pair.map_from_last)
            kept = sorted({first, row, *np.nonzero(off <= most)[0].tolist()})
            fit = pair if len(kept) == 2 else _fitted(pair.map_from_last,
                                                      [sights[other] for other in kept])
            break
    return fit, tuple(kept)


def _fitted(map_from_last: NDArray[np.float64], sights: Sequence[Sight]) -> _Fit:
    """Refine a pose by damped least squares; steps (v, w) act on last_from_map from the left."""
    pose, damping, tags = invert_transform(map_from_last), _DAMPING, {
        sight.tag.tag_id for sight in sights}
    sigmas = np.array([np.hypot(np.hypot(_CORNER_PX, _BENT * sight.side_px),
                                (len(tags) > 1) * _TAG_M * sight.pixels_per_metre)
                       for sight in sights])
    weights = np.repeat(1.0 / sigmas ** 2, 8)
    residuals, jacobian = _linearized(pose, sights)
    cost = weights @ residuals ** 2
    for _ in range(_STEPS):
        information = (jacobian.T * weights) @ jacobian
        step = -np.linalg.solve(information + np.diag(damping * np.diag(information) + 1e-9),
                                jacobian.T @ (weights * residuals))
        moved = make_transform(cv2.Rodrigues(step[3:])[0], step[:3]) @ pose
        found = _linearized(moved, sights)
        gain = cost - weights @ found[0] ** 2
        if gain > 0.0:
            pose, (residuals, jacobian), cost, damping = moved, found, cost - gain, 0.1 * damping
        else:
            damping *= 10.0
        if abs(gain) < _SMALL_GAIN:
            break
    turn = np.kron(np.eye(2), -pose[:3, :3].T)
    covariance = turn @ np.linalg.inv(information + 1e-6 * np.eye(6)) @ turn.T
    far_m = float(np.mean([np.linalg.norm(sight.points[0] @ pose[:3, :3].T + pose[:3, 3])
                           for sight in sights]))
    of_map = [_TAG_M ** 2 + (_FOCAL * far_m) ** 2 + (_TAG_RAD * far_m) ** 2 / len(tags),
              _TAG_RAD ** 2 / len(tags)]
    return _Fit(invert_transform(pose), float(cost), _off(residuals),
                (covariance + covariance.T) / 2 + np.diag(np.repeat(of_map, 3)))


def _off(residuals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the root mean square distance (s,) of the corners of sights."""
    return np.asarray(np.sqrt((residuals.reshape(-1, 4, 2) ** 2).sum(axis=2).mean(axis=1)))


def _linearized(last_from_map: NDArray[np.float64], sights: Sequence[Sight]
                ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the residuals (8 s,) [px] of the corners at a pose (4, 4), and their Jacobian.

    Lenses are linearized at the corners that are seen.
    """
    cameras = np.array([sight.camera_from_last for sight in sights])
    last = np.array([sight.points for sight in sights]) @ last_from_map[:3, :3].T \
        + last_from_map[:3, 3]
    seen = last @ cameras[:, :3, :3].transpose(0, 2, 1) + cameras[:, None, :3, 3]
    depths = np.maximum(seen[..., 2], _LEAST_DEPTH_M)
    points = seen[..., :2] / depths[..., None]
    scales = np.array([sight.scales for sight in sights])
    residuals = np.einsum('scij,scj->sci', scales, points - np.array(
        [sight.bearings for sight in sights]))
    of_points = np.zeros((*points.shape, 3))  # of the points by their place in the camera
    of_points[..., [0, 1], [0, 1]] = 1.0
    of_points[..., 2] = -points
    of_steps = np.zeros((*points.shape[:2], 3, 6))
    of_steps[..., [0, 1, 2], [0, 1, 2]] = 1.0
    of_steps[..., [0, 1, 2], [4, 5, 3]] = last[..., [2, 0, 1]]
    of_steps[..., [0, 1, 2], [5, 3, 4]] = -last[..., [1, 2, 0]]
    jacobian = (scales @ of_points / depths[..., None, None]) @ cameras[:, None, :3, :3] @ of_steps
    return residuals.ravel(), jacobian.reshape(-1, 6)
