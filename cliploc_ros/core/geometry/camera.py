# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The camera: intrinsics, distortion, and conversion between pixels and the plane z = 1."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.errors import CameraError

# Valid numbers of coefficients of each distortion model of sensor_msgs/CameraInfo; '': pinhole.
_COEFFICIENT_COUNTS = {'': (0,), 'plumb_bob': (0, 4, 5), 'rational_polynomial': (0, 8, 12, 14),
                       'equidistant': (4,)}
_NEWTON_STEPS = 20
_NEWTON_DIFFERENCE = 1e-6
_FOLD_STEP_DEG = 0.1
# A larger error after undistorting and distorting again means that the model has no inverse.
_MAX_ROUND_TRIP_PX = 0.1
# Boxes of a lens with distortion that extend further than 75 degrees from its axis are not usable:
# the plane z = 1 stretches them, so that the ellipse no longer touches its box at the midpoints of
# the edges. In simulated fisheye images, the median overlap with the true box is .93 up to this
# angle, and .62 at 86 degrees.
_WIDEST_BOX = np.tan(np.radians(75.0))
# Corners of the base of a frustum: x right and y down, in units of half its size.
_CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with distortion, as in sensor_msgs/CameraInfo.

    Raises
    ------
    CameraError
        A value is impossible; the message states it.
    """

    #: Image size [px]
    width: int
    height: int
    #: Focal lengths and principal point [px]
    fx: float
    fy: float
    cx: float
    cy: float
    #: 'plumb_bob', 'rational_polynomial' or 'equidistant' (fisheye); '' without distortion
    distortion_model: str = ''
    distortion: tuple[float, ...] = ()  #: Coefficients of the model, in OpenCV's order

    def __post_init__(self) -> None:
        """Raise CameraError for impossible values."""
        if not (0 < self.width < np.inf and 0 < self.height < np.inf):
            raise CameraError(f'image size {self.width}x{self.height} is not positive and finite')
        intrinsics = (self.fx, self.fy, self.cx, self.cy)
        # squares of normalized points must not overflow
        if not (min(self.fx, self.fy) > 1e-6 and np.all(np.abs(intrinsics) < 1e9)):
            raise CameraError(
                f'fx={self.fx:g} fy={self.fy:g} cx={self.cx:g} cy={self.cy:g}: focal lengths must '
                'be positive, and all values plausible pixels (is the camera calibrated?)')
        if not np.all(np.isfinite(self.distortion)):
            raise CameraError(f'distortion {self.distortion} has values that are not finite')
        model, counts = self.distortion_model, _COEFFICIENT_COUNTS.get(self.distortion_model)
        if counts is None or (not model and any(self.distortion)):
            names = ', '.join(filter(None, _COEFFICIENT_COUNTS))
            raise CameraError(
                f"distortion model '{model}' is none of {names}: publish one of them (equidistant "
                "is OpenCV's fisheye, Kannala-Brandt with 4 coefficients), or rectified images")
        # except for a fisheye, any number of zeros is valid, as they do not distort
        if len(self.distortion) not in counts and not self.is_pinhole:
            raise CameraError(f"distortion model '{model}' has "
                              f'{" or ".join(map(str, filter(None, counts)))} coefficients, '
                              f'not {len(self.distortion)}')

    @property
    def is_pinhole(self) -> bool:
        """Return whether the camera has no distortion. A fisheye always has, even with zeros."""
        return self.distortion_model != 'equidistant' and not any(self.distortion)

    @property
    def pinhole(self) -> 'Camera':
        """Return the camera of the undistorted images."""
        return Camera(self.width, self.height, self.fx, self.fy, self.cx, self.cy)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """Return the intrinsic matrix K (3, 3) [px]."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def normalize_points(self, points_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert pixels (n, 2) to undistorted points (n, 2) on the plane z = 1.

        Rows where the distortion model has no inverse are NaN.
        """
        points_px = np.asarray(points_px, dtype=np.float64).reshape(-1, 2)
        normalized = (points_px - (self.cx, self.cy)) / (self.fx, self.fy)
        if self.is_pinhole or len(points_px) == 0:
            return normalized
        if self.distortion_model == 'equidistant':
            # start with the inverse of an ideal fisheye, with the angle limited below 90 degrees
            angle = np.minimum(np.linalg.norm(normalized, axis=1, keepdims=True), 1.5)
            normalized *= np.tan(angle) / np.maximum(angle, 1e-12)
        with np.errstate(all='ignore'):
            for _ in range(_NEWTON_STEPS):
                projected = self._distorted(normalized)
                (xx, xy), (yx, yy) = (
                    ((self._distorted(normalized + step) - projected) / _NEWTON_DIFFERENCE).T
                    for step in ((_NEWTON_DIFFERENCE, 0.0), (0.0, _NEWTON_DIFFERENCE)))
                x, y = (projected - points_px).T
                normalized -= (np.stack([x * yy - y * yx, xx * y - xy * x], axis=1)
                               / (xx * yy - xy * yx)[:, None])
            missed = np.linalg.norm(self.project_normalized(normalized) - points_px, axis=1)
        normalized[~(missed <= _MAX_ROUND_TRIP_PX)] = np.nan
        return normalized

    @cached_property
    def _reach(self) -> float:
        """Return the distance from the axis at which the lens model folds, on the plane z = 1."""
        distances = np.tan(np.radians(np.arange(0.0, 90.0, _FOLD_STEP_DEG)))
        with np.errstate(all='ignore'):
            columns = self._distorted(np.stack([distances, 0.0 * distances], axis=1))[:, 0]
            folds = np.nonzero(~(np.diff(columns) > 0.0))[0]
        return float(distances[folds[0]]) if len(folds) else np.inf

    def project_normalized(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Project points (n, 2) on the plane z = 1 to distorted pixels (n, 2).

        Rows beyond the fold of the distortion model are NaN, because the model would project them
        into the image.
        """
        points = np.asarray(points, dtype=np.float64).reshape(-1, 2)
        if self.is_pinhole or len(points) == 0:
            return points * (self.fx, self.fy) + (self.cx, self.cy)
        pixels = self._distorted(points)
        pixels[~(np.linalg.norm(points, axis=1) <= self._reach)] = np.nan
        return pixels

    def _distorted(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Project points (n, 2) to distorted pixels (n, 2), without a check of the fold."""
        coefficients, zero = np.array(self.distortion), np.zeros(3)
        if self.distortion_model == 'equidistant':
            pixels = cv2.fisheye.distortPoints(np.ascontiguousarray(points[:, None]),
                                               self.matrix, coefficients)
        else:
            solid = np.concatenate([points, np.ones((len(points), 1))], axis=1)
            pixels, _ = cv2.projectPoints(solid[:, None], zero, zero, self.matrix, coefficients)
        return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)

    def normalize_bboxes(self, bboxes_xyxy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert boxes (n, 4) [px] to undistorted boxes (n, 4) on the plane z = 1.

        Each edge is placed at its undistorted midpoint, where the inscribed ellipse touches it.
        Boxes are NaN if the distortion model has no inverse there, or if they are too far from the
        axis of a lens with distortion.
        """
        bboxes_xyxy = np.asarray(bboxes_xyxy, dtype=np.float64).reshape(-1, 4)
        left, top, right, bottom = bboxes_xyxy.T
        with np.errstate(invalid='ignore', over='ignore'):  # a box may extend from -inf to inf
            middle_x, middle_y = (left + right) / 2, (top + bottom) / 2
        midpoints = np.stack([left, middle_y, middle_x, top, right, middle_y, middle_x, bottom],
                             axis=-1)
        points = self.normalize_points(midpoints.reshape(-1, 2)).reshape(-1, 4, 2)
        if not self.is_pinhole:
            is_near = (np.linalg.norm(points, axis=2) <= _WIDEST_BOX).all(axis=1)
            points[~is_near] = np.nan
        return np.asarray(points[:, range(4), [0, 1, 0, 1]])

    def bboxes_in_pixels(self, edges: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert boxes (n, 4) on the plane z = 1 to undistorted boxes (n, 4) [px]."""
        return edges * ([self.fx, self.fy] * 2) + [self.cx, self.cy] * 2


def frusta(cameras: Sequence[Camera], map_from_camera: NDArray[np.float64], depth_m: float
           ) -> NDArray[np.float64]:
    """Return the edges (8 f, 2, 3) of the frusta of f cameras [m], as pairs of end points.

    Parameters
    ----------
    cameras : sequence of Camera
        Camera of each pose.
    map_from_camera : ndarray (f, 4, 4)
    depth_m : float
        Distance from the apex to the base [m].
    """
    half = np.array([(camera.width / camera.fx, camera.height / camera.fy)
                     for camera in cameras]).reshape(-1, 2)
    corners = np.full((len(half), 4, 3), depth_m)
    corners[:, :, :2] = _CORNERS * (half[:, None] * 0.5 * depth_m)
    points = np.einsum('fij,fkj->fki', map_from_camera[:, :3, :3], corners) \
        + map_from_camera[:, None, :3, 3]
    tips = np.broadcast_to(map_from_camera[:, None, :3, 3], points.shape)
    lines = np.concatenate([np.stack([tips, points], axis=2),
                            np.stack([points, np.roll(points, 1, axis=1)], axis=2)], axis=1)
    return np.asarray(lines.reshape(-1, 2, 3))
