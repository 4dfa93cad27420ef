# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Check that the images and poses of a recording agree; if not, find the conventions that do.

Matched points of two images lie on epipolar lines. A pair of images counts only if some epipolar
geometry, independent of the poses, explains its matches. Images without overlap prove nothing.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry import transforms
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.keyframes.features import SIFT, extract
from cliploc_ros.errors import DatasetError

_Pose = NDArray[np.float64]
_FLIP, _TURN = np.diag([1.0, -1.0, -1.0, 1.0]), np.diag([-1.0, 1.0, -1.0, 1.0])
# A camera that looks forward, on a body with the axes forward, left, up (REP 103).
_BODY_FROM_CAMERA = transforms.make_transform(
    np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))
#: Conventions of a stored pose; each function converts to map_from_camera with OpenCV's axes.
AXES: Mapping[str, Callable[[_Pose], _Pose]] = {
    'opencv': lambda pose: pose,
    'opengl': lambda pose: pose @ _FLIP,
    'opencv-inverse': transforms.invert_transform,
    'opengl-inverse': lambda pose: transforms.invert_transform(pose) @ _FLIP,
    'ros': lambda pose: pose @ _BODY_FROM_CAMERA}

# Number of image pairs to compare, of first images to try, and of later images to try with each.
_PAIRS, _TRIED, _REACH = 4, 12, 20
# The rotation between the images of a pair [degrees]: wrong axes reverse it.
_TURN_DEG = (4.0, 30.0)
_FEATURES, _LONGEST_PX = 500, 480
# Least number and share of the matches that one epipolar geometry explains, and its gate [px].
_LEAST_MATCHES, _LEAST_SHARE, _GATE_PX = 25, 0.5, 2.0
# Median epipolar errors at an image width of _LONGEST_PX [px]: correct conventions give 0.3 to 2.
_GOOD_PX, _WRONG_PX, _BETTER = 3.0, 4.0, 0.35
# Share of the matches behind both cameras by which images are mirrored. Chosen.
_BEHIND = 0.8


class View(NamedTuple):
    """An image and its pose, as recorded."""

    pose: _Pose | None
    look: Callable[[], tuple[NDArray[np.uint8], Camera]]  #: Returns the image and its camera
    #: The same, with the image's EXIF orientation applied
    look_upright: Callable[[], tuple[NDArray[np.uint8], Camera]] | None = None
    pose_at: Callable[[int], _Pose | None] | None = None  #: Returns the pose at a stamp [ns]
    stamp_ns: int = 0


class Reading(NamedTuple):
    """Conventions under which the poses, cameras and stamps of a recording are read."""

    remedy: str  #: Advice if this reading fits and the given one does not
    pose: Callable[[_Pose], _Pose] = AXES['opencv']
    camera: Callable[[Camera], Camera] = lambda camera: camera
    upright: bool = False  #: Whether to apply the EXIF orientation of images
    shift_ns: int = 0  #: Delay of the pose after the image's stamp
    #: This reading replaces the given one only if the given one's median error exceeds least_px
    #: [px], and its own is below that error times `better`
    least_px: float = _WRONG_PX
    better: float = _BETTER


def w_first(pose: _Pose) -> _Pose:
    """Correct a pose (4, 4) whose quaternion w x y z was read as x y z w."""
    return transforms.transform_from_pose(
        pose[:3, 3], np.roll(transforms.quaternion_from_transform(pose), -1))


def check_agreement(views: Sequence[View], readings: Mapping[str, Reading], where: object) -> str:
    """Return a note if images and poses do not fit; '' if they fit, or if the check cannot decide.

    Parameters
    ----------
    views : sequence
        Neighbours in this order should overlap.
    readings : mapping
        The readings by name; the first is the given one. Of readings with equal errors the first
        wins.

    Raises
    ------
    DatasetError
        Images and poses fit well under another reading; the message names it.
    """
    given, first = next(iter(readings.items()))
    # mirrored images fit turned cameras: about x as 'opengl' if left and right are exchanged
    readings = {**readings, 'turned': Reading(
        'turn the camera about its y axis', lambda pose: first.pose(pose) @ _TURN, first.camera)}
    found: dict[str, list[float]] = {name: [] for name in readings}
    for pair in _pairs([view for view in views if view.pose is not None], first):
        for name, error_px in _epipolar_errors(pair, readings).items():
            found[name].append(error_px)
        if len(found[given]) == _PAIRS:
            break
    if len(found[given]) < _PAIRS // 2:
        return ''
    errors = {name: float(np.median(np.abs(values))) for name, values in found.items()
              if len(values) == len(found[given])}
    best = min(errors, key=lambda name: errors[name])
    if errors[best] < _GOOD_PX and np.median(np.sign(found[best])) < 0.0:
        raise DatasetError(f'{where}: the images are mirrored: they fit the poses as {best} '
                           f'({errors[best]:.1f} px), but with all points behind the cameras; '
                           'record them as the camera sees them')
    reading = readings[best]
    if errors[given] > reading.least_px and errors[best] < min(_GOOD_PX,
                                                               reading.better * errors[given]):
        raise DatasetError(f'{where}: the images do not fit the poses as {given} (median epipolar '
                           f'error {errors[given]:.1f} px), but they fit as {best} '
                           f'({errors[best]:.1f} px): {reading.remedy}')
    if errors[given] < _WRONG_PX:
        return ''
    return (f'the images do not fit the poses: median epipolar error {errors[given]:.1f} px, '
            f'{errors[best]:.1f} px at best ({best})')


def _pairs(views: Sequence[View], given: Reading) -> Iterator[tuple[View, View]]:
    """Yield pairs of views close in order, with a rotation of _TURN_DEG between them."""
    turns = [given.pose(view.pose)[:3, :3] for view in views if view.pose is not None]
    last = len(views) - 1
    for start in np.unique(np.linspace(0, max(0, last - 1), _TRIED).astype(int)).tolist():
        angles = [transforms.rotation_angle_deg(turns[start].T @ turn)
                  for turn in turns[start + 1:start + 1 + _REACH]]
        fit = [place for place, angle in enumerate(angles) if _TURN_DEG[0] < angle < _TURN_DEG[1]]
        if fit:
            yield views[start], views[start + 1 + fit[0]]


def _epipolar_errors(pair: tuple[View, View], readings: Mapping[str, Reading]) -> dict[str, float]:
    """Return the median epipolar error of two images under each reading, by its name [px].

    It is negative if the points lie behind both cameras, as in mirrored images.
    The result is empty if no epipolar geometry explains enough matches, as for images without
    overlap.
    """
    errors = {}
    ways = dict.fromkeys((reading.upright, reading.camera) for reading in readings.values())
    try:
        seen = {upright: _match(pair, upright) for upright, _ in ways}
        kept = {way: _overlapping(*seen[way[0]], way[1]) for way in ways}
    except DatasetError:  # the caller reports it when it reads the images
        return {}
    for name, reading in readings.items():
        points, focal_px = kept[reading.upright, reading.camera]
        first, second = (view.pose if view.pose_at is None or not reading.shift_ns
                         else view.pose_at(view.stamp_ns + reading.shift_ns) for view in pair)
        if len(points[0]) and first is not None and second is not None:
            step = transforms.invert_transform(reading.pose(second)) @ reading.pose(first)
            found = cv2.triangulatePoints(np.eye(3, 4), step[:3], points[0].T, points[1].T)
            found = found / found[3]
            is_behind = (found[2] < 0.0) & (step[2] @ found < 0.0)
            errors[name] = (1.0 - 2.0 * (is_behind.mean() > _BEHIND)) * focal_px * float(
                np.median(_sampson(points[0], points[1], step)))
    return errors


def _match(pair: tuple[View, View], upright: bool
           ) -> tuple[list[Camera], list[NDArray[np.float64]]]:
    """Match two images; return their cameras, and the matched pixels (n, 2) of each."""
    looks = [view.look_upright() if upright and view.look_upright else view.look()
             for view in pair]
    features = [extract(image, _FEATURES, _LONGEST_PX) for image, _ in looks]
    ours, theirs = (SIFT.units(feature.descriptors) for feature in features)
    rows, _ = SIFT.match(ours, theirs)
    return ([camera for _, camera in looks],
            [feature.pixels[rows[:, side]] for side, feature in enumerate(features)])


def _overlapping(cameras: Sequence[Camera], pixels: Sequence[NDArray[np.float64]],
                 change: Callable[[Camera], Camera]) -> tuple[NDArray[np.float64], float]:
    """Return the inliers (2, n, 2) of an epipolar geometry at z = 1, and the focal length [px].

    The geometry is estimated from the matches, independent of the poses. With too few inliers, the
    result is empty.
    """
    points = np.array([change(camera).normalize_points(pixel)
                       for camera, pixel in zip(cameras, pixels, strict=True)])
    points, camera = points[:, np.isfinite(points).all(axis=(0, 2))], cameras[0]
    focal_px = camera.fx * _LONGEST_PX / max(camera.width, camera.height)
    if points.shape[1] < _LEAST_MATCHES:
        return points[:, :0], focal_px
    _, inside = cv2.findEssentialMat(points[0], points[1], np.eye(3),
                                     threshold=_GATE_PX / focal_px)
    kept = np.zeros(points.shape[1], dtype=np.bool_) if inside is None else inside[:, 0] > 0
    if kept.sum() < max(_LEAST_MATCHES, _LEAST_SHARE * len(kept)):
        kept[:] = False
    return points[:, kept], focal_px


def _sampson(ours: NDArray[np.float64], theirs: NDArray[np.float64], step: _Pose
             ) -> NDArray[np.float64]:
    """Return the Sampson distances (n,) of matched points (n, 2) at z = 1 to epipolar lines."""
    x, y, z = step[:3, 3] / max(float(np.linalg.norm(step[:3, 3])), 1e-12)
    essential = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ step[:3, :3]
    first, second = (np.column_stack([points, np.ones(len(points))]) for points in (ours, theirs))
    lines, back = first @ essential.T, second @ essential
    with np.errstate(divide='ignore', invalid='ignore'):
        return np.nan_to_num(np.abs(np.sum(second * lines, axis=1)) / np.sqrt(
            lines[:, 0]**2 + lines[:, 1]**2 + back[:, 0]**2 + back[:, 1]**2), nan=0.0)
