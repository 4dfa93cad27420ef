# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The gain of each part of the method: ``python -m cliploc_ros.evaluation.ladder``.

The first rung is the paper's configuration. The last ones know what most robots know: the height
of the camera, the vertical, and the motion between five images. Vertical and motion are simulated
from the true poses, with noise.
"""

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from cliploc_ros.command import run_command
from cliploc_ros.core.maps.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.datasets.queries import Queries, load_queries
from cliploc_ros.evaluation.methods import Method
from cliploc_ros.evaluation.paper_table import as_markdown, as_text
from cliploc_ros.evaluation.run import count_trials, run_methods
from cliploc_ros.evaluation.sensors import with_neighbours, with_vertical
from cliploc_ros.evaluation.summary import LIMITS_M, Summary, summarize
from cliploc_ros.evaluation.trials import Query, make_queries

_TRIALS = 3
_PAPER = RelocalizerOptions(algorithm='b-prosac', iterations=500, refine=False)
_FOUND_ONLY = RelocalizerOptions(refine=False)
_DEFAULT = RelocalizerOptions()
_VERTICAL_NOISE_DEG = 1.0
_STEP_NOISE = 0.01, 0.5  # of odometry from frame to frame [m], [deg]
_HEADER = ('what is added', 'success at .25 / .5 / 1 m', 'error [m]: median, mean', 'accepted',
           'recall', 'precision (95 %)', 'false accepts', 'search [ms]')


@dataclass(frozen=True)
class Rung:
    """One step: its options, and the sensors besides the camera."""

    name: str
    options: RelocalizerOptions
    vertical: bool = False
    frames: bool = False

    @property
    def is_noisy(self) -> bool:
        """Return whether it has simulated sensors."""
        return self.vertical or self.frames


def rungs(height_range_m: tuple[float, float]) -> tuple[Rung, ...]:
    """Return the ladder, for cameras at such heights [m]."""
    high = replace(_DEFAULT, height_range_m=height_range_m)
    return (
        Rung('the paper: hybrid_b-prosac, 500 samples', _PAPER),
        Rung('`auto`: all likely samples, each once', _FOUND_ONLY),
        Rung('`refine`: the defaults', _DEFAULT),
        Rung('`height_range_m`', high),
        Rung('`gravity`, off by 1 degree', high, vertical=True),
        Rung('five frames, `odom`; no height, no gravity', _DEFAULT, frames=True),
        Rung('five frames, height, gravity', high, vertical=True, frames=True),
    )


def climb(landmark_map: LandmarkMap, recorded: Queries, ladder: Sequence[Rung], *,
          every_frame: bool = False,
          advance: Callable[[int], object] = lambda searches: None) -> list[Summary]:
    """Run each rung on the queries.

    Parameters
    ----------
    landmark_map : LandmarkMap
    recorded : Queries
    ladder : sequence of Rung
    every_frame : bool
        Use the neighbouring frames as queries, too.
    advance : callable, optional
        Called with the number of searches done.

    Returns
    -------
    list of Summary
        One for each rung, over three draws of its samples or noise.
    """
    found = []
    for rung in ladder:
        draws = list(_draws(landmark_map, recorded, rung, every_frame))
        found += summarize(run_methods(
            landmark_map, [Method(rung.name, rung.options)], draws[0], trials=_TRIALS,
            noisy=draws[1:] and draws, advance=lambda some: advance(len(some))))
    return found


def _draws(landmark_map: LandmarkMap, recorded: Queries, rung: Rung, every_frame: bool
           ) -> Iterator[tuple[Query, ...]]:
    """Yield the queries with the sensors of a rung, each time with other noise."""
    queries = make_queries(recorded, landmark_map, every_frame=True)
    groups = [frame.group for frame in recorded]
    for seed in range(_TRIALS if rung.is_noisy else 1):
        known = with_vertical(queries, _VERTICAL_NOISE_DEG, seed) if rung.vertical else queries
        if rung.frames:
            known = with_neighbours(known, groups, *_STEP_NOISE, seed)
        yield tuple(one for one in known if every_frame or recorded[one.number].is_main)


def table_rows(summaries: Sequence[Summary]) -> list[tuple[str, ...]]:
    """Return the cells of the table, its header first. The median is that of the solved."""
    return [_HEADER, *((
        one.method, ' / '.join(f'{one.success(limit):.2f}' for limit in LIMITS_M),
        f'{np.median(one.errors_m[np.isfinite(one.errors_m)]):.3f}, {one.mean_error_m:.2f}',
        f'{one.accepted.mean():.2f}', f'{one.recall():.2f}',
        '{:.2f} ({:.2f} to {:.2f})'.format(one.precision(), *one.precision_interval()),
        f'{one.false_accepts()} of {int(one.accepted.sum())}', f'{one.mean_search_ms:.0f}')
        for one in summaries)]


def run(arguments: Sequence[str]) -> int:
    """Climb the ladder with the options of the command line, and print the table."""
    parser = argparse.ArgumentParser(
        prog='python -m cliploc_ros.evaluation.ladder',
        description='Print the gain of each part of the method on recorded queries.')
    parser.add_argument('--queries', type=Path, required=True, metavar='NPZ')
    parser.add_argument('--map', type=Path, required=True, metavar='YAML')
    parser.add_argument('--height-range', type=float, nargs=2, default=(0.8, 2.2),
                        metavar=('LOW', 'HIGH'), help='of the camera [m] (%(default)s)')
    parser.add_argument('--frames', choices=('main', 'all'), default='main')
    parser.add_argument('--markdown', action='store_true', help='print the table in Markdown')
    options = parser.parse_args(arguments)
    landmark_map = LandmarkMap.from_file(options.map)
    recorded = load_queries(options.queries, landmark_map.landmark_ids)
    ladder = rungs(tuple(options.height_range))
    every_frame = options.frames == 'all'
    count = sum(1 for frame in recorded if every_frame or frame.is_main)
    total = count * sum(count_trials(Method(one.name, one.options), _TRIALS, one.is_noisy)
                        for one in ladder)
    with tqdm(total=total, unit='search', disable=None) as bar:
        rows = table_rows(climb(landmark_map, recorded, ladder, every_frame=every_frame,
                                advance=bar.update))
    print(as_markdown(rows) if options.markdown else as_text(rows))
    return 0


def main() -> int:
    """Run from the command line; return the exit code."""
    return run_command(lambda: run(sys.argv[1:]))


if __name__ == '__main__':
    sys.exit(main())
