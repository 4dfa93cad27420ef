# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The plain method that users choose instead: SIFT, votes of nearest descriptors, PnP by OpenCV.

It shares no code with cliploc_ros.core.keyframes, has no limit of size, and accepts every pose.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.datasets.depth import depths_of_points
from cliploc_ros.datasets.frames import Frame

_VOTED, _RATIO, _LEAST = 5, 0.8, 6


class Baseline:
    """Localizes among posed images with depth."""

    def __init__(self, frames: Sequence[Frame]) -> None:
        self._sift = cv2.SIFT.create()
        self._points: list[NDArray[np.float64]] = []
        self._descriptors: list[NDArray[np.float32]] = []
        for frame in frames:
            pixels, descriptors = self._features(frame.image_rgb)
            assert frame.depth is not None and frame.map_from_camera is not None
            depths = depths_of_points(frame.depth, frame.camera, pixels)
            rays = np.column_stack([frame.camera.normalize_points(pixels), np.ones(len(pixels))])
            points = rays * depths[:, None] @ frame.map_from_camera[:3, :3].T
            known = np.isfinite(depths)
            self._points.append((points + frame.map_from_camera[:3, 3])[known])
            self._descriptors.append(descriptors[known])

    @property
    def megabytes(self) -> float:
        """Return the size of points and descriptors [MB]."""
        numbers = sum(one.size for one in self._points) + sum(
            one.size for one in self._descriptors)
        return 4 * numbers / 1e6

    def localize(self, image_rgb: NDArray[np.uint8], camera: Camera) -> NDArray[np.float64] | None:
        """Return map_from_camera (4, 4); None where PnP fails."""
        pixels, descriptors = self._features(image_rgb)
        if len(pixels) < _LEAST:
            return None
        squares = [np.sum(one**2, axis=1) - 2.0 * descriptors @ one.T for one in self._descriptors]
        votes = np.argmin([one.min(axis=1) for one in squares], axis=0)
        voted = np.argsort(-np.bincount(votes, minlength=len(squares)), kind='stable')[:_VOTED]
        found, seen = [], []
        for keyframe in voted.tolist():
            distances = squares[keyframe] + np.sum(descriptors**2, axis=1)[:, None]
            nearest = np.argpartition(distances, 1, axis=1)[:, :2]
            first, second = np.take_along_axis(distances, nearest, axis=1).T
            clear = first < _RATIO**2 * second
            found.append(self._points[keyframe][nearest[clear, 0]])
            seen.append(pixels[clear])
        return _solve(np.concatenate(found), np.concatenate(seen), camera)

    def _features(self, image_rgb: NDArray[np.uint8]
                  ) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        gray = cv2.cvtColor(image_rgb, cv2.COLOR_RGB2GRAY)
        points, descriptors = self._sift.detectAndCompute(gray, None)
        if descriptors is None:
            return np.empty((0, 2)), np.empty((0, 128), dtype=np.float32)
        return np.array([one.pt for one in points]), descriptors


def _solve(points: NDArray[np.float64], pixels: NDArray[np.float64], camera: Camera
           ) -> NDArray[np.float64] | None:
    if len(points) < _LEAST:
        return None
    found, turn, place, inliers = cv2.solvePnPRansac(
        points, pixels, camera.matrix, None, iterationsCount=1000, reprojectionError=3.0,
        confidence=0.9999)
    if not found or inliers is None or len(inliers) < _LEAST:
        return None
    rows = inliers.ravel()
    turn, place = cv2.solvePnPRefineLM(points[rows], pixels[rows], camera.matrix, None, turn,
                                       place)
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(turn)[0].T
    pose[:3, 3] = -pose[:3, :3] @ place.ravel()
    return pose
