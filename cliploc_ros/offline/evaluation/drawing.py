# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Maps from above, and names that do not cover each other."""

import io
from itertools import product

import numpy as np
from matplotlib import color_sequences
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from matplotlib.patheffects import withStroke
from numpy.typing import ArrayLike, NDArray

from cliploc_ros.core.geometry.ellipsoid import outline_points
from cliploc_ros.core.map.landmark_map import LandmarkMap

#: Outlines text, so that it is legible on any background.
EDGED = (withStroke(linewidth=2.0, foreground='white'),)
_MOST_NAMES = 100
_NAME = 'name'
# Steps of a name from its place, in half widths and in heights, the nearest first.
_STEPS = sorted(product((0.0, 1.1, -1.1, 2.2, -2.2), np.arange(-4, 5) * 1.05),
                key=lambda step: (abs(step[0]) + abs(step[1]), -step[1]))


def draw_map(axes: Axes, landmark_map: LandmarkMap) -> dict[str, tuple[float, ...]]:
    """Draw each landmark from above, with its name if there are few.

    Parameters
    ----------
    axes : Axes
        x and y of the map [m], with equal scales.

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
        draw_outline(axes, center, shape, facecolor=colors[class_id], edgecolor='#333333',
                     linewidth=0.5, alpha=0.55, zorder=3)
    if len(landmark_map) <= _MOST_NAMES:
        # the highest first: they hide the others
        for row in np.argsort(-landmark_map.centers[:, 2], kind='stable'):
            write_name(axes, landmark_map.centers[row, :2], landmark_map.landmark_ids[row], 6)
    return colors


def draw_outline(axes: Axes, center: NDArray[np.float64], shape: NDArray[np.float64],
                 **style: object) -> None:
    """Draw an ellipsoid, of center (3,) and shape (6,), from above."""
    outline = np.array([center[0], center[1], shape[0], shape[1], shape[3]])
    axes.add_patch(Polygon(outline_points(outline), closed=True, **style))


def write_name(axes: Axes, xy: ArrayLike, text: str, size: float = 8,
               color: str = '#222222') -> None:
    """Write a name at a place (2,); see spread_names."""
    x, y = np.asarray(xy)
    axes.text(x, y, text, fontsize=size, color=color, ha='center', va='center', zorder=9,
              path_effects=EDGED, parse_math=False, clip_on=True, gid=_NAME).set_in_layout(False)


def spread_names(figure: Figure) -> None:
    """Move names that would cover each other, and hide those that have no room.

    A line joins a name that was moved with its place. The names that were written first stay.
    """
    figure.draw_without_rendering()
    renderer = FigureCanvasAgg(figure).get_renderer()
    for axes in figure.axes:
        taken: list[NDArray[np.float64]] = []
        for name in [one for one in axes.texts if one.get_gid() == _NAME]:
            box = np.reshape(name.get_window_extent(renderer).extents, (2, 2))
            size, place = box[1] - box[0], name.get_position()
            for across, up in _STEPS:
                moved = box + size * (across / 2, up)
                if (moved[0] >= axes.bbox.min).all() and (moved[1] <= axes.bbox.max).all() \
                        and not any((moved[0] < other[1]).all() and (other[0] < moved[1]).all()
                                    for other in taken):
                    break
            else:
                name.set_visible(False)
                continue
            taken.append(moved)
            x, y = axes.transData.inverted().transform(moved.mean(axis=0)).tolist()
            name.set_position((x, y))
            if abs(up) > 1.5 or abs(across) > 1.5:
                axes.add_artist(Line2D((place[0], x), (place[1], y), color='#666666',
                                       linewidth=0.5, zorder=8))


def png_of(figure: Figure, dpi: int) -> bytes:
    """Return a figure as PNG, its names spread."""
    spread_names(figure)
    buffer = io.BytesIO()
    figure.savefig(buffer, format='png', dpi=dpi)
    return buffer.getvalue()
