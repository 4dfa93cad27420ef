# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Several recordings of a place: where their coordinate frames lie, and one layer of keyframes.

The keyframes of each recording are localized in the layer of the other one, by their own features.
This gives the transform between the coordinate frames, and says which keyframes the layer needs:
those that it does not localize yet (Churchill and Newman, "Experience-based navigation", 2013).
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.transforms import make_transform
from cliploc_ros.core.keyframes.features import Features
from cliploc_ros.core.keyframes.layer import PIXEL_SCALE, KeyframeLayer
from cliploc_ros.core.keyframes.localization import KeyframeLocalizer
from cliploc_ros.errors import MappingError, counted

# A keyframe with fewer agreeing points may be recognized by chance.
_LEAST_POINTS = 15
# Recordings are placed by at most this number of keyframes of each, with this number of points.
_TRIED, _POINTS = 100, 60
# A keyframe agrees with a placing if half of its points are projected within this angle. Poses of
# recordings have errors of centimetres: 15 px at f = 525 px are 6 cm at 2 m.
_AGREE = 15.0 / 525.0
# Least number of keyframes that agree, and of them for each one that agrees with another placing.
_LEAST_AGREEING, _PER_RIVAL = 5, 3.0
# Scale of the robust loss: 2 px at f = 525 px.
_LOSS = 2.0 / 525.0


class Sight(NamedTuple):
    """A keyframe of one layer that another layer recognizes, with m points of that layer."""

    keyframe: int
    pose: NDArray[np.float64]  #: (4, 4): in the frame of its own layer
    found: NDArray[np.float64]  #: (4, 4): in the frame of the other layer
    points: NDArray[np.float64]  #: (m, 3): in the frame of the other layer
    own: NDArray[np.float64]  #: (m, 3): the same points by the keyframe, in its camera
    agreed: int  #: Number of agreeing features
    keyframes: tuple[int, ...]  #: Keyframes of the other layer with agreeing points

    def similarity(self, is_scaled: bool) -> NDArray[np.float64]:
        """Return the transform (4, 4), with a scale, of its layer's frame into the other one."""
        reach = np.linalg.norm(self.points - self.found[:3, 3], axis=1)
        scale = np.median(reach / np.linalg.norm(self.own, axis=1)) if is_scaled else 1.0
        return np.asarray(self.found @ np.diag([scale] * 3 + [1.0]) @ np.linalg.inv(self.pose))

    def residuals(self, other_from_own: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the errors (m, 2) of the points' projections under a transform (4, 4)."""
        own_from_other = np.linalg.inv(other_from_own @ self.pose)
        inside = self.points @ own_from_other[:3, :3].T + own_from_other[:3, 3]
        ahead = np.maximum(inside[:, 2:], 1e-3 * np.linalg.norm(inside, axis=1, keepdims=True))
        return np.asarray(inside[:, :2] / ahead - self.own[:, :2] / self.own[:, 2:])


def recognize(layer: KeyframeLayer, other: KeyframeLayer, keyframes: Sequence[int]) -> list[Sight]:
    """Localize keyframes of a layer in another layer; return those that it recognizes."""
    localizer, sights = KeyframeLocalizer(other), []
    for keyframe in keyframes:
        rows, camera = layer.rows(keyframe), layer.camera_of(keyframe)
        pixels = layer.pixels[rows] / PIXEL_SCALE
        features = Features(pixels, layer.descriptors[rows],
                            np.ones(len(pixels), dtype=np.float32))
        found = localizer.localize_features(features, camera)
        if not found.places or found.places[0].inliers < _LEAST_POINTS:
            found = localizer.localize_features(features, camera, fast=found)
        for place in found.places[:1]:
            if place.inliers >= _LEAST_POINTS:
                own = np.asarray(layer.points[rows], dtype=np.float64)[
                    cKDTree(pixels).query(place.pixels)[1]]
                sights.append(Sight(keyframe, layer.map_from_camera[keyframe],
                                    place.map_from_camera, place.points, own, place.inliers,
                                    place.keyframes))
    return sights


class Placing(NamedTuple):
    """Where the coordinate frame of a recording lies: scale it, rotate it, then shift it."""

    scale: float
    rotation: NDArray[np.float64]  #: (3, 3)
    shift: NDArray[np.float64]  #: (3,)
    agreeing: int  #: Number of keyframes that agree
    tried: int  #: Number of keyframes that were recognized


def find_placing(layer: KeyframeLayer, other: KeyframeLayer, is_scaled: bool, name: str
                 ) -> Placing:
    """Place a layer in the coordinate frame of another one.

    Parameters
    ----------
    is_scaled : bool
        Whether the unit of the layer is unknown.
    name : str
        The recording, for messages.

    Raises
    ------
    MappingError
        Too few keyframes agree about the placing, or two placings fit.
    """
    there, back = (recognize(one, two, range(0, len(one), 1 + len(one) // _TRIED))
                   for one, two in ((layer, other), (other, layer)))
    sights = [sight._replace(points=sight.points[::step], own=sight.own[::step])
              for sight in (*there, *back) for step in [1 + len(sight.points) // _POINTS]]

    def errors(placing: NDArray[np.float64], rows: Sequence[int]) -> list[NDArray[np.float64]]:
        reverse = np.linalg.inv(placing)
        return [sights[row].residuals(placing if row < len(there) else reverse) for row in rows]

    def agreeing(placing: NDArray[np.float64], rows: Sequence[int]) -> list[int]:
        return [row for row, error in zip(rows, errors(placing, rows), strict=True)
                if np.median(np.linalg.norm(error, axis=1)) < _AGREE]

    def best(rows: Sequence[int]) -> tuple[list[int], NDArray[np.float64]]:
        found = [sights[row].similarity(is_scaled) for row in rows]
        found = [one if row < len(there) else np.linalg.inv(one)
                 for row, one in zip(rows, found, strict=True)]
        return max(((agreeing(one, rows), one) for one in found), key=lambda pair: len(pair[0]),
                   default=([], np.eye(4)))

    every = range(len(sights))
    kept, placing = best(every)
    rivals, _ = best([row for row in every if row not in kept])
    if len(kept) < max(_LEAST_AGREEING, _PER_RIVAL * len(rivals)):
        raise MappingError(
            f'{name}: its place in the map is unknown: {counted(len(kept), "keyframe")} '
            f'agree about it, expected {_LEAST_AGREEING}; {len(rivals)} about another place; '
            'record more views of mapped places, or give `same_frame`')
    for _ in range(2):
        middle = make_transform(np.eye(3), np.concatenate(
            [sights[row].points for row in kept if row < len(there)] or [np.zeros((1, 3))]
        ).mean(axis=0))

        def moved(step: NDArray[np.float64], start: NDArray[np.float64] = placing,
                  middle: NDArray[np.float64] = middle) -> NDArray[np.float64]:
            turn = make_transform(Rotation.from_rotvec(step[:3]).as_matrix() * np.exp(
                step[6:].sum()), step[3:6])
            return np.asarray(middle @ turn @ np.linalg.inv(middle) @ start)
        rows = kept
        fit = least_squares(lambda step: np.concatenate(errors(moved(step), rows)).ravel(),
                            np.zeros(6 + is_scaled), loss='cauchy', f_scale=_LOSS)
        placing = moved(fit.x)
        kept = agreeing(placing, every)
    scale = float(np.cbrt(np.linalg.det(placing[:3, :3])))
    return Placing(scale, placing[:3, :3] / scale, placing[:3, 3], len(kept), len(sights))


def move_layer(layer: KeyframeLayer, placing: Placing) -> KeyframeLayer:
    """Move a layer into the coordinate frame of a placing."""
    return layer
