# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Does a localizer notice a wrong camera? ``python -m studies.camera --help``.

One localizer gets all images of a recording, or of drives through simulated worlds, in their
order; another one begins anew at each image. Their boxes or their camera_info are wrong by one of
some rules. Poses that are accepted are counted, and the looks until the camera is called wrong.
"""

import argparse
import sys
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from tqdm import tqdm

from cliploc_ros.command import positive_int, run_command
from cliploc_ros.core.geometry.transforms import RIGHT_M
from cliploc_ros.core.localizer import Localizer
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.query import Query
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.errors import OptionsError
from cliploc_ros.offline.datasets.observations import load_queries
from cliploc_ros.offline.evaluation.figures import within_ellipsoid
from cliploc_ros.offline.evaluation.trials import PosedQuery, make_queries, with_vertical
from studies import wrong_sensors
from studies.reports import errors_of, interval, table
from studies.worlds.places import KINDS
from studies.worlds.world import make_drive

_VERTICAL_DEG = 1.0
#: What is wrong with all images, from nothing to much.
CAMERAS: dict[str, Callable[[Sequence[PosedQuery]], Sequence[PosedQuery]]] = {
    'right': lambda some: some,
    'focal length x 1.03': lambda some: wrong_sensors.scaled_focal(some, 1.03),
    'focal length x .97': lambda some: wrong_sensors.scaled_focal(some, 0.97),
    'focal length x 1.3': lambda some: wrong_sensors.scaled_focal(some, 1.3),
    'focal length x .8': lambda some: wrong_sensors.scaled_focal(some, 0.8),
    'K x 2': lambda some: wrong_sensors.scaled_camera(some, 2.0),
    'K x .5': lambda some: wrong_sensors.scaled_camera(some, 0.5),
    'principal point + .2 widths': lambda some: wrong_sensors.shifted_center(some, 0.2),
    'boxes of a crop, 300 px': lambda some: wrong_sensors.middle_crop(some, 300.0),
    'boxes of a crop, 416 px': lambda some: wrong_sensors.middle_crop(some, 416.0),
    'boxes x .5': lambda some: wrong_sensors.scaled_boxes(some, 0.5),
    'boxes x 1.5': lambda some: wrong_sensors.scaled_boxes(some, 1.5),
    'boxes + .15 widths': lambda some: wrong_sensors.shifted_boxes(some, 0.15)}


class Place(NamedTuple):
    """A map and queries in order."""

    landmark_map: LandmarkMap
    queries: Sequence[PosedQuery]
    size: tuple[int, int]  #: Of the images [px]


class Answer(NamedTuple):
    """The answer to one request."""

    accepted: bool
    error_m: float
    square: float
    is_called_wrong: bool  #: The camera, by then


def answers(place: Place, change: Callable[[Sequence[PosedQuery]], Sequence[PosedQuery]],
            is_one: bool) -> Iterator[Answer]:
    """Yield the answers of one localizer, or of a new one for each query."""
    options = RelocalizerOptions(k=min(3, len(place.landmark_map)))
    relocalizer = Relocalizer(place.landmark_map, options)
    localizer = Localizer(relocalizer)
    for query in change([_of_size(one, place.size) for one in place.queries]):
        if not is_one:
            localizer = Localizer(relocalizer)
        found = localizer.answer(Query((query.observation,), run=None))
        error_m, _, square = errors_of(found, query.map_from_camera)
        yield Answer(found.accepted, error_m, square, bool(localizer.cameras.faults))


def _of_size(query: PosedQuery, size: tuple[int, int]) -> PosedQuery:
    """Return a query with the size of its image, which query files do not hold."""
    camera = replace(query.observation.camera, width=size[0], height=size[1])
    return replace(query, observation=replace(query.observation, camera=camera))


def _places(options: argparse.Namespace) -> Iterator[Place]:
    for path, map_path in zip(options.queries, options.map, strict=True):
        landmark_map = LandmarkMap.from_file(map_path)
        queries = make_queries(load_queries(path, landmark_map.landmark_ids), landmark_map, True)
        yield Place(landmark_map, sorted(queries, key=lambda one: one.observation.stamp_ns)
                    [::options.every], tuple(options.size))
    for kind in options.kinds:
        for seed in range(options.first_seed, options.first_seed + options.worlds):
            world = make_drive(kind, seed, options.images).world
            yield Place(world.landmark_map, world.queries, (640, 480))


def row_of(name: str, way: str, runs: Sequence[Sequence[Answer]]) -> list[object]:
    """Return a row of the table: what became of some runs."""
    every = [one for run in runs for one in run]
    accepted = [one for one in every if one.accepted]
    wrong = sum(one.error_m > RIGHT_M for one in accepted)
    called = [next((number for number, one in enumerate(run, start=1) if one.is_called_wrong), 0)
              for run in runs]
    alarms = [number for number in called if number]
    return [name, way, len(every), len(accepted), wrong, interval(wrong, len(every), 3),
            f'{within_ellipsoid(np.array([one.square for one in accepted])):.2f}'
            if accepted else '',
            f'{len(alarms)} of {len(runs)}' if way == 'one' else '',
            f'{np.median(alarms):.0f}, {max(alarms)}' if alarms and way == 'one' else '']


def run(arguments: Sequence[str]) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--queries', type=Path, default=[], nargs='*', metavar='NPZ')
    parser.add_argument('--map', type=Path, default=[], nargs='*', metavar='YAML',
                        help='of each query file')
    parser.add_argument('--size', type=positive_int, nargs=2, default=(640, 480),
                        metavar=('W', 'H'), help='of the images of the query files [px]')
    parser.add_argument('--every', type=positive_int, default=1, metavar='N',
                        help='take each N-th image of a query file')
    parser.add_argument('--kinds', nargs='*', choices=KINDS, default=[], help='of worlds')
    parser.add_argument('--worlds', type=positive_int, default=4, metavar='N',
                        help='of each kind')
    parser.add_argument('--first-seed', type=int, default=3000, metavar='N')
    parser.add_argument('--images', type=positive_int, default=60, metavar='N',
                        help='of a drive')
    parser.add_argument('--cameras', nargs='+', choices=CAMERAS, default=[*CAMERAS])
    parser.add_argument('--vertical', action='store_true', help='it is known to a degree')
    options = parser.parse_args(arguments)
    if len(options.queries) != len(options.map):
        raise OptionsError('give as many maps as query files, in the same order')
    runs: dict[tuple[str, str], list[list[Answer]]] = defaultdict(list)
    for place in tqdm(list(_places(options)), 'places', disable=None):
        queries = with_vertical(place.queries, _VERTICAL_DEG) if options.vertical \
            else place.queries
        for name in options.cameras:
            for way in ('new', 'one'):
                runs[name, way].append([*answers(place._replace(queries=queries), CAMERAS[name],
                                                 way == 'one')])
    print(table(['camera', 'localizer', 'n', 'accepted', 'wrong', '95 % of n', 'in 95 %',
                 'called wrong', 'after looks: median, most'],
                [row_of(*key, some) for key, some in runs.items()]))
    return 0


if __name__ == '__main__':
    sys.exit(run_command(lambda: run(sys.argv[1:])))
