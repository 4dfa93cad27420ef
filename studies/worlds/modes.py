# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a robot knows in a simulated world: one image or five, the vertical, the height."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.evaluation.sensors import with_neighbours, with_vertical
from cliploc_ros.evaluation.trials import Query
from studies.worlds.cameras import GROUP_SIZE
from studies.worlds.world import World

#: What is known besides one image.
MODES = ('one image', 'vertical', 'vertical, height', 'five images', 'five, vertical, height')
#: Deviations of a step of odometry, and by how much the height range exceeds the true heights.
STEP_M, STEP_DEG, HEIGHT_M = 0.01, 0.5, 0.2


class Request(NamedTuple):
    """The last image of each group of a world, with what else is known.

    Parameters
    ----------
    mode : str
    queries : sequence of Query
    options : RelocalizerOptions
    knows_vertical : bool
    """

    mode: str
    queries: Sequence[Query]
    options: RelocalizerOptions
    knows_vertical: bool


def requests(world: World, seed: int, options: RelocalizerOptions) -> Iterator[Request]:
    """Yield the requests of each mode.

    Parameters
    ----------
    world : World
    seed : int
        Of the sensors' errors.
    options : RelocalizerOptions
        vertical_deviation_deg is the true one of the vertical; k is lowered for small maps.
    """
    heights = [one.map_from_camera[2, 3] for one in world.queries]
    options = replace(options, k=min(options.k, len(world.landmark_map)))
    known = replace(options, height_range_m=(min(heights) - HEIGHT_M, max(heights) + HEIGHT_M))
    level = with_vertical(world.queries, options.vertical_deviation_deg, seed)
    odometry = (world.groups, STEP_M, STEP_DEG, seed)
    for mode, queries, its in zip(MODES, (
            world.queries, level, level, with_neighbours(world.queries, *odometry),
            with_neighbours(level, *odometry)), (options, options, known, options, known),
            strict=True):
        yield Request(mode, queries[GROUP_SIZE - 1::GROUP_SIZE], its, 'vertical' in mode)
