# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Systematic differences of boxes and landmarks, which point to the camera and its mount."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.mapping.landmarks import Landmarks
from cliploc_ros.mapping.posed_detections import PosedDetections
from cliploc_ros.mapping.projection import project_box
from cliploc_ros.mapping.views import Views

# Guesses: what a sound recording stays below.
_MAX_SHIFT_PX = 4.0
_MAX_STRETCH = 0.03
_FEWEST_BOXES = 50


@dataclass(frozen=True)
class Residuals:
    """Medians over the boxes that show a landmark and do not touch the image border.

    Parameters
    ----------
    boxes : int
    right_px, down_px : float
        By which boxes lie right of and below their landmarks [px].
    stretch : float
        By which distances from the image centre are too long, as a share: a focal length that
        is set too short.
    """

    boxes: int
    right_px: float
    down_px: float
    stretch: float

    def advice(self) -> list[str]:
        """Return what to check."""
        advice: list[str] = []
        if self.boxes < _FEWEST_BOXES:
            return advice
        if max(abs(self.right_px), abs(self.down_px)) > _MAX_SHIFT_PX:
            advice.append(f'boxes lie {self.right_px:+.1f} px right of and {self.down_px:+.1f} px '
                          "below their landmarks: check the camera's mount and its principal "
                          'point')
        if abs(self.stretch) > _MAX_STRETCH:
            advice.append(f'the image is stretched by {self.stretch:+.1%} about its centre: check '
                          'the focal length')
        return advice


def mean_residuals(detections: PosedDetections, views: Views, landmarks: Landmarks,
                   shown: NDArray[np.int64]) -> Residuals:
    """Return the systematic differences.

    Parameters
    ----------
    detections : PosedDetections
    views : Views
        Of the same detections.
    landmarks : Landmarks
    shown : ndarray (n,) of int
        The landmark that each box shows, -1 for none.
    """
    rows = np.nonzero((shown >= 0) & ~views.is_open.any(axis=1))[0]
    if len(rows) == 0:
        return Residuals(0, 0.0, 0.0, 0.0)
    expected = np.full((len(rows), 4), np.nan)
    for place, row in enumerate(rows):
        frame = views.frames[row]
        project_box(views.rotations[frame], views.translations[frame],
                    landmarks.centers[shown[row]], landmarks.bases[shown[row]], expected[place])
    focal = np.array([detections.camera.fx, detections.camera.fy])
    seen = 0.5 * (views.edges[rows, :2] + views.edges[rows, 2:])
    offsets = seen - 0.5 * (expected[:, :2] + expected[:, 2:])
    right_px, down_px = np.nanmedian(offsets, axis=0) * focal
    outer = np.hypot(*seen.T) > 0.5 * np.hypot(*views.bounds[2:])
    outward = np.sum(offsets * seen, axis=1) / np.sum(seen * seen, axis=1)
    stretch = float(np.nanmedian(outward[outer])) if outer.sum() >= _FEWEST_BOXES else 0.0
    return Residuals(len(rows), float(right_px), float(down_px), stretch)
