# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Draw the built map and the true objects, from above and from two sides."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon
from numpy.typing import NDArray

from cliploc_ros.core.geometry.ellipsoid import outline_points, shape_matrices
from cliploc_ros.demo.map_review import MapReview
from cliploc_ros.demo.style import ACCEPTED, REFUSED
from cliploc_ros.evaluation.map_view import EDGED

_DPI = 110
_MARGIN_M = 0.35
_MISSED = '#E69F00'
_TRUTH = '#222222'
_HEADING_M = 0.2
_NAME_OFFSET_M = 0.2
# Axes of the map across and up in each panel, and where these meet in a symmetric matrix that is
# stored as xx, xy, xz, yy, yz, zz.
_PANELS = ((0, 1, (0, 1, 3)), (0, 2, (0, 2, 5)), (1, 2, (3, 4, 5)))
_AXIS_NAMES = 'xyz'


def draw_map_review(review: MapReview, map_from_camera: NDArray[np.float64], path: Path) -> None:
    """Draw found, missed and false objects.

    Parameters
    ----------
    review : MapReview
    map_from_camera : ndarray (F, 4, 4)
        Of the images of the mapping walk.
    path : Path
        The PNG to write.
    """
    points = np.concatenate([[one.center for one in review.objects], review.landmark_map.centers,
                             map_from_camera[:, :3, 3]])
    low, high = points.min(axis=0) - _MARGIN_M, points.max(axis=0) + _MARGIN_M
    extents = high - low
    figure = Figure(figsize=(13.0, 1.0 + 13.0 * (extents[1] + extents[2]) / extents[:2].sum()),
                    dpi=_DPI, layout='constrained')
    grid = figure.add_gridspec(2, 2, height_ratios=(extents[1], extents[2]),
                               width_ratios=(extents[0], extents[1]))
    for place, (across, up, entries) in zip((grid[0, 0], grid[1, 0], grid[1, 1]), _PANELS,
                                            strict=True):
        axes = figure.add_subplot(place)
        axes.set(xlim=(low[across], high[across]), ylim=(low[up], high[up]), aspect='equal',
                 xlabel=f'{_AXIS_NAMES[across]} [m]', ylabel=f'{_AXIS_NAMES[up]} [m]')
        axes.grid(color='#EEEEEE', zorder=0)
        _draw_panel(axes, review, (across, up), entries)
        if up == 1:
            # Draw where the camera was, and where it looked.
            positions, forward = map_from_camera[:, :2, 3], map_from_camera[:, :2, 2]
            axes.plot(*positions.T, ':', color='#888888', linewidth=1.0, zorder=2)
            axes.plot(*positions.T, '.', color='#666666', markersize=5, zorder=2)
            for start, end in zip(positions, positions + _HEADING_M * forward, strict=True):
                axes.plot(*zip(start, end, strict=True), color='#666666', linewidth=0.9, zorder=2)
    legend = figure.add_subplot(grid[0, 1])
    legend.set_axis_off()
    legend.legend(handles=_legend(review), loc='upper left', frameon=False, fontsize=11)
    figure.savefig(path)


def _draw_panel(axes: Axes, review: MapReview, plane: tuple[int, int],
                entries: tuple[int, int, int]) -> None:
    found = {one.object_row for one in review.found}
    landmark_map = review.landmark_map
    for landmark, (center, shape) in enumerate(zip(landmark_map.centers, landmark_map.shapes,
                                                   strict=True)):
        color = REFUSED if landmark in review.false else ACCEPTED
        outline = outline_points(np.array([*center[[*plane]], *shape[[*entries]]]))
        axes.add_patch(Polygon(outline, closed=True, facecolor=color, edgecolor='none', alpha=0.45,
                               zorder=4 if landmark in review.false else 3))
    shapes = shape_matrices(np.array([one.semi_axes for one in review.objects]),
                            np.array([one.orientation for one in review.objects]))
    for row, (one, shape) in enumerate(zip(review.objects, shapes, strict=True)):
        is_missed = row not in found
        outline = outline_points(np.array([*one.center[[*plane]], *shape[[*entries]]]))
        axes.add_patch(Polygon(outline, closed=True, fill=False, zorder=6 if is_missed else 5,
                               edgecolor=_MISSED if is_missed else _TRUTH,
                               linewidth=2.0 if is_missed else 0.6))
        if is_missed:
            _name(axes, one.center[[*plane]] + (0.0, _NAME_OFFSET_M), one.object_id, '#8A5A00')
    for landmark in review.false:
        _name(axes, landmark_map.centers[landmark, [*plane]] - (0.0, _NAME_OFFSET_M),
              landmark_map.landmark_ids[landmark], REFUSED)


def _name(axes: Axes, place: NDArray[np.float64], name: str, color: str) -> None:
    axes.text(place[0], place[1], name, fontsize=8, ha='center', va='center', color=color,
              zorder=8, fontweight='bold', path_effects=EDGED)


def _legend(review: MapReview) -> list[Line2D | Patch]:
    return [
        Patch(facecolor=ACCEPTED, alpha=0.45, label=f'landmark of an object: {len(review.found)}'),
        Patch(facecolor=REFUSED, alpha=0.45, label=f'false landmark: {len(review.false)}'),
        Patch(facecolor='none', edgecolor=_MISSED, linewidth=2.0,
              label=f'missed object: {len(review.missed)}'),
        Patch(facecolor='none', edgecolor=_TRUTH, linewidth=0.6, label='true object'),
        Line2D([], [], color='#666666', marker='.', linestyle=':',
               label='mapping walk, with the direction of each view')]
