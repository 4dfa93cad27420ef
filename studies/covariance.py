# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Are covariances consistent with errors? ``python -m studies.covariance consistency --help``.

The table gives, for each mode, the share of the accepted poses within 1 m of the truth that lie
in the 95 % ellipsoid of their covariance. Verticals are off by 1 degree on each axis, the same for
all images of a group. Odometry is off by 1 cm and 0.5 degrees in each step. Worlds are simulated.
"""

import argparse
import sys
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2
from tqdm import tqdm

from cliploc_ros.command import run_command
from cliploc_ros.core.geometry.transforms import RIGHT_M, pose_difference
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.offline.evaluation.trials import with_neighbours
from studies.acceptance.places import (
    STEP_DEG,
    STEP_M,
    VERTICAL_DEG,
    Place,
    add_arguments,
    chosen_places,
)
from studies.reports import draw, interval, print_section, table
from studies.wrong_sensors import with_mount_error

MODES = ('one image', 'vertical', 'five images', 'five, vertical')
_FREEDOMS = (6, 3, 3)  # of the pose error, the position error and the orientation error


def squares_of(place: Place, seed: int) -> Iterator[tuple[str, tuple[float, ...]]]:
    """Yield the mode of each accepted, correct pose, and its squared normalized errors.

    The three errors are those of the pose, the position and the orientation. They are chi-squared
    distributed with six, three and three degrees of freedom if the covariance is consistent.
    Queries are independent questions: no evidence about the camera, and no looks before.
    """
    relocalizer = Relocalizer(place.landmark_map,
                              RelocalizerOptions(k=min(3, len(place.landmark_map))))
    queries, groups = place.frames, place.groups
    level = with_mount_error(queries, groups, VERTICAL_DEG, seed)
    odometry = (STEP_M, STEP_DEG, seed)
    for mode, asked in zip(MODES, (queries, level, with_neighbours(queries, groups, *odometry),
                                   with_neighbours(level, groups, *odometry)), strict=True):
        for query, is_main in zip(asked, place.is_main, strict=True):
            if not is_main and not place.every_frame:
                continue
            found = relocalizer.relocalize([*query.neighbours, query.observation])
            if not found.accepted:
                continue
            assert found.map_from_camera is not None and found.covariance is not None
            error = pose_difference(found.map_from_camera, query.map_from_camera)
            if np.linalg.norm(error[:3]) < RIGHT_M:
                yield mode, tuple(float(part @ np.linalg.solve(block, part)) for part, block in (
                    (error, found.covariance), (error[:3], found.covariance[:3, :3]),
                    (error[3:], found.covariance[3:, 3:])))


def shares(squares: NDArray[np.float64], expected: float = 0.95) -> list[float]:
    """Return the shares (3,) of squares (n, 3) within the ellipsoids of an expected share."""
    return [float((own < chi2.ppf(expected, freedom)).mean())
            for own, freedom in zip(squares.T, _FREEDOMS, strict=True)]


def run(arguments: Sequence[str]) -> int:
    """Print the table and draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('study', choices=['consistency'])
    add_arguments(parser, ('room', 'office', 'shop'), worlds=20)
    parser.set_defaults(frames='main')
    parser.add_argument('--out', type=Path, metavar='DIR', help='folder to draw the figure in')
    options = parser.parse_args(arguments)
    found: dict[str, list[tuple[float, ...]]] = defaultdict(list)
    for place in tqdm(chosen_places(options), 'places', disable=None):
        for mode, own in squares_of(place.load(), place.seed):
            found[mode].append(own)
    squares = {mode: np.array(found[mode]) for mode in MODES if mode in found}
    rows = []
    for mode, squares_of_mode in squares.items():
        whole, position, orientation = shares(squares_of_mode)
        count = len(squares_of_mode)
        rows.append([mode, count, f'{whole:.3f} ({interval(whole * count, count, 3)})',
                     f'{position:.3f}', f'{orientation:.3f}'])
    print_section('Share within the 95 % ellipsoid', table(
        ['known', 'accepted, right', 'pose (95 % interval)', 'position', 'orientation'], rows))
    if options.out is not None and squares:
        _draw(options.out, squares)
    return 0


def _draw(folder: Path, squares: Mapping[str, NDArray[np.float64]]) -> None:
    expected = np.linspace(0.0, 0.999, 200)
    with draw(folder / 'consistency.png', 'share that the ellipsoids should hold',
              'share that they hold') as axes:
        axes.plot([0, 1], [0, 1], color='#888888', linewidth=1.6, label='ideal')
        axes.axvline(0.95, color='#888888', linewidth=0.8, linestyle=':', label='95 %')
        for mode, squares_of_mode in squares.items():
            axes.plot(expected, [shares(squares_of_mode, share)[0] for share in expected],
                      linewidth=1.4, label=f'{mode}: {shares(squares_of_mode)[0]:.3f}')
        axes.set(xlim=(0, 1), ylim=(0, 1.01))


if __name__ == '__main__':
    sys.exit(run_command(lambda: run(sys.argv[1:])))
