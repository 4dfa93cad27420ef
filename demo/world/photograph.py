# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Degrade an image as a cheap camera does: motion blur, exposure, noise."""

import cv2
import numpy as np
import numpy.typing as npt


def expose(image: npt.NDArray[np.uint8], rng: np.random.Generator,
           blur_px: float = 2.0) -> npt.NDArray[np.uint8]:
    """Add motion blur, exposure error and noise to an image.

    Parameters
    ----------
    image : (h, w, 3) array of uint8
        RGB.
    rng : numpy.random.Generator
        Draws the exposure, the motion and the noise.
    blur_px : float
        Typical length of the motion during the exposure [px].

    Returns
    -------
    (h, w, 3) array of uint8
    """
    gain = np.exp(rng.normal(0, 0.12))
    balance = np.exp(rng.normal(0, 0.025, 3))
    noise = rng.normal(0, rng.uniform(1.5, 5.0), image.shape)
    moved = _move(image, abs(rng.normal(0, blur_px)), rng.uniform(0, np.pi))
    return np.clip(moved * gain * balance + noise, 0, 255).astype(np.uint8)


def _move(image: npt.NDArray[np.uint8], length_px: float, angle: float) -> \
        npt.NDArray[np.uint8]:
    """Blur the image along a line, as a turning camera does."""
    if length_px < 1:
        return image
    half = int(np.ceil(length_px / 2))
    kernel = np.zeros((2 * half + 1, 2 * half + 1), dtype=np.float32)
    reach = length_px / 2 * np.array([np.cos(angle), np.sin(angle)])
    start, end = np.round(half - reach).astype(int), np.round(half + reach).astype(int)
    cv2.line(kernel, start.tolist(), end.tolist(), 1.0)
    return np.asarray(cv2.filter2D(image, -1, kernel / kernel.sum()), dtype=np.uint8)
