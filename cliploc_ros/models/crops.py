# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Preparation of crops for an image tower of CLIP, as in open_clip, without PyTorch."""

import sys
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

# Crops with a greater ratio of sides are cut first: CLIP sees only the central square.
_MAX_ASPECT = 16


class CropPreparation:
    """Scales crops to the input of a tower.

    ``config`` is open_clip's ``PreprocessCfg``: size, mean, std, interpolation, resize_mode
    ('shortest', 'longest' or 'squash') and fill_color.
    """

    def __init__(self, config: Mapping[str, Any]) -> None:
        size = config['size']
        self._height, self._width = map(int, (size, size) if isinstance(size, int) else size)
        self._mode = config.get('resize_mode') or 'shortest'
        self._filter = (Image.Resampling.BILINEAR if config.get('interpolation') == 'bilinear'
                        else Image.Resampling.BICUBIC)
        self._fill = config.get('fill_color') or 0
        self._mean, self._std = (np.float32(config[name]).reshape(-1, 1, 1)
                                 for name in ('mean', 'std'))
        self._max_aspect = _MAX_ASPECT if self._mode == 'shortest' else sys.maxsize

    def __call__(self, crop_rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Convert a crop (h, w, 3) to the input (3, H, W) of the tower."""
        image = Image.fromarray(np.ascontiguousarray(self._cut(crop_rgb)))
        image = image.resize(self._scaled(*image.size), self._filter)
        left, top = (round((has - wants) / 2.0) for has, wants in
                     zip(image.size, (self._width, self._height), strict=True))
        if left < 0 or top < 0:
            frame = Image.new('RGB', (self._width, self._height), (self._fill,) * 3)
            frame.paste(image, (max(self._width - image.width, 0) // 2,
                                max(self._height - image.height, 0) // 2))
            image, left, top = frame, 0, 0
        image = image.crop((left, top, left + self._width, top + self._height))
        pixels = np.asarray(image, dtype=np.float32).transpose(2, 0, 1) / np.float32(255)
        return np.asarray((pixels - self._mean) / self._std)

    def _scaled(self, width: int, height: int) -> tuple[int, int]:
        """Return the width and height that a crop is scaled to."""
        if self._mode == 'squash':
            return self._width, self._height
        ratios = height / self._height, width / self._width
        if self._mode == 'shortest' and self._height == self._width:
            short, side = min(width, height), self._height
            return ((side, int(side * height / short)) if width <= height
                    else (int(side * width / short), side))
        ratio = max(ratios) if self._mode == 'longest' else min(ratios)
        return round(width / ratio), round(height / ratio)

    def _cut(self, crop_rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Cut a very long crop to its middle.

        The short side is scaled to the tower's input before the central square is cut out. A crop
        of 1 x 2000 pixels would first become an image of 224 x 448,000.
        """
        height, width = crop_rgb.shape[:2]
        longest = self._max_aspect * min(height, width)
        cut_x, cut_y = max(width - longest, 0) // 2, max(height - longest, 0) // 2
        return crop_rgb[cut_y:height - cut_y, cut_x:width - cut_x]
