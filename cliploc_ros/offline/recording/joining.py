# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Several recordings of a place: where their coordinate frames lie, and one layer of keyframes.

The keyframes of a recording are localized in the layer of the others, by their own features. This
gives the transform between the coordinate frames, and says which keyframes the layer needs:
those that it does not localize yet (Churchill and Newman, "Experience-based navigation", 2013). Of
a full cell, those stay that localize most others (Muehlfellner et al., "Summary maps", 2016).
"""

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import chain, compress
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry import transforms
from cliploc_ros.core.keyframes.features import Features
from cliploc_ros.core.keyframes.layer import PIXEL_SCALE, KeyframeLayer, Source
from cliploc_ros.core.keyframes.localization import KeyframeLocalizer
from cliploc_ros.errors import MappingError
from cliploc_ros.offline.recording.layer_words import with_words

# A keyframe is recognized by this number of points: fewer may agree by chance. It is not added if
# the layer localizes it with this number: it is known, or contradicts the map.
_LEAST_POINTS, _ENOUGH = 15, 80
# A keyframe agrees with a placing that projects half of its points within this angle. Poses of
# recordings have errors of centimetres: 15 px at f = 525 px are 6 cm at 2 m.
_AGREE = 15.0 / 525.0
# Least number of keyframes that agree, and of them for each one that agrees with another placing.
_LEAST_AGREEING, _PER_RIVAL = 5, 3.0
# Scale of the robust loss: 2 px at f = 525 px. Weight of a relative error of depth: 2 % count as
# much. Without depth, placings of the kitchen's halves are off by twice as much, scales by 1.7 %.
_LOSS, _DEPTH = 2.0 / 525.0, 0.2
# Size of a cell of positions [m], and of the components of directions.
_CELL_M, _CELL_DIRECTION = 1.0, 0.5


class Placing(NamedTuple):
    """Where the coordinate frame of a recording lies: scale it, rotate it, then shift it."""

    scale: float = 1.0
    rotation: NDArray[np.float64] = np.eye(3)  #: (3, 3)
    shift: NDArray[np.float64] = np.zeros(3)  #: (3,) [m]


class SeenKeyframe(NamedTuple):
    """A keyframe of a recording that the layer of a map recognizes, with m points of the layer."""

    keyframe: int
    pose: NDArray[np.float64]  #: (4, 4): in the frame of the recording
    found: NDArray[np.float64]  #: (4, 4): in the map
    points: NDArray[np.float64]  #: (m, 3): in the map
    own: NDArray[np.float64]  #: (m, 3): the same points by the keyframe, in its camera
    agreed: int  #: Number of agreeing features
    keyframes: NDArray[np.int64]  #: Keyframes of the layer with agreeing points

    def similarity(self, is_scaled: bool) -> NDArray[np.float64]:
        """Return the transform (4, 4), with a scale, of the recording's frame into the map's."""
        reach = np.linalg.norm(self.points - self.found[:3, 3], axis=1)
        scale = np.median(reach / np.linalg.norm(self.own, axis=1)) if is_scaled else 1.0
        return np.asarray(self.found @ np.diag([scale] * 3 + [1.0]) @ np.linalg.inv(self.pose))

    def errors(self, map_from_recording: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the errors (m, 3) of the points: on the plane z = 1, and of their depths."""
        camera_from_map = np.linalg.inv(map_from_recording @ self.pose)
        inside = self.points @ camera_from_map[:3, :3].T + camera_from_map[:3, 3]
        ahead = np.maximum(inside[:, 2:], 1e-3 * np.linalg.norm(inside, axis=1, keepdims=True))
        return np.column_stack([inside[:, :2] / ahead - self.own[:, :2] / self.own[:, 2:],
                                _DEPTH * (ahead / self.own[:, 2:] - 1.0)])

    def agrees(self, map_from_recording: NDArray[np.float64]) -> bool:
        """Return whether the keyframe agrees with a placing (4, 4)."""
        return bool(np.median(np.linalg.norm(self.errors(map_from_recording), axis=1)) < _AGREE)


def recognize(new: KeyframeLayer, layer: KeyframeLayer) -> list[SeenKeyframe]:
    """Localize the keyframes of a recording in the layer of a map; return the recognized ones."""
    localizer, sights = KeyframeLocalizer(layer), []
    for keyframe, pose in enumerate(new.map_from_camera):
        rows, camera = new.rows(keyframe), new.camera_of(keyframe)
        pixels = new.pixels[rows] / PIXEL_SCALE
        features = Features(pixels, new.descriptors_of(rows), np.ones(len(pixels), np.float32))
        found = localizer.localize_features(features, camera)
        if not found.places or found.places[0].inliers < _LEAST_POINTS:
            found = localizer.localize_features(features, camera, fast=found)
        for place in (one for one in found.places[:1] if one.inliers >= _LEAST_POINTS):
            own = new.points[rows][cKDTree(pixels).query(place.pixels)[1]]
            sights.append(SeenKeyframe(keyframe, pose, place.map_from_camera, place.points,
                                own.astype(float), place.inliers, np.array(place.keyframes)))
    return sights


def find_placing(sights: Sequence[SeenKeyframe], is_scaled: bool = False) -> tuple[Placing, int]:
    """Place a recording in a map; return the number of keyframes that agree, too.

    Each recognized keyframe proposes a placing. The proposal with the most agreeing keyframes is
    refined by robust least squares on their points. With `is_scaled`, for a recording of unknown
    unit, the scale is estimated, too.

    MappingError: too few keyframes agree about the placing, or two placings fit.
    """
    guesses = [sight.similarity(is_scaled) for sight in sights]
    agree = np.array([[sight.agrees(guess) for sight in sights] for guess in guesses] or [[]],
                     dtype=np.bool_)
    row = int(agree.sum(axis=1).argmax())
    kept, placing = agree[row], (guesses or [np.eye(4)])[row]
    for _ in range(2 * bool(kept.sum() >= _LEAST_AGREEING)):
        placing = _refined([*compress(sights, kept)], placing, is_scaled)
        kept = np.array([sight.agrees(placing) for sight in sights])
    scale = float(np.cbrt(np.linalg.det(placing[:3, :3])))
    found, agreeing = Placing(scale, placing[:3, :3] / scale, placing[:3, 3]), int(kept.sum())
    rivals = max((int((others & ~kept).sum()) for others, sight in zip(agree, sights, strict=False)
                  if not transforms.SAME_LOOK.agree(sight.found, transforms.move_poses(
                      sight.pose[None], *found)[0])), default=0)
    if agreeing < max(_LEAST_AGREEING, _PER_RIVAL * rivals):
        raise MappingError(f'its place in the map is unknown: {agreeing} of {len(sights)} '
                           f'recognized keyframes agree about it, {rivals} about another place; '
                           'record views that the map has, too, or build a map of its own')
    return found, agreeing


def _refined(sights: list[SeenKeyframe], start: Any, is_scaled: bool) -> NDArray[np.float64]:
    """Refine a placing (4, 4) by robust least squares."""
    def moved(step: NDArray[np.float64]) -> NDArray[np.float64]:
        turn = Rotation.from_rotvec(step[:3]).as_matrix() * np.exp(step[6:].sum())
        return np.asarray(start @ transforms.make_transform(turn, step[3:6]))
    return moved(least_squares(
        lambda step: np.concatenate([sight.errors(moved(step)) for sight in sights]).ravel(),
        np.zeros(6 + is_scaled), x_scale='jac', loss='cauchy', f_scale=_LOSS).x)


def join_layers(layers: Sequence[KeyframeLayer]) -> KeyframeLayer:
    """Join layers of one kind of features in one coordinate frame, without small images."""
    layers = [layer.plain() for layer in layers]
    sources = [layer.sources or (Source(''),) for layer in layers]
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(layer, name) for layer in layers])
        for name in ('map_from_camera', 'pixels', 'points', 'descriptors', 'words')}

    def rows(name: str, counts: Iterable[int]) -> NDArray[np.int64]:
        firsts, found = np.cumsum([0, *counts]), [getattr(layer, name) for layer in layers]
        return np.concatenate([first + np.broadcast_to(0 if own is None else own, len(layer))
                               for first, own, layer in zip(firsts, found, layers, strict=False)])
    return with_words(replace(
        layers[0], cameras=tuple(chain(*(layer.cameras for layer in layers))),
        camera_rows=rows('camera_rows', (len(layer.cameras) for layer in layers)),
        sources=tuple(chain(*sources)), source_rows=rows('source_rows', map(len, sources)),
        deviation_per_metre=np.concatenate([layer.deviations() for layer in layers]),
        offsets=np.cumsum([0, *chain(*(np.diff(layer.offsets) for layer in layers))]),
        images=None, image_offsets=None, **joined))


def add_layer(layer: KeyframeLayer, new: KeyframeLayer, is_scaled: bool, same_frame: bool,
              per_cell: int) -> tuple[KeyframeLayer, Placing, str]:
    """Add the keyframes of a recording to those of a map.

    Parameters
    ----------
    is_scaled : bool
        Whether the unit of the recording is unknown, see find_placing.
    same_frame : bool
        Keep the poses of the recording; a shift is only named.
    per_cell : int
        Greatest number of keyframes of a cell of place and direction.

    Returns
    -------
    layer : KeyframeLayer
    placing : Placing
    note : str
        The placing, and what was added.

    Raises
    ------
    MapError, MappingError
        The features are of different kinds, or the recording cannot be placed.
    """
    sights, placing = recognize(new, layer), Placing()
    note = 'it is not compared with the map, which recognizes too few of its keyframes'
    with suppress(*[MappingError] * same_frame):
        found, agreed = find_placing(sights, is_scaled)
        poses = transforms.move_poses(new.map_from_camera, *found)
        shift_m = np.median(np.linalg.norm((poses - new.map_from_camera)[:, :3, 3], axis=1))
        placing = placing if same_frame else found
        note = (f'{agreed} keyframes place it {shift_m:.2f} m and '
                f'{transforms.rotation_angle_deg(found.rotation):.1f} degrees from where its '
                f'poses are{", which stay" * same_frame}')
    new = new.moved(*placing)
    poses, first = np.concatenate([layer.map_from_camera, new.map_from_camera]), len(layer)
    kept, votes, displaced = np.ones(len(poses), bool), np.zeros(len(poses), dtype=np.int64), 0
    for sight in sights:
        votes[sight.keyframes] += 1
        if sight.agreed >= _ENOUGH:
            kept[row := first + sight.keyframe] = False
            displaced += not transforms.SAME_LOOK.agree(sight.found, poses[row])
    added = int(kept[first:].sum())
    cells = np.floor(np.hstack([poses[:, :3, 3] / _CELL_M, poses[:, :3, 2] / _CELL_DIRECTION]))
    cell = np.unique(cells[kept], axis=0, return_inverse=True)[1].ravel()
    # of a cell, those with the most votes; new ones win ties
    order = np.lexsort([-np.arange(len(cell)), -votes[kept], cell])
    kept[np.nonzero(kept)[0][order]] = np.concatenate(
        [*map(np.arange, np.bincount(cell))]) < per_cell
    note += (f'; {added} of its {len(new)} keyframes are new, {displaced} contradict the map; '
             f'full cells lose {first + added - kept.sum()}')
    parts = [part.select(chosen) for part, chosen in ((layer, kept[:first]), (new, kept[first:]))
             if chosen.any()]
    return join_layers(parts) if added else layer, placing, note
