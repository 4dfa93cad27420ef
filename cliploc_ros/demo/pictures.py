# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Draw the demo's picture of a wake-up: the camera image, and its matches."""

import textwrap
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon, Rectangle
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from cliploc_ros.core.geometry.ellipsoid import outline_points, project_ellipsoids
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.demo.review import ACCEPTED, REFUSED, Judged, Review, verdict
from cliploc_ros.evaluation.figures import EDGED, draw_map

_DPI = 110
_BOX, _UNMATCHED, _ELLIPSE, _EXPECTED = '#56B4E9', '#FFFFFF', '#E69F00', '#F0E442'
_EDGED = (withStroke(linewidth=2.6, foreground='black', alpha=0.6),)
# Left edge of each column in the panel beside the image, 0 to 1.
_COLUMNS = {'box': 0.0, 'landmark': 0.065, 'CLIP': 0.73, 'rank': 0.815, 'IoU': 0.89, '': 0.965}
_LABEL_CHARS = 54
_LINE_CHARS = 88
_MOST_ROWS = 34
_TOP_VIEW_DPI = 140
_TRUTH = '#222222'
_MARGIN_M = 0.45
_HEADING_M = 0.28


def draw_wake_up(review: Review, landmark_map: LandmarkMap, path: Path) -> None:
    """Draw the camera image with boxes and projected landmarks, and list the matches beside it.

    Parameters
    ----------
    path : Path
        The PNG to write.
    """
    figure = Figure(figsize=(14.0, 6.9), dpi=_DPI)
    judged = review.judged
    color = ACCEPTED if judged.wake_up.accepted else REFUSED
    figure.text(0.008, 0.945, f'Wake-up {judged.number}: {verdict(judged)}', color=color,
                fontsize=15, fontweight='bold')
    wake_up = judged.wake_up
    figure.text(0.992, 0.945, f'score {wake_up.score:.2f}, {wake_up.inliers} inliers',
                fontsize=11, ha='right')
    image_axes = figure.add_axes((0.008, 0.075, 0.552, 0.84))
    _draw_image(image_axes, review, landmark_map)
    _draw_legend(figure)
    panel = figure.add_axes((0.572, 0.03, 0.42, 0.885))
    panel.set_axis_off()
    panel.set(xlim=(0, 1), ylim=(_MOST_ROWS, -1))
    _list_matches(panel, review, landmark_map)
    figure.savefig(path)


def _draw_image(axes: Axes, review: Review, landmark_map: LandmarkMap) -> None:
    height, width = review.image_rgb.shape[:2]
    axes.imshow(review.image_rgb, interpolation='bilinear')
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xticks=[], yticks=[])
    if review.judged.pose is not None and review.repeated:
        _draw_landmarks(axes, review, landmark_map, review.judged.pose)
    matched = {match.detection for match in review.matches}
    for row, number in _reading_order(review).items():
        left, top, right, bottom = review.detections.bboxes_xyxy[row]
        color = _BOX if row in matched else _UNMATCHED
        axes.add_patch(Rectangle(
            (left, top), right - left, bottom - top, fill=False, edgecolor=color, linewidth=1.3,
            linestyle='-' if row in matched else (0, (3, 2)), path_effects=_EDGED))
        axes.text(max(left, 2) + 1, max(top, 2) + 1, str(number), fontsize=7.5, color='black',
                  ha='left', va='top', clip_on=True,
                  bbox={'boxstyle': 'square,pad=0.12', 'facecolor': color, 'edgecolor': 'none'})


def _draw_landmarks(axes: Axes, review: Review, landmark_map: LandmarkMap,
                    map_from_camera: NDArray[np.float64]) -> None:
    """Draw the outlines of all landmarks as seen from the pose; emphasize matched ones."""
    matched = {match.landmark for match in review.matches}
    outlines = project_ellipsoids(invert_transform(map_from_camera), landmark_map.centers,
                                  landmark_map.shapes)
    for landmark, outline in enumerate(outlines):
        if not np.isfinite(outline).all():
            continue
        points = review.camera.project_normalized(outline_points(outline))
        own = landmark in matched
        axes.add_patch(Polygon(
            points, closed=True, fill=False, edgecolor=_ELLIPSE if own else _EXPECTED,
            linewidth=1.8 if own else 0.9, linestyle='-' if own else ':',
            path_effects=_EDGED if own else None))


def _draw_legend(figure: Figure) -> None:
    lines = [
        Line2D([], [], color=_BOX, linewidth=2, label='box with its landmark'),
        Line2D([], [], color='#888888', linewidth=2, linestyle='--', label='box without one'),
        Line2D([], [], color=_ELLIPSE, linewidth=2, label='matched landmark, projected'),
        Line2D([], [], color='#B8A800', linewidth=1.5, linestyle=':',
               label='any other landmark of the map')]
    figure.legend(handles=lines, loc='lower left', bbox_to_anchor=(0.0, 0.0), ncol=4,
                  frameon=False, fontsize=9)


def _reading_order(review: Review) -> dict[int, int]:
    """Return a number for the row of each detection, from left to right."""
    order = np.argsort(review.detections.bboxes_xyxy[:, [0, 2]].sum(axis=1), kind='stable')
    return {int(row): number for number, row in enumerate(order, start=1)}


def _list_matches(panel: Axes, review: Review, landmark_map: LandmarkMap) -> None:
    line = _list_reason(panel, review, -0.5)
    if not review.repeated:
        panel.text(0, line, 'The repeated search for this picture found another pose: '
                            'its matches are not shown.', fontsize=9, va='top')
        return
    for name, x in _COLUMNS.items():
        if review.similarities is not None or name not in ('CLIP', 'rank'):
            panel.text(x, line, name, fontsize=8.5, fontweight='bold', va='top')
    line += 1.1
    numbers = _reading_order(review)
    for match in sorted(review.matches, key=lambda match: numbers[match.detection]):
        # Label, similarity and its rank as text, and whether the match is true.
        landmark = match.landmark
        similarity = rank = ''
        if review.similarities is not None:
            row = review.similarities[match.detection]
            similarity, rank = f'{row[landmark]:.2f}', str(1 + int((row > row[landmark]).sum()))
        is_true = None if review.true_landmarks is None else (
            review.true_landmarks[match.detection] == landmark_map.landmark_ids[landmark])
        cells = landmark_map.labels[landmark], similarity, rank, is_true
        _write_row(panel, line, [str(numbers[match.detection]), *cells[:3], f'{match.iou:.2f}'],
                   cells[3])
        line += 1
    _list_rest(panel, review, numbers, line + 0.4)


def _list_reason(panel: Axes, review: Review, line: float) -> float:
    """Write why the pose was refused; return the next free line."""
    if review.judged.wake_up.accepted:
        return line
    lines = textwrap.wrap('Refused: ' + review.judged.wake_up.reason, _LINE_CHARS)
    if review.judged.pose is not None:
        lines.append('Matches of the best hypothesis, which was not published:')
    for text in lines:
        panel.text(0, line, text, fontsize=9, va='top', color=REFUSED)
        line += 1
    return line + 0.3


def _write_row(panel: Axes, line: float, cells: list[str], is_true: bool | None) -> None:
    cells[1] = textwrap.shorten(cells[1], _LABEL_CHARS, placeholder='…')
    for x, cell in zip(_COLUMNS.values(), cells, strict=False):
        panel.text(x, line, cell, fontsize=8.5, va='top')
    if is_true is not None:
        panel.text(_COLUMNS[''], line, '✓' if is_true else '✗', fontsize=9, va='top',
                   color=ACCEPTED if is_true else REFUSED, fontweight='bold')


def _list_rest(panel: Axes, review: Review, numbers: dict[int, int], line: float) -> None:
    """List the boxes without a landmark in as few lines as possible."""
    matched = {match.detection for match in review.matches}
    rest = [f'{number} {review.detections.class_ids[row]}' for row, number in numbers.items()
            if row not in matched]
    if rest:
        text = 'Without a landmark: ' + ', '.join(rest)
        panel.text(0, line, textwrap.fill(text, _LINE_CHARS), fontsize=8.5, va='top',
                   color='#555555')


def draw_top_view(judged: Sequence[Judged], landmark_map: LandmarkMap,
                  path_xyz: NDArray[np.float64], path: Path) -> None:
    """Draw map, walk, and a line from each estimate to its ground truth.

    Parameters
    ----------
    judged : sequence of Judged
        The wake-ups.
    path_xyz : ndarray (t, 3)
        Path of the camera [m].
    path : Path
        The PNG to write.
    """
    points = np.concatenate([landmark_map.centers[:, :2], path_xyz[:, :2]])
    low, high = points.min(axis=0) - _MARGIN_M, points.max(axis=0) + _MARGIN_M
    width, height = high - low
    scale = min(11.0 / width, 9.0 / height)
    figure = Figure(figsize=(width * scale + 3.2, height * scale + 0.9), dpi=_TOP_VIEW_DPI,
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
