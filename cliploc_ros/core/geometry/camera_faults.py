# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Check that a calibration is plausible, and not that of another resolution, unit or lens."""

import math
from collections.abc import Iterable, Iterator
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import is_rigid, make_transform, rotation_angle_deg
from cliploc_ros.errors import CameraError

# Distance of the principal point from the image centre, in image widths and heights: unusual, and
# certainly wrong. The recorded cameras of ../shared/data have at most .04; K of half the
# resolution has .35, of twice the resolution .7.
_OFF_MIDDLE, _FAR_OFF_MIDDLE = 0.12, 0.2
# Largest usual and possible fields of view [deg], by whether the lens is a fisheye.
_WIDE = {True: (240.0, 300.0), False: (125.0, 150.0)}
# Smallest usual and possible fields of view [deg].
_NARROW_DEG, _NEEDLE_DEG = 3.0, 0.3
# Largest usual and possible ratios of the focal lengths. Images stretched to a square have 1.8,
# single fields of video 2.
_STRETCHED, _TORN = 1.1, 2.5
# Midpoints of the edges of an image, as offsets from its centre in image widths and heights.
_MIDDLES = np.array([(-0.5, 0.0), (0.5, 0.0), (0.0, -0.5), (0.0, 0.5)])
# Largest share of the focal length in elements of K that should be 0. They are not used.
_MOST_SKEW = 0.005
_ROTATION_TOLERANCE = 0.01
# Rotation of rectified images against raw images from which on the error of a pose exceeds its
# standard deviation [deg].
_MOST_TURN_DEG = 1.0
# Smallest and largest ratio of the focal lengths of P and K, and largest distance of their
# principal points in image sizes. Without distortion, P and K are equal; with distortion, P shows
# more or less of the image.
_AS_K, _NEAR_K = (0.98, 1.02, 0.02), (0.2, 1.7, 0.3)
# Limits that distinguish another lens from the same lens at another resolution.
_TIMES_K, _AS_SCALED = 1.2, 0.1
_CACHED = 64


class Fault(NamedTuple):
    """An implausible or contradictory input."""

    text: str  #: Description in one line
    #: Whether poses would certainly be wrong, so that the input is refused; else it is unusual
    is_certain: bool


def calibration_faults(sensor: Camera, k: NDArray[np.float64], r: NDArray[np.float64],
                       p: NDArray[np.float64], rectified: bool) -> list[Fault]:
    """Return the faults of a calibration: implausible or contradictory values.

    Parameters
    ----------
    sensor : Camera
        Camera of the whole sensor, from K and distortion, or from P for rectified images.
    k, r, p : ndarray (3, 3), (3, 3), (3, 4)
        See sensor_msgs/CameraInfo. Zeros mean that R or P, or K of rectified images, is missing.
    rectified : bool
        Whether the images are rectified.
    """
    used, name = (p[:, :3], 'P') if rectified else (k, 'K')
    deviations = [[_MOST_SKEW * sensor.fx] * 3, [_MOST_SKEW * sensor.fy] * 3, [1e-3] * 3]
    faults = list(camera_faults(sensor))
    if not (np.abs(used - sensor.matrix) <= deviations).all():
        faults.insert(0, Fault(
            f'{np.round(used, 3).tolist()} does not have the form [fx 0 cx, 0 fy cy, 0 0 1]: is '
            'it transposed? Skew is not supported', True))
    faults = [fault._replace(text=f'{name}: {fault.text}') for fault in faults]
    if (contradiction := _contradiction(p, k, sensor, rectified)) is not None:
        faults.append(contradiction)
    # one unusual value alone may be harmless
    if contradiction is not None and len(faults) > 1:
        faults = [fault._replace(is_certain=True) for fault in faults]
    return [*faults, *(Fault(text, False) for text in _doubts(r, p, rectified))]


def check_faults(faults: Iterable[Fault]) -> None:
    """Raise CameraError with the first certain fault."""
    for fault in faults:
        if fault.is_certain:
            raise CameraError(fault.text)


@lru_cache(_CACHED)
def camera_faults(camera: Camera) -> tuple[Fault, ...]:
    """Return the faults of the camera of uncropped images, certain faults first.

    A cropped image may have any principal point, so pass the camera of the uncropped image.
    """
    return tuple(sorted(_faults_of(camera), key=lambda fault: not fault.is_certain))


def fields_of_view(camera: Camera) -> tuple[float, float]:
    """Return the horizontal and vertical field of view [deg], from the focal lengths alone."""
    halves = (0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy)
    if camera.distortion_model != 'equidistant':
        halves = (math.atan(halves[0]), math.atan(halves[1]))
    return math.degrees(2.0 * halves[0]), math.degrees(2.0 * halves[1])


def _faults_of(camera: Camera) -> Iterator[Fault]:
    off = math.hypot(camera.cx / camera.width - 0.5, camera.cy / camera.height - 0.5)
    if off > _OFF_MIDDLE:
        yield Fault(
            f'the principal point ({camera.cx:g}, {camera.cy:g}) is far from the centre of '
            f'{camera.width}x{camera.height} px, as if K were that of {2 * camera.cx:.0f}x'
            f'{2 * camera.cy:.0f} px: scale K with the image; set width, height and roi of a '
            'cropped image', off > _FAR_OFF_MIDDLE)
    is_fisheye = camera.distortion_model == 'equidistant'
    wide_deg, no_lens_deg = _WIDE[is_fisheye]
    for side, field_deg, focal_px in zip(('wide', 'high'), fields_of_view(camera),
                                         (camera.fx, camera.fy), strict=True):
        if not _NARROW_DEG <= field_deg <= wide_deg:
            yield Fault(
                f'the image is {field_deg:.3g} degrees {side} with a focal length of '
                f"{focal_px:g} px and {'a' if is_fisheye else 'no'} fisheye lens: is the focal "
                'length in pixels of this image?', not _NEEDLE_DEG <= field_deg <= no_lens_deg)
    ratio = max(camera.fx / camera.fy, camera.fy / camera.fx)
    if ratio > _STRETCHED:
        yield Fault(f'the focal lengths {camera.fx:g} and {camera.fy:g} px differ by a factor of '
                    f'{ratio:.3g}: is the image really stretched?', ratio > _TORN)
    # coefficients that fold the image belong to another lens or model, or have another order
    folds = [share for share in (0.5, 1.0) if not camera.is_pinhole and np.isnan(
        camera.normalize_points((0.5 + share * _MIDDLES) * (camera.width, camera.height))).any()
        and (share == 0.5 or not is_fisheye)]
    if folds:
        yield Fault(
            f"the coefficients {[float(f'{value:.4g}') for value in camera.distortion]} of "
            f'{camera.distortion_model} fold the image onto itself before its '
            f"{'border' if folds[0] == 1.0 else 'inner half ends'}: are they of this lens, and "
            'in this order?', folds[0] == 0.5)


def _doubts(rotation: NDArray[np.float64], projection: NDArray[np.float64], rectified: bool
            ) -> Iterator[str]:
    """Yield unusual properties of R (3, 3) and P (3, 4); zeros mean that they are missing."""
    if np.any(rotation):
        if not is_rigid(make_transform(rotation, np.zeros(3)), _ROTATION_TOLERANCE):
            yield 'R is not a rotation: set it to the identity'
        elif (turn_deg := rotation_angle_deg(rotation)) > _MOST_TURN_DEG and not rectified:
            yield (f'R turns the coordinate frame by {turn_deg:.3g} degrees to that of rectified '
                   'images: use rectified images, with rectified true')
    if np.any(projection):
        focal_px = projection[0, 0]
        if not (np.isfinite(projection).all() and focal_px > 0.0 and projection[1, 1] > 0.0
                and abs(projection[0, 1]) <= _MOST_SKEW * focal_px and projection[1, 0] == 0.0
                and (projection[2] == (0.0, 0.0, 1.0, 0.0)).all()):
            yield 'P does not have the form [fx 0 cx Tx, 0 fy cy Ty, 0 0 1 0]: set it to K'


def _contradiction(projection: NDArray[np.float64], matrix: NDArray[np.float64], sensor: Camera,
                   rectified: bool) -> Fault | None:
    """Return a fault if P (3, 4) and K (3, 3) belong to different images; None if not."""
    focal_px, of_k = np.diag(projection)[:2], np.diag(matrix)[:2]
    if not ((focal_px > 0.0).all() and (of_k > 0.0).all()):
        return None
    should_equal = sensor.is_pinhole and not rectified
    low, high, far = _AS_K if should_equal else _NEAR_K
    ratios = focal_px / of_k
    moved = np.abs(projection[:2, 2] - matrix[:2, 2]) / (sensor.width, sensor.height)
    if low <= ratios.min() and ratios.max() <= high and moved.max() <= far:
        return None
    # if P is only scaled, it may be that of another resolution, and K may be right
    scaled = np.allclose(projection[:2, 2] / ratios, matrix[:2, 2], rtol=_AS_SCALED)
    return Fault(
        'P has focal lengths {:g} and {:g} and principal point ({:g}, {:g}) px, but K has {:g} '
        'and {:g} and ({:g}, {:g}): does one of them belong to another resolution?'.format(
            *focal_px, *projection[:2, 2], *of_k, *matrix[:2, 2]),
        should_equal and not scaled and not 1.0 / _TIMES_K <= ratios.min() <= ratios.max()
        <= _TIMES_K)
