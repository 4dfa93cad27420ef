# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Decide which keyframes, and which of their points, a recording confirms, retires or adds.

The keyframes of the recording look for the points of old keyframes with nearly the same view. A
point is found if a feature at its projection matches. The points of a keyframe, and those of each
cube of the room in all keyframes, are gone if hardly any look finds them, while others are found.
"""

from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cliploc_ros.core.geometry.ellipsoid import normalized_lengths
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.core.keyframes.localization import ENOUGH_INLIERS, keyframes_near
from cliploc_ros.core.map.presence import probability_there
from cliploc_ros.errors import MappingError
from cliploc_ros.offline.mapping.landmarks import Landmarks
from cliploc_ros.offline.recording.joining import join_layers

# A keyframe is looked for in this number of nearest views, up to this distance of views: 1.2 m or
# 24 degrees. A feature is at the projection of a point up to this angle: 8 px at f = 525 px.
_VIEWS, _NEAR, _AT_PLACE = 6, 0.6, 8.0 / 525.0
# A point is out of view without a feature within this angle.
_BESIDE = 40.0 / 525.0
# Edge of the cubes [m]; share of looks that find a point that is gone; greatest worth of the usual
# share [looks]; a place below this probability is gone. Measured on the kitchen in thirds: .2 of
# the looks find points that are there, at least .035 in each cube with 100 looks; at most .011
# find points 1 m from their place.
_CUBE_M, _CHANCE, _WORTH, _GONE_BELOW = 0.5, 0.005, 8.0, 0.05
# Limits of the usual share.
_SHARES = (0.02, 0.95)
# A keyframe with fewer points is retired; with fewer found points, it is not confirmed. Chosen.
_LEAST_POINTS = 20
# Least number of looks for the points of a keyframe that can retire it. A keyframe that lost a
# greater share of its points shows a changed place. Chosen.
_FEW_LOOKS, _LOST = 20, 0.05
_FATES = 'confirmed', 'retired', 'added', 'not observed'
# Least share of the keyframes that a recording of the place confirms.
_MIN_CONFIRMED_SHARE = 0.3


class KeyframeFate(NamedTuple):
    """What became of a keyframe."""

    fate: str  #: One of _FATES
    position: list[float]  #: Of the camera in the map [m]
    points: int  #: Number of its points
    removed: int = 0  #: Number of points that were removed
    looks: int = 0  #: Number of looks for its points
    found: int = 0  #: Number of these looks that found the point


class UpdatedLayer(NamedTuple):
    """A layer after an update."""

    layer: KeyframeLayer
    removed: KeyframeLayer | None  #: The points that were removed; None without any
    fates: tuple[KeyframeFate, ...]  #: Of the old keyframes in their order, then of new ones

    def count(self, fate: str) -> int:
        """Return the number of keyframes with a fate."""
        return sum(keyframe.fate == fate for keyframe in self.fates)

    def line(self) -> str:
        """Return the numbers of keyframes as text."""
        counts = [f'{self.count(name)} {name}' for name in _FATES]
        removed = sum(fate.removed for fate in self.fates)
        return f'keyframes: {", ".join(counts)}; {removed} points removed'


# A point without partner: not found, found elsewhere in the image, out of view.
_MISSED, _ELSEWHERE, _UNSEEN = -1, -2, -3


class _Searches(NamedTuple):
    """Looks for points of old keyframes in keyframes of a recording."""

    points: NDArray[np.int64]  #: (l,): row of the old point
    partners: NDArray[np.int64]  #: (l,): row of the new point that it matches, or see above

    def are_gone(self, places: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return a mask of the points (n,) whose places are gone; `places` (n,) has numbers."""
        expected, found = (np.bincount(places[self.points], weights, places.max() + 1)
                           for weights in (None, self.partners >= 0))
        found = np.where(found > 2.0 * _CHANCE * expected, found, 0.0)
        share = np.clip(found.sum() / max(1.0, expected[found > 0.0].sum()), *_SHARES)
        likely = probability_there(found, expected, share, _WORTH, _CHANCE)
        return np.asarray(likely < _GONE_BELOW)[places]


_NO_LOOKS = _Searches(np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64))


def check_belongs(updated: UpdatedLayer) -> None:
    """Refuse a recording that confirms too few of the keyframes that it shows, or none.

    Without landmarks, nothing else shows that its poses are in the coordinate frame of the map.
    """
    there, gone = updated.count('confirmed'), updated.count('retired')
    if there < max(1.0, _MIN_CONFIRMED_SHARE * (there + gone)):
        raise MappingError(
            f'the recording does not belong to this map: {there} keyframes are where it says, '
            f'{gone} are not; check the frame of the poses, or build a new map')


def update_layer(old: KeyframeLayer, new: KeyframeLayer | None, gone: Landmarks) -> UpdatedLayer:
    """Update the keyframes of a map.

    Parameters
    ----------
    new : KeyframeLayer, optional
        Of the recording, with poses in the map. None: the recording has no images.
    gone : Landmarks
        Objects that are no longer in these places.
    """
    old, count = old.plain(), len(old)
    new = old.select(np.zeros(count, dtype=np.bool_)) if new is None else new
    sizes, looks = np.diff(old.offsets), _look_for(old, new)
    owners = np.repeat(np.arange(count), sizes)
    points = np.concatenate([old.points_in_map(keyframe) for keyframe in range(count)])
    _, cubes = np.unique(np.floor(points / _CUBE_M), axis=0, return_inverse=True)
    cubes, is_gone = cubes.ravel(), np.zeros(len(points), dtype=np.bool_)
    for center, basis in zip(gone.centers, gone.bases, strict=True):
        is_gone |= normalized_lengths(points - center, (basis @ basis.T)[None]) < 1.0
    is_found, is_matched = looks.partners >= 0, looks.partners != _MISSED
    matched = _Searches(looks.points[is_matched], looks.partners[is_matched])
    for seen, places in product((looks, matched), (owners, cubes, cubes * count + owners)):
        is_gone |= seen.are_gone(places)
    expected, found = (np.bincount(owners[rows], minlength=count) for rows in (
        looks.points, looks.points[is_found]))
    # a keyframe of a changed place keeps the points that were found, if these are enough
    is_searched, removed = expected >= _FEW_LOOKS, np.bincount(owners, is_gone, count)
    is_gone |= (is_searched & (removed > _LOST * sizes))[owners] & ~np.isin(
        np.arange(len(points)), looks.points[is_found])
    is_kept = (removed == 0) | ((np.bincount(owners, ~is_gone, count) >= _LEAST_POINTS) & (
        ~is_searched | (found >= _LEAST_POINTS)))
    is_gone |= ~is_kept[owners]
    removed = np.bincount(owners, is_gone, count).astype(np.int64)
    names = np.where(found >= _LEAST_POINTS, 'confirmed', 'not observed')
    shown = np.unique(looks.partners[is_found & ~is_gone[looks.points]])
    is_needed = np.diff(np.searchsorted(shown, new.offsets)) < ENOUGH_INLIERS
    kept, added = old.select(is_kept, ~is_gone), new.select(is_needed)
    fates = [KeyframeFate(*row) for row in zip(
        *(column.tolist() for column in (
            np.where(is_kept, names, 'retired'), old.map_from_camera[:, :3, 3].round(3), sizes,
            removed, expected, found)), strict=True)]
    fates += [KeyframeFate('added', pose[:3, 3].round(3).tolist(), size) for pose, size in zip(
        added.map_from_camera, np.diff(added.offsets).tolist(), strict=True)]
    return UpdatedLayer(join_layers([part for part in (kept, added) if len(part)]), old.select(
        removed > 0, is_gone) if is_gone.any() else None, tuple(fates))


def _look_for(old: KeyframeLayer, new: KeyframeLayer) -> _Searches:
    """Look for the points of old keyframes in the nearest views of a recording."""
    seen = [new.points[new.rows(view)].astype(np.float64) for view in range(len(new))]
    bearings = [points[:, :2] / points[:, 2:] for points in seen]
    trees = [*map(cKDTree, bearings)]
    looks = [_NO_LOOKS]
    for keyframe, pose in enumerate(old.map_from_camera):
        points, start = old.points_in_map(keyframe), old.rows(keyframe).start
        for view in keyframes_near(new.map_from_camera, pose, _NEAR)[:_VIEWS].tolist():
            camera_from_map = invert_transform(new.map_from_camera[view])
            inside = points @ camera_from_map[:3, :3].T + camera_from_map[:3, 3]
            places = inside[:, :2] / np.maximum(inside[:, 2:], 1e-6)
            in_view = np.isfinite(trees[view].query(
                places, distance_upper_bound=_BESIDE)[0]) & (inside[:, 2] > 0.0)
            pairs, _ = old.kind.match(old.unit_descriptors(keyframe), new.unit_descriptors(view))
            is_found = np.linalg.norm(
                places[pairs[:, 0]] - bearings[view][pairs[:, 1]], axis=1) < _AT_PLACE
            partners = np.where(in_view, _MISSED, _UNSEEN)
            partners[pairs[:, 0]] = np.where(is_found, new.offsets[view] + pairs[:, 1], _ELSEWHERE)
            looked = np.nonzero(partners != _UNSEEN)[0]
            looks.append(_Searches(start + looked, partners[looked]))
    return _Searches(*map(np.concatenate, zip(*looks, strict=True)))
