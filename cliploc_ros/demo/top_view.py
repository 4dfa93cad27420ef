# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Draw the demo's map from above, with a line from each estimate to its truth (paper, Fig. 7)."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from cliploc_ros.core.maps.landmark_map import LandmarkMap
from cliploc_ros.demo.review import Judged
from cliploc_ros.demo.style import ACCEPTED, REFUSED
from cliploc_ros.evaluation.map_view import EDGED, draw_map

_DPI = 140
_TRUTH = '#222222'
_MARGIN_M = 0.45
_HEADING_M = 0.28


def draw_top_view(judged: Sequence[Judged], landmark_map: LandmarkMap,
                  path_xyz: NDArray[np.float64], path: Path) -> None:
    """Draw map, walk, and a line from each estimate to its ground truth.

    Parameters
    ----------
    judged : sequence of Judged
        The wake-ups.
    landmark_map : LandmarkMap
    path_xyz : ndarray (t, 3)
        Path of the camera [m].
    path : Path
        The PNG to write.
    """
    points = np.concatenate([landmark_map.centers[:, :2], path_xyz[:, :2]])
    low, high = points.min(axis=0) - _MARGIN_M, points.max(axis=0) + _MARGIN_M
    width, height = high - low
    scale = min(11.0 / width, 9.0 / height)
    figure = Figure(figsize=(width * scale + 3.2, height * scale + 0.9), dpi=_DPI,
                    layout=ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.08))
    axes = figure.add_subplot()
    frame = landmark_map.frame_id
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect='equal',
             xlabel=f'x in {frame} [m]', ylabel=f'y in {frame} [m]')
    axes.grid(color='#EEEEEE', zorder=0)
    axes.set_axisbelow(True)
    class_colors = draw_map(axes, landmark_map)
    axes.plot(path_xyz[:, 0], path_xyz[:, 1], color='#999999', linewidth=1.0, zorder=2)
    for one in judged:
        _draw_wake_up(axes, one)
    figure.legend(handles=_legend(class_colors), loc='outside right upper', frameon=False,
                  fontsize=9)
    figure.savefig(path)


def _draw_wake_up(axes: Axes, judged: Judged) -> None:
    """Draw truth and estimate as arrows along the view, with a line between them."""
    color = ACCEPTED if judged.wake_up.accepted else REFUSED
    seen_from = judged.pose if judged.truth is None else judged.truth
    if seen_from is not None:
        _number(axes, seen_from, judged.number, color)
    if judged.truth is not None:
        _draw_camera(axes, judged.truth, _TRUTH, 'o', hollow=True)
    if judged.pose is None:
        return
    if judged.wake_up.accepted or judged.truth is None:
        _draw_camera(axes, judged.pose, color, 'o' if judged.wake_up.accepted else 'X')
    else:
        # Not published, so drawn smaller.
        axes.plot(*judged.pose[:2, 3], marker='X', markersize=6, color=color, zorder=7,
                  linestyle='none')
    if judged.truth is not None:
        ends = np.stack([judged.truth[:2, 3], judged.pose[:2, 3]])
        axes.plot(ends[:, 0], ends[:, 1], color=color, zorder=6,
                  linewidth=1.6 if judged.wake_up.accepted else 0.8,
                  alpha=1.0 if judged.wake_up.accepted else 0.6,
                  linestyle='-' if judged.wake_up.accepted else (0, (4, 3)))


def _draw_camera(axes: Axes, map_from_camera: NDArray[np.float64], color: str, marker: str,
                 hollow: bool = False) -> None:
    x, y = map_from_camera[:2, 3]
    dx, dy = map_from_camera[:2, 2] * _HEADING_M  # along the optical axis
    axes.plot([x, x + dx], [y, y + dy], color=color, linewidth=1.4, zorder=5)
    axes.plot(x, y, marker=marker, markersize=9 if hollow else 5.5, color=color, zorder=7,
              linestyle='none', markerfacecolor='none' if hollow else color)


def _number(axes: Axes, map_from_camera: NDArray[np.float64], number: int, color: str) -> None:
    """Write the wake-up's number behind the camera, to its left."""
    x, y = map_from_camera[:2, 3] - 0.11 * (map_from_camera[:2, 2] + map_from_camera[:2, 0])
    axes.text(x, y, str(number), fontsize=10, fontweight='bold', color=color, ha='center',
              va='center', zorder=8, path_effects=EDGED)


def _legend(class_colors: dict[str, tuple[float, ...]]) -> list[Line2D | Patch]:
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=_TRUTH, marker='o', markersize=9, markerfacecolor='none',
               label='ground truth and view'),
        Line2D([], [], color=ACCEPTED, marker='o', markersize=5.5,
               label='accepted estimate,\njoined to its truth'),
        Line2D([], [], color=REFUSED, marker='X', linestyle=(0, (4, 3)),
               label='refused: best hypothesis,\nnot published'),
        Line2D([], [], color='#999999', linewidth=1.0, label='the walk'),
    ]
    return handles + [Patch(facecolor=color, edgecolor='#333333', alpha=0.55, label=name)
                      for name, color in class_colors.items()]
