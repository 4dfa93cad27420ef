# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Do covariances hold the errors? ``python -m studies.covariance consistency --help``.

For each mode: how many of the accepted poses within 1 m lie in the ellipsoid that their covariance
says holds 95 %. Verticals are off by 1 degree on each axis, the same for all images of a group.
Odometry is off by 1 cm and 0.5 degrees in each step. Worlds are simulated.
"""

import argparse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2
from tqdm import tqdm

from cliploc_ros.command import positive_int
from cliploc_ros.core.geometry.transforms import RIGHT_M, pose_difference
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.errors import OptionsError
from cliploc_ros.offline.datasets.queries import load_queries
from cliploc_ros.offline.evaluation.sensors import with_neighbours
from cliploc_ros.offline.evaluation.summary import wilson_interval
from cliploc_ros.offline.evaluation.trials import PosedQuery, make_queries
from studies.worlds.cameras import GROUP_SIZE
from studies.worlds.places import KINDS
from studies.worlds.world import make_world
from studies.wrong_sensors import with_mount_error

MODES = ('one image', 'vertical', 'five images', 'five, vertical')
# Deviations of the simulated sensors.
_VERTICAL_DEG, _STEP_M, _STEP_DEG = 1.0, 0.01, 0.5


class Squares(NamedTuple):
    """Squared errors (n,) of poses in their own covariances: whole, of position, of orientation.

    Their chi-squared distributions have six, three and three degrees of freedom.
    """

    whole: NDArray[np.float64]
    position: NDArray[np.float64]
    orientation: NDArray[np.float64]

    def shares(self, expected: float = 0.95) -> tuple[float, float, float]:
        """Return the shares within the ellipsoids that should hold a share."""
        return tuple(float((own < chi2.ppf(expected, freedom)).mean())  # type: ignore[return-value]
                     for own, freedom in zip(self, (6, 3, 3), strict=True))


def squares_of(landmark_map: LandmarkMap, queries: Sequence[PosedQuery], groups: Sequence[int],
               wanted: Sequence[int], seed: int = 0) -> Iterator[tuple[str, tuple[float, ...]]]:
    """Yield the mode and the three squares of each accepted, right pose.

    Parameters
    ----------
    queries : sequence of PosedQuery
        All images.
    groups : sequence of int
        The group of each.
    wanted : sequence of int
        Rows of the images to localize.
    seed : int
        Of the sensors' noise.
    """
    options = RelocalizerOptions(k=min(3, len(landmark_map)))
    relocalizer = Relocalizer(landmark_map, options)
    level = with_mount_error(queries, groups, _VERTICAL_DEG, seed)
    odometry = (_STEP_M, _STEP_DEG, seed)
    for mode, asked in zip(MODES, (queries, level, with_neighbours(queries, groups, *odometry),
                                   with_neighbours(level, groups, *odometry)), strict=True):
        for query in (asked[row] for row in wanted):
            found = relocalizer.relocalize([*query.neighbours, query.observation])
            if not found.accepted:
                continue
            assert found.map_from_camera is not None and found.covariance is not None
            error = pose_difference(found.map_from_camera, query.map_from_camera)
            if np.linalg.norm(error[:3]) < RIGHT_M:
                yield mode, tuple(float(one @ np.linalg.solve(own, one)) for one, own in (
                    (error, found.covariance), (error[:3], found.covariance[:3, :3]),
                    (error[3:], found.covariance[3:, 3:])))


def _of_worlds(options: argparse.Namespace) -> Iterator[tuple[str, tuple[float, ...]]]:
    tasks = [(kind, options.first_seed + number) for kind in options.kinds
             for number in range(options.worlds)]
    for kind, seed in tqdm(tasks, 'worlds', disable=None):
        world = make_world(kind, seed, sigma_m=options.sigma_m)
        if options.hide_sigma:
            world = replace(world, landmark_map=replace(world.landmark_map, details=()))
        yield from squares_of(world.landmark_map, world.queries, world.groups,
                              range(GROUP_SIZE - 1, len(world.queries), GROUP_SIZE), seed)


def _of_recording(options: argparse.Namespace) -> Iterator[tuple[str, tuple[float, ...]]]:
    for path, map_path in zip(options.queries, options.map, strict=True):
        landmark_map = LandmarkMap.from_file(map_path)
        recorded = load_queries(path, landmark_map.landmark_ids)
        rows = [row for row, frame in enumerate(recorded.frames)
                if options.frames == 'all' or frame.is_main]
        yield from squares_of(landmark_map, make_queries(recorded, landmark_map, True),
                              [frame.group for frame in recorded.frames], rows)


def table(squares: Mapping[str, Squares]) -> str:
    """Return the shares within the 95 % ellipsoids of each mode, as Markdown."""
    rows = ['| known | accepted, right | pose (95 % interval) | position | orientation |',
            '|---|---|---|---|---|']
    for mode, own in squares.items():
        whole, position, orientation = own.shares()
        low, high = wilson_interval(whole * len(own.whole), len(own.whole))
        rows.append(f'| {mode} | {len(own.whole)} | {whole:.3f} ({low:.3f} to {high:.3f}) '
                    f'| {position:.3f} | {orientation:.3f} |')
    return '\n'.join(rows)


def run(arguments: list[str]) -> int:
    """Print the table and draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--kinds', nargs='+', choices=KINDS, default=['room', 'office', 'shop'])
    parser.add_argument('--worlds', type=positive_int, default=20, metavar='N',
                        help='of each kind')
    parser.add_argument('--first-seed', type=int, default=0, metavar='N')
    parser.add_argument('--sigma', type=float, metavar='M', dest='sigma_m',
                        help="deviation of the maps' positions; drawn by default")
    parser.add_argument('--hide-sigma', action='store_true',
                        help='maps without position_sigma and class weights')
    parser.add_argument('--queries', type=Path, default=[], nargs='*', metavar='NPZ',
                        help='recordings instead of worlds')
    parser.add_argument('--map', type=Path, default=[], nargs='*', metavar='YAML',
                        help='of each query file')
    parser.add_argument('--frames', choices=('main', 'all'), default='main')
    parser.add_argument('--out', type=Path, metavar='DIR', help='draw the figure there')
    options = parser.parse_args(arguments)
    if options.first_seed < 0:
        raise OptionsError(f'--first-seed: {options.first_seed} is below 0')
    if options.sigma_m is not None and not 0.0 <= options.sigma_m <= 1.0:
        raise OptionsError(f'--sigma: {options.sigma_m} must lie within 0 and 1 m')
    if len(options.queries) != len(options.map):
        raise OptionsError('give as many maps as query files, in the same order')
    found: dict[str, list[tuple[float, ...]]] = {mode: [] for mode in MODES}
    for mode, own in (_of_recording if options.queries else _of_worlds)(options):
        found[mode].append(own)
    squares = {mode: Squares(*np.array(own).T) for mode, own in found.items() if own}
    print(table(squares))
    if options.out is not None and squares:
        _draw(options.out, squares)
    return 0


def _draw(folder: Path, squares: Mapping[str, Squares]) -> None:
    # late, since the table needs no matplotlib
    from cliploc_ros.files.storage import make_folder
    from cliploc_ros.offline.evaluation.figures import add_legend, new_axes, save_figure

    make_folder(folder)
    figure, axes = new_axes('share that the ellipsoids should hold', 'share that they hold')
    expected = np.linspace(0.0, 0.999, 200)
    axes.plot([0, 1], [0, 1], color='#888888', linewidth=1.6, label='ideal')
    axes.axvline(0.95, color='#888888', linewidth=0.8, linestyle=':', label='95 %')
    for mode, own in squares.items():
        axes.plot(expected, [own.shares(one)[0] for one in expected], linewidth=1.4,
                  label=f'{mode}: {own.shares()[0]:.3f}')
    axes.set(xlim=(0, 1), ylim=(0, 1.01))
    add_legend(figure)
    print(f'wrote {save_figure(figure, folder / "consistency.png")}')
