# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The right half of the debug image: the keyframe that most points agree with."""

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.keyframes.layer import PIXEL_SCALE, KeyframeLayer
from cliploc_ros.core.keyframes.localization import RecognizedPlace

_BLANK, _OTHER, _TEXT = (40, 40, 40), (120, 120, 120), (255, 255, 255)
_RADIUS_PX = 3
# Lines between more points hide the images.
_MOST_LINES = 20


def beside_keyframe(canvas: NDArray[np.uint8], seen: RecognizedPlace, layer: KeyframeLayer
                    ) -> NDArray[np.uint8]:
    """Return the image (h, w, 3) with the keyframe that fits it best to the right of it.

    Points that agree have the same colour in both, and some are joined by lines. A layer without
    images has a blank panel with the points of the keyframe.

    Parameters
    ----------
    canvas : ndarray (h, w, 3) uint8
        The localized image. It is not changed.
    seen : RecognizedPlace
        With one keyframe at least.
    layer : KeyframeLayer
        That it was recognized in.
    """
    keyframe = seen.keyframes[0]
    height, width = canvas.shape[:2]
    rows = layer.rows(keyframe)
    scale = height / layer.camera.height
    panel, place = _panel(layer, keyframe, scale), np.array([width, 0])
    both = np.concatenate([canvas, panel], axis=1)
    pixels = np.asarray(layer.pixels[rows]) / PIXEL_SCALE * scale + place
    if layer.image_rgb(keyframe) is None:
        for there in _whole(pixels):
            cv2.circle(both, there, 1, _OTHER, cv2.FILLED)
    own = np.nonzero((seen.rows >= rows.start) & (seen.rows < rows.stop))[0]
    ours, theirs = _whole(seen.pixels[own]), _whole(pixels[seen.rows[own] - rows.start])
    colors = _colors(seen.pixels[own])
    joined = set(np.linspace(0, len(own) - 1, min(len(own), _MOST_LINES)).astype(int).tolist())
    for row, (here, there, color) in enumerate(zip(ours, theirs, colors, strict=True)):
        if row in joined:
            cv2.line(both, here, there, color, 1, cv2.LINE_AA)
        for point in (here, there):
            cv2.circle(both, point, _RADIUS_PX, color, cv2.FILLED, cv2.LINE_AA)
    text = f'keyframe {keyframe}: {len(own)} of {seen.inliers} inliers'
    at = (width + 6, height - 8)
    cv2.putText(both, text, (at[0] + 1, at[1] + 1), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1,
                cv2.LINE_AA)
    cv2.putText(both, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.45, _TEXT, 1, cv2.LINE_AA)
    return both


def _panel(layer: KeyframeLayer, keyframe: int, scale: float) -> NDArray[np.uint8]:
    """Return the keyframe's image, as high as the localized one; blank where there is none."""
    width = max(1, round(scale * layer.camera.width))
    height = max(1, round(scale * layer.camera.height))
    image = layer.image_rgb(keyframe)
    if image is None:
        return np.full((height, width, 3), _BLANK, dtype=np.uint8)
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_LINEAR))


def _colors(pixels: NDArray[np.float64]) -> list[list[int]]:
    """Return a colour for each point, by its column: neighbours have similar ones."""
    order = np.argsort(np.argsort(pixels[:, 0], kind='stable'), kind='stable')
    hues = 170.0 * order / max(1, len(order))
    colors = np.full((len(order), 1, 3), 255, dtype=np.uint8)
    colors[:, 0, 0] = hues
    return [] if not len(order) else cv2.cvtColor(colors, cv2.COLOR_HSV2RGB)[:, 0].tolist()


def _whole(pixels: NDArray[np.float64]) -> list[list[int]]:
    """Return whole pixels, within the range that OpenCV can draw."""
    return np.clip(np.rint(pixels), -30_000, 30_000).astype(int).tolist()
