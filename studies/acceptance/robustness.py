# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The cost of a wrong map or detector: ``python -m studies.acceptance.robustness``.

Landmarks are removed, moved, mislabelled and exchanged, detections are dropped and invented, at
increasing levels. At each level all queries are localized. Success counts poses accepted or not; a
false accept is the worst outcome.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import ceil
from pathlib import Path
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from tqdm import tqdm

from cliploc_ros.command import run_command
from cliploc_ros.core.maps.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.datasets.queries import load_queries
from cliploc_ros.evaluation.figures import save_figure
from cliploc_ros.evaluation.methods import AUTO, Method
from cliploc_ros.evaluation.output import make_folder
from cliploc_ros.evaluation.run import run_methods
from cliploc_ros.evaluation.summary import Summary, summarize, wilson_interval
from cliploc_ros.evaluation.trials import Query, make_queries
from studies.acceptance.troubles import (
    Change,
    drop_detections,
    exchange_landmarks,
    invent_detections,
    mislabel_landmarks,
    move_landmarks,
    remove_landmarks,
)

_SUCCESS_M = 1.0
_SHARES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
_ALL_SHARES = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
_DISTANCES_M = (0.0, 0.1, 0.2, 0.3, 0.5, 1.0)
_PANEL_SIZE = 2.8, 2.8  # of one trouble in the figure [inch]
_COLUMNS = 3
_LABEL_WIDTH = 22

@dataclass(frozen=True)
class Trouble:
    """A change of map or detections, its levels, and the label of its axis."""

    name: str
    label: str
    levels: tuple[float, ...]
    change: Change


TROUBLES = (
    Trouble('landmarks_removed', 'share of landmarks removed', _SHARES, remove_landmarks),
    Trouble('landmarks_moved', 'a third of the landmarks moved by [m]', _DISTANCES_M,
            move_landmarks),
    Trouble('landmarks_exchanged', 'share of landmarks that exchange places', _ALL_SHARES,
            exchange_landmarks),
    Trouble('landmarks_mislabelled', 'share of landmarks mislabelled', _SHARES,
            mislabel_landmarks),
    Trouble('detections_dropped', 'share of detections dropped', _SHARES, drop_detections),
    Trouble('detections_invented', 'invented detections for each true one', _SHARES,
            invent_detections))


def measure(landmark_map: LandmarkMap, queries: Sequence[Query], trouble: Trouble, seed: int
            ) -> Iterator[Summary]:
    """Localize all queries at each level of a trouble, with the default options."""
    for level in trouble.levels:
        # equal draws, so that each level contains the one before
        rng = np.random.default_rng(seed)
        changed, asked = trouble.change(landmark_map, queries, level, rng)
        options = RelocalizerOptions()
        options = replace(options, k=min(options.k, len(changed)))
        yield summarize(run_methods(changed, [Method(AUTO, options)], asked, trials=1))[0]


def draw(folder: Path, found: Sequence[tuple[Trouble, Sequence[Summary]]]) -> Path:
    """Draw success, accepted poses and false accepts, with 95 % intervals."""
    rows, columns = ceil(len(found) / _COLUMNS), min(len(found), _COLUMNS)
    figure = Figure(figsize=(_PANEL_SIZE[0] * columns, _PANEL_SIZE[1] * rows),
                    layout='constrained')
    panels = figure.subplots(rows, columns, sharey=True, squeeze=False)
    for axes, (trouble, summaries) in zip(panels.flat, found, strict=False):
        _draw_panel(axes, trouble, summaries)
    for axes in panels[:, 0]:
        axes.set(ylabel='share of images', ylim=(-0.02, 1.02))
    for axes in panels.flat[len(found):]:
        axes.remove()
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc='outside upper center', ncols=3,
                  frameon=False, fontsize=9)
    return save_figure(figure, folder / 'robustness.png')


def _draw_panel(axes: Axes, trouble: Trouble, summaries: Sequence[Summary]) -> None:
    counts = (('within 1 m', '#0072B2', 'o', [int((one.errors_m < _SUCCESS_M).sum())
                                              for one in summaries]),
              ('accepted', '#009E73', 's', [int(one.accepted.sum()) for one in summaries]),
              ('false accepts', '#D55E00', 'X', [one.false_accepts(_SUCCESS_M)
                                                 for one in summaries]))
    total = summaries[0].errors_m.size
    for label, color, marker, found in counts:
        intervals = np.array([wilson_interval(one, total) for one in found])
        axes.fill_between(trouble.levels, *intervals.T, color=color, alpha=0.15, linewidth=0)
        axes.plot(trouble.levels, np.array(found) / total, color=color, marker=marker,
                  markersize=5, linewidth=1.4, label=label)
    axes.set_xlabel(fill(trouble.label, _LABEL_WIDTH))
    axes.grid(alpha=0.3)
    axes.set_axisbelow(True)


def run(arguments: list[str]) -> int:
    """Measure and draw every trouble."""
    parser = argparse.ArgumentParser(prog='robustness', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--queries', type=Path, required=True, metavar='NPZ')
    parser.add_argument('--map', type=Path, required=True, metavar='YAML')
    parser.add_argument('--out', type=Path, default=Path('robustness'), metavar='DIR')
    parser.add_argument('--frames', choices=('main', 'all'), default='all')
    parser.add_argument('--seed', type=int, default=0)
    options = parser.parse_args(arguments)
    make_folder(options.out)
    landmark_map = LandmarkMap.from_file(options.map)
    queries = make_queries(load_queries(options.queries, landmark_map.landmark_ids), landmark_map,
                           options.frames == 'all')
    found = []
    for trouble in TROUBLES:
        summaries = list(tqdm(measure(landmark_map, queries, trouble, options.seed),
                              trouble.name, len(trouble.levels), disable=None))
        print(f'{trouble.label}:')
        for level, one in zip(trouble.levels, summaries, strict=True):
            print(f'  {level:4.2f}: success {one.success(_SUCCESS_M):.3f}, accepted '
                  f'{one.accepted.mean():.3f}, false accepts {one.false_accepts(_SUCCESS_M)} '
                  f'of {one.accepted.sum()}')
        found.append((trouble, summaries))
    print(f'wrote {draw(options.out, found)}')
    return 0


def main() -> int:
    """Run from the command line; return the exit code."""
    return run_command(lambda: run(sys.argv[1:]))


if __name__ == '__main__':
    sys.exit(main())
