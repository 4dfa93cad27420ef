# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Extract local features of an image, and match the features of two images.

A FeatureKind extracts and matches features. SIFT is built in (Lowe, "Distinctive Image Features
from Scale-Invariant Keypoints", 2004), as RootSIFT (Arandjelovic and Zisserman, "Three things
everyone should know to improve object retrieval", 2012). OpenCV extracts the features. A
descriptor takes 128 bytes.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

DIMENSIONS = 128  #: Dimensions of a SIFT descriptor
# Scale from entries of a unit vector of square roots to bytes: in practice, no entry exceeds .5.
_SCALE = 512.0
# A dark image is first brightened until its 99th percentile has this value: SIFT drops features
# of low contrast.
_DARK = 160.0
# Below SIFT's default of .04: floors, walls and boxes have low contrast.
_CONTRAST = 0.02
# A match is refused if another feature of the other image is nearly as similar (Lowe, 2004).
_RATIO = 0.85
# Rounding error of a cosine. It is added to distances, so that equal descriptors have ratio 1.
_SAME = 1e-6


@dataclass(frozen=True)
class Features:
    """The n features of an image."""

    pixels: NDArray[np.float64]  #: (n, 2) [px] in the original, distorted image
    descriptors: NDArray[np.uint8]  #: (n, d)
    strengths: NDArray[np.float32]  #: (n,): response of the detector, in decreasing order

    def __len__(self) -> int:
        """Return the number of features."""
        return len(self.pixels)


@dataclass(frozen=True)
class FeatureKind:
    """Extraction, storage and comparison of one kind of features."""

    #: Identifies the descriptors: descriptors of different kinds must not be compared
    name: str
    dimensions: int  #: Dimensions of a descriptor: d
    #: Extracts features from an image (h, w, 3): (image, maximum number, longest side [px] to
    #: which a larger image is reduced)
    extract: Callable[[NDArray[np.uint8], int, int], Features]
    #: An entry of a unit vector is stored as the byte `zero` + `scale` * entry
    zero: int = 0
    scale: float = _SCALE
    #: Maximum ratio of the distances to the most similar and to the second feature of an image
    ratio: float = _RATIO
    least_inliers: int = 0  #: A pose with fewer agreeing features may be a chance result
    #: Fast pass: longest side of the image, and maximum number of features. At the image size of
    #: keyframes, features would take twice the time without a higher success rate.
    query_px: int = 400
    query_most: int = 600

    def units(self, descriptors: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Convert descriptors (n, d) to unit vectors (n, d)."""
        rows = descriptors.astype(np.float32) - self.zero
        rows /= np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-9)
        return rows

    def match(self, ours: NDArray[np.float32], theirs: NDArray[np.float32]
              ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Match the unit descriptors of two images: mutual nearest neighbours with a ratio test.

        Returns
        -------
        pairs : ndarray (k, 2) of int
            Rows of ours and theirs.
        shares : ndarray (k,)
            Squared distance of each pair, divided by that to the second-nearest row of theirs.
        """
        if len(ours) == 0 or len(theirs) < 2:
            return np.empty((0, 2), dtype=np.int64), np.empty(0, dtype=np.float32)
        cosines = ours @ theirs.T
        best = cosines.argmax(axis=1)
        first = cosines[np.arange(len(ours)), best]
        rows = np.nonzero(first >= cosines.max(axis=0)[best])[0]
        others = cosines[rows]
        others[np.arange(len(rows)), best[rows]] = -1.0
        # squared distances of unit vectors are 2 - 2 cos
        nearest, second = (np.maximum(1.0 - cosine, 0.0) + _SAME for cosine in (
            first[rows], others.max(axis=1, initial=-1.0)))
        shares = nearest / second
        rows, shares = rows[shares < self.ratio**2], shares[shares < self.ratio**2]
        return np.stack([rows, best[rows]], axis=1), shares


#: Factories of feature kinds by name; calling one may load or download a model.
FeatureKinds = Mapping[str, Callable[[], FeatureKind]]


def extract(image_rgb: NDArray[np.uint8], most: int, longest_side_px: int = 800) -> Features:
    """Return up to `most` features of an image (h, w, 3), the strongest first.

    A larger image is reduced first, which limits the time. Features of an image at different sizes
    match; a reduced image lacks only the finest features.
    """
    gray = cv2.cvtColor(image_rgb, cv2.COLOR_RGB2GRAY)
    scale = min(1.0, longest_side_px / max(image_rgb.shape[:2]))
    if scale < 1.0:
        size = [max(1, round(scale * side)) for side in reversed(gray.shape)]
        gray = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
    bright = float(np.percentile(gray, 99))
    if 0.0 < bright < _DARK:
        gray = cv2.convertScaleAbs(gray, alpha=_DARK / bright)
    sift = cv2.SIFT.create(nfeatures=most, contrastThreshold=_CONTRAST)
    points, descriptors = sift.detectAndCompute(gray, None)
    if descriptors is None:
        return Features(np.empty((0, 2)), np.empty((0, DIMENSIONS), np.uint8),
                        np.empty(0, np.float32))
    strengths = np.array([point.response for point in points], dtype=np.float32)
    rows = np.argsort(-strengths, kind='stable')[:most]
    pixels = (np.array([point.pt for point in points])[rows] + 0.5) / scale - 0.5
    found = descriptors[rows]
    shares = found / np.maximum(found.sum(axis=1, keepdims=True), 1e-9)
    return Features(pixels, compact(np.sqrt(shares)), strengths[rows])


#: The built-in feature kind.
SIFT = FeatureKind('rootsift-128-uint8', DIMENSIONS, extract)
ONLY_SIFT: FeatureKinds = {SIFT.name: lambda: SIFT}


def compact(units: NDArray[np.float32], zero: int = 0, scale: float = _SCALE) -> NDArray[np.uint8]:
    """Convert unit vectors (n, d) to descriptors (n, d), see FeatureKind."""
    return np.clip(np.round(scale * units) + zero, 0, 255).astype(np.uint8)
