# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The cases: changes of queries, map and layer, and the true poses of the changed queries."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.fit.covariance import odometry_deviations
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import invert_transform, make_transform, pose_error
from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.offline.datasets.frames import RawFrame

Image = NDArray[np.uint8]
Floats = NDArray[np.float64]
Rng = np.random.Generator
# A picture shows a mapped image whose viewing direction differs by more than 60 degrees. A second
# look is about 20 cm from the first.
_AWAY_COS = 0.5
_SECOND_M, _SECOND_RANGE_M, _SECOND_DEG = 0.2, (0.1, 0.35), 25.0


@dataclass(frozen=True)
class Place:
    """A mapped part of a site, and images of the remaining part: queries and second looks."""

    site: str
    name: str  # begins with the name of the site
    model: str  # weights of YOLO
    mapped: tuple[RawFrame, ...]
    asked: tuple[RawFrame, ...]
    seconds: tuple[RawFrame, ...]
    map_file: Path | None = None  # None: the map is built from the mapped images


class World(NamedTuple):
    """A map, its layer, and the shift (3,) to the other place where a query also fits [m]."""

    landmark_map: LandmarkMap
    layer: KeyframeLayer
    shift_m: Floats


@dataclass(frozen=True)
class Case:
    """The differences from a plain query."""

    image: str = ''  # name of a change of the image
    picture: tuple[str, float] | None = None  # of the mapped place: kind, share of the image
    looks: int = 1  # 2: the robot looks once more from 20 cm to the side
    is_strange: bool = False  # the image is of another site: every accepted pose is false
    focal: float = 1.0  # factor of the focal length that the robot assumes
    features: int = 3000
    draws_classes: bool = False  # the class of each box is drawn at random
    prior: str = ''  # a wrong prior: 'height' (1 to 3 m too high) or 'vertical' (by 30 degrees)
    world: Callable[[World, Rng], World] | None = None  # changes map and layer
    truths: tuple[int, ...] = (0,)  # positions of the query, in shifts of the world: first counts


class Query(NamedTuple):
    """Images of one robot, oldest first, and its true poses at the last; none at another site.

    Each image comes with the camera that the robot assumes, and odom_from_camera or None.
    """

    shots: list[tuple[Image, Camera, Floats | None]]
    truths: tuple[Floats, ...]
    up_in_camera: Floats | None
    height_range_m: tuple[float, float]


def _light_unevenly(image: Image, rng: Rng) -> Floats:
    """Vary the light linearly across the image, from a factor of 1.6 to 0.2."""
    angle = rng.uniform(0.0, 2.0 * np.pi)
    y, x = np.mgrid[-1.0:1.0:image.shape[0] * 1j, -1.0:1.0:image.shape[1] * 1j]
    along = (x * np.cos(angle) + y * np.sin(angle)) / np.sqrt(2.0)
    return np.asarray(image * (0.9 + 0.7 * along)[..., None])


def _cover(image: Image, share: float, other: Image | None, rng: Rng) -> Image:
    """Cover a share of the image from one side, in grey or with another image."""
    height, width = image.shape[:2]
    rows, columns = round(share * height), round(share * width)
    sides = np.s_[:, :columns], np.s_[:, width - columns:], np.s_[:rows], np.s_[height - rows:]
    covered = image.copy()
    part = covered[sides[int(rng.integers(4))]]
    part[:] = 110 if other is None else cv2.resize(other, part.shape[1::-1])
    return covered


#: Changes of an image, by name: functions of the image, another site's image, and a generator.
IMAGE_CHANGES: dict[str, Callable[[Image, Image, Rng], Any]] = {
    'dark and noisy': lambda image, _, rng: image * 0.25 + rng.normal(0.0, 6.0, image.shape),
    'blurred': lambda image, *_: cv2.GaussianBlur(image, (0, 0), 2.5),
    'unevenly lit': lambda image, _, rng: _light_unevenly(image, rng),
    'half covered': lambda image, _, rng: _cover(image, 0.5, None, rng),
    'occluder on 30 %': lambda image, other, rng: _cover(image, 0.3, other, rng),
    'occluder on 50 %': lambda image, other, rng: _cover(image, 0.5, other, rng),
    'mirrored': lambda image, *_: image[:, ::-1]}


class Picture(NamedTuple):
    """A textured rectangle in front of a camera: a corner (3,) and two edge vectors (3,) [m]."""

    corner: Floats
    right: Floats
    down: Floats
    texture: Image


def make_picture(kind: str, share: float, camera: Camera, source: Image, source_camera: Camera,
                 rng: Rng) -> Picture:
    """Return a picture that covers a share of a camera's image.

    A 'crop' is like a window: each pixel shows the same ray as in the source's camera. 'shrunk'
    is the complete source image; 'warped' is the same, seen from the side by 30 to 60 degrees.
    """
    size = np.array([source_camera.width, source_camera.height])
    depth, angle = rng.uniform(1.5, 2.5), rng.uniform(30.0, 60.0) * rng.choice([-1.0, 1.0])
    if kind == 'crop':
        reach = 0.5 * np.sqrt(share) * np.array([camera.width / camera.fx,
                                                 camera.height / camera.fy])
        ends = source_camera.project_normalized(np.stack([-reach, reach]))
        (left, top), (right, bottom) = np.clip(np.round(ends), 0, size - 1).astype(int).tolist()
        low, high = source_camera.normalize_points(np.array([[left, top], [right, bottom]]))
        return Picture(depth * np.append(low, 1.0), depth * np.array([high[0] - low[0], 0.0, 0.0]),
                       depth * np.array([0.0, high[1] - low[1], 0.0]),
                       source[top:bottom + 1, left:right + 1])
    small = size * min(1.0, np.sqrt(share) * camera.width / size[0])
    texture = cv2.resize(source, small.astype(int).tolist(), interpolation=cv2.INTER_AREA)
    turn = Rotation.from_euler('y', angle if kind == 'warped' else 0.0, degrees=True)
    across, down = turn.apply([1.0, 0.0, 0.0]), np.array([0.0, size[1] / size[0], 0.0])
    coarse = replace(camera, width=camera.width // 8, height=camera.height // 8,
                     fx=camera.fx / 8, fy=camera.fy / 8, cx=camera.cx / 8, cy=camera.cy / 8)
    for _ in range(12):  # until it covers its share
        picture = Picture(np.array([0.0, 0.0, depth]) - 0.5 * (across + down), across, down,
                          np.asarray(texture, dtype=np.uint8))
        covered = float(_places_on(picture, coarse, np.eye(4))[0].mean())
        growth = np.clip(np.sqrt(share / max(covered, 1e-3)), 0.5, 2.0)
        across, down = growth * across, growth * down
    return picture


def hang(image: Image, picture: Picture, camera: Camera, first_from_camera: Floats) -> Image:
    """Draw a picture into an image of a camera that has moved by first_from_camera (4, 4)."""
    inside, places = _places_on(picture, camera, first_from_camera)
    pixels = (places * (np.array(picture.texture.shape[1::-1]) - 1)).astype(np.float32)
    shown = cv2.remap(picture.texture, pixels[..., 0], pixels[..., 1], cv2.INTER_LINEAR)
    return np.asarray(np.where(inside[..., None], shown, image), dtype=np.uint8)


def _places_on(picture: Picture, camera: Camera, first_from_camera: Floats
               ) -> tuple[NDArray[np.bool_], Floats]:
    """Return a mask (h, w) of pixels that show the picture, and places on it (h, w, 2), 0 to 1."""
    rays = _rays(camera) @ first_from_camera[:3, :3].T
    begin = first_from_camera[:3, 3] - picture.corner
    normal = np.cross(picture.right, picture.down)
    with np.errstate(divide='ignore', invalid='ignore'):
        distances = -(begin @ normal) / (rays @ normal)
        points = begin + distances[..., None] * rays
        places = np.stack([points @ edge / (edge @ edge)
                           for edge in (picture.right, picture.down)], axis=-1)
        inside = (distances > 0.0) & ((places >= 0.0) & (places <= 1.0)).all(axis=-1)
    return inside, np.where(inside[..., None], places, 0.0)


@lru_cache(maxsize=8)
def _rays(camera: Camera) -> Floats:
    """Return the ray (h, w, 3) of each pixel; NaN outside the lens's field of view."""
    rows, columns = np.mgrid[:camera.height, :camera.width]
    points = camera.normalize_points(np.stack([columns, rows], axis=-1).reshape(-1, 2))
    return np.column_stack([points, np.ones(len(points))]).reshape(*rows.shape, 3)


def mirrored_map(world: World, rng: Rng) -> World:
    """Mirror the landmarks about a vertical plane through their mean; keyframes stay."""
    landmarks, normal = world.landmark_map, _level_direction(rng)
    mirror = np.eye(3) - 2.0 * np.outer(normal, normal)
    middle = landmarks.centers.mean(axis=0)
    turns = mirror @ Rotation.from_quat(landmarks.quats_xyzw).as_matrix() @ np.diag([-1, 1, 1])
    return world._replace(landmark_map=replace(
        landmarks, centers=(landmarks.centers - middle) @ mirror + middle,
        quats_xyzw=Rotation.from_matrix(turns).as_quat()))


def moved_half(metres: float, world: World, rng: Rng) -> World:
    """Move everything on one side of a vertical plane through the room, horizontally."""
    landmarks, layer = world.landmark_map, world.layer
    points = [layer.points_in_map(row) for row in range(len(layer))]
    middle = np.median(np.concatenate(points), axis=0)
    normal, shift = _level_direction(rng), metres * _level_direction(rng)
    centers = landmarks.centers.copy()
    for some in (centers, *points):
        some[(some - middle) @ normal > 0.0] += shift
    cameras = [invert_transform(pose) for pose in layer.map_from_camera]
    moved = [some @ camera[:3, :3].T + camera[:3, 3]
             for some, camera in zip(points, cameras, strict=True)]
    return World(replace(landmarks, centers=centers),
                 replace(layer, points=np.concatenate(moved).astype(np.float32)), shift)


def twin(share: float, removed: int, world: World, rng: Rng) -> World:
    """Add a room 20 m away that looks the same, with some objects removed.

    The layer has this share of the second room's keyframes, from the start of its recording.
    """
    landmarks, layer, shift = world.landmark_map, world.layer, np.array([20.0, 0.0, 0.0])
    kept = rng.permutation(len(landmarks))[:max(1, len(landmarks) - removed)]
    second = landmarks.select(np.sort(kept).tolist())
    count = round(share * len(layer))
    poses, end = layer.map_from_camera[:count].copy(), layer.offsets[count]
    poses[:, :3, 3] += shift
    offsets = layer.offsets[-1] + layer.offsets[1:count + 1]
    columns: dict[str, Any] = {name: np.concatenate([column, column[:end]])
                               for name, column in vars(layer).items()
                               if name in ('pixels', 'points', 'descriptors', 'words')}
    return World(
        LandmarkMap(
            landmarks.frame_id,
            landmarks.landmark_ids + tuple(f'{name}_twin' for name in second.landmark_ids),
            landmarks.labels + second.labels, landmarks.class_ids + second.class_ids,
            np.concatenate([landmarks.centers, second.centers + shift]),
            np.concatenate([landmarks.semi_axes, second.semi_axes]),
            np.concatenate([landmarks.quats_xyzw, second.quats_xyzw]),
            landmarks.details + second.details),
        replace(layer, map_from_camera=np.concatenate([layer.map_from_camera, poses]),
                offsets=np.concatenate([layer.offsets, offsets]), deviation_per_metre=np.append(
                    layer.deviations(), layer.deviations()[:count]), **columns), shift)


def _level_direction(rng: Rng) -> Floats:
    angle = rng.uniform(0.0, 2.0 * np.pi)
    return np.array([np.cos(angle), np.sin(angle), 0.0])


def cases() -> dict[str, Case]:
    """Return all cases by name, ``FAMILY: CASE``."""
    found = {'plain: one image': Case(), 'pair: two images': Case(looks=2)}
    found |= {f'image: {name}': Case(name) for name in IMAGE_CHANGES}
    found['mirror: image'] = found.pop('image: mirrored')
    found['mirror: landmarks'] = Case(world=mirrored_map)
    for looks, strange, kind, share in product((1, 2), (False, True), ('crop', 'shrunk', 'warped'),
                                               (15, 30, 60)):
        family = 'picture' + ' pair' * (looks - 1) + ' elsewhere' * strange
        found[f'{family}: {kind}, {share} %'] = Case(
            picture=(kind, share / 100), looks=looks, is_strange=strange)
    for metres in (0.6, 1.0, 1.5, 2.0):
        found[f'moved half: {metres} m'] = Case(world=partial(moved_half, metres), truths=(0, 1))
    layers = {'full': 1.0, 'three quarters': 0.75, 'half': 0.5, 'a quarter': 0.25, 'none': 0.0}
    for layer, room, removed in product(layers, (0, 1), (0, 3)):
        name = f'twins, layer {layer}: {("first", "second")[room]} room, {removed} objects less'
        found[name] = Case(world=partial(twin, layers[layer], removed), truths=(room,))
    for factor in (0.5, 0.8, 0.9, 0.95, 1.05, 1.1, 1.2, 2.0):
        found[f'intrinsics: K times {factor}'] = Case(focal=factor)
    return found | {
        'other room: image': Case(is_strange=True), 'features: 500': Case(features=500),
        'classes: shuffled': Case(draws_classes=True),
        'prior: height outside': Case(prior='height'),
        'prior: vertical outside': Case(prior='vertical')}


def make_query(case: Case, place: Place, others: Sequence[Place], frame: RawFrame,
               shift_m: Floats, rng: Rng) -> Query | None:
    """Return a query from a frame of a place; None if there is no second look.

    ``others`` are places of other sites. ``shift_m`` is that of the changed world.
    """
    other = others[int(rng.integers(len(others)))]
    strange = other.asked[int(rng.integers(len(other.asked)))]
    # A mapped image whose direction differs by more than 60 degrees, or else differs most.
    cosines = np.array([pose_of(mapped)[:3, 2] for mapped in place.mapped]) @ pose_of(frame)[:3, 2]
    away = np.nonzero(cosines < _AWAY_COS)[0]
    source = place.mapped[int(rng.choice(away)) if len(away) else int(np.argmin(cosines))]
    if case.is_strange:
        place, frame = other, strange
    frames = [frame, *_second_look(frame, place.seconds)][:case.looks]
    if len(frames) < case.looks:
        return None
    poses = [pose_of(raw) for raw in frames]
    picture = case.picture and make_picture(*case.picture, frame.color()[1], *source.color(), rng)
    shots: list[tuple[Image, Camera, Floats | None]] = []
    # `odom_from_camera` of one or two poses, with the errors that the package assumes.
    # Poses in files are rounded, so their rotations are orthonormalized.
    exact = [make_transform(Rotation.from_matrix(pose[:3, :3]).as_matrix(), pose[:3, 3])
             for pose in poses]
    steps = [invert_transform(exact[0]) @ pose for pose in exact]
    errors = [odometry_deviations(step) * rng.normal(size=6) for step in steps]
    odometry = [step @ make_transform(Rotation.from_rotvec(error[3:]).as_matrix(), error[:3])
                for step, error in zip(steps, errors, strict=True)]
    for raw, pose, odom in zip(frames, poses, odometry, strict=True):
        image, camera = raw.color()
        if picture is not None:
            image = hang(image, picture, camera, invert_transform(poses[0]) @ pose)
        if case.image:
            changed = IMAGE_CHANGES[case.image](image, strange.color()[0], rng)
            image = np.ascontiguousarray(np.clip(np.round(changed), 0, 255), dtype=np.uint8)
        camera = replace(camera, fx=case.focal * camera.fx, fy=case.focal * camera.fy)
        shots.append((image, camera, odom if case.looks > 1 else None))
    up, height = pose[2, :3], float(pose[2, 3])
    tilt = np.cross(up, rng.normal(size=3))
    tilt *= np.radians(30.0) / np.linalg.norm(tilt)
    return Query(
        shots, () if case.is_strange else tuple(make_transform(
            pose[:3, :3], pose[:3, 3] + shifts * shift_m) for shifts in case.truths),
        Rotation.from_rotvec(tilt).apply(up) if case.prior == 'vertical' else None,
        (height + 1.0, height + 3.0) if case.prior == 'height' else (-np.inf, np.inf))


def pose_of(frame: RawFrame) -> Floats:
    """Return map_from_camera (4, 4) of a frame that has one."""
    assert frame.map_from_camera is not None
    return frame.map_from_camera


def _second_look(frame: RawFrame, others: Sequence[RawFrame]) -> list[RawFrame]:
    """Return the image at about 20 cm in a similar direction; none if there is no such image."""
    found = [(abs(distance - _SECOND_M), row) for row, other in enumerate(others)
             for distance, angle in [pose_error(pose_of(frame), pose_of(other))]
             if _SECOND_RANGE_M[0] <= distance <= _SECOND_RANGE_M[1] and angle < _SECOND_DEG]
    return [others[min(found)[1]]] if found else []
