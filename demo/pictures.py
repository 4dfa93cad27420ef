# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Draw the demo's picture of a wake-up: the camera image, and its matches."""

import textwrap
from collections.abc import Sequence, Set
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon, Rectangle
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.ellipsoid import outline_points, project_ellipsoids
from cliploc_ros.core.geometry.transforms import invert_transform, pose_error
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Detections
from cliploc_ros.files.storage import write_file
from cliploc_ros.offline.evaluation.figures import draw_map, spread_names, write_name
from cliploc_ros.offline.page import ACCEPTED, BAD
from demo.review import Judged, Review

_DPI = 110
_BOX, _UNMATCHED, _ELLIPSE, _EXPECTED = '#56B4E9', '#FFFFFF', '#E69F00', '#F0E442'
_EDGED = (withStroke(linewidth=2.6, foreground='black', alpha=0.6),)
# Left edge of each column in the panel beside the image, 0 to 1.
_COLUMNS = {'box': 0.0, 'landmark': 0.065, 'CLIP': 0.73, 'rank': 0.815, 'IoU': 0.89, '': 0.965}
_LABEL_CHARS = 54
_LINE_CHARS = 88
_MOST_ROWS = 34
_TOP_VIEW_DPI = 160
_TRUTH = '#222222'
_MARGIN_M = 0.45
_HEADING_M = 0.28
# Colours of the watch's states.
_STATES = {'localized': '#CDE8D8', 'uncertain': '#F5ECC8', 'lost': '#F3CFC3'}


def draw_wake_up(review: Review, landmark_map: LandmarkMap, path: Path) -> None:
    """Draw the camera image with boxes and projected landmarks, and list the matches beside it."""
    figure = Figure(figsize=(14.0, 11.3 if review.beside else 6.9), dpi=_DPI)
    judged, wake_up, top = review.judged, review.judged.wake_up, 0.965 if review.beside else 0.945
    figure.text(0.008, top, f'Wake-up {judged.number}: {judged.verdict}', fontsize=15,
                color=ACCEPTED if wake_up.accepted else BAD, fontweight='bold')
    figure.text(0.992, top, f'score {wake_up.score:.2f}, {wake_up.landmarks} landmarks',
                fontsize=11, ha='right')
    numbers = _numbers(review)
    if review.beside:
        views = {review.camera_name: review, **review.beside}
        for place, (name, view) in enumerate(views.items()):
            axes = figure.add_axes((0.008 + 0.496 * (place % 2), 0.48 - 0.45 * (place // 2),
                                    0.488, 0.425))
            _draw_image(axes, view, landmark_map, _numbers(view), is_numbered=False)
            axes.set_title(name, loc='left', fontsize=10, pad=3)
    else:
        _draw_image(figure.add_axes((0.008, 0.075, 0.552, 0.84)), review, landmark_map, numbers)
    figure.legend(loc='lower left', bbox_to_anchor=(0.0, 0.0), ncol=4, frameon=False, fontsize=9,
                  handles=[
        Line2D([], [], color=_BOX, linewidth=2, label='box matched to a landmark'),
        Line2D([], [], color='#888888', linewidth=2, linestyle='--', label='unmatched box'),
        Line2D([], [], color=_ELLIPSE, linewidth=2, label='matched landmark, projected'),
        Line2D([], [], color='#B8A800', linewidth=1.5, linestyle=':',
               label='other landmark of the map')])
    if review.beside:
        write_file(path, figure.savefig)
        return
    panel = figure.add_axes((0.572, 0.03, 0.42, 0.885))
    panel.set_axis_off()
    panel.set(xlim=(0, 1), ylim=(_MOST_ROWS, -1))
    _list_matches(panel, review, landmark_map, numbers)
    write_file(path, figure.savefig)


def _numbers(review: Review) -> dict[int, int]:
    """Return a number for the row of each detection, from left to right."""
    order = np.argsort(review.detections.bboxes_xyxy[:, [0, 2]].sum(axis=1), kind='stable')
    return {int(row): number for number, row in enumerate(order, start=1)}


def _draw_image(axes: Axes, review: Review, landmark_map: LandmarkMap, numbers: dict[int, int],
                is_numbered: bool = True) -> None:
    height, width = review.image_rgb.shape[:2]
    axes.imshow(review.image_rgb, interpolation='bilinear')
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xticks=[], yticks=[])
    pose = review.judged.pose
    if pose is not None and review.repeated:
        _draw_outlines(axes, review.camera, landmark_map, pose,
                       {match.landmark for match in review.matches})
    matched = {match.detection for match in review.matches}
    for row, number in numbers.items():
        left, top, right, bottom = review.detections.bboxes_xyxy[row]
        color = _BOX if row in matched else _UNMATCHED
        axes.add_patch(Rectangle(
            (left, top), right - left, bottom - top, fill=False, edgecolor=color, linewidth=1.3,
            linestyle='-' if row in matched else (0, (3, 2)), path_effects=_EDGED))
        if not is_numbered:  # no list refers to the boxes
            continue
        axes.text(max(left, 2) + 1, max(top, 2) + 1, str(number), fontsize=7.5, color='black',
                  ha='left', va='top', clip_on=True,
                  bbox={'boxstyle': 'square,pad=0.12', 'facecolor': color, 'edgecolor': 'none'})


def _draw_outlines(axes: Axes, camera: Camera, landmark_map: LandmarkMap,
                   pose: NDArray[np.float64], matched: Set[int], width: float = 0.9,
                   is_edged: bool = False) -> None:
    """Draw the outlines of all landmarks as seen from a pose.

    Matched landmarks are bold. The others are dotted, with a given line width and optionally a
    dark edge.
    """
    for landmark, outline in enumerate(project_ellipsoids(
            invert_transform(pose), landmark_map.centers, landmark_map.shapes)):
        if np.isfinite(outline).all():
            own = landmark in matched
            axes.add_patch(Polygon(
                camera.project_normalized(outline_points(outline)), closed=True, fill=False,
                edgecolor=_ELLIPSE if own else _EXPECTED, linewidth=1.8 if own else width,
                linestyle='-' if own else ':', path_effects=_EDGED if own or is_edged else None))


def _list_matches(panel: Axes, review: Review, landmark_map: LandmarkMap, numbers: dict[int, int]
                  ) -> None:
    """List why the pose was refused, the matches, and the boxes without a landmark."""
    line, judged = -0.5, review.judged
    if not judged.wake_up.accepted:
        lines = textwrap.wrap('Refused: ' + judged.wake_up.reason, _LINE_CHARS)
        if judged.pose is not None:
            lines.append('Matches of the best hypothesis, which was not published:')
        for text in lines:
            panel.text(0, line, text, fontsize=9, va='top', color=BAD)
            line += 1
        line += 0.3
    if not review.repeated:
        panel.text(0, line, 'The search repeated for this picture found another pose. '
                            'Its matches are not shown.', fontsize=9, va='top')
        return
    for name, x in _COLUMNS.items():
        if review.similarities is not None or name not in ('CLIP', 'rank'):
            panel.text(x, line, name, fontsize=8.5, fontweight='bold', va='top')
    line += 1.1
    for match in sorted(review.matches, key=lambda match: numbers[match.detection]):
        similarity = rank = ''
        if review.similarities is not None:
            row = review.similarities[match.detection]
            similarity = f'{row[match.landmark]:.2f}'
            rank = str(1 + int((row > row[match.landmark]).sum()))
        label = textwrap.shorten(landmark_map.labels[match.landmark], _LABEL_CHARS,
                                 placeholder='…')
        cells = (str(numbers[match.detection]), label, similarity, rank, f'{match.iou:.2f}')
        for x, cell in zip(_COLUMNS.values(), cells, strict=False):
            panel.text(x, line, cell, fontsize=8.5, va='top')
        if review.true_landmarks is not None:
            is_true = (review.true_landmarks[match.detection]
                       == landmark_map.landmark_ids[match.landmark])
            panel.text(_COLUMNS[''], line, '✓' if is_true else '✗', fontsize=9, va='top',
                       color=ACCEPTED if is_true else BAD, fontweight='bold')
        line += 1
    matched = {match.detection for match in review.matches}
    rest = [f'{number} {review.detections.class_ids[row]}' for row, number in numbers.items()
            if row not in matched]
    if rest:
        text = textwrap.fill('Unmatched boxes: ' + ', '.join(rest), _LINE_CHARS)
        panel.text(0, line + 0.4, text, fontsize=8.5, va='top', color='#555555')


def draw_top_view(judged: Sequence[Judged], landmark_map: LandmarkMap,
                  path_xyz: NDArray[np.float64], path: Path) -> None:
    """Draw map, the camera's walk (t, 3) [m], and a line from each estimate to the truth.

    A refused hypothesis outside the map is not drawn, but its number is red.
    """
    points = np.concatenate([landmark_map.centers[:, :2], path_xyz[:, :2]])
    low, high = points.min(axis=0) - _MARGIN_M, points.max(axis=0) + _MARGIN_M
    width, height = high - low
    scale = min(5.5 / width, 4.8 / height)
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
    for wake_up in judged:
        pose = wake_up.pose
        if pose is not None and not ((low <= pose[:2, 3]) & (pose[:2, 3] <= high)).all():
            pose = None
        _draw_wake_up(axes, wake_up, pose)
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=_TRUTH, marker='o', markersize=9, markerfacecolor='none',
               label='true pose and view'),
        Line2D([], [], color=ACCEPTED, marker='o', markersize=5.5,
               label='accepted estimate,\njoined to the true pose'),
        Line2D([], [], color=BAD, marker='X', linestyle=(0, (4, 3)),
               label='refused: best hypothesis,\nnot published'),
        Line2D([], [], color='#999999', linewidth=1.0, label='path of the camera')]
    handles += [Patch(facecolor=color, edgecolor='#333333', alpha=0.55, label=name)
                for name, color in class_colors.items()]
    figure.legend(handles=handles, loc='outside right upper', frameon=False, fontsize=9)
    spread_names(figure)
    write_file(path, figure.savefig)


def _draw_wake_up(axes: Axes, judged: Judged, pose: NDArray[np.float64] | None) -> None:
    """Draw true and estimated pose as arrows in the viewing direction, joined by a line."""
    accepted, truth = judged.wake_up.accepted, judged.truth
    color = ACCEPTED if accepted else BAD
    seen_from = pose if truth is None else truth
    if seen_from is not None:
        # the number lies behind the camera, to its left
        x, y = seen_from[:2, 3] - 0.11 * (seen_from[:2, 2] + seen_from[:2, 0])
        write_name(axes, (x, y), str(judged.number), 11, color)
    if truth is not None:
        _draw_camera(axes, truth, _TRUTH, 'o', hollow=True)
    if pose is None:
        return
    if accepted or truth is None:
        _draw_camera(axes, pose, color, 'o' if accepted else 'X')
    else:
        # Not published, so drawn smaller.
        axes.plot(*pose[:2, 3], marker='X', markersize=6, color=color, zorder=7, linestyle='none')
    if truth is not None:
        axes.plot(*zip(truth[:2, 3], pose[:2, 3], strict=True), color=color, zorder=6,
                  linewidth=1.6 if accepted else 0.8, alpha=1.0 if accepted else 0.6,
                  linestyle='-' if accepted else (0, (4, 3)))


def _draw_camera(axes: Axes, map_from_camera: NDArray[np.float64], color: str, marker: str,
                 hollow: bool = False) -> None:
    x, y = map_from_camera[:2, 3]
    dx, dy = map_from_camera[:2, 2] * _HEADING_M  # along the optical axis
    axes.plot([x, x + dx], [y, y + dy], color=color, linewidth=1.4, zorder=5)
    axes.plot(x, y, marker=marker, markersize=9 if hollow else 5.5, color=color, zorder=7,
              linestyle='none', markerfacecolor='none' if hollow else color)


@dataclass(frozen=True)
class Moment:
    """The robot's pose at a time, the pose of its localizer, and the state of the watch."""

    time_s: float  #: [s]
    truth: NDArray[np.float64]  #: (4, 4): map_from_camera
    localized: NDArray[np.float64]  #: (4, 4): map_from_camera of the localizer
    state: str


@dataclass(frozen=True)
class Step:
    """An event, its time [s], and the number of looks before it."""

    time_s: float
    looks: int
    text: str


def draw_kidnapped(file: Path, camera: Camera, detections: Detections, landmark_map: LandmarkMap,
                   moments: Sequence[Moment], steps: Sequence[Step], path: Path) -> None:
    """Draw a kidnapped robot: the last view before the watch reported it lost, paths, and error.

    The boxes are detections in that view. The outlines are the landmarks, projected with the
    localizer's pose at that time.
    """
    figure = Figure(figsize=(14.0, 9.0), dpi=_DPI, layout='constrained')
    (view, top), (timeline, _) = figure.subplots(2, 2, height_ratios=(3, 2))
    grid = timeline.get_subplotspec().get_gridspec()
    for axes in figure.axes[2:]:
        axes.remove()
    timeline = figure.add_subplot(grid[1, :])
    lost = next(row for row, moment in enumerate(moments) if moment.state == 'lost')
    _draw_expected(view, file, camera, detections, landmark_map, moments[lost].localized)
    _draw_ways(top, landmark_map, moments)
    times = np.array([moment.time_s for moment in moments])
    errors = [pose_error(moment.localized, moment.truth)[0] for moment in moments]
    for moment, end in zip(moments, times[1:], strict=False):
        timeline.axvspan(moment.time_s, end, color=_STATES.get(moment.state, '#FFFFFF'),
                         linewidth=0)
    timeline.plot(times, errors, color=_TRUTH, linewidth=2.0)
    for number, step in enumerate(steps):
        timeline.axvline(step.time_s, color='#666666', linewidth=0.8, linestyle=':')
        timeline.text(step.time_s + 0.1, 4.8 - 0.25 * number, step.text, fontsize=8)
    timeline.set(xlabel='time [s]', ylabel="localizer's error [m]", ylim=(0.0, 5.1),
                 xlim=(0.0, times[-1] + 2.0))
    timeline.legend(handles=[Patch(color=color, label=state) for state, color in _STATES.items()],
                    loc='lower left', fontsize=9)
    spread_names(figure)
    write_file(path, figure.savefig)


def _draw_expected(axes: Axes, file: Path, camera: Camera, detections: Detections,
                   landmark_map: LandmarkMap, pose: NDArray[np.float64]) -> None:
    axes.imshow(cv2.cvtColor(cv2.imread(str(file)), cv2.COLOR_BGR2RGB))
    axes.set(xlim=(0, camera.width), ylim=(camera.height, 0), xticks=[], yticks=[])
    axes.set_title("detections (boxes) and landmarks projected from the localizer's pose (dotted)",
                   fontsize=10)
    for left, top, right, bottom in detections.bboxes_xyxy:
        axes.add_patch(Rectangle((left, top), right - left, bottom - top, fill=False,
                                 edgecolor=_BOX, linewidth=1.5, path_effects=_EDGED))
    _draw_outlines(axes, camera, landmark_map, pose, frozenset(), width=1.5, is_edged=True)


def _draw_ways(axes: Axes, landmark_map: LandmarkMap, moments: Sequence[Moment]) -> None:
    """Draw the path of the robot, and the path of its localizer's poses."""
    draw_map(axes, landmark_map)
    for name, color, style in (('truth', _TRUTH, '-'), ('localized', BAD, '--')):
        way = np.array([getattr(moment, name)[:2, 3] for moment in moments])
        jumps = np.nonzero(np.linalg.norm(np.diff(way, axis=0), axis=1) > 1.0)[0] + 1
        for number, part in enumerate(np.split(way, jumps)):
            axes.plot(*part.T, color=color, linestyle=style, linewidth=2.0,
                      label=None if number else
                      {'truth': 'true path', 'localized': 'path of the localizer'}[name])
        for row in jumps:
            axes.annotate('', way[row], way[row - 1], arrowprops={
                'arrowstyle': '->', 'color': color, 'linestyle': ':'})
    axes.set(aspect='equal', xlabel='x [m]', ylabel='y [m]')
    axes.legend(fontsize=9, loc='upper right')
