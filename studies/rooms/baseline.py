# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A simple baseline: RootSIFT, tracks at the known poses, PnP of pycolmap.

The RootSIFT features (Lowe 2004; Arandjelovic and Zisserman 2012) of all map images are matched
pair by pair, and the tracks of the matches are triangulated with the known poses. An image is
matched with all map images; LO-RANSAC (Chum et al. 2003) of pycolmap finds and refines its pose.
"""

from collections.abc import Iterable
from itertools import combinations, pairwise

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.core.keyframes.features import SIFT
from cliploc_ros.offline.datasets.frames import PosedImage

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]
_FEATURES, _CONTRAST = 1500, 0.02
# Images whose viewing directions differ by more have no common points.
_MOST_DEG = 70.0
# Greatest distance of a ray of a match or track from its point [px at f = 525 px], and least
# value of the widest angle between two rays of a track.
_NEAR, _LEAST_ANGLE = 3.0 / 525.0, np.radians(1.5)
_LEAST_INLIERS = 12


class SiftMap:
    """The triangulated points of posed images, and their features."""

    def __init__(self, frames: Iterable[PosedImage]) -> None:
        seen = [(frame, *_features(frame.image_rgb, frame.camera)) for frame in frames
                if frame.map_from_camera is not None]
        self._descriptors = [descriptors for _, _, descriptors in seen]
        poses = np.array([frame.map_from_camera for frame, _, _ in seen])
        rays = [np.column_stack([bearings, np.ones(len(bearings))]) for _, bearings, _ in seen]
        starts = np.cumsum([0, *map(len, rays)])
        matches = [np.empty((0, 2), dtype=np.int64)]
        for first, second in combinations(range(len(seen)), 2):
            if poses[first, :3, 2] @ poses[second, :3, 2] < np.cos(np.radians(_MOST_DEG)):
                continue
            pairs, _ = SIFT.match(self._descriptors[first], self._descriptors[second])
            near = _is_epipolar(rays[first][pairs[:, 0]], rays[second][pairs[:, 1]],
                                invert_transform(poses[second]) @ poses[first])
            matches.append(pairs[near] + (starts[first], starts[second]))
        images = np.repeat(np.arange(len(seen)), np.diff(starts))
        #: (n, 3): the point of each feature of all images, NaN if it has none
        points = _triangulate(np.concatenate(matches), images, np.concatenate(rays), poses)
        self._points = [points[first:last] for first, last in pairwise(starts)]

    def locate(self, image_rgb: NDArray[np.uint8], camera: Camera) -> Floats | None:
        """Return map_from_camera (4, 4); None if too few features agree on a pose."""
        bearings, descriptors = _features(image_rgb, camera)
        found = set[tuple[int, float, float, float]]()
        for theirs, points in zip(self._descriptors, self._points, strict=True):
            known = np.nonzero(np.isfinite(points[:, 0]))[0]
            pairs, _ = SIFT.match(descriptors, theirs)
            pairs = pairs[np.isin(pairs[:, 1], known)]
            found |= {(feature, *points[point]) for feature, point in pairs.tolist()}
        if len(found) < _LEAST_INLIERS:
            return None
        matched = np.array(sorted(found))
        focal = 0.5 * (camera.fx + camera.fy)
        pinhole = pycolmap.Camera(model='PINHOLE', width=camera.width, height=camera.height,
                                  params=[focal, focal, 0.5 * camera.width, 0.5 * camera.height])
        pixels = bearings[matched[:, 0].astype(np.int64)] * focal + (
            0.5 * camera.width, 0.5 * camera.height)
        answer = pycolmap.estimate_and_refine_absolute_pose(pixels, matched[:, 1:], pinhole)
        if answer is None or answer['num_inliers'] < _LEAST_INLIERS:
            return None
        camera_from_map = np.eye(4)
        camera_from_map[:3] = answer['cam_from_world'].matrix()
        return invert_transform(camera_from_map)


def _features(image_rgb: NDArray[np.uint8], camera: Camera) -> tuple[Floats, NDArray[np.float32]]:
    """Return bearings (n, 2) and unit descriptors (n, 128)."""
    points, descriptors = cv2.SIFT.create(_FEATURES, contrastThreshold=_CONTRAST).detectAndCompute(
        cv2.cvtColor(image_rgb, cv2.COLOR_RGB2GRAY), None)
    if descriptors is None:
        return np.empty((0, 2)), np.empty((0, 128), dtype=np.float32)
    bearings = camera.normalize_points(np.array([point.pt for point in points], dtype=np.float64))
    known = np.isfinite(bearings).all(axis=1)
    roots = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9))
    return bearings[known], roots[known]


def _is_epipolar(ours: Floats, theirs: Floats, theirs_from_ours: Floats) -> NDArray[np.bool_]:
    """Return a mask (k,) of matches whose rays (k, 3) can meet."""
    x, y, z = theirs_from_ours[:3, 3]
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ theirs_from_ours[:3, :3]
    lines = ours @ essential.T
    lengths = np.maximum(np.linalg.norm(lines[:, :2], axis=1), 1e-12)
    return np.asarray(np.abs(np.sum(lines * theirs, axis=1)) / lengths < _NEAR)


def _triangulate(matches: Rows, images: Rows, rays: Floats, poses: Floats) -> Floats:
    """Return the point (n, 3) of each feature, from the track of its matches; NaN if none."""
    count = len(images)
    graph = coo_matrix((np.ones(len(matches)), matches.T), shape=(count, count))
    _, tracks = connected_components(graph, directed=False)
    # a track with two features of the same image is wrong
    pairs, repeats = np.unique(np.stack([tracks, images]), axis=1, return_counts=True)
    is_wrong = np.zeros(tracks.max() + 1, dtype=bool)
    is_wrong[pairs[0, repeats > 1]] = True
    used = np.bincount(tracks)[tracks] > 1
    used &= ~is_wrong[tracks]
    points = np.full((count, 3), np.nan)
    for _ in range(2):  # repeat without the features that are too far from their point
        found = _nearest_points(tracks[used], images[used], rays[used], poses)
        points[used] = found[tracks[used]]
        inside = np.einsum('nji,nj->ni', poses[images, :3, :3], points - poses[images, :3, 3])
        with np.errstate(divide='ignore', invalid='ignore'):
            errors = np.linalg.norm(inside[:, :2] / inside[:, 2:] - rays[:, :2], axis=1)
            used &= (errors < _NEAR) & (inside[:, 2] > 0.0)
        points[~used] = np.nan
        used &= np.bincount(tracks[used], minlength=len(is_wrong))[tracks] > 1
    turned = np.einsum('nij,nj->ni', poses[images, :3, :3], rays)
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    order = np.nonzero(used)[0][np.argsort(tracks[used], kind='stable')]
    for rows in np.split(order, np.nonzero(np.diff(tracks[order]))[0] + 1):
        if len(rows) < 2 or (turned[rows] @ turned[rows].T).min() > np.cos(_LEAST_ANGLE):
            points[rows] = np.nan
    points[~used] = np.nan
    return points


def _nearest_points(tracks: Rows, images: Rows, rays: Floats, poses: Floats) -> Floats:
    """Return the point (t, 3) nearest to all rays of each track; NaN if it is undetermined."""
    turned = np.einsum('nij,nj->ni', poses[images, :3, :3], rays)
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    across = np.eye(3) - turned[:, :, None] * turned[:, None, :]
    size = int(tracks.max(initial=-1)) + 1
    normal, right = np.zeros((size, 3, 3)), np.zeros((size, 3))
    np.add.at(normal, tracks, across)
    np.add.at(right, tracks, np.einsum('nij,nj->ni', across, poses[images, :3, 3]))
    sound = np.abs(np.linalg.det(normal)) > 1e-9
    found = np.full((size, 3), np.nan)
    found[sound] = np.linalg.solve(normal[sound], right[sound, :, None])[..., 0]
    return found
