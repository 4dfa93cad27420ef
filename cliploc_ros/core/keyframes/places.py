# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Places that keyframes recognize in an image, with the evidence for and against each place."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class RecognizedPlace(NamedTuple):
    """A pose found from keyframes, with the evidence for and against it."""

    map_from_camera: NDArray[np.float64]  #: (4, 4)
    #: (6, 6), (6, 6): in the order of core.fit.covariance; and the part due to errors of the
    #: keyframes, which all looks at the same keyframes share
    covariance: NDArray[np.float64]
    shared: NDArray[np.float64]
    #: Number of agreeing features, without features that agree with a place found earlier
    inliers: int
    #: Share of the comparable cells of the image that contain inliers, 0 to 1: of the cells
    #: where the keyframes predict points and the image has features
    confirmed: float
    #: Focal length estimated from the points, as a multiple of the camera's, and its relative
    #: standard deviation; 1 and inf without an estimate. At right poses the ratio is close to 1.
    #: Wrong intrinsics, or a picture of the place at another scale, give another ratio.
    focal_ratio: float = 1.0
    focal_deviation: float = np.inf
    #: Root of the aspect of the focal lengths, x to y, estimated the same way: a picture seen from
    #: the side is narrow
    aspect_ratio: float = 1.0
    aspect_deviation: float = np.inf
    #: Angle to the known vertical in standard deviations, see Constraint.tilt_error. It excludes
    #: no place: the vertical may be wrong, for example because of a wrong camera mount.
    tilt_error: float = 0.0
    #: Keyframes with agreeing points, in decreasing order of points, and the share of each
    keyframes: tuple[int, ...] = ()
    shares: tuple[float, ...] = ()
    #: (k, 2): position of each agreeing point in the original, distorted image [px]
    pixels: NDArray[np.float64] = np.empty((0, 2))
    #: (k,): index of each agreeing point in the layer
    rows: NDArray[np.int64] = np.empty(0, dtype=np.int64)
    points: NDArray[np.float64] = np.empty((0, 3))  #: (k, 3): its position in the map [m]
    is_thorough: bool = False  #: Whether the thorough pass found the place
    #: How far the view of the nearest keyframe with agreeing points is from the pose: the sum of
    #: distance / 2 m and angle / 40 degrees
    apart: float = 0.5
    #: Share, 0 to 1, of the agreeing features that agree on another pose, as points do that have
    #: moved: a part of the place was elsewhere when it was mapped
    parted: float = 0.0
    recorded: str = ''  #: Recording of the keyframe with most points, see KeyframeLayer.recorded


class Recognition(NamedTuple):
    """The places where keyframes recognize an image."""

    #: Mutually different places. The place whose points lie in the most cells of the image is
    #: first: a poster has many points, but shows only a part of its place.
    places: tuple[RecognizedPlace, ...] = ()
    #: Whether all chosen keyframes were matched. A search that the deadline stopped returns no
    #: places: it may have missed rivals.
    is_complete: bool = True
    is_thorough: bool = False  #: Whether the thorough pass found the places, see ImageRecognizer
    #: Height of the best place, if it is outside the range of heights and no place is inside [m]
    outside_m: float | None = None
