# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Draw the pictures of a check: the map from above with landmarks, grid and recorded frames."""

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize, to_rgba
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch, Polygon, Rectangle

from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.offline import page as html
from cliploc_ros.offline.evaluation.figures import EDGED, draw_outline, png_of, write_name
from cliploc_ros.offline.evaluation.map_check import page
from cliploc_ros.offline.mapping.check.places import RADIUS_M
from cliploc_ros.offline.mapping.check.relocalization import Trial, count_verdicts, refused_spans
from cliploc_ros.offline.mapping.check.report import CheckReport

_DPI = 120
_MARGIN_M = 0.4
_LARGEST_IN = 6.4
INK = '#222222'
_HEAT = LinearSegmentedColormap.from_list('accepted', ['#FBE9C6', '#56B4E9', '#003E6B'])
_UNSEEN = '#DDDDDD'
_MOST_NAMES = 30
_MOST_LOOK_ALIKES = 6


def draw_pictures(landmark_map: LandmarkMap, report: CheckReport
                  ) -> Iterator[tuple[str, str, bytes]]:
    """Yield the name, the caption and the PNG of each picture."""
    canvas = _Canvas(landmark_map, report)
    yield ('grid', 'Expected relocalization, top view. A cell is a camera position. Its shade '
           'shows the share of headings with a correct, accepted pose, among the headings with '
           'three or more detectable landmarks. Ticks show the headings at which a wrong pose '
           'was accepted. Positions inside landmarks and beyond all objects are omitted. '
           'Numbers refer to the advice.', png_of(_grid_figure(canvas), _DPI))
    if report.recording is not None and report.recording.trials:
        yield ('frames', 'Recorded frames, each relocalized in a map that was fitted without '
               'the frames of that time. The dot is the camera, the wedge its heading. Times '
               'mark the longest sequences of refused frames.',
               png_of(_frames_figure(canvas, report.recording.trials), _DPI))
        yield ('time', 'The same frames over time: the number of mapped landmarks that were '
               'detected, and the verdict.', png_of(_time_figure(report.recording.trials), _DPI))
    yield ('landmarks', 'Top view of the landmarks. Landmarks with a fault are named. If there '
           'are many, only landmarks with a serious fault.',
           png_of(_landmarks_figure(canvas), _DPI))
    if report.look_alikes:
        yield ('look_alikes', 'Places that look alike, joined in pairs.',
               png_of(_look_alikes_figure(canvas), _DPI))


class _Canvas:
    """Makes figures of the map from above, which have the same bounds."""

    def __init__(self, landmark_map: LandmarkMap, report: CheckReport):
        self.map, self.report = landmark_map, report
        grid, half = report.grid.positions[:, :2], report.grid.spacing_m / 2
        self.path = None if report.recording is None else report.recording.path_xyz[:, :2]
        #: (P,): the grid positions to draw. Beyond the objects and the path there may be walls.
        self.shown = np.ones(len(grid), dtype=np.bool_)
        points = [landmark_map.centers[:, :2]]
        if self.path is not None:
            points.append(self.path)
            hull = cv2.convexHull(np.concatenate(points).astype(np.float32))
            self.shown = report.grid.is_near | np.array([
                cv2.pointPolygonTest(hull, position, False) > 0 for position in grid.tolist()])
        every = np.concatenate([*points, grid[self.shown] - half, grid[self.shown] + half])
        self._low = every.min(axis=0) - _MARGIN_M
        self._high = every.max(axis=0) + _MARGIN_M
        #: The longer side [m]
        self.size = float((self._high - self._low).max())

    def figure(self, title: str, face: str | Sequence[str], alpha: float = 0.35
               ) -> tuple[Figure, Axes]:
        """Return a figure with the landmarks, equal scales, and room for a legend below."""
        width, height = (self._high - self._low) * _LARGEST_IN / self.size
        figure = Figure(figsize=(max(6.5, width + 1.6), max(4.0, height + 1.6)),
                        layout=ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.1))
        axes = figure.add_subplot()
        axes.set(xlim=(self._low[0], self._high[0]), ylim=(self._low[1], self._high[1]),
                 aspect='equal')
        # a frame_id may be text that mathtext refuses
        axes.set_xlabel(f'x in {self.map.frame_id} [m]', parse_math=False)
        axes.set_ylabel(f'y in {self.map.frame_id} [m]', parse_math=False)
        axes.set_title(title, fontsize=12)
        axes.set_axisbelow(True)
        faces = [face] * len(self.map) if isinstance(face, str) else face
        for center, shape, color in zip(self.map.centers, self.map.shapes, faces, strict=True):
            draw_outline(axes, center, shape, facecolor=color, edgecolor='#444444', linewidth=0.7,
                         alpha=alpha, zorder=3, path_effects=EDGED if color == 'none' else None)
        return figure, axes


def _add_legend(figure: Figure, handles: Sequence[Line2D | Patch]) -> None:
    figure.legend(handles=list(handles), loc='outside lower center', ncols=min(3, len(handles)),
                  frameon=False, fontsize=9)


def _grid_figure(canvas: _Canvas) -> Figure:
    grid = canvas.report.grid
    height = grid.positions[0, 2] if len(grid.positions) else 0.0
    figure, axes = canvas.figure(f'Expected accepted poses, camera {height:.2f} m high', 'none',
                                 alpha=0.9)
    shown = canvas.shown
    side, inset = grid.spacing_m, 0.06 * grid.spacing_m
    for position, near, accepted, useful in zip(
            grid.positions[shown], grid.is_near[shown], grid.accepted[shown],
            grid.useful[shown], strict=True):
        x, y = position[:2] - side / 2
        is_dark = useful == 0 and accepted == 0
        axes.add_patch(Rectangle(
            (x, y), side, side, linewidth=0.0, zorder=1,
            facecolor=_UNSEEN if is_dark else _HEAT(min(1.0, accepted / max(1, useful)))))
        if near and canvas.path is not None:
            axes.add_patch(Rectangle((x + inset, y + inset), side - 2 * inset, side - 2 * inset,
                                     fill=False, edgecolor='#555555', linewidth=0.6, zorder=2))
    handles: list[Line2D | Patch] = [
        Line2D([], [], color='#444444', marker='o', markerfacecolor='none', linestyle='none',
               label='landmark'),
        Patch(facecolor=_UNSEEN, label='fewer than 3 landmarks in view')]
    if canvas.path is not None:
        axes.plot(*canvas.path.T, color=INK, linewidth=1.0, zorder=4, linestyle=(0, (4, 2)),
                  path_effects=EDGED)
        handles += [Line2D([], [], color=INK, linewidth=1.0, linestyle=(0, (4, 2)),
                           label='path of the recording'),
                    Patch(facecolor='white', edgecolor='#555555', label='near the recording')]
    wrong = [trial for trial in grid.trials if trial.verdict == 'misled']
    for trial in wrong:
        x, y = trial.position[:2]
        ahead = trial.forward[:2] / max(float(np.linalg.norm(trial.forward[:2])), 1e-9)
        dx, dy = 0.45 * side * ahead
        axes.plot([x, x + dx], [y, y + dy], color=html.MISLED, linewidth=2.5, zorder=7,
                  path_effects=EDGED)
        axes.plot(x, y, 'X', color=html.MISLED, markersize=9, markeredgecolor='white', zorder=8)
    handles.append(Line2D([], [], color=html.MISLED, marker='X', linewidth=2.5,
                          label=f'misled ({len(wrong)} of {len(grid.trials)} views)'))
    rows = {name: row for row, name in enumerate(canvas.map.landmark_ids)}
    for number, advice in enumerate(canvas.report.to_do[:page.FIRST_ADVICE], start=1):
        place = (canvas.map.centers[rows[advice.landmarks[0]]] if advice.landmarks
                 else None if advice.view is None else advice.view.position)
        if place is not None:
            axes.text(place[0], place[1], str(number), fontsize=10, fontweight='bold', zorder=10,
                      color='white', ha='center', va='center',
                      bbox={'boxstyle': 'circle,pad=0.25', 'facecolor': INK, 'edgecolor': 'white'})
    bar = figure.colorbar(ScalarMappable(Normalize(0, 100), _HEAT), ax=axes, shrink=0.7,
                          pad=0.02)
    bar.set_label('correct pose accepted\n[% of headings that show 3 landmarks]', fontsize=9)
    _add_legend(figure, handles)
    return figure


def _frames_figure(canvas: _Canvas, trials: Sequence[Trial]) -> Figure:
    figure, axes = canvas.figure('Recorded frames, cross-validated', '#BBBBBB')
    size = 0.035 * canvas.size
    for trial in trials:
        ahead, tip = trial.forward[:2], trial.position[:2]
        color, is_refused = page.VERDICT_COLORS[trial.verdict], trial.verdict == 'refused'
        side = np.array([-ahead[1], ahead[0]]) * 0.5
        axes.add_patch(Polygon(
            [tip, tip + size * (ahead + side), tip + size * (ahead - side)], closed=True,
            facecolor=to_rgba(color, 0.0 if is_refused else 0.3), edgecolor=color,
            linewidth=1.0, zorder=5))
        axes.plot(tip[0], tip[1], marker='s' if is_refused else 'o', color=color, markersize=4,
                  zorder=6)
        if trial.verdict == 'misled' and trial.estimate is not None:
            axes.plot([tip[0], trial.estimate[0]], [tip[1], trial.estimate[1]],
                      color=html.MISLED, linewidth=1.5, zorder=7)
    first = trials[0].stamp_s or 0.0
    for run in [run for run in refused_spans(trials) if len(run) > 1][:8]:
        middle = run[len(run) // 2]
        behind = middle.position[:2] - 1.2 * size * middle.forward[:2]
        write_name(axes, behind, f'{(middle.stamp_s or 0.0) - first:.0f} s')
    counts = count_verdicts(trials)
    _add_legend(figure, [
        *(Line2D([], [], color=color, label=f'{verdict} ({counts[verdict]})', markersize=5,
                 marker='s' if verdict == 'refused' else 'o')
          for verdict, color in page.VERDICT_COLORS.items()),
        Patch(facecolor='#BBBBBB', edgecolor='#444444', alpha=0.5, label='landmark')])
    return figure


def _time_figure(trials: Sequence[Trial]) -> Figure:
    figure = Figure(figsize=(9.0, 2.8), layout=ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.08))
    axes = figure.add_subplot()
    stamps = np.array([trial.stamp_s or 0.0 for trial in trials])
    stamps -= stamps[0]
    width = 0.8 * (float(np.median(np.diff(stamps))) if len(stamps) > 1 else 1.0)
    handles: list[Line2D | Patch] = []
    for verdict, color in page.VERDICT_COLORS.items():
        chosen = np.array([trial.verdict == verdict for trial in trials])
        counts = np.array([trial.landmarks for trial in trials])
        style: dict[str, Any] = {
            'edgecolor': color, 'linewidth': 1.0,
            'facecolor': 'white' if verdict == 'refused' else color,
            'hatch': '////' if verdict == 'refused' else None}
        axes.bar(stamps[chosen], counts[chosen], width=width, **style)
        # a separate patch, since missing bars give the legend no colour
        handles.append(Patch(label=f'{verdict} ({chosen.sum()})', **style))
        none = chosen & (counts == 0)
        axes.plot(stamps[none], np.zeros(none.sum()), 'x', color=color, clip_on=False, zorder=5)
    axes.set(xlabel='time from the first frame [s]', ylabel='detected landmarks')
    axes.legend(handles=handles, frameon=False, fontsize=9, ncols=3, loc='lower right',
                bbox_to_anchor=(1.0, 1.0))
    return figure


def _landmarks_figure(canvas: _Canvas) -> Figure:
    landmark_map, checks = canvas.map, canvas.report.landmarks
    grades = {check.landmark_id: page.grade(check) for check in checks}
    colors = [page.GRADE_COLORS[grades[name]] for name in landmark_map.landmark_ids]
    figure, axes = canvas.figure('Landmarks', colors, alpha=0.6)
    named = [check for check in checks if check.faults]
    if len(named) > _MOST_NAMES:
        named = [check for check in named if page.grade(check) == 'faulty'][:_MOST_NAMES]
    for check in named:
        write_name(axes, check.center[:2], check.landmark_id)
    if canvas.path is not None:
        axes.plot(*canvas.path.T, color=html.FAINT, linewidth=0.8, zorder=2)
    counts = Counter(grades.values())
    _add_legend(figure, [Patch(facecolor=color, edgecolor='#444444', alpha=0.6,
                               label=f'{page.GRADE_NAMES[name]} ({counts[name]})')
                         for name, color in page.GRADE_COLORS.items()])
    return figure


def _look_alikes_figure(canvas: _Canvas) -> Figure:
    figure, axes = canvas.figure('Places that look alike', '#BBBBBB')
    for number, pair in enumerate(canvas.report.look_alikes[:_MOST_LOOK_ALIKES], start=1):
        for letter, place in (('a', pair.first), ('b', pair.second)):
            axes.add_patch(Circle(place[:2], RADIUS_M, fill=False, edgecolor=page.LOOK_ALIKE,
                                  linewidth=1.8, zorder=5))
            axes.text(place[0], place[1] + 0.8 * RADIUS_M, f'{number}{letter}', fontsize=11,
                      fontweight='bold', color=INK, ha='center', va='center', zorder=9,
                      path_effects=EDGED, clip_on=True)
        axes.plot([pair.first[0], pair.second[0]], [pair.first[1], pair.second[1]],
                  color=page.LOOK_ALIKE, linewidth=1.2, linestyle=(0, (4, 2)), zorder=4)
    _add_legend(figure, [
        Line2D([], [], color=page.LOOK_ALIKE, marker='o', markersize=12, markerfacecolor='none',
               linestyle=(0, (4, 2)), label=f'pair of places, radius {RADIUS_M:g} m'),
        Patch(facecolor='#BBBBBB', edgecolor='#444444', alpha=0.5, label='landmark')])
    return figure


