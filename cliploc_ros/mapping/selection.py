# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which landmarks are good enough for the map; the others get a reason."""

import numpy as np

from cliploc_ros.mapping.evidence import Evidence
from cliploc_ros.mapping.landmarks import Landmarks
from cliploc_ros.mapping.options import MappingOptions


def reasons_against(landmarks: Landmarks, evidence: Evidence, options: MappingOptions
                    ) -> list[str | None]:
    """Return for each landmark why it stays out of the map; None where it belongs into it."""
    return [_reason(evidence, number, float(np.linalg.norm(basis)), options)
            for number, basis in enumerate(landmarks.bases)]


def _reason(evidence: Evidence, number: int, size_m: float, options: MappingOptions
            ) -> str | None:
    """Return the first reason against a landmark, or None."""
    viewpoints, ratio = evidence.viewpoints[number], evidence.seen_ratio[number]
    baseline, sigma = evidence.baseline_deg[number], evidence.position_sigma[number]
    if viewpoints < options.min_viewpoints:
        return f'seen from {viewpoints} viewpoints, not {options.min_viewpoints}'
    if ratio < options.min_seen_ratio:
        return f'seen in {_floor(100 * ratio)} % of the frames that show its place, not ' \
               f'{100 * options.min_seen_ratio:g} %: rarely detected, or moved'
    if baseline < options.min_baseline_deg:
        return f'seen from one side only: {_floor(baseline)} degrees, not ' \
               f'{options.min_baseline_deg:g}'
    if sigma > max(options.max_position_sigma_m, options.max_position_sigma_share * size_m):
        return f'its position is uncertain: {sigma:.2f} m'
    if evidence.median_iou[number] < options.min_median_iou:
        return f'its boxes do not fit one ellipsoid: median IoU {evidence.median_iou[number]:.2f}'
    return None


def _floor(value: float) -> str:
    """Return one decimal, never rounded up: 19.97 stays below 20."""
    return f'{np.floor(10.0 * value) / 10.0:.1f}'
