# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Find printed tags in an image, with OpenCV's aruco and corners from fits to the edges.

The corners of aruco are those of a contour, off by half a pixel and more. As in AprilTag 3
(Krogius et al., "Flexible Layouts for Fiducial Tags", 2019), each edge of the black square is
therefore found again where the brightness changes across it, and lines through these places meet
in the corners. Lines are fitted on the plane z = 1, where no lens bends them.
"""

from collections.abc import Iterable
from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.observation import SeenTags
from cliploc_ros.errors import ModelError

# Wrong bits of a pattern that are corrected: with more, tags are seen where there are none.
_CORRECTED = {'tag25h9': 1, 'tag36h10': 2, 'tag36h11': 3}
# Least perimeter of a tag: smaller ones cannot be read [px].
_LEAST_PERIMETER_PX = 40.0
# Places along an edge, as shares of it, and across it, in units of the reach.
_ALONG, _ACROSS = np.linspace(0.06, 0.94, 23), np.linspace(-1.0, 1.0, 17)
# Reach across an edge: share of a module, the width of the black border, and its limits [px].
_REACH, _LAST_REACH, _REACH_PX = 0.8, 0.55, (1.2, 6.0)
_PASSES = 4
# Places (g, 4) inside a tag, as weights of its corners; the percentile of their brightness that
# is white.
_RIGHT, _DOWN = (axis.ravel() for axis in np.meshgrid(*[np.linspace(0.05, 0.95, 12)] * 2))
_INSIDE = np.stack([(1 - _RIGHT) * (1 - _DOWN), _RIGHT * (1 - _DOWN), _RIGHT * _DOWN,
                    (1 - _RIGHT) * _DOWN], axis=1)
_WHITE = 85
# Robust fit of a line: rounds, scale of Cauchy's loss [px], and least share of points on it.
_ROUNDS, _LOSS_PX, _LEAST_ON_LINE = 4, 0.5, 0.6


def detect_tags(image_rgb: NDArray[np.uint8], camera: Camera, families: Iterable[str]) -> SeenTags:
    """Find the tags of some families in an image (h, w, 3).

    ModelError: OpenCV is installed without aruco.
    """
    gray = cv2.cvtColor(image_rgb, cv2.COLOR_RGB2GRAY)
    names, corners = list[str](), [np.empty((0, 4, 2))]
    for family in families:
        find, modules = _finder(family, _LEAST_PERIMETER_PX / max(gray.shape))
        found, numbers = find(gray)
        if numbers is None:
            continue
        # OpenCV's AprilTags are those of AprilTag 3 turned by 180 degrees
        turned = np.reshape(found, (-1, 4, 2))[:, [2, 3, 0, 1] if family[:3] == 'tag' else [
            0, 1, 2, 3]].astype(np.float64)
        names += [f'{family}_{number}' for number in np.ravel(numbers)]
        corners.append(_refined(gray, camera, turned, modules))
    every = np.concatenate(corners)
    # of two tags with one name, neither can be used: one is a copy
    kept = [row for row, name in enumerate(names)
            if names.count(name) == 1 and np.isfinite(every[row]).all()]
    return SeenTags(tuple(names[row] for row in kept), every[kept])


@cache
def _finder(family: str, least_rate: float) -> tuple[Any, int]:
    """Return a function that finds the tags of a family, and the modules along their side."""
    aruco = getattr(cv2, 'aruco', None)
    if aruco is None:
        raise ModelError('this OpenCV has no aruco, which finds tags: install python3-opencv')
    dictionary = aruco.getPredefinedDictionary(getattr(
        aruco, f'DICT_APRILTAG_{family[3:]}' if family[:3] == 'tag' else family))
    is_old = not hasattr(aruco, 'ArucoDetector')  # before OpenCV 4.7
    options = aruco.DetectorParameters_create() if is_old else aruco.DetectorParameters()
    dictionary.maxCorrectionBits = _CORRECTED.get(family, 0)
    options.errorCorrectionRate, options.minMarkerPerimeterRate = 1.0, least_rate
    # two windows of the threshold find as many tags as OpenCV's three, in 0.6 of the time
    options.adaptiveThreshWinSizeMin, options.adaptiveThreshWinSizeMax = 5, 15
    options.maxErroneousBitsInBorderRate = 0.2  # squares with a whiter border are not decoded

    def find(gray: NDArray[np.uint8]) -> tuple[Any, Any]:
        return (aruco.detectMarkers(gray, dictionary, parameters=options) if is_old else
                aruco.ArucoDetector(dictionary, options).detectMarkers(gray))[:2]
    return find, dictionary.markerSize + 2


def _refined(gray: NDArray[np.uint8], camera: Camera, corners: NDArray[np.float64], modules: int
             ) -> NDArray[np.float64]:
    """Return corners (n, 4, 2) [px] where lines through the edges of the black squares meet."""
    for number in range(_PASSES):
        edges = np.roll(corners, -1, axis=1) - corners
        sides = np.linalg.norm(edges, axis=2, keepdims=True)
        # the normal points out of the square, as corners go clockwise: from black to white
        normals = edges[..., ::-1] * (1.0, -1.0) / sides
        is_last = number == _PASSES - 1
        reach = np.clip((_LAST_REACH if is_last else _REACH)
                        * sides.min(axis=1, keepdims=True) / modules, *_REACH_PX)
        places = corners[:, :, None] + _ALONG[:, None] * edges[:, :, None]
        samples = places[:, :, :, None] + (reach * normals)[:, :, None, None] * _ACROSS[:, None]
        values = _sampled(gray, samples)
        if not is_last:
            # the tag's own white limits the values: beyond its margin may be a brighter wall,
            # which is out of reach of the last pass
            white = np.percentile(_sampled(gray, np.einsum('gc,ncd->ngd', _INSIDE, corners)),
                                  _WHITE, axis=1)
            values = np.minimum(values, white[:, None, None, None])
        rise = np.maximum(0.0, np.gradient(values, axis=-1)) ** 2
        weights = rise.sum(axis=-1)
        shift = (rise @ _ACROSS) / np.maximum(weights, 1e-9)
        found = places + shift[..., None] * (reach * normals)[:, :, None]
        flat = camera.normalize_points(found.reshape(-1, 2)).reshape(found.shape)
        corners, is_good = _crossings(flat, np.sqrt(weights), camera)
    corners[~is_good] = np.nan
    return corners


def _sampled(gray: NDArray[np.uint8], places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the brightness (...) at places (..., 2) [px]."""
    x, y = places.reshape(-1, places.shape[-2], 2).astype(np.float32).transpose(2, 0, 1)
    return cv2.remap(gray, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).reshape(
        places.shape[:-1]).astype(np.float64)


def _crossings(points: NDArray[np.float64], weights: NDArray[np.float64], camera: Camera
               ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the pixels (n, 4, 2) where neighbours of four lines through points cross.

    Points (n, 4, k, 2) on the plane z = 1 have weights (n, 4, k). The lines are robust. Also
    return whether enough points of each edge are on its line (n,).
    """
    points, off = np.nan_to_num(points), np.zeros(weights.shape)
    for _ in range(_ROUNDS):
        kept = weights / (1.0 + (off / _LOSS_PX) ** 2)
        kept = kept / np.maximum(kept.sum(axis=-1, keepdims=True), 1e-9)
        middles = np.einsum('nek,nekd->ned', kept, points)
        apart = points - middles[:, :, None]
        normals = np.linalg.eigh(np.einsum('nek,nekd,nekf->nedf', kept, apart, apart))[1][..., 0]
        off = camera.fx * np.abs(np.einsum('nekd,ned->nek', apart, normals))
    lines = np.concatenate([normals, -np.sum(normals * middles, axis=-1, keepdims=True)], axis=-1)
    crossings = np.cross(np.roll(lines, 1, axis=1), lines)
    found = camera.project_normalized((crossings[..., :2] / crossings[..., 2:]).reshape(
        -1, 2)).reshape(-1, 4, 2)
    return found, (np.mean(off < _LOSS_PX, axis=-1) >= _LEAST_ON_LINE).all(axis=1)
