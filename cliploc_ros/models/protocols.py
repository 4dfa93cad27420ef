# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Protocols of the neural networks."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.observation import Detections


class ImageTextEncoder(Protocol):
    """Embeds image crops and text labels in one space, where cosine means similarity."""

    key: str  #: Identifies model and weights: equal keys give equal embeddings

    def encode_crops(self, image_rgb: NDArray[np.uint8], bboxes_xyxy: NDArray[np.float64]
                     ) -> NDArray[np.float32]:
        """Return one embedding for each box of an image (h, w, 3) uint8, red first.

        The boxes (n, 4) are left, top, right, bottom [px]; each must overlap the image. The
        embeddings (n, d) have unit length.
        """

    def encode_labels(self, labels: Sequence[str]) -> NDArray[np.float32]:
        """Return one embedding (L, d) for each of L labels, float32 rows of unit length."""


class ObjectDetector(Protocol):
    """Finds the objects in an image."""

    def detect(self, image_rgb: NDArray[np.uint8]) -> Detections:
        """Return the objects in an image (h, w, 3) uint8, boxes in pixels of that image."""
