# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What users have without this package: SIFT (Lowe 2004), points by depth, PnP with RANSAC."""

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import invert_transform, make_transform
from cliploc_ros.offline.datasets.frames import PosedImage
from cliploc_ros.offline.recording.keyframe_layer import depths_of_points

_MOST_FEATURES, _RATIO = 2000, 0.8
# Nearest features vote for images; those with most votes are matched one by one.
_NEIGHBOURS, _BEST_IMAGES = 4, 5
_LEAST_INLIERS, _REPROJECTION_PX, _ITERATIONS = 12, 4.0, 2000


class SiftMap:
    """The SIFT features of posed images with depth; those without depth are left out."""

    def __init__(self, frames: Iterable[PosedImage]) -> None:
        self._sift = cv2.SIFT.create(_MOST_FEATURES)
        self._points: list[NDArray[np.float64]] = []
        self._descriptors: list[NDArray[np.float32]] = []
        for frame in frames:
            if frame.depth is None or frame.map_from_camera is None:
                continue
            pixels, descriptors = self._features(frame.image_rgb)
            depths = depths_of_points(frame.depth, frame.camera, pixels)
            kept = np.isfinite(depths)
            rays = np.column_stack([frame.camera.normalize_points(pixels[kept]),
                                    np.ones(kept.sum())])
            points = rays * depths[kept, None].astype(np.float64)
            pose = frame.map_from_camera
            self._points.append(points @ pose[:3, :3].T + pose[:3, 3])
            self._descriptors.append(descriptors[kept])
        self._matcher = cv2.FlannBasedMatcher({'algorithm': 1, 'trees': 4}, {'checks': 64})
        self._matcher.add(self._descriptors)
        self._matcher.train()

    def locate(self, image_rgb: NDArray[np.uint8], camera: Camera) -> NDArray[np.float64] | None:
        """Return map_from_camera (4, 4); None where too few features agree on a pose."""
        pixels, descriptors = self._features(image_rgb)
        if len(pixels) < _LEAST_INLIERS:
            return None
        votes = np.bincount([near.imgIdx for nearest in self._matcher.knnMatch(
            descriptors, _NEIGHBOURS) for near in nearest], minlength=len(self._points))
        seen, points = [], []
        for image in np.argsort(-votes)[:_BEST_IMAGES]:
            if len(self._descriptors[image]) < 2:
                continue
            for one, other in cv2.BFMatcher().knnMatch(descriptors, self._descriptors[image], 2):
                if one.distance < _RATIO * other.distance:
                    seen.append(pixels[one.queryIdx])
                    points.append(self._points[image][one.trainIdx])
        if len(seen) < _LEAST_INLIERS:
            return None
        rays = camera.normalize_points(np.array(seen))
        is_found, turn, shift, inliers = cv2.solvePnPRansac(
            np.array(points), rays, np.eye(3), None, iterationsCount=_ITERATIONS,
            reprojectionError=_REPROJECTION_PX / camera.fx, flags=cv2.SOLVEPNP_AP3P)
        if not is_found or inliers is None or len(inliers) < _LEAST_INLIERS:
            return None
        rows = inliers.ravel()
        turn, shift = cv2.solvePnPRefineLM(np.array(points)[rows], rays[rows], np.eye(3), None,
                                           turn, shift)
        return invert_transform(make_transform(np.asarray(cv2.Rodrigues(turn)[0], dtype=float),
                                               np.asarray(shift, dtype=float).ravel()))

    def _features(self, image_rgb: NDArray[np.uint8]
                  ) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        keypoints, descriptors = self._sift.detectAndCompute(
            cv2.cvtColor(image_rgb, cv2.COLOR_RGB2GRAY), None)
        if descriptors is None:
            return np.empty((0, 2)), np.empty((0, 128), dtype=np.float32)
        return (np.array([one.pt for one in keypoints], dtype=np.float64),
                np.asarray(descriptors, dtype=np.float32))
