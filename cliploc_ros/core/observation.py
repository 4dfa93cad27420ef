# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the camera saw at one instant: detections, and how well they match each label."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.camera import Camera


@dataclass(frozen=True)
class Detections:
    """The objects a detector found in one image.

    Parameters
    ----------
    bboxes_xyxy : ndarray (n, 4)
        Left, top, right, bottom [px] in the image as it came (distorted).
    class_ids : tuple of str
        Class name of each detection, n of them.
    scores : ndarray (n,)
        Detector confidence, 0 to 1.
    """

    bboxes_xyxy: NDArray[np.float64]
    class_ids: tuple[str, ...]
    scores: NDArray[np.float64]

    def __len__(self) -> int:
        """Return the number of detections."""
        return len(self.class_ids)
