# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Simulated changes: of images, and of the world that a map and a layer show."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.core.maps.landmark_map import LandmarkMap
from cliploc_ros.datasets.frames import Frame

Image = NDArray[np.uint8]
#: Takes an image and a generator; returns the changed image.
ImageChange = Callable[[Image, np.random.Generator], Image]
_TWIN_AWAY_M, _AWAY_COS = 20.0, 0.5


def _darken(image: Image, rng: np.random.Generator) -> Image:
    """Take three quarters of the light, and add noise of 6 grey levels."""
    return _rounded(image * 0.25 + rng.normal(0.0, 6.0, image.shape))


def _blur(image: Image, rng: np.random.Generator) -> Image:
    """Blur by 2.5 px, as of a lens out of focus."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 2.5), dtype=np.uint8)


def _light_unevenly(image: Image, rng: np.random.Generator) -> Image:
    """Let the light fall from 1.6 times as much to a fifth, across the image."""
    angle = rng.uniform(0.0, 2.0 * np.pi)
    height, width = image.shape[:2]
    y, x = np.mgrid[-1.0:1.0:height * 1j, -1.0:1.0:width * 1j]
    along = (x * np.cos(angle) + y * np.sin(angle)) / np.sqrt(2.0)
    return _rounded(image * (0.9 + 0.7 * along)[..., None])


def _cover(image: Image, rng: np.random.Generator) -> Image:
    """Make half of the image grey: left, right, upper or lower."""
    covered = image.copy()
    height, width = image.shape[:2]
    halves = (np.s_[:, :width // 2], np.s_[:, width // 2:], np.s_[:height // 2],
              np.s_[height // 2:])
    covered[halves[int(rng.integers(4))]] = 110
    return covered


#: Changes of a query, by name.
IMAGE_CHANGES: dict[str, ImageChange] = {
    'dark and noisy': _darken, 'blurred': _blur, 'unevenly lit': _light_unevenly,
    'half covered': _cover}


def put_poster(image: Image, other: Image, share: float) -> Image:
    """Return an image whose middle, this share of it, shows what another image shows there."""
    height, width = image.shape[:2]
    rows, columns = (round(0.5 * size * (1.0 - np.sqrt(share))) for size in (height, width))
    changed = image.copy()
    inside = np.s_[rows:height - rows, columns:width - columns]
    changed[inside] = other[inside]
    return changed


def elsewhere(frame: Frame, others: Sequence[Frame], rng: np.random.Generator) -> Frame:
    """Return a frame that looks another way, by more than 60 degrees or else the most."""
    assert frame.map_from_camera is not None
    posed = [(one, one.map_from_camera[:3, 2]) for one in others
             if one.map_from_camera is not None]
    cosines = np.array([axis for _, axis in posed]) @ frame.map_from_camera[:3, 2]
    away = np.nonzero(cosines < _AWAY_COS)[0]
    return posed[int(rng.choice(away)) if len(away) else int(np.argmin(cosines))][0]


def twin_map(landmark_map: LandmarkMap, removed: int, rng: np.random.Generator) -> LandmarkMap:
    """Return a map with a second, identical room, which lacks some of the objects."""
    count = len(landmark_map)
    kept = np.sort(rng.permutation(count)[:max(1, count - removed)])
    twin = landmark_map.select(kept.tolist())
    moved = twin.centers + np.array([_TWIN_AWAY_M, 0.0, 0.0])
    return LandmarkMap(
        landmark_map.frame_id,
        landmark_map.landmark_ids + tuple(f'{one}_twin' for one in twin.landmark_ids),
        landmark_map.labels + twin.labels, landmark_map.class_ids + twin.class_ids,
        np.concatenate([landmark_map.centers, moved]),
        np.concatenate([landmark_map.semi_axes, twin.semi_axes]),
        np.concatenate([landmark_map.quats_xyzw, twin.quats_xyzw]),
        landmark_map.details + twin.details if landmark_map.details else ())


def twin_layer(layer: KeyframeLayer) -> KeyframeLayer:
    """Return a layer with a second room that looks the same."""
    poses = layer.map_from_camera.copy()
    poses[:, 0, 3] += _TWIN_AWAY_M
    return replace(
        layer, map_from_camera=np.concatenate([layer.map_from_camera, poses]),
        offsets=np.concatenate([layer.offsets, layer.offsets[-1] + layer.offsets[1:]]),
        pixels=np.concatenate([layer.pixels] * 2), points=np.concatenate([layer.points] * 2),
        descriptors=np.concatenate([layer.descriptors] * 2),
        words=np.concatenate([layer.words] * 2))


def _rounded(image: NDArray[np.float64]) -> Image:
    return np.asarray(np.clip(np.round(image), 0, 255), dtype=np.uint8)
