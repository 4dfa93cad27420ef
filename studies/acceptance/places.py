# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recorded and simulated places, the modes of localizing there, and options to choose places."""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cliploc_ros.command import positive_int
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.errors import OptionsError
from cliploc_ros.offline.datasets.observations import Queries, load_observations, load_queries
from cliploc_ros.offline.evaluation.trials import make_queries, with_neighbours, with_vertical
from cliploc_ros.offline.mapping.building import build_map
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.posed_query import PosedQuery
from cliploc_ros.units import NS_PER_S
from studies.worlds.cameras import GROUP_SIZE
from studies.worlds.depths import simulate_depths
from studies.worlds.places import KINDS
from studies.worlds.world import make_world

#: Input of a request: one or five images, with or without a known vertical and height.
MODES = ('one image', 'vertical', 'vertical, height', 'five images', 'five, vertical, height')
ONE, VERTICAL, LEVEL, FIVE, ALL = MODES
#: Seed of the sensor errors. Simulated worlds have separate seeds.
SEED = 7
#: Deviations of a vertical and of a step of odometry.
VERTICAL_DEG, STEP_M, STEP_DEG = 1.0, 0.01, 0.5
# Margin of the height range beyond the true heights [m].
_HEIGHT_M = 0.2
# Number of random halvings of a recording; each half serves as the map once.
_HALVINGS = 3


class Place(NamedTuple):
    """A map, all frames with the group of each, and which frames are queries.

    With every_frame, each frame is a query in the modes of one image.
    """

    landmark_map: LandmarkMap
    frames: Sequence[PosedQuery]
    groups: Sequence[int]
    is_main: Sequence[bool]
    every_frame: bool = False

    @property
    def modes(self) -> tuple[str, ...]:
        """Return the modes that are possible: five images need groups of frames."""
        has_groups = len(set(self.groups)) < len(self.groups)
        return MODES if has_groups else (ONE, VERTICAL, LEVEL)

    def ask(self, mode: str, seed: int = SEED, vertical_deg: float = VERTICAL_DEG
            ) -> list[PosedQuery]:
        """Return the queries with the input of a mode."""
        is_fused = mode in (FIVE, ALL)
        queries: Sequence[PosedQuery] = self.frames
        if is_fused and any(query.neighbours for query in queries):
            return []  # the neighbours are the robot's other cameras at one instant
        if mode in (VERTICAL, LEVEL, ALL):
            queries = with_vertical(queries, vertical_deg, seed)
        if is_fused:
            queries = with_neighbours(queries, self.groups, STEP_M, STEP_DEG, seed)
        return [query for query, is_main in zip(queries, self.is_main, strict=True)
                if is_main or (self.every_frame and not is_fused)]

    def options(self, mode: str, options: RelocalizerOptions) -> RelocalizerOptions:
        """Return options with the height range that is known in a mode, for the place's map."""
        options = replace(options, k=min(options.k, len(self.landmark_map)))
        if mode not in (LEVEL, ALL):
            return options
        heights = [frame.map_from_camera[2, 3] for frame in self.frames]
        return replace(options, height_range_m=(min(heights) - _HEIGHT_M,
                                                max(heights) + _HEIGHT_M))


class Recording(NamedTuple):
    """A query file and its map."""

    queries: Path
    landmark_map: Path
    every_frame: bool = True
    seed: int = 0
    has_depth: bool = False  #: Use the depth of the file, or simulate it from the map's ellipsoids

    @property
    def name(self) -> str:
        """Return the name of its rows in a table."""
        return self.queries.stem

    def load(self) -> Place:
        """Return the place."""
        landmark_map = LandmarkMap.from_file(self.landmark_map)
        found = load_queries(self.queries)
        queries: Sequence[PosedQuery] = make_queries(found, landmark_map, every_frame=True)
        if not self.has_depth:
            queries = _without_depth(queries)
        elif all(frame.observation.depths is None for frame in found.frames):
            queries = _with_simulated_depth(queries, found, landmark_map)
        return Place(landmark_map, queries,
                     [frame.group for frame in found.frames],
                     [frame.is_main for frame in found.frames], self.every_frame)


class Simulated(NamedTuple):
    """A simulated world; the last image of each group is a query."""

    kind: str
    seed: int
    has_depth: bool = False
    cameras: int = 1

    @property
    def name(self) -> str:
        """Return the name of its rows in a table."""
        return self.kind

    def load(self) -> Place:
        """Return the place."""
        world = make_world(self.kind, self.seed, has_depth=self.has_depth, cameras=self.cameras)
        return Place(world.landmark_map, world.queries, world.groups,
                     [query.number % GROUP_SIZE == GROUP_SIZE - 1 for query in world.queries])


class Halved(NamedTuple):
    """A map from a random half of a recording's frames, with the other half as queries."""

    observations: Path
    seed: int
    is_swapped: bool = False  #: Whether the halves are swapped
    has_depth: bool = False

    @property
    def name(self) -> str:
        """Return the name of its rows in a table."""
        return self.observations.stem

    def halves(self) -> list[PosedDetections]:
        """Return the mapped half and the half that is asked about."""
        recorded = load_observations(self.observations)
        order = np.random.default_rng(self.seed).permutation(len(recorded))
        halves = [recorded.select_frames(np.sort(half)) for half in np.array_split(order, 2)]
        return halves[::-1] if self.is_swapped else halves

    def load(self) -> Place:
        """Return the place. The boxes of its queries have no similarities."""
        mapped, asked = self.halves()
        landmark_map = build_map(mapped).landmark_map
        queries = [PosedQuery(number, observation_of(asked, number, round(stamp_s * NS_PER_S)),
                              pose) for number, (stamp_s, pose) in enumerate(zip(
                       asked.stamps_s, asked.map_from_camera, strict=True))]
        if not self.has_depth:
            queries = _without_depth(queries)
        return Place(landmark_map, queries, range(len(queries)), [True] * len(queries))


def _without_depth(queries: Sequence[PosedQuery]) -> list[PosedQuery]:
    return [replace(query, observation=replace(query.observation, depths=None))
            for query in queries]


def _with_simulated_depth(queries: Sequence[PosedQuery], recorded: Queries,
                          landmark_map: LandmarkMap
                          ) -> tuple[PosedQuery, ...]:
    """Return queries with simulated depths of the landmarks that their boxes show."""
    ids = landmark_map.landmark_ids
    rows = np.array([ids.index(landmark_id) if landmark_id in ids else -1
                     for landmark_id in recorded.landmark_ids] + [-1])
    found = []
    for query, frame in zip(queries, recorded.frames, strict=True):
        shown = rows[frame.true_landmark]
        centers = np.where(shown[:, None] >= 0, landmark_map.centers[shown], np.nan)
        depths = simulate_depths(centers, landmark_map.shapes[shown], query.map_from_camera,
                                 np.random.default_rng([SEED, query.number, 4]))
        found.append(replace(query, observation=replace(query.observation, depths=depths)))
    return tuple(found)


AnyPlace = Recording | Simulated | Halved


def add_arguments(parser: argparse.ArgumentParser, kinds: Sequence[str] = tuple(KINDS),
                  worlds: int = 0, first_seed: int = 0) -> None:
    """Add the options that choose places, with a study's defaults; chosen_places reads them."""
    parser.add_argument('--queries', type=Path, default=[], nargs='*', metavar='NPZ',
                        help='recordings; they replace the worlds unless --worlds is given')
    parser.add_argument('--map', type=Path, default=[], nargs='*', metavar='YAML',
                        help='one map for all query files, or one for each')
    parser.add_argument('--observations', type=Path, default=[], nargs='*', metavar='NPZ',
                        help='recordings without a map: random halves are mapped, the other '
                        'halves are queries, by classes')
    parser.add_argument('--depth', action='store_true',
                        help='use the depth of the files, or simulate it')
    parser.add_argument('--cameras', type=positive_int, default=1, metavar='N',
                        help='cameras of the robot in worlds, in modes of one image (%(default)s)')
    parser.add_argument('--frames', choices=('main', 'all'), default='all')
    parser.add_argument('--worlds', type=int, metavar='N',
                        help=f'simulated worlds of each kind ({worlds})')
    parser.add_argument('--kinds', nargs='+', choices=KINDS, default=list(kinds), metavar='KIND',
                        help=f'kinds of worlds: {", ".join(KINDS)}')
    parser.add_argument('--first-seed', type=int, default=first_seed, metavar='N',
                        help='seed of the first world of a kind (%(default)s)')
    parser.add_argument('--workers', type=positive_int, default=1, metavar='N',
                        help='processes (%(default)s)')
    parser.set_defaults(default_worlds=worlds)


def chosen_places(options: argparse.Namespace) -> list[AnyPlace]:
    """Return the places that the options choose.

    Raises
    ------
    OptionsError
        No place is chosen, the number of maps does not fit the query files, or a number is
        negative.
    """
    worlds = options.worlds
    if worlds is None:
        worlds = 0 if options.queries or options.observations else options.default_worlds
    if worlds < 0 or options.first_seed < 0:
        raise OptionsError('--worlds and --first-seed must not be negative')
    maps = options.map * len(options.queries) if len(options.map) == 1 else options.map
    if len(maps) != len(options.queries):
        raise OptionsError('give one map, or as many maps as query files in the same order')
    places: list[AnyPlace] = [
        *(Halved(path, seed, is_swapped, options.depth) for path in options.observations
          for seed in range(_HALVINGS) for is_swapped in (False, True)),
        *(Recording(path, map_path, options.frames == 'all', has_depth=options.depth)
          for path, map_path in zip(options.queries, maps, strict=True)),
        *(Simulated(kind, options.first_seed + number, options.depth, options.cameras)
          for kind in options.kinds for number in range(worlds))]
    if not places:
        raise OptionsError('nothing to test: give --queries and --map, --observations, or '
                           '--worlds')
    return places


def observation_of(recorded: PosedDetections, row: int, stamp_ns: int) -> Observation:
    """Return a frame of a recording as an observation without similarities."""
    boxes = slice(recorded.frame_offsets[row], recorded.frame_offsets[row + 1])
    odom = None if recorded.odom_from_camera is None else recorded.odom_from_camera[row]
    return Observation(
        recorded.camera_of(row), recorded.detections_of(row), stamp_ns=stamp_ns,
        camera_name=recorded.name_of(row),
        depths=None if recorded.depths is None else recorded.depths[boxes].astype(np.float64),
        odom_from_camera=None if odom is None or np.isnan(odom).any() else odom)
