# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Poses of a camera by the corners of the tags that it sees.

A planar square has up to two poses that fit its corners nearly as well, its flips (Collins and
Bartoli, "Infinitesimal Plane-based Pose Estimation", 2014). Both are refined, alone and together
with all other tags that agree.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.transforms import SAME_MINIMUM, invert_transform, make_transform
from cliploc_ros.core.map.tags import SQUARE, Tag
from cliploc_ros.core.observation import NO_TAGS, Observation

# Deviation of a corner: pixels, and a share of the tag's side, as paper bends. Deviation of the
# place of a tag in the map [m] [rad], and relative error of the focal length. Chosen.
_CORNER_PX, _BENT, _TAG_M, _TAG_RAD, _FOCAL = 0.5, 0.005, 0.01, np.radians(0.5), 0.005
# Tags agree if their corners are off by at most these pixels and metres at the tag.
_AGREE_PX, _AGREE_M = 2.0, 0.03
# OpenCV stops at an absolute change of the cost: coordinates as large as pixels are fine enough.
_FINE = 1000.0
_FIRSTS = 4  # number of tags that are the first of a pose: those largest in view


class TagSight(NamedTuple):
    """A tag of the map in an image."""

    tag: Tag
    bearings: NDArray[np.float64]  #: (4, 2): its corners, on the plane z = 1
    scale: float  #: Pixels per unit of this plane there
    side_px: float  #: Mean length of its sides


class TagPlace(NamedTuple):
    """A pose that tags give."""

    map_from_camera: NDArray[np.float64]  #: (4, 4)
    covariance: NDArray[np.float64]  #: (6, 6): in the order of core.fit.covariance
    names: tuple[str, ...]  #: Names of the tags that agree
    others: tuple[str, ...]  #: Names of the tags of the map that are seen and do not agree
    #: Half the sum of squares, in deviations, by which another pose fits the same corners better
    misfit: float


def find_tag_places(tags: Sequence[Tag], seen: Observation) -> list[TagPlace]:
    """Return the distinct poses that the tags of a map give an image, with most tags first."""
    sights, found = sights_of(tags, seen), list[tuple[_Fit, tuple[int, ...]]]()
    for first in range(min(_FIRSTS, len(sights))):
        if any(first in kept and len(kept) > 1 for _, kept in found):
            continue
        for start in flips(sights[first]):
            fit, kept = _joined(start, first, sights)
            if not any(SAME_MINIMUM.agree(fit[0], other) for (other, _, _), _ in found):
                found.append((fit, kept))
    best = {kept: min(cost for (_, cost, _), own in found if own == kept) for _, kept in found}
    names = [sight.tag.name for sight in sights]
    places = [TagPlace(pose, covariance, tuple(names[row] for row in kept),
                       tuple(sorted({*names} - {names[row] for row in kept})),
                       0.5 * (cost - best[kept])) for (pose, cost, covariance), kept in found]
    return sorted(places, key=lambda place: (-len(place.names), place.misfit))


def sights_of(tags: Sequence[Tag], seen: Observation) -> list[TagSight]:
    """Return the tags of a map in an image, those largest in view first."""
    sights, camera = list[TagSight](), seen.camera
    found = seen.tags or NO_TAGS
    for name, pixels in zip(found.names, found.corners_px, strict=True):
        own = [tag for tag in tags if tag.name == name]
        bearings = camera.normalize_points(pixels)
        if own and np.isfinite(bearings).all() and cv2.contourArea(
                pixels.astype(np.float32)) > 9.0:  # smaller ones are no squares
            side, flat = (float(np.linalg.norm(
                corners - np.roll(corners, 1, axis=0), axis=1).mean())
                for corners in (pixels, bearings))
            sights += [TagSight(tag, bearings, side / flat, side) for tag in own]
    return sorted(sights, key=lambda sight: -sight.side_px)


def flips(sight: TagSight) -> list[NDArray[np.float64]]:
    """Return the poses (4, 4), camera_from_map, that the corners of one tag allow; best first."""
    # OpenCV returns wrong rotations near 180 degrees, as of a tag upright in the image: its axes
    # are turned about x, so that it is at 0 degrees, and its corners are in another order
    _, turns, shifts, _ = cv2.solvePnPGeneric(
        sight.tag.size * SQUARE, np.ascontiguousarray(sight.bearings[::-1, None]), np.eye(3),
        None, flags=cv2.SOLVEPNP_IPPE_SQUARE)
    return [make_transform(cv2.Rodrigues(turn)[0] * (1.0, -1.0, -1.0), shift.ravel())
            @ invert_transform(sight.tag.map_from_tag)
            for turn, shift in zip(turns, shifts, strict=True) if np.isfinite([turn, shift]).all()]


# A pose, the sum of squares of the distances of corners in deviations, and the covariance.
_Fit = tuple[NDArray[np.float64], float, NDArray[np.float64]]


def _joined(start: NDArray[np.float64], first: int, sights: Sequence[TagSight]
            ) -> tuple[_Fit, tuple[int, ...]]:
    """Fit a pose to a sight, and to all others that agree; return their rows, too."""
    pose, kept = _refined(start, [sights[first]]), [first]
    rows = [row for row in range(len(sights)) if row != first]
    for row in rows[:_FIRSTS]:  # the second tag settles the pose, which then says which agree
        pair = _refined(pose, [sights[first], sights[row]])
        agree = [other for other, sight in enumerate(sights)
                 if _off(pair, sight)[0] < _AGREE_PX + _AGREE_M * sight.side_px / sight.tag.size]
        if first in agree and row in agree:
            pose, kept = _refined(pair, [sights[other] for other in agree]), agree
            break
    return _fit(pose, [sights[row] for row in kept]), tuple(kept)


def _refined(camera_from_map: NDArray[np.float64], sights: Sequence[TagSight]
             ) -> NDArray[np.float64]:
    """Refine a pose (4, 4) by OpenCV's Levenberg-Marquardt on the plane z = 1."""
    middle = np.mean([sight.tag.center for sight in sights], axis=0)
    points = np.concatenate([sight.tag.corners for sight in sights]) - middle
    turn, shift = cv2.solvePnPRefineLM(
        points, _FINE * np.concatenate([sight.bearings for sight in sights]),
        np.diag([_FINE, _FINE, 1.0]), None, cv2.Rodrigues(camera_from_map[:3, :3])[0],
        camera_from_map[:3, :3] @ middle[:, None] + camera_from_map[:3, 3:])
    rotation = cv2.Rodrigues(turn)[0]
    return make_transform(rotation, shift.ravel() - rotation @ middle)


def _off(camera_from_map: NDArray[np.float64], sight: TagSight
         ) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """Return the root mean square distance of the corners [px], and all places in the camera.

    These are (4, 3), and on the plane z = 1 (4, 2).
    """
    inside = sight.tag.corners @ camera_from_map[:3, :3].T + camera_from_map[:3, 3]
    places = inside[:, :2] / np.maximum(inside[:, 2:], 1e-6)
    squares = ((places - sight.bearings) ** 2).sum(axis=1)
    return sight.scale * float(np.sqrt(squares.mean())), inside, places


def _fit(camera_from_map: NDArray[np.float64], sights: Sequence[TagSight]) -> _Fit:
    """Return a refined pose with cost and covariance."""
    cost, information, far_m = 0.0, 1e-6 * np.eye(6), 0.0
    for sight in sights:
        off, inside, places = _off(camera_from_map, sight)
        # the place of a single tag in the map moves all of its corners alike
        sigma_px = math.hypot(_CORNER_PX, _BENT * sight.side_px, (
            _TAG_M * sight.side_px / sight.tag.size if len(sights) > 1 else 0.0))
        cost += 4.0 * (off / sigma_px) ** 2
        far_m += float(np.linalg.norm(inside.mean(axis=0))) / len(sights)
        for (u, v), depth in zip(places.tolist(), inside[:, 2].tolist(), strict=True):
            jacobian = sight.scale / sigma_px * np.array([
                [1 / depth, 0.0, -u / depth, -u * v, 1.0 + u * u, -v],
                [0.0, 1 / depth, -v / depth, -1.0 - v * v, u * v, u]])
            information += jacobian.T @ jacobian
    turn = np.kron(np.eye(2), -camera_from_map[:3, :3].T)
    of_map = [_TAG_M ** 2 + (_FOCAL * far_m) ** 2 + (_TAG_RAD * far_m) ** 2 / len(sights),
              _TAG_RAD ** 2 / len(sights)]
    return (invert_transform(camera_from_map), cost,
            turn @ np.linalg.inv(information) @ turn.T + np.diag(np.repeat(of_map, 3)))
