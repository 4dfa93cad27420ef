# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Draw the paper's figures and others, as PNG and SVG, and maps from above with names."""

import io
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib import color_sequences
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from matplotlib.patheffects import withStroke
from numpy.typing import ArrayLike, NDArray
from tqdm import tqdm

from cliploc_ros.core.geometry.ellipsoid import outline_points
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.files.storage import write_file
from cliploc_ros.offline.evaluation.methods import PAPER_METHODS
from cliploc_ros.offline.evaluation.summary import SUCCESS_M, Summary, find_best
from cliploc_ros.offline.evaluation.trials import Result
from cliploc_ros.offline.posed_query import PosedQuery

#: Outline of text, which makes it legible on any background.
EDGED = (withStroke(linewidth=2.0, foreground='white'),)
# Greatest number of landmarks that are drawn with their names, and the size of a name [pt].
_MOST_NAMES, _NAME_PT = 40, 8
_NAME = 'name'
# Offsets of a name from its place, in half widths and in heights of the name, nearest first.
_STEPS = sorted(product((0.0, 1.1, -1.1, 2.2, -2.2), np.arange(-4, 5) * 1.05),
                key=lambda step: (abs(step[0]) + abs(step[1]), -step[1]))


def draw_map(axes: Axes, landmark_map: LandmarkMap) -> dict[str, tuple[float, ...]]:
    """Draw each landmark from above, with its name if the map has few landmarks.

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
        # the highest first, since they hide the others
        for row in np.argsort(-landmark_map.centers[:, 2], kind='stable'):
            write_name(axes, landmark_map.centers[row, :2], landmark_map.landmark_ids[row],
                       _NAME_PT)
    return colors


def draw_outline(axes: Axes, center: NDArray[np.float64], shape: NDArray[np.float64],
                 **style: object) -> None:
    """Draw an ellipsoid of center (3,) and shape (6,) from above."""
    outline = np.array([center[0], center[1], shape[0], shape[1], shape[3]])
    axes.add_patch(Polygon(outline_points(outline), closed=True, **style))


def write_name(axes: Axes, xy: ArrayLike, text: str, size: float = 8,
               color: str = '#222222') -> None:
    """Write a name at a position (2,), which spread_names may change."""
    x, y = np.asarray(xy)
    axes.text(x, y, text, fontsize=size, color=color, ha='center', va='center', zorder=9,
              path_effects=EDGED, parse_math=False, clip_on=True, gid=_NAME).set_in_layout(False)


def spread_names(figure: Figure) -> None:
    """Move names that cover each other, and hide names that find no room.

    A line joins a moved name to its place. Names that were written earlier take precedence.
    """
    figure.draw_without_rendering()
    renderer = FigureCanvasAgg(figure).get_renderer()
    for axes in figure.axes:
        taken: list[NDArray[np.float64]] = []
        for name in [text for text in axes.texts if text.get_gid() == _NAME]:
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
    """Return a figure as PNG, after spread_names."""
    spread_names(figure)
    buffer = io.BytesIO()
    figure.savefig(buffer, format='png', dpi=dpi)
    return buffer.getvalue()


# Okabe and Ito's colours, which colour-blind readers can distinguish. The colour shows the
# matching; line style and marker show the algorithm. Other methods have other colours.
_COLORS = {'class': '#D55E00', 'clip': '#009E73', 'hybrid': '#0072B2'}
_OTHER_COLORS = ('#CC79A7', '#E69F00', '#56B4E9', '#000000', '#F0E442')
_STYLES = {'bf': ('-', 'o'), 'ransac': ((0, (1, 1.2)), '^'), 'prosac': ((0, (5, 1.5)), 's'),
           'b-prosac': ((0, (5, 1, 1, 1)), 'D')}
_SIZE = (6.4, 4.0)
_MAX_ERROR_M = 2.0
# Margin around the points of a map from above [m], and its longer side [in].
_MARGIN_M, _LARGEST_IN = 0.5, 7.0
#: Colours of curves, for colour-blind readers.
JUDGED_COLORS = ('#0072B2', '#D55E00', '#009E73', '#CC79A7', '#E69F00', '#56B4E9')


def draw_all(folder: Path, landmark_map: LandmarkMap, queries: Sequence[PosedQuery],
             results: Sequence[Result], summaries: Sequence[Summary],
             sweep: Mapping[str, Mapping[int, Summary]]) -> list[Path]:
    """Draw every figure that has data.

    Parameters
    ----------
    folder : Path
        Folder of the figures.
    summaries : sequence of Summary
        Summaries of the results. Poses of other programs appear in the figures of success only.
    sweep : mapping of str to mapping of int to Summary
        Summaries of each sampling method, by its number of iterations.

    Returns
    -------
    list of Path
        The PNG files; each has an SVG beside it.
    """
    searched = [summary for summary in summaries if not summary.is_given]
    best = find_best(searched)
    success = f'success (within {SUCCESS_M:g} m)'
    figures: dict[str, Callable[[], Figure]] = {
        'success_over_threshold': partial(_drawn, 'error threshold [m]', 'success',
                                          _success_over_threshold, summaries),
        'precision_over_recall': partial(
            _drawn, 'recall: accepted share of the correct poses',
            f'precision: share of accepted poses within {SUCCESS_M:g} m', _precision_over_recall,
            searched),
        'top_view': partial(_top_view, landmark_map, queries,
                            [result for result in results if result.method == best.method],
                            best.method)}
    if sweep:
        figures['success_over_iterations'] = partial(_drawn, 'iterations', success,
                                                     _success_over_iterations, sweep)
    return [save_figure(draw(), folder / f'{name}.png') for name, draw in tqdm(
        figures.items(), 'figures', unit='figure', disable=None)]


def _drawn(xlabel: str, ylabel: str, draw: Callable[..., None], *values: Any) -> Figure:
    """Return a figure in which a function draws values, with a legend if anything has a label."""
    figure, axes = new_axes(xlabel, ylabel)
    draw(axes, *values)
    if axes.get_legend_handles_labels()[0]:
        add_legend(figure)
    return figure


def save_figure(figure: Figure, path: Path) -> Path:
    """Write a figure as PNG and as SVG beside it; return the path."""
    spread_names(figure)
    write_file(path, lambda partial: figure.savefig(partial, dpi=150))
    # no date and fixed ids: equal results give equal SVG files
    with matplotlib.rc_context({'svg.hashsalt': path.stem}):
        write_file(path.with_suffix('.svg'),
                   lambda partial: figure.savefig(partial, metadata={'Date': None}))
    return path


def new_axes(xlabel: str, ylabel: str) -> tuple[Figure, Axes]:
    """Return a figure and its axes in the common style."""
    figure = Figure(figsize=_SIZE, layout='constrained')
    axes = figure.add_subplot()
    axes.set(xlabel=xlabel, ylabel=ylabel)
    axes.set_prop_cycle(color=JUDGED_COLORS)
    axes.grid(alpha=0.3)
    axes.set_axisbelow(True)
    return figure, axes


def new_top_view(points: NDArray[np.float64], frame_id: str) -> tuple[Figure, Axes]:
    """Return a figure of the map from above with room for points (n, 2), and equal scales."""
    low, high = points.min(axis=0) - _MARGIN_M, points.max(axis=0) + _MARGIN_M
    width, height = (high - low) * _LARGEST_IN / (high - low).max()
    figure = Figure(figsize=(max(4.5, width) + 2.0, max(3.0, height) + 1.3),
                    layout=ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.08))
    axes = figure.add_subplot(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect='equal')
    axes.set_axisbelow(True)
    # a frame_id may be text that mathtext refuses
    axes.set_xlabel(f'x in {frame_id} [m]', parse_math=False)
    axes.set_ylabel(f'y in {frame_id} [m]', parse_math=False)
    return figure, axes


def _style(method: str) -> tuple[str, object, str | None]:
    """Return the colour, line style and marker of a method."""
    if method in PAPER_METHODS:
        matching, algorithm = method.split('_')
        return _COLORS[matching], *_STYLES[algorithm]
    number = sum(method.encode())
    return (_OTHER_COLORS[number % len(_OTHER_COLORS)],
            *tuple(_STYLES.values())[number // len(_OTHER_COLORS) % len(_STYLES)])


def add_legend(figure: Figure) -> None:
    """Add the legend beside the axes."""
    figure.legend(loc='outside right upper', frameon=False, fontsize=8)


def _success_over_threshold(axes: Axes, summaries: Sequence[Summary]) -> None:
    limits = np.linspace(0.0, _MAX_ERROR_M, 401)
    for summary in summaries:
        color, line, _ = _style(summary.method)
        errors = np.sort(summary.errors_m.ravel())
        axes.plot(limits, np.searchsorted(errors, limits) / errors.size, color=color,
                  linestyle=line, linewidth=1.4, label=summary.method)
    axes.set(xlim=(0, _MAX_ERROR_M), ylim=(0, 1))


def _success_over_iterations(axes: Axes, sweep: Mapping[str, Mapping[int, Summary]]) -> None:
    for method, by_count in sweep.items():
        color, line, marker = _style(method)
        rates = [summary.success(SUCCESS_M) for summary in by_count.values()]
        axes.plot([*by_count], rates, color=color, linestyle=line, marker=marker, markersize=4,
                  linewidth=1.2, label=method)
    counts = sorted({count for by_count in sweep.values() for count in by_count})
    axes.set_xscale('log')
    axes.set_xticks(counts, [f'{count:,}' for count in counts])
    axes.set_xticks([], minor=True)
    axes.set_ylim(0, 1)


def _precision_over_recall(axes: Axes, summaries: Sequence[Summary]) -> None:
    for summary in summaries:
        color, line, marker = _style(summary.method)
        recall, precision = precision_recall(summary)
        if not len(recall):
            continue
        # the legend shows the marker, too
        axes.plot(recall, precision, color=color, linestyle=line, linewidth=1.2, marker=marker,
                  markevery=[], markeredgecolor='black', label=summary.method)
        if summary.accepted.any():
            axes.plot(summary.recall(), summary.precision(), color=color, marker=marker,
                      markersize=6, markeredgecolor='black', linestyle='none')
    axes.set(xlim=(-0.02, 1.02), ylim=(None, 1.02))
    axes.set_title('lines: all thresholds; markers: the threshold of the run', fontsize=9)


def precision_recall(summary: Summary) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return recall and precision for each threshold of the confidence.

    Returns
    -------
    recall, precision : ndarray (m,)
        From the strictest threshold to the loosest; empty if no pose is correct.
    """
    solved = np.isfinite(summary.errors_m)
    order = np.argsort(-summary.confidence[solved], kind='stable')
    right = (summary.errors_m[solved] < SUCCESS_M)[order]
    if not right.any():
        return np.empty(0), np.empty(0)
    accepted = np.cumsum(right)
    # poses of equal confidence are accepted together
    last = np.append(np.diff(summary.confidence[solved][order]) != 0, True)
    return (accepted / right.sum())[last], (accepted / np.arange(1, right.size + 1))[last]


def _top_view(landmark_map: LandmarkMap, queries: Sequence[PosedQuery], results: Sequence[Result],
              method: str) -> Figure:
    truth = {query.number: query.map_from_camera for query in queries}
    first = [result for result in results if result.trial == 0]
    positions = np.array([pose[:2, 3] for pose in truth.values()])
    figure, axes = new_top_view(np.concatenate([landmark_map.centers[:, :2], positions]),
                                landmark_map.frame_id)
    axes.set_title(f'{method}: estimates joined to the true poses', parse_math=False)
    draw_map(axes, landmark_map)
    axes.plot(positions[:, 0], positions[:, 1], 'o', markersize=6, markerfacecolor='none',
              color='#222222', label='true pose', zorder=6)
    for label, color, marker, verdict in (('accepted', '#0072B2', 'o', True),
                                          ('refused', '#D55E00', 'X', False)):
        chosen = [result for result in first if result.solved and result.accepted == verdict]
        ends = [[truth[result.query][:2, 3], np.array(result.map_from_camera)[:2, 3],
                 np.full(2, np.nan)] for result in chosen]  # a line with gaps is faster than many
        if chosen:
            axes.plot(*np.array(ends).reshape(-1, 2).T, color=color, linewidth=0.9, zorder=5,
                      marker=marker, markevery=(1, 3), markersize=4,
                      label=f'{label} ({len(chosen)})')
    add_legend(figure)
    return figure
