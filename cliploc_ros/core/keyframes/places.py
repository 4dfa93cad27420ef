# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Places that keyframes recognize in an image, and the evidence for and against each."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class RecognizedPlace(NamedTuple):
    """A pose by keyframes, and the evidence for and against it."""

    map_from_camera: NDArray[np.float64]  #: (4, 4)
    #: (6, 6): in the order of core.fit.covariance; and its part that the keyframes cause, which
    #: looks at the same keyframes share
    covariance: NDArray[np.float64]
    shared: NDArray[np.float64]
    #: Number of features that agree, without those that agree with a place found before
    inliers: int
    #: Share of the comparable cells of the image that show what the keyframes have there
    confirmed: float
    #: The share that this number of inliers confirms if they are spread as usual: 0 to 1
    expected: float
    #: Number of cells that confirm, and of those that are comparable: the keyframes expect points
    #: there, and the image has features
    cells: tuple[int, int] = (0, 0)
    #: The focal length that the points suggest as a multiple of the camera's, and its relative
    #: standard deviation; 1 and inf where they suggest none. Right poses suggest a ratio of 1;
    #: wrong intrinsics, and a picture of the place of another size, suggest another one.
    focal_ratio: float = 1.0
    focal_deviation: float = np.inf
    #: The same of the root of its aspect, x to y: a picture that is seen from the side is narrow
    aspect_ratio: float = 1.0
    aspect_deviation: float = np.inf
    #: Angle off the known vertical in standard deviations, see Constraint.tilt_error. It
    #: excludes no place: the vertical may be wrong, as with a wrong camera mount.
    tilt_error: float = 0.0
    #: Those that points agree with, the most points first, and the share of the points
    keyframes: tuple[int, ...] = ()
    shares: tuple[float, ...] = ()
    #: (k, 2): where the image, as it is, shows each point that agrees [px]
    pixels: NDArray[np.float64] = np.empty((0, 2))
    #: (k,): which point of the layer that is
    rows: NDArray[np.int64] = np.empty(0, dtype=np.int64)
    points: NDArray[np.float64] = np.empty((0, 3))  #: (k, 3): where it is in the map [m]
    is_thorough: bool = False  #: Whether the thorough pass found it


class Recognition(NamedTuple):
    """The places where keyframes recognize an image."""

    #: None agrees with another one. The one whose points lie in the most cells of the image is
    #: first: a poster has many points, but shows only a part of its place.
    places: tuple[RecognizedPlace, ...] = ()
    #: Whether all keyframes were matched that should be. A search that the deadline cut has no
    #: places: it may have missed their rivals.
    is_complete: bool = True
    is_thorough: bool = False  #: Whether the thorough pass found them, see ImageRecognizer
