# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The pictures of a check: the map from above with landmarks, grid and recorded frames."""

import io
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize, to_rgba
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch, Polygon, Rectangle
from numpy.typing import NDArray

from cliploc_ros.core.geometry.ellipsoid import outline_points
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.evaluation.figures import EDGED
from cliploc_ros.evaluation.map_check.page import (
    FAINT,
    GRADE_COLORS,
    GRADE_NAMES,
    INK,
    LOOK_ALIKE,
    MISLED,
    VERDICT_COLORS,
    grade,
)
from cliploc_ros.mapping.checking.places import RADIUS_M
from cliploc_ros.mapping.checking.relocalization import Trial, refused_spans
from cliploc_ros.mapping.checking.report import CheckReport, GridCheck

_DPI = 110
_MARGIN_M = 0.4
_LARGEST_IN = 9.0
_HEAT = LinearSegmentedColormap.from_list('accepted', ['#FBE9C6', '#56B4E9', '#003E6B'])
_UNSEEN = '#DDDDDD'
_MOST_NAMES = 30
# Width and height of a name in shares of the picture.
_NAME_ROOM = np.array([0.09, 0.035])
_MOST_LOOK_ALIKES = 6


def draw_pictures(landmark_map: LandmarkMap, report: CheckReport
                  ) -> Iterator[tuple[str, str, bytes]]:
    """Yield the name, the caption and the PNG of each picture."""
    # Low and high corner (2, 2) of what the pictures show [m].
    grid = report.grid.positions[:, :2]
    half = report.grid.spacing_m / 2
    points = [landmark_map.centers[:, :2], grid - half, grid + half]
    if report.recording is not None:
        points.append(report.recording.path_xyz[:, :2])
    every = np.concatenate(points)
    bounds = np.array([every.min(axis=0) - _MARGIN_M, every.max(axis=0) + _MARGIN_M])
    yield ('grid', 'Expected relocalization from above. A cell is a camera position: the darker, '
           'the more of the headings with at least three detectable landmarks give an accepted, '
           'right pose. Ticks point where the camera looked when a wrong pose was accepted. '
           'Positions inside of a landmark are left out.',
           _png(_grid_figure(landmark_map, report, bounds)))
    if report.recording is not None and report.recording.trials:
        yield ('frames', 'Recorded frames, each relocalized in a map that was fitted without '
               'frames of that time. The dot is the camera, the wedge where it looks. Times '
               'are those of the longest runs of refused frames.',
               _png(_frames_figure(landmark_map, report, bounds)))
        yield ('time', 'The same frames over time: how many landmarks of the map the detector '
               'found, and the verdict.', _png(_time_figure(report.recording.trials)))
    yield ('landmarks', 'The landmarks from above. Names are those of landmarks with a fault; '
           'where these are many, with a serious one.',
           _png(_landmarks_figure(landmark_map, report, bounds)))
    if report.look_alikes:
        yield ('look_alikes', 'Places that look alike, joined in pairs.',
               _png(_look_alikes_figure(landmark_map, report, bounds)))


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format='png', dpi=_DPI)
    return buffer.getvalue()


def _map_figure(landmark_map: LandmarkMap, bounds: NDArray[np.float64], title: str
                ) -> tuple[Figure, Axes]:
    """Return a figure with equal scales in x and y, and room for a legend below."""
    width, height = bounds[1] - bounds[0]
    scale = _LARGEST_IN / max(width, height)
    figure = Figure(figsize=(max(6.5, width * scale + 1.6), max(4.0, height * scale + 1.6)),
                    layout=ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.1))
    axes = figure.add_subplot()
    axes.set(xlim=bounds[:, 0], ylim=bounds[:, 1], aspect='equal')
    # a frame_id is any text, also one that mathtext refuses
    axes.set_xlabel(f'x in {landmark_map.frame_id} [m]', parse_math=False)
    axes.set_ylabel(f'y in {landmark_map.frame_id} [m]', parse_math=False)
    axes.set_title(title, fontsize=12)
    axes.set_axisbelow(True)
    return figure, axes


def _draw_outlines(axes: Axes, landmark_map: LandmarkMap, face: str | Sequence[str],
                   alpha: float = 0.35, edge: str = '#444444') -> None:
    """Draw each landmark as seen from above."""
    faces = [face] * len(landmark_map) if isinstance(face, str) else face
    for center, shape, color in zip(landmark_map.centers, landmark_map.shapes, faces,
                                    strict=True):
        outline = np.array([center[0], center[1], shape[0], shape[1], shape[3]])
        axes.add_patch(Polygon(outline_points(outline), closed=True, facecolor=color,
                               edgecolor=edge, linewidth=0.7, alpha=alpha, zorder=3,
                               path_effects=EDGED if color == 'none' else None))


def _name(axes: Axes, xy: NDArray[np.float64], text: str, color: str = INK) -> None:
    axes.text(xy[0], xy[1], text, fontsize=8, color=color, ha='center', va='center', zorder=9,
              path_effects=EDGED, parse_math=False, clip_on=True)


def _add_legend(figure: Figure, handles: Sequence[Line2D | Patch]) -> None:
    figure.legend(handles=list(handles), loc='outside lower center', ncols=min(4, len(handles)),
                  frameon=False, fontsize=9)


def _grid_figure(landmark_map: LandmarkMap, report: CheckReport, bounds: NDArray[np.float64]
                 ) -> Figure:
    grid = report.grid
    height = grid.positions[0, 2] if len(grid.positions) else 0.0
    figure, axes = _map_figure(landmark_map, bounds,
                               f'Expected relocalization, camera {height:.2f} m high')
    for position, near, accepted, useful in zip(grid.positions, grid.is_near, grid.accepted,
                                                grid.useful, strict=True):
        corner = position[:2] - grid.spacing_m / 2
        is_dark = useful == 0 and accepted == 0
        axes.add_patch(Rectangle(
            (corner[0], corner[1]), grid.spacing_m, grid.spacing_m, linewidth=0.0, zorder=1,
            facecolor=_UNSEEN if is_dark else _HEAT(min(1.0, accepted / max(1, useful)))))
        if near and report.recording is not None:
            inset = 0.06 * grid.spacing_m
            axes.add_patch(Rectangle(
                (corner[0] + inset, corner[1] + inset), grid.spacing_m - 2 * inset,
                grid.spacing_m - 2 * inset, fill=False, edgecolor='#555555', linewidth=0.6,
                zorder=2))
    _draw_outlines(axes, landmark_map, 'none', alpha=0.9)
    handles: list[Line2D | Patch] = [
        Line2D([], [], color='#444444', marker='o', markerfacecolor='none', linestyle='none',
               label='landmark'),
        Patch(facecolor=_UNSEEN, label='fewer than 3 landmarks in every view')]
    if report.recording is not None:
        path = report.recording.path_xyz
        axes.plot(path[:, 0], path[:, 1], color=INK, linewidth=1.0, zorder=4,
                  linestyle=(0, (4, 2)), path_effects=EDGED)
        handles += [Line2D([], [], color=INK, linewidth=1.0, linestyle=(0, (4, 2)),
                           label='path of the recording'),
                    Patch(facecolor='white', edgecolor='#555555', label='near the recording')]
    handles += _draw_misled(axes, grid)
    bar = figure.colorbar(ScalarMappable(Normalize(0, 100), _HEAT), ax=axes, shrink=0.7,
                          pad=0.02)
    bar.set_label('right pose accepted\n[% of headings that show 3 landmarks]', fontsize=9)
    _add_legend(figure, handles)
    return figure


def _draw_misled(axes: Axes, grid: GridCheck) -> list[Line2D | Patch]:
    wrong = [one for one in grid.trials if one.verdict == 'misled']
    for one in wrong:
        x, y = one.position[:2]
        ahead = one.forward[:2] / max(float(np.linalg.norm(one.forward[:2])), 1e-9)
        dx, dy = 0.45 * grid.spacing_m * ahead
        axes.plot([x, x + dx], [y, y + dy], color=MISLED, linewidth=2.5, zorder=7,
                  path_effects=EDGED)
        axes.plot(x, y, 'X', color=MISLED, markersize=9, markeredgecolor='white', zorder=8)
    return [Line2D([], [], color=MISLED, marker='X', linewidth=2.5,
                   label=f'misled ({len(wrong)} of {len(grid.trials)} views)')]


def _frames_figure(landmark_map: LandmarkMap, report: CheckReport, bounds: NDArray[np.float64]
                   ) -> Figure:
    assert report.recording is not None
    trials = report.recording.trials
    figure, axes = _map_figure(landmark_map, bounds, 'Recorded frames, cross-validated')
    _draw_outlines(axes, landmark_map, '#BBBBBB')
    size = 0.035 * float((bounds[1] - bounds[0]).max())
    for one in trials:
        _draw_frustum(axes, one, size)
        if one.verdict == 'misled' and one.estimate is not None:
            axes.plot([one.position[0], one.estimate[0]], [one.position[1], one.estimate[1]],
                      color=MISLED, linewidth=1.5, zorder=7)
    first = trials[0].stamp_s or 0.0
    for run in [run for run in refused_spans(trials) if len(run) > 1][:8]:
        middle = run[len(run) // 2]
        behind = middle.position[:2] - 1.2 * size * middle.forward[:2]
        _name(axes, behind, f'{(middle.stamp_s or 0.0) - first:.0f} s', INK)
    handles: list[Line2D | Patch] = []
    for verdict, color in VERDICT_COLORS.items():
        count = sum(one.verdict == verdict for one in trials)
        handles.append(Line2D([], [], color=color, label=f'{verdict} ({count})', markersize=5,
                              marker='s' if verdict == 'refused' else 'o'))
    _add_legend(figure, [*handles, Patch(facecolor='#BBBBBB', edgecolor='#444444', alpha=0.5,
                                         label='landmark')])
    return figure


def _draw_frustum(axes: Axes, trial: Trial, size: float) -> None:
    """Draw a dot at the camera and a wedge to where it looks."""
    ahead = trial.forward[:2]
    side = np.array([-ahead[1], ahead[0]]) * 0.5
    tip = trial.position[:2]
    color = VERDICT_COLORS[trial.verdict]
    axes.add_patch(Polygon(
        [tip, tip + size * (ahead + side), tip + size * (ahead - side)], closed=True,
        facecolor=to_rgba(color, 0.0 if trial.verdict == 'refused' else 0.3), edgecolor=color,
        linewidth=1.0, zorder=5))
    axes.plot(tip[0], tip[1], marker='s' if trial.verdict == 'refused' else 'o', color=color,
              markersize=4, zorder=6)


def _time_figure(trials: Sequence[Trial]) -> Figure:
    figure = Figure(figsize=(9.0, 2.8), layout=ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.08))
    axes = figure.add_subplot()
    stamps = np.array([one.stamp_s or 0.0 for one in trials])
    stamps -= stamps[0]
    width = 0.8 * (float(np.median(np.diff(stamps))) if len(stamps) > 1 else 1.0)
    handles: list[Line2D | Patch] = []
    for verdict, color in VERDICT_COLORS.items():
        chosen = np.array([one.verdict == verdict for one in trials])
        counts = np.array([one.landmarks for one in trials])
        style: dict[str, Any] = {
            'edgecolor': color, 'linewidth': 1.0,
            'facecolor': 'white' if verdict == 'refused' else color,
            'hatch': '////' if verdict == 'refused' else None}
        axes.bar(stamps[chosen], counts[chosen], width=width, **style)
        # a patch of its own, since bars that are missing give the legend no colour
        handles.append(Patch(label=f'{verdict} ({chosen.sum()})', **style))
        none = chosen & (counts == 0)
        axes.plot(stamps[none], np.zeros(none.sum()), 'x', color=color, clip_on=False, zorder=5)
    axes.set(xlabel='time from the first frame [s]', ylabel='landmarks detected')
    axes.legend(handles=handles, frameon=False, fontsize=9, ncols=3, loc='lower right',
                bbox_to_anchor=(1.0, 1.0))
    return figure


def _landmarks_figure(landmark_map: LandmarkMap, report: CheckReport,
                      bounds: NDArray[np.float64]) -> Figure:
    figure, axes = _map_figure(landmark_map, bounds, 'Landmarks')
    grades = {one.landmark_id: grade(one) for one in report.landmarks}
    colors = [GRADE_COLORS[grades[name]] for name in landmark_map.landmark_ids]
    _draw_outlines(axes, landmark_map, colors, alpha=0.6)
    row_of = {name: row for row, name in enumerate(landmark_map.landmark_ids)}
    named = [one.landmark_id for one in report.landmarks if one.faults]
    if len(named) > _MOST_NAMES:
        named = [name for name in named if grades[name] == 'faulty'][:_MOST_NAMES]
    room = _NAME_ROOM * float((bounds[1] - bounds[0]).max())
    for place, names in _stacked(landmark_map.centers[[row_of[name] for name in named], :2],
                                 named, room):
        _name(axes, place, '\n'.join(names))
    if report.recording is not None:
        axes.plot(*report.recording.path_xyz[:, :2].T, color=FAINT, linewidth=0.8, zorder=2)
    counts = {name: sum(one == name for one in grades.values()) for name in GRADE_COLORS}
    _add_legend(figure, [Patch(facecolor=color, edgecolor='#444444', alpha=0.6,
                               label=f'{GRADE_NAMES[name]} ({counts[name]})')
                         for name, color in GRADE_COLORS.items()])
    return figure


def _stacked(places: NDArray[np.float64], names: Sequence[str], room_m: NDArray[np.float64]
             ) -> list[tuple[NDArray[np.float64], list[str]]]:
    """Return places and the names to write there; names nearer than some room share one."""
    stacks: list[tuple[NDArray[np.float64], list[str]]] = []
    for place, name in zip(places, names, strict=True):
        for other, there in stacks:
            if (np.abs(other - place) < room_m).all():
                there.append(name)
                break
        else:
            stacks.append((place, [name]))
    return [(place, there if len(there) <= 3 else [*there[:2], f'and {len(there) - 2} more'])
            for place, there in stacks]


def _look_alikes_figure(landmark_map: LandmarkMap, report: CheckReport,
                        bounds: NDArray[np.float64]) -> Figure:
    figure, axes = _map_figure(landmark_map, bounds, 'Places that look alike')
    _draw_outlines(axes, landmark_map, '#BBBBBB')
    for number, one in enumerate(report.look_alikes[:_MOST_LOOK_ALIKES], start=1):
        for letter, place in (('a', one.first), ('b', one.second)):
            axes.add_patch(Circle(place[:2], RADIUS_M, fill=False, edgecolor=LOOK_ALIKE,
                                  linewidth=1.8, zorder=5))
            axes.text(place[0], place[1] + 0.8 * RADIUS_M, f'{number}{letter}', fontsize=11,
                      fontweight='bold', color=INK, ha='center', va='center', zorder=9,
                      path_effects=EDGED, clip_on=True)
        axes.plot([one.first[0], one.second[0]], [one.first[1], one.second[1]],
                  color=LOOK_ALIKE, linewidth=1.2, linestyle=(0, (4, 2)), zorder=4)
    _add_legend(figure, [
        Line2D([], [], color=LOOK_ALIKE, marker='o', markersize=12, markerfacecolor='none',
               linestyle=(0, (4, 2)), label=f'pair of places, {RADIUS_M:g} m around'),
        Patch(facecolor='#BBBBBB', edgecolor='#444444', alpha=0.5, label='landmark')])
    return figure


