# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Local features of an image, and which of two images show the same point.

A FeatureKind finds features and compares them. SIFT is built in (Lowe, "Distinctive Image
Features from Scale-Invariant Keypoints", 2004), with the square root of Arandjelovic and Zisserman
("Three things everyone should know to improve object retrieval", 2012). OpenCV finds the features;
a descriptor takes 128 bytes.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

DIMENSIONS = 128  #: Of a descriptor of SIFT
# A unit vector of square roots times this fits into a byte; no entry of a real one exceeds .5.
_SCALE = 512.0
# A dark image is made brighter first, until one pixel in a hundred is at least so bright: SIFT
# leaves out features of little contrast.
_DARK = 160.0
# Less than SIFT's own .04: floors, walls and boxes have little contrast.
_CONTRAST = 0.02
# A match is refused if another feature of the other image is nearly as similar (Lowe, 2004).
_RATIO = 0.85
# Cosines are as near to equal as this by rounding: of two equal descriptors neither is clearer.
_SAME = 1e-6


@dataclass(frozen=True)
class Features:
    """The n features of an image."""

    pixels: NDArray[np.float64]  #: (n, 2) [px] in the image as it is, distorted
    descriptors: NDArray[np.uint8]  #: (n, d)
    strengths: NDArray[np.float32]  #: (n,): response of the detector; the strongest is first

    def __len__(self) -> int:
        """Return the number of features."""
        return len(self.pixels)


@dataclass(frozen=True)
class FeatureKind:
    """Extraction, storage and comparison of one kind of features."""

    #: Identifies the descriptors: those of another kind must not be compared with these
    name: str
    dimensions: int  #: Dimensions of a descriptor: d
    #: Takes an image (h, w, 3), the most features, and the longest side that it is made smaller to
    extract: Callable[[NDArray[np.uint8], int, int], Features]
    #: An entry of a unit vector is stored as a byte: this plus `scale` times the entry
    zero: int = 0
    scale: float = _SCALE
    #: The most similar feature of another image is at most this share as far as the second one
    ratio: float = _RATIO
    least_inliers: int = 0  #: With fewer features that agree, a pose may be one of chance
    #: The fast pass: longest side of the image, and the most features. At the size of keyframes,
    #: features take twice the time at equal success.
    query_px: int = 400
    query_most: int = 600

    def compact(self, units: NDArray[np.float32]) -> NDArray[np.uint8]:
        """Return unit vectors (n, d) as descriptors."""
        return compact(units, self.zero, self.scale)

    def units(self, descriptors: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return descriptors (n, d) as unit vectors."""
        return unit_rows(descriptors, self.zero)

    def match(self, ours: NDArray[np.float32], theirs: NDArray[np.float32]
              ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Return the pairs of rows of two images' unit descriptors, see the function match."""
        return match(ours, theirs, self.ratio)


#: Kinds by their names; a call makes one, which may load or download something.
FeatureKinds = Mapping[str, Callable[[], FeatureKind]]


def extract(image_rgb: NDArray[np.uint8], most: int, longest_side_px: int = 800) -> Features:
    """Return the strongest features of an image (h, w, 3), up to a number.

    A larger image is made smaller first: it bounds the time. Features of different sizes of an
    image match: those that the smaller one lacks are its finest.
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


#: The built-in kind.
SIFT = FeatureKind('rootsift-128-uint8', DIMENSIONS, extract)
ONLY_SIFT: FeatureKinds = {SIFT.name: lambda: SIFT}


def compact(units: NDArray[np.float32], zero: int = 0, scale: float = _SCALE
            ) -> NDArray[np.uint8]:
    """Return unit vectors (n, d) as descriptors, see FeatureKind."""
    return np.clip(np.round(scale * units) + zero, 0, 255).astype(np.uint8)


def unit_rows(descriptors: NDArray[np.uint8], zero: int = 0) -> NDArray[np.float32]:
    """Return descriptors (n, d) as unit vectors; a byte of `zero` stands for 0."""
    rows = descriptors.astype(np.float32) - zero
    rows /= np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-9)
    return rows


def match(ours: NDArray[np.float32], theirs: NDArray[np.float32], ratio: float = _RATIO
          ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return which rows of two images' unit descriptors show the same point, and how clearly.

    Each is the other's most similar one, and clearly more similar than the second of theirs.

    Returns
    -------
    pairs : ndarray (k, 2) of int
        Rows of ours and theirs.
    shares : ndarray (k,)
        Squared distance of each as a share of that to the second of theirs.
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
    rows, shares = rows[shares < ratio**2], shares[shares < ratio**2]
    return np.stack([rows, best[rows]], axis=1), shares
