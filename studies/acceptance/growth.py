# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How confidence grows with images: ``python -m studies.acceptance.growth --help``.

A robot takes up to five images while it turns or drives, and is localized after each with all that
it took, as the node does. Confidence should grow with each image, and not faster than justified:
of the poses with confidence .9 to .95, .9 to .95 should be right after any number of images.
"""

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.command import positive_int, run_command
from cliploc_ros.core.geometry.tolerances import RIGHT_M
from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.maps.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.core.session import Session
from cliploc_ros.datasets.queries import load_queries
from cliploc_ros.errors import OptionsError
from cliploc_ros.evaluation.run import run_all
from cliploc_ros.evaluation.sensors import with_mount_error, with_neighbours
from cliploc_ros.evaluation.summary import wilson_interval
from cliploc_ros.evaluation.trials import Query, make_queries
from studies.acceptance.confidence_fit import draw_judged
from studies.worlds.cameras import GROUP_SIZE
from studies.worlds.places import KINDS
from studies.worlds.world import make_world

# Deviations of the simulated sensors.
_VERTICAL_DEG, _STEP_M, _STEP_DEG = 1.0, 0.01, 0.5
# Bounds of the confidences that are counted together.
_BINS = (0.0, 0.5, 0.8, 0.9, 0.95, 0.98, 1.0)
_WINDOW_S = 1e6


class Answer(NamedTuple):
    """The answer after so many images of a group; the error is infinite without a pose."""

    images: int
    confidence: float
    error_m: float
    accepted: bool


class MakeWalker(NamedTuple):
    """Makes the function that answers in a world."""

    vertical: bool
    options: RelocalizerOptions

    def __call__(self) -> Callable[[tuple[str, int]], list[list[Answer]]]:
        """Return the function."""
        return lambda task: self.answers(*task)

    def answers(self, kind: str, seed: int) -> list[list[Answer]]:
        """Return the answers to each group of a world."""
        world = make_world(kind, seed)
        return list(answers_of(world.landmark_map, world.queries, world.groups, self.options,
                               seed, self.vertical))


def answers_of(landmark_map: LandmarkMap, queries: Sequence[Query], groups: Sequence[int],
               options: RelocalizerOptions, seed: int = 0, vertical: bool = False
               ) -> Iterator[list[Answer]]:
    """Yield the answers to each group of images, after one image, two and so on.

    Parameters
    ----------
    landmark_map : LandmarkMap
    queries : sequence of Query
        All images.
    groups : sequence of int
        The group of each.
    options : RelocalizerOptions
    seed : int
        Of the sensors' noise.
    vertical : bool
        Whether the robot knows it, to a degree on each axis.
    """
    if vertical:
        queries = with_mount_error(queries, groups, _VERTICAL_DEG, seed)
    queries = with_neighbours(queries, groups, _STEP_M, _STEP_DEG, seed)
    relocalizer = Relocalizer(landmark_map, replace(options, k=min(options.k, len(landmark_map))))
    for group in dict.fromkeys(groups):
        session = Session(relocalizer)
        frames = sorted((one for one, its in zip(queries, groups, strict=True) if its == group),
                        key=lambda one: one.observation.stamp_ns)
        yield [_answer(session, query, number) for number, query in enumerate(frames, 1)]


def _answer(session: Session, query: Query, images: int) -> Answer:
    found = session.localize(query.observation, 0, GROUP_SIZE, _WINDOW_S)
    error = np.inf if found.map_from_camera is None \
        else pose_error(found.map_from_camera, query.map_from_camera)[0]
    return Answer(images, found.confidence, float(error), found.accepted)


def tables(groups: Sequence[Sequence[Answer]]) -> str:
    """Return the growth and the reliability after each number of images, as Markdown."""
    growth = ['| images | poses within 1 m | mean confidence | of the right | of the wrong | '
              'grew, of those right twice | accepted, wrong | recall |',
              '|---|---|---|---|---|---|---|---|']
    reliability = [
        '| confidence | ' + ' | '.join(
            f'{number} image{"s"[:number > 1]}' for number in _numbers(groups)) + ' |',
        '|---|' + '---|' * len(_numbers(groups))]
    columns = {number: _columns(groups, number) for number in _numbers(groups)}
    for number, (confidence, right, accepted) in columns.items():
        before = columns.get(number - 1)
        grew = '' if before is None else _mean((confidence > before[0])[before[1] & right])
        growth.append(
            f'| {number} | {right.sum()} of {len(right)} | {confidence.mean():.3f} '
            f'| {_mean(confidence[right])} | {_mean(confidence[~right])} | {grew} '
            f'| {accepted.sum()}, {(accepted & ~right).sum()} | {_mean(accepted[right])} |')
    for low, high in pairwise(_BINS):
        cells = []
        for confidence, right, _ in columns.values():
            own = (confidence >= low) & ((confidence < high) | (high == 1.0))
            cells.append(_share(right[own], confidence[own]))
        reliability.append(f'| {low:.2f} to {high:.2f} | ' + ' | '.join(cells) + ' |')
    reliability.append('| all: expected, right | ' + ' | '.join(
        f'{confidence.sum():.0f}, {right.sum()}' for confidence, right, _ in columns.values())
        + ' |')
    return '\n'.join([*growth, '', *reliability])


def _numbers(groups: Sequence[Sequence[Answer]]) -> range:
    return range(1, 1 + max(map(len, groups), default=0))


def _columns(groups: Sequence[Sequence[Answer]], images: int
             ) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_]]:
    """Return confidence, whether right and whether accepted, of each group after some images."""
    answers = [one[images - 1] for one in groups if len(one) >= GROUP_SIZE]
    return (np.array([one.confidence for one in answers]),
            np.array([one.error_m < RIGHT_M for one in answers], dtype=np.bool_),
            np.array([one.accepted for one in answers], dtype=np.bool_))


def _mean(values: NDArray[np.float64] | NDArray[np.bool_]) -> str:
    return f'{values.mean():.3f}' if len(values) else ''


def _share(right: NDArray[np.bool_], confidence: NDArray[np.float64]) -> str:
    """Return how many are right, of how many, and the interval of the share."""
    if not len(right):
        return ''
    low, high = wilson_interval(float(right.sum()), len(right))
    return f'{right.sum()} of {len(right)} ({low:.2f} to {high:.2f}; mean {confidence.mean():.2f})'


def run(arguments: list[str]) -> int:
    """Print the tables and draw the reliability."""
    parser = argparse.ArgumentParser(prog='growth', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--kinds', nargs='+', choices=KINDS,
                        default=['room', 'office', 'shop', 'bare room'])
    parser.add_argument('--worlds', type=positive_int, default=20, metavar='N',
                        help='of each kind')
    parser.add_argument('--first-seed', type=int, default=0, metavar='N')
    parser.add_argument('--queries', type=Path, default=[], nargs='*', metavar='NPZ',
                        help='recordings instead of worlds')
    parser.add_argument('--map', type=Path, metavar='YAML', help='of the recordings')
    parser.add_argument('--matching', choices=('hybrid', 'class'), default='hybrid')
    parser.add_argument('--vertical', action='store_true', help='known to 1 degree on each axis')
    parser.add_argument('--workers', type=positive_int, default=1, metavar='N')
    parser.add_argument('--out', type=Path, metavar='DIR', help='draw the reliability there')
    options = parser.parse_args(arguments)
    if options.first_seed < 0:
        raise OptionsError(f'--first-seed: {options.first_seed} is below 0')
    if options.queries and options.map is None:
        raise OptionsError('--queries: name their map with --map')
    groups = _of_recordings(options) if options.queries else _of_worlds(options)
    print(tables(groups))
    if options.out is not None:
        draw_judged(options.out, 'after one to five images', {
            f'{number} image{"s"[:number > 1]}': _columns(groups, number)[:2]
            for number in _numbers(groups)})
    return 0


def _of_worlds(options: argparse.Namespace) -> list[list[Answer]]:
    tasks = [(kind, options.first_seed + number) for kind in options.kinds
             for number in range(options.worlds)]
    make = MakeWalker(options.vertical, RelocalizerOptions(matching=options.matching))
    return run_all(make, tasks, 'worlds', options.workers)


def _of_recordings(options: argparse.Namespace) -> list[list[Answer]]:
    landmark_map = LandmarkMap.from_file(options.map)
    groups: list[list[Answer]] = []
    for path in options.queries:
        recorded = load_queries(path, landmark_map.landmark_ids)
        groups += answers_of(landmark_map, make_queries(recorded, landmark_map, True),
                             [frame.group for frame in recorded.frames],
                             RelocalizerOptions(matching=options.matching), 0, options.vertical)
    return groups


def main() -> int:
    """Run from the command line; return the exit code."""
    return run_command(lambda: run(sys.argv[1:]))


if __name__ == '__main__':
    sys.exit(main())
