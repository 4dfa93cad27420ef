# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A map drawn from above."""

import numpy as np
from matplotlib import color_sequences
from matplotlib.axes import Axes
from matplotlib.patches import Polygon
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from cliploc_ros.core.geometry.ellipsoid import outline_points
from cliploc_ros.core.maps.landmark_map import LandmarkMap

#: Outlines text, so that it is legible on any background.
EDGED = (withStroke(linewidth=2.0, foreground='white'),)
_MOST_NAMES = 100
# Landmarks nearer than this share one place for their names.
_SAME_PLACE_M = 0.14


def draw_map(axes: Axes, landmark_map: LandmarkMap) -> dict[str, tuple[float, ...]]:
    """Draw each landmark from above, with its name if there are few.

    Parameters
    ----------
    axes : Axes
        x and y of the map [m], with equal scales.
    landmark_map : LandmarkMap

    Returns
    -------
    dict of str to tuple of float
        Colour of each class.
    """
    classes = sorted(set(landmark_map.class_ids))
    palette = color_sequences['tab20'][::2] + color_sequences['tab20'][1::2]
    colors = {name: palette[i % len(palette)] for i, name in enumerate(classes)}
    for center, shape, class_id in zip(landmark_map.centers, landmark_map.shapes,
                                       landmark_map.class_ids, strict=True):
        outline = np.array([center[0], center[1], shape[0], shape[1], shape[3]])
        axes.add_patch(Polygon(outline_points(outline), closed=True, facecolor=colors[class_id],
                               edgecolor='#333333', linewidth=0.5, alpha=0.55, zorder=3))
    for place, names in _places(landmark_map) if len(landmark_map) <= _MOST_NAMES else ():
        axes.text(place[0], place[1], '\n'.join(names), fontsize=5.4, ha='center', va='center',
                  zorder=4, linespacing=0.95, path_effects=EDGED)
    return colors


def _places(landmark_map: LandmarkMap) -> list[tuple[NDArray[np.float64], list[str]]]:
    """Return places and the names to write there; stacked landmarks share one."""
    places: list[tuple[NDArray[np.float64], list[int]]] = []
    for row in np.argsort(-landmark_map.centers[:, 2], kind='stable'):
        center = landmark_map.centers[row, :2]
        for place, rows in places:
            if np.linalg.norm(place - center) < _SAME_PLACE_M:
                rows.append(int(row))
                break
        else:
            places.append((center, [int(row)]))
    return [(place, [landmark_map.landmark_ids[row] for row in rows]) for place, rows in places]
