# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Changes of images, and of the world that a map and a layer show."""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.core.maps.landmark_map import LandmarkMap

Image = NDArray[np.uint8]
#: Takes an image, an image of another site and a generator; returns the changed image.
ImageChange = Callable[[Image, Image, np.random.Generator], Image]
_TWIN_AWAY_M = 20.0


class World(NamedTuple):
    """A map, its layer, and where else in the map a query may be said to be, as a shift [m]."""

    landmark_map: LandmarkMap
    layer: KeyframeLayer
    shift_m: NDArray[np.float64]


class Picture(NamedTuple):
    """A rectangle that hangs in front of a camera, and what is on it.

    Parameters
    ----------
    corner, right, down : ndarray (3,)
        Its first corner, and the way to the next ones, from the camera [m].
    texture : ndarray (h, w, 3)
    region : ndarray (4,)
        Part of the texture that it shows: left, top, right, bottom [px].
    """

    corner: NDArray[np.float64]
    right: NDArray[np.float64]
    down: NDArray[np.float64]
    texture: Image
    region: NDArray[np.float64]


def _darken(image: Image, other: Image, rng: np.random.Generator) -> Image:
    """Take three quarters of the light, and add noise of 6 grey levels."""
    return _rounded(image * 0.25 + rng.normal(0.0, 6.0, image.shape))


def _blur(image: Image, other: Image, rng: np.random.Generator) -> Image:
    """Blur by 2.5 px, as of a lens out of focus."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 2.5), dtype=np.uint8)


def _light_unevenly(image: Image, other: Image, rng: np.random.Generator) -> Image:
    """Let the light fall from 1.6 times as much to a fifth, across the image."""
    angle = rng.uniform(0.0, 2.0 * np.pi)
    height, width = image.shape[:2]
    y, x = np.mgrid[-1.0:1.0:height * 1j, -1.0:1.0:width * 1j]
    along = (x * np.cos(angle) + y * np.sin(angle)) / np.sqrt(2.0)
    return _rounded(image * (0.9 + 0.7 * along)[..., None])


def _cover(share: float, is_textured: bool) -> ImageChange:
    """Return what covers a share from one side: grey, or with an image of another site."""
    def change(image: Image, other: Image, rng: np.random.Generator) -> Image:
        height, width = image.shape[:2]
        rows, columns = round(share * height), round(share * width)
        sides = (np.s_[:, :columns], np.s_[:, width - columns:], np.s_[:rows],
                 np.s_[height - rows:])
        covered = image.copy()
        part = covered[sides[int(rng.integers(4))]]
        part[:] = cv2.resize(other, part.shape[1::-1], interpolation=cv2.INTER_AREA) \
            if is_textured else 110
        return covered
    return change


#: Changes of a query's image, by name.
IMAGE_CHANGES: dict[str, ImageChange] = {
    'dark and noisy': _darken, 'blurred': _blur, 'unevenly lit': _light_unevenly,
    'half covered': _cover(0.5, False), 'occluder on 30 %': _cover(0.3, True),
    'occluder on 50 %': _cover(0.5, True)}


def crop(camera: Camera, source: Image, source_camera: Camera, share: float,
         rng: np.random.Generator) -> Picture:
    """Return a picture like a window: each ray shows what the other camera has on it."""
    reach = 0.5 * np.sqrt(share) * np.array([camera.width / camera.fx, camera.height / camera.fy])
    middle = camera.normalize_points(np.array([[camera.width / 2, camera.height / 2]]))[0]
    corners = np.stack([middle - reach, middle + reach])
    depth = rng.uniform(1.5, 2.5)
    return Picture(depth * np.append(corners[0], 1.0), depth * np.array([2 * reach[0], 0.0, 0.0]),
                   depth * np.array([0.0, 2 * reach[1], 0.0]), source,
                   source_camera.project_normalized(corners).ravel())


def shrink(camera: Camera, source: Image, source_camera: Camera, share: float,
           rng: np.random.Generator, turn_deg: float = 0.0) -> Picture:
    """Return a picture that shows the whole other image, seen from the side by an angle."""
    height, width = source.shape[:2]
    small = min(1.0, np.sqrt(share) * camera.width / width)
    texture = cv2.resize(source, None, fx=small, fy=small, interpolation=cv2.INTER_AREA)
    region = np.array([0.0, 0.0, texture.shape[1] - 1.0, texture.shape[0] - 1.0])
    turn = Rotation.from_euler('y', turn_deg, degrees=True).as_matrix()
    coarse = replace(camera, width=camera.width // 8, height=camera.height // 8,
                     fx=camera.fx / 8, fy=camera.fy / 8, cx=camera.cx / 8, cy=camera.cy / 8)
    middle = np.array([0.0, 0.0, rng.uniform(1.5, 2.5)])
    right, down = turn @ [1.0, 0.0, 0.0], np.array([0.0, height / width, 0.0])
    for _ in range(12):  # until it takes its share of the image
        picture = Picture(middle - 0.5 * (right + down), right, down,
                          np.asarray(texture, dtype=np.uint8), region)
        covered = float(_places_on(picture, coarse, np.eye(4))[0].mean())
        growth = np.clip(np.sqrt(share / max(covered, 1e-3)), 0.5, 2.0)
        right, down = growth * right, growth * down
    return picture


def warp(camera: Camera, source: Image, source_camera: Camera, share: float,
         rng: np.random.Generator) -> Picture:
    """Return a picture that is seen from the side, by 30 to 60 degrees."""
    angle = rng.uniform(30.0, 60.0) * rng.choice([-1.0, 1.0])
    return shrink(camera, source, source_camera, share, rng, angle)


#: Kinds of pictures, by name.
PICTURES = {'crop': crop, 'shrunk': shrink, 'warped': warp}


def hang(image: Image, picture: Picture, camera: Camera, first_from_camera: NDArray[np.float64]
         ) -> Image:
    """Return an image with a picture, seen by a camera (4, 4) that has moved since it was hung."""
    inside, across = _places_on(picture, camera, first_from_camera)
    low, high = picture.region[:2], picture.region[2:]
    pixels = (low + across * (high - low)).astype(np.float32)
    shown = cv2.remap(picture.texture, pixels[..., 0], pixels[..., 1], cv2.INTER_LINEAR,
                      borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(np.where(inside[..., None], shown, image), dtype=np.uint8)


def _places_on(picture: Picture, camera: Camera, first_from_camera: NDArray[np.float64]
               ) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Return which pixels (h, w) show the picture, and where on it (h, w, 2): 0 to 1."""
    rays = _rays(camera) @ first_from_camera[:3, :3].T
    begin = first_from_camera[:3, 3] - picture.corner
    normal = np.cross(picture.right, picture.down)
    with np.errstate(divide='ignore', invalid='ignore'):
        distances = -(begin @ normal) / (rays @ normal)
        points = begin + distances[..., None] * rays
        across = np.stack([points @ one / (one @ one) for one in (picture.right, picture.down)],
                          axis=-1)
        inside = (distances > 0.0) & ((across >= 0.0) & (across <= 1.0)).all(axis=-1)
    return inside, np.where(inside[..., None], across, 0.0)


@lru_cache(maxsize=8)
def _rays(camera: Camera) -> NDArray[np.float64]:
    """Return the direction (h, w, 3) of each pixel; NaN where the lens shows nothing."""
    rows, columns = np.mgrid[:camera.height, :camera.width]
    points = camera.normalize_points(np.stack([columns, rows], axis=-1).reshape(-1, 2))
    return np.column_stack([points, np.ones(len(points))]).reshape(*rows.shape, 3)


def mirrored_map(world: World, rng: np.random.Generator) -> World:
    """Mirror the landmarks about an upright plane through their middle; keyframes stay."""
    landmarks = world.landmark_map
    normal = _level_direction(rng)
    mirror = np.eye(3) - 2.0 * np.outer(normal, normal)
    middle = landmarks.centers.mean(axis=0)
    turns = mirror @ Rotation.from_quat(landmarks.quats_xyzw).as_matrix() @ np.diag([-1, 1, 1])
    return world._replace(landmark_map=replace(
        landmarks, centers=(landmarks.centers - middle) @ mirror + middle,
        quats_xyzw=Rotation.from_matrix(turns).as_quat()))


def moved_half(metres: float) -> Callable[[World, np.random.Generator], World]:
    """Return what moves all on one side of an upright plane through the room, on the level."""
    def change(world: World, rng: np.random.Generator) -> World:
        landmarks, layer = world.landmark_map, world.layer
        points = [layer.points_in_map(row) for row in range(len(layer))]
        middle = np.median(np.concatenate(points), axis=0)
        normal, shift = _level_direction(rng), metres * _level_direction(rng)
        moved = []
        for pose, ours in zip(layer.map_from_camera, points, strict=True):
            camera_from_map = invert_transform(pose)
            ours[(ours - middle) @ normal > 0.0] += shift
            moved.append(ours @ camera_from_map[:3, :3].T + camera_from_map[:3, 3])
        centers = landmarks.centers.copy()
        centers[(centers - middle) @ normal > 0.0] += shift
        return World(replace(landmarks, centers=centers),
                     replace(layer, points=np.concatenate(moved).astype(np.float32)), shift)
    return change


def twin(share: float, removed: int) -> Callable[[World, np.random.Generator], World]:
    """Return what adds a room that looks the same, without some of the objects.

    The layer has this share of the second room's keyframes: the first ones of its recording.
    """
    def change(world: World, rng: np.random.Generator) -> World:
        landmarks, layer = world.landmark_map, world.layer
        shift = np.array([_TWIN_AWAY_M, 0.0, 0.0])
        kept = np.sort(rng.permutation(len(landmarks))[:max(1, len(landmarks) - removed)])
        second = landmarks.select(kept.tolist())
        both = LandmarkMap(
            landmarks.frame_id,
            landmarks.landmark_ids + tuple(f'{one}_twin' for one in second.landmark_ids),
            landmarks.labels + second.labels, landmarks.class_ids + second.class_ids,
            np.concatenate([landmarks.centers, second.centers + shift]),
            np.concatenate([landmarks.semi_axes, second.semi_axes]),
            np.concatenate([landmarks.quats_xyzw, second.quats_xyzw]),
            landmarks.details + second.details if landmarks.details else ())
        count = round(share * len(layer))
        poses, end = layer.map_from_camera[:count].copy(), layer.offsets[count]
        poses[:, :3, 3] += shift
        return World(both, replace(
            layer, map_from_camera=np.concatenate([layer.map_from_camera, poses]),
            offsets=np.concatenate([layer.offsets,
                                    layer.offsets[-1] + layer.offsets[1:count + 1]]),
            pixels=np.concatenate([layer.pixels, layer.pixels[:end]]),
            points=np.concatenate([layer.points, layer.points[:end]]),
            descriptors=np.concatenate([layer.descriptors, layer.descriptors[:end]]),
            words=np.concatenate([layer.words, layer.words[:end]])), shift)
    return change


def _level_direction(rng: np.random.Generator) -> NDArray[np.float64]:
    angle = rng.uniform(0.0, 2.0 * np.pi)
    return np.array([np.cos(angle), np.sin(angle), 0.0])


def _rounded(image: NDArray[np.float64]) -> Image:
    return np.asarray(np.clip(np.round(image), 0, 255), dtype=np.uint8)
