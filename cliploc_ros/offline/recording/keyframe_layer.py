# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Build a layer of keyframes: choose images, extract features, and place them in the map."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.depth import DepthImage, points_in_color
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.core.keyframes import layer
from cliploc_ros.core.keyframes.features import SIFT, FeatureKind
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import DatasetError, MappingError
from cliploc_ros.offline.datasets.frames import Frames, PosedImage, undistorted
from cliploc_ros.offline.mapping.triangulation import check_scale
from cliploc_ros.offline.recording.layer_words import with_words
from cliploc_ros.units import NS_PER_S

# Features extracted from an image, before those without a point are left out.
_MOST_FOUND = 2000
# A larger image is scaled down first.
_LONGEST_PX = 800
# An image with fewer points is not a keyframe. Both limit --keyframe-points of build_map.
_LEAST_POINTS = 20
# Stored images are for visual inspection; each takes 7 to 9 kB.
_IMAGE_PX, _JPEG_QUALITY = 256, 60
# Rays that cross at a smaller angle do not locate a point accurately enough.
_LEAST_PARALLAX = np.radians(1.5)
# Greatest distance of a ray from its point: 2 px at f = 525 px.
_MOST_ERROR = 2.0 / 525.0
# Neighbours of an image, for matching: the nearest images with a similar direction.
_NEIGHBOURS = 8
_LEAST_M, _MOST_M, _MOST_COS = 0.05, 2.0, np.cos(np.radians(40.0))
#: Range of depths of points in a room or hall [m].
_DEPTHS_M = (0.2, 40.0)
# Greatest number of keyframes in whose images depth is compared with triangulated points.
_COMPARED = 6
# Poses jump by more than this against the images [m] and this many times the median. Chosen: the
# kitchen's poses differ by up to 0.04 m. An image is compared with this number of later images;
# this share of the measurements across a jump agrees with their median up to this share of it.
_JUMP_M, _UNUSUAL, _ACROSS, _AGREE, _JUMP_SPREAD = 0.12, 8.0, 3, 0.6, 0.5
# Least number of points that locate an image.
_LEAST_SEEN = 12
# A neighbouring pixel whose depth is greater by this share belongs to another surface.
_BESIDE, _EDGE = np.ones((3, 3), dtype=np.uint8), 0.1


@dataclass(frozen=True)
class LayerOptions:
    """Spacing of keyframes, and the number of their points."""

    #: An image becomes a keyframe unless a keyframe is nearer than both limits. 0: every image.
    distance_m: float = 0.1
    angle_deg: float = 5.0
    #: Points per keyframe. A point takes 146 bytes: 600 points of 50 keyframes take 4.4 MB.
    most_points: int = 600
    #: Whether to store small images of the keyframes, for visual inspection
    images: bool = False
    kind: FeatureKind = SIFT  #: Kind of the features


_DEFAULT = LayerOptions()


class PosedFeatures(NamedTuple):
    """The n features of a posed image."""

    map_from_camera: NDArray[np.float64]  #: (4, 4)
    bearings: NDArray[np.float64]  #: (n, 2): on the plane z = 1
    descriptors: NDArray[np.uint8]  #: (n, d)


class _Keyframe(NamedTuple):
    """A keyframe: its features (strongest first), their depths, its JPEG, and its camera."""

    posed: PosedFeatures
    depths: NDArray[np.float64]
    jpeg: bytes
    camera: Camera  #: Camera of the undistorted image
    stamp_ns: int


def build_layer(frames: Frames, landmark_map: LandmarkMap, options: LayerOptions = _DEFAULT
                ) -> layer.KeyframeLayer:
    """Build the keyframes of all cameras of a recording, in the coordinate frame of its poses.

    Parameters
    ----------
    frames : Frames
        Images with depth, or overlapping images, whose points are triangulated.
    landmark_map : LandmarkMap
        The map that the layer belongs to.

    Raises
    ------
    MappingError
        No image has enough points.
    DatasetError
        The images show that depth has another unit, or that the poses jump.
    """
    parts = [[_look(frame, options) for frame in _chosen(part, options)] for part in frames.each]
    seen = list(chain.from_iterable(parts))
    images, kind = [keyframe.posed for keyframe in seen], options.kind
    of_images = list[NDArray[np.float64]]()
    chosen = []  # keyframes, the points of their features, and the rows of these features
    for number, keyframe in enumerate(seen):
        # points (n, 3) in the camera's coordinate frame; NaN where unknown
        if np.isfinite(keyframe.depths).any():
            points = np.column_stack([keyframe.posed.bearings, np.ones(len(keyframe.depths))]
                                     ) * keyframe.depths[:, None]
        else:
            points = triangulate(images, number, kind)
        of_images.append(points)
        # the strongest features that have a point
        rows = np.nonzero(np.isfinite(points).all(axis=1))[0][:options.most_points]
        if len(rows) >= _LEAST_POINTS:
            chosen.append((keyframe, points[rows], rows))
    for part, own in zip(frames.each, parts, strict=True):
        _check_depth(own, kind, f' of {part.camera}' if part.camera else '')
        _check_steps(own, [of_images.pop(0) for _ in own], kind, frames.source)
    if not chosen:
        raise MappingError(f'{frames.source}: no keyframe: of {len(seen)} images, none has '
                           f'{_LEAST_POINTS} points; record depth, or overlapping '
                           'images 5 cm apart')
    cameras = [keyframe.camera for keyframe, _, _ in chosen]
    descriptors = np.concatenate([keyframe.posed.descriptors[rows]
                                  for keyframe, _, rows in chosen])
    pixels = np.concatenate([
        keyframe.posed.bearings[rows] * (keyframe.camera.fx, keyframe.camera.fy)
        + (keyframe.camera.cx, keyframe.camera.cy) for keyframe, _, rows in chosen])
    different = tuple(dict.fromkeys(cameras))
    # stamps of images without time begin at 0
    date = str(np.datetime64(seen[0].stamp_ns, 'ns'))[:10] * (seen[0].stamp_ns > 10**17)
    built = with_words(layer.KeyframeLayer(
        landmark_map.frame_id, landmark_map.landmark_ids,
        landmark_map.centers.astype(np.float32), different,
        np.array([keyframe.posed.map_from_camera for keyframe, _, _ in chosen]),
        np.cumsum([0, *(len(rows) for _, _, rows in chosen)]),
        np.clip(np.round(pixels * layer.PIXEL_SCALE), 0, 65535).astype(np.uint16),
        np.concatenate([points for _, points, _ in chosen]).astype(np.float32),
        descriptors, np.zeros(len(descriptors), np.uint16), descriptors[:1],
        np.array([layer.FROM_DEPTH if np.isfinite(keyframe.depths).any() else layer.TRIANGULATED
                  for keyframe, _, _ in chosen]),
        camera_rows=None if len(different) == 1 else np.array(
            [different.index(own) for own in cameras]), kind=kind,
        sources=(layer.Source(frames.source.name, date),)))
    if not options.images:
        return built
    jpegs = [keyframe.jpeg for keyframe, _, _ in chosen]
    return replace(built, images=np.frombuffer(b''.join(jpegs), dtype=np.uint8),
                   image_offsets=np.cumsum([0, *map(len, jpegs)]))


def _check_depth(seen: Sequence[_Keyframe], kind: FeatureKind, of: str) -> None:
    """Refuse keyframes with depth in another unit than their poses.

    DatasetError: points that are triangulated in a sample of the images have other depths.
    """
    images, ratios = [keyframe.posed for keyframe in seen], list[float]()
    for number in range(0, len(seen), 1 + len(seen) // _COMPARED):
        if np.isfinite(seen[number].depths).any():
            found = triangulate(images, number, kind)[:, 2] / seen[number].depths
            ratios += found[np.isfinite(found)].tolist()
    if len(ratios) >= _LEAST_POINTS:
        check_scale(float(np.median(ratios)), of, 'triangulated points')


def _check_steps(keyframes: Sequence[_Keyframe], points: Sequence[NDArray[np.float64]],
                 kind: FeatureKind, where: object) -> None:
    """Refuse poses that jump against the images, which are in order, with the points of each.

    DatasetError: images after a step are located elsewhere than their poses say, by the points of
    images before it, and the reverse, and most pairs across the step agree by how far.
    """
    found = [(first, second, shift) for first in range(len(keyframes))
             for second in range(first + 1, min(first + 1 + _ACROSS, len(keyframes)))
             for shift in _shifts(keyframes, points, first, second, kind)]
    of_pair = np.array([pair for *pair, _ in found], dtype=np.int64).reshape(-1, 2)
    shifts = np.array([shift for *_, shift in found]).reshape(-1, 3)
    median_m = float(np.median([0.0, *np.linalg.norm(shifts, axis=1)]))
    least_m, jumps = max(_JUMP_M, _UNUSUAL * median_m), list[tuple[int, int, float]]()
    for after in np.unique(of_pair[:, 1]).tolist():
        across = (of_pair[:, 0] < after) & (after <= of_pair[:, 1])
        jump = np.median(shifts[across], axis=0)
        size_m = float(np.linalg.norm(jump))
        agree = across & (np.linalg.norm(shifts - jump, axis=1) < _JUMP_SPREAD * size_m)
        # a false match or pose displaces one image, a jump displaces all of them
        if (size_m > least_m and agree.sum() >= _AGREE * across.sum()
                and np.ptp(of_pair[agree], axis=0).all()):
            jumps.append((int(agree.sum()), -after, size_m))
    if jumps:
        _, after, size_m = max(jumps)
        raise DatasetError(
            f'{where}: the poses jump by {size_m:.2f} m at '
            f'{keyframes[-after].stamp_ns / NS_PER_S:.2f} s, unlike the images: use the recording '
            'before or after it alone, or give corrected poses as `trajectory`')


def _shifts(keyframes: Sequence[_Keyframe], points: Sequence[NDArray[np.float64]], first: int,
            second: int, kind: FeatureKind) -> Iterator[NDArray[np.float64]]:
    """Yield how far (3,) the second image is displaced against the first one, in map axes [m].

    There are two measurements, by the points of each image, or fewer if these do not locate the
    other one.
    """
    rows, _ = kind.match(*(kind.units(keyframes[row].posed.descriptors)
                           for row in (first, second)))
    for source, target, pairs, sign in ((first, second, rows, 1.0),
                                        (second, first, rows[:, ::-1], -1.0)):
        pairs = pairs[np.isfinite(points[source][pairs[:, 0]]).all(axis=1)]
        if len(pairs) < _LEAST_SEEN:
            continue
        ours, theirs = (keyframes[row].posed for row in (source, target))
        _, turn, shift, kept = cv2.solvePnPRansac(
            points[source][pairs[:, 0]], theirs.bearings[pairs[:, 1]], np.eye(3), None,
            reprojectionError=2.0 * _MOST_ERROR, iterationsCount=200)
        if kept is not None and len(kept) >= max(_LEAST_SEEN, 0.3 * len(pairs)):
            place = -Rotation.from_rotvec(turn[:, 0]).inv().apply(shift[:, 0])
            yield sign * (theirs.map_from_camera[:3, 3] - ours.map_from_camera[:3, 3]
                          - ours.map_from_camera[:3, :3] @ place)


def _chosen(frames: Frames, options: LayerOptions) -> Iterator[PosedImage]:
    """Yield the images of the keyframes: those without an earlier keyframe nearby."""
    chosen = np.empty((0, 4, 4))

    def is_new(place: int, stamp_ns: int, pose: NDArray[np.float64] | None) -> bool:
        nonlocal chosen
        if pose is None:
            return False
        # rotations are compared with the few near ones only, since that takes most of the time
        near = chosen[np.linalg.norm(chosen[:, :3, 3] - pose[:3, 3], axis=1) < options.distance_m]
        turns = pose[:3, :3].T @ near[:, :3, :3]
        if len(near) and (np.degrees(Rotation.from_matrix(turns).magnitude())
                          < options.angle_deg).any():
            return False
        chosen = np.concatenate([chosen, pose[None]])
        return True
    for raw in frames.read_raw(is_new):
        with suppress(DatasetError):  # the recorder reports unusable images
            yield raw.decode()


def _look(frame: PosedImage, options: LayerOptions) -> _Keyframe:
    """Extract the features of an image; if it has depth, only features with known depth."""
    assert frame.map_from_camera is not None
    features = options.kind.extract(frame.image_rgb, _MOST_FOUND, _LONGEST_PX)
    bearings = frame.camera.normalize_points(features.pixels)
    depths = np.full(len(features), np.nan)
    known = np.isfinite(bearings).all(axis=1)
    if frame.depth is not None:
        depths = depths_of_points(frame.depth, frame.camera, features.pixels).astype(np.float64)
        known &= np.isfinite(depths)
        known &= np.cumsum(known) <= options.most_points
    return _Keyframe(PosedFeatures(frame.map_from_camera, bearings[known],
                                   features.descriptors[known]), depths[known],
                     _small_jpeg(frame) if options.images else b'', frame.camera.pinhole,
                     frame.stamp_ns)


def _small_jpeg(frame: PosedImage) -> bytes:
    """Return a small undistorted image as JPEG."""
    camera = frame.camera
    scale = min(1.0, _IMAGE_PX / max(camera.width, camera.height))
    width, height = (max(1, round(scale * side)) for side in (camera.width, camera.height))
    x, y = width / camera.width, height / camera.height
    small = replace(camera, width=width, height=height, fx=x * camera.fx, fy=y * camera.fy,
                    cx=x * (camera.cx + 0.5) - 0.5, cy=y * (camera.cy + 0.5) - 0.5)
    image = undistorted(np.asarray(cv2.resize(
        frame.image_rgb, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8), small)
    _, content = cv2.imencode('.jpg', np.ascontiguousarray(image[..., ::-1]),
                              [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return bytes(content)


def triangulate(images: Sequence[PosedFeatures], row: int, kind: FeatureKind = SIFT
                ) -> NDArray[np.float64]:
    """Triangulate the points (n, 3) of an image's features, in its camera's frame [m].

    Each feature is matched in the neighbouring images, and each match gives a point. The point
    that most matches agree with is kept; ties are broken by the widest angle. NaN: no point.
    """
    ours = images[row]
    poses = np.array([image.map_from_camera for image in images])
    distances = np.linalg.norm(poses[:, :3, 3] - poses[row, :3, 3], axis=1)
    cosines = 0.5 * (np.einsum('kij,ij->k', poses[:, :3, :3], poses[row, :3, :3]) - 1.0)
    fit = (distances > _LEAST_M) & (distances < _MOST_M) & (cosines > _MOST_COS)
    order = np.argsort(distances, kind='stable')
    neighbours = order[fit[order]][:_NEIGHBOURS].tolist()
    count = len(ours.bearings)
    seen = np.full((len(neighbours), count, 2), np.nan)
    cameras = np.array([invert_transform(images[neighbour].map_from_camera) @ ours.map_from_camera
                        for neighbour in neighbours]).reshape(-1, 4, 4)
    descriptors = kind.units(ours.descriptors)
    for number, neighbour in enumerate(neighbours):
        pairs, _ = kind.match(descriptors, kind.units(images[neighbour].descriptors))
        seen[number, pairs[:, 0]] = images[neighbour].bearings[pairs[:, 1]]
    best = np.full((count, 3), np.nan)
    scores = np.zeros(count)
    for number in range(len(neighbours)):
        points, angles = _crossings(ours.bearings, seen[number], cameras[number])
        agreed = np.sum([_agrees(points, other, camera)
                         for other, camera in zip(seen, cameras, strict=True)], axis=0)
        sound = (_agrees(points, seen[number], cameras[number])
                 & _agrees(points, ours.bearings, np.eye(4)) & (angles >= _LEAST_PARALLAX)
                 & (points[:, 2] > _DEPTHS_M[0]) & (points[:, 2] < _DEPTHS_M[1]))
        score = np.where(sound, agreed + angles, 0.0)
        best[score > scores] = points[score > scores]
        scores = np.maximum(scores, score)
    return best


def _crossings(ours: NDArray[np.float64], theirs: NDArray[np.float64],
               theirs_from_ours: NDArray[np.float64]
               ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the midpoints (n, 3) between pairs of rays, in our frame, and their angles [rad]."""
    back = invert_transform(theirs_from_ours)
    first, second = (rays / np.linalg.norm(rays, axis=1, keepdims=True) for rays in (
        np.column_stack([bearings, np.ones(len(bearings))]) for bearings in (ours, theirs)))
    second, place = second @ back[:3, :3].T, back[:3, 3]
    cosines = np.sum(first * second, axis=1)
    along, other = first @ place, second @ place
    with np.errstate(divide='ignore', invalid='ignore'):
        reach = (along - cosines * other) / (1.0 - cosines**2)
        theirs_reach = (cosines * along - other) / (1.0 - cosines**2)
        points = 0.5 * (first * reach[:, None] + place + second * theirs_reach[:, None])
        return points, np.arccos(np.clip(cosines, -1.0, 1.0))


def _agrees(points: NDArray[np.float64], bearings: NDArray[np.float64],
            camera: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return a mask (n,): the points (n, 3) that a camera sees at its bearings (n, 2)."""
    inside = points @ camera[:3, :3].T + camera[:3, 3]
    with np.errstate(divide='ignore', invalid='ignore'):
        errors = np.linalg.norm(inside[:, :2] / inside[:, 2:] - bearings, axis=1)
        return np.asarray((inside[:, 2] > 0.0) & (errors < _MOST_ERROR))


def depths_of_points(depth: DepthImage, camera: Camera, pixels: NDArray[np.float64]
                     ) -> NDArray[np.float32]:
    """Return the depth at the pixels of a colour image.

    Parameters
    ----------
    camera : Camera
        Camera of the colour image.
    pixels : ndarray (n, 2)
        In the colour image, distorted [px].

    Returns
    -------
    ndarray (n,) float32
        Depth along z of the colour camera [m], of the nearest surface within one pixel. NaN where
        nothing was measured, and at edges, where a neighbour is much farther away.
    """
    height, width = depth.depths_m.shape
    seen, values = points_in_color(depth, camera, 1)
    places = np.round(seen * [[width / camera.width], [height / camera.height]]).astype(np.int64)
    inside = ((places >= 0) & (places < [[width], [height]])).all(axis=0)
    near = np.full((height, width), np.inf, dtype=np.float32)
    np.minimum.at(near, (places[1, inside], places[0, inside]), values[inside])
    nearest = cv2.erode(near, _BESIDE, borderType=cv2.BORDER_REPLICATE)
    furthest = cv2.dilate(np.where(np.isfinite(near), near, 0.0), _BESIDE)
    rows = np.round(pixels * (width / camera.width, height / camera.height)).astype(np.int64)
    rows = np.clip(rows, 0, (width - 1, height - 1))
    found, other = nearest[rows[:, 1], rows[:, 0]], furthest[rows[:, 1], rows[:, 0]]
    with np.errstate(invalid='ignore'):
        return np.where(np.isfinite(found) & (other - found <= _EDGE * found), found,
                        np.float32(np.nan))
