# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Whether a camera is plausible: intrinsics of another resolution, unit or lens."""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from cliploc_ros.core.geometry.camera import Camera

# Distance of the principal point from the middle, in widths and heights. The recorded cameras of
# ../shared/data have .04 at most; K of half the resolution has .35, of twice the resolution .7.
_OFF_MIDDLE, _FAR_OFF_MIDDLE = 0.12, 0.2
# Fields of view that lenses have, and that no lens has [deg], of a fisheye and of others.
_WIDE = {True: (240.0, 300.0), False: (125.0, 150.0)}
_NARROW_DEG, _NEEDLE_DEG = 3.0, 0.3
# Ratio of the focal lengths. Images stretched to a square have 1.8, single fields of video 2.
_STRETCHED, _TORN = 1.1, 2.5
# The middle of each edge of the inner half of an image, and of its border.
_MIDDLES = np.array([(-0.5, 0.0), (0.5, 0.0), (0.0, -0.5), (0.0, 0.5)])
_CACHED = 64


class Fault(NamedTuple):
    """What contradicts itself in an input, in one line."""

    text: str
    #: Whether poses would certainly be wrong, so that the input is refused; else it is unusual
    is_certain: bool


@lru_cache(_CACHED)
def camera_faults(camera: Camera) -> tuple[Fault, ...]:
    """Return what is implausible about the camera of whole images, the certain faults first.

    An image that is cut out of a larger one has any principal point: give the camera of the whole.
    """
    faults = [*_off_middle(camera), *_field(camera), *_stretch(camera), *_fold(camera)]
    return tuple(sorted(faults, key=lambda fault: not fault.is_certain))


def _off_middle(camera: Camera) -> list[Fault]:
    share = np.array([camera.cx / camera.width, camera.cy / camera.height])
    off = float(np.linalg.norm(share - 0.5))
    if off <= _OFF_MIDDLE:
        return []
    return [Fault(
        f'the principal point ({camera.cx:g}, {camera.cy:g}) is far from the middle of '
        f'{camera.width}x{camera.height} px, as that of an image of {2 * camera.cx:.0f}x'
        f'{2 * camera.cy:.0f} px is: scale K with the image; give width, height and roi of a '
        'cropped one', off > _FAR_OFF_MIDDLE)]


def _field(camera: Camera) -> list[Fault]:
    is_fisheye = camera.distortion_model == 'equidistant'
    wide_deg, no_lens_deg = _WIDE[is_fisheye]
    return [Fault(
        f'the image is {field_deg:.3g} degrees {side} by a focal length of {focal_px:g} px and '
        f"{'a fisheye' if is_fisheye else 'no fisheye'}: is it in pixels of this image?",
        not _NEEDLE_DEG <= field_deg <= no_lens_deg)
        for side, field_deg, focal_px in zip(('wide', 'high'), fields_of_view(camera),
                                             (camera.fx, camera.fy), strict=True)
        if not _NARROW_DEG <= field_deg <= wide_deg]


def fields_of_view(camera: Camera) -> tuple[float, float]:
    """Return how wide and how high an image is [deg], by its focal lengths alone."""
    halves = (0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy)
    if camera.distortion_model != 'equidistant':
        halves = (math.atan(halves[0]), math.atan(halves[1]))
    return math.degrees(2.0 * halves[0]), math.degrees(2.0 * halves[1])


def _stretch(camera: Camera) -> list[Fault]:
    ratio = max(camera.fx / camera.fy, camera.fy / camera.fx)
    return [] if ratio <= _STRETCHED else [Fault(
        f'the focal lengths {camera.fx:g} and {camera.fy:g} px differ by a factor of {ratio:.3g}: '
        'is the image stretched like that?', ratio > _TORN)]


def _fold(camera: Camera) -> list[Fault]:
    """Return whether coefficients fold the image: they are of another lens or model, or order."""
    if camera.is_pinhole:
        return []
    size = (camera.width, camera.height)
    for share in (0.5, 1.0):
        pixels = np.multiply(0.5 + share * _MIDDLES, size)
        if np.isnan(camera.normalize_points(pixels)).any() and (
                share == 0.5 or camera.distortion_model != 'equidistant'):
            return [Fault(
                f"the coefficients {[float(f'{one:.4g}') for one in camera.distortion]} of "
                f'{camera.distortion_model} fold the image onto itself before its '
                f"{'border' if share == 1.0 else 'inner half ends'}: are they of this lens, and "
                'in this order?', share == 0.5)]
    return []
