# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is wrong with the images of a camera, from the images themselves.

Each sign has to last for some looks. A wall before a standing robot is as bare as a cloth over its
lens, and its image as smooth as one that is out of focus, so what is blurred or dirty shows in
different views only. An image that stays the same to the last bit is frozen once the robot moves.
"""

import zlib

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.transforms import SAME_VIEW

# Of the grey image at this width [px], values 0 to 255. 533 images of five rooms and a corridor
# have a mean from 56, a deviation from 21 and a Laplacian from 10 on, bare walls 1; those that are
# smoothed by 1/80 of their width have a Laplacian of 1 to 2. Chosen between.
_WIDTH_PX = 320
_DARK_MEAN, _DARK_HIGH, _BARE, _SMOOTH = 15.0, 40.0, 6.0, 3.0
# Looks in a row until a fault is named.
_LOOKS = {'dark': 3, 'bare': 3, 'frozen': 2, 'smooth': 5}
_WORDS = {'dark': 'the camera is in the dark, or covered',
          'bare': 'the camera is covered, or before a bare wall',
          'frozen': 'the image is frozen', 'smooth': 'the image is blurred, or the lens dirty'}


class ImageFaults:
    """Signs of faults over the images of one camera."""

    def __init__(self) -> None:
        self._counts = dict.fromkeys(_LOOKS, 0)
        self._pose = np.full((4, 4), np.nan)
        self._checksum = -1

    def add(self, image: NDArray[np.uint8], pose: NDArray[np.float64]) -> str:
        """Take in an image (h, w, 3) from a pose (4, 4), by odometry if known; return the fault.

        The text is empty where there is none.
        """
        moved = not SAME_VIEW.agree(pose, self._pose)  # true of the first one
        checksum = zlib.crc32(np.ascontiguousarray(image))
        same, self._checksum = checksum == self._checksum, checksum
        signs = _signs(image)
        for name, shown in signs.items():
            if not shown:
                self._counts[name] = 0
            elif moved or name != 'smooth':
                self._counts[name] += 1
        self._counts['frozen'] = self._counts['frozen'] + moved if same else 0
        if moved:
            self._pose = pose
        return next((_WORDS[name] for name, least in _LOOKS.items()
                     if self._counts[name] >= least), '')


def _signs(image: NDArray[np.uint8]) -> dict[str, bool]:
    """Return which signs an image shows by itself."""
    height = max(1, round(image.shape[0] * _WIDTH_PX / image.shape[1]))
    small = cv2.resize(image, (_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
    grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.float32)
    mean, deviation = grey.mean(), grey.std()
    is_dark = bool(mean < _DARK_MEAN and np.quantile(grey, 0.95) < _DARK_HIGH)
    is_bare = bool(deviation < _BARE) and not is_dark
    detail = cv2.Laplacian(grey, cv2.CV_32F).std()
    return {'dark': is_dark, 'bare': is_bare,
            'smooth': bool(detail < _SMOOTH) and not (is_dark or is_bare)}
