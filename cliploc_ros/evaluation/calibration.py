# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fitting the confidence to recordings: ``python -m cliploc_ros.evaluation.calibration --help``.

Each frame is localized as it is, with boxes dropped or invented, by classes alone, and in a map
whose objects have exchanged places, where every pose is wrong. The coefficients maximize the
likelihood of what turned out right. For the report, they are fitted on half of the places and
tested on the other half, both ways; neighbouring frames are always in the same half. The
coefficients printed in the end are fitted on all frames.

The installed coefficients are fitted to simulated worlds by the same functions, see
cliploc_ros.evaluation.worlds.fit. What a few recordings cannot show, the influence of the map's
size and of the vertical, keeps its installed coefficient here.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from tqdm import tqdm

from cliploc_ros.command import run_command
from cliploc_ros.core.acceptance.confidence import Setting
from cliploc_ros.core.maps.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.datasets.queries import load_queries
from cliploc_ros.errors import OptionsError
from cliploc_ros.evaluation.confidence_fit import (
    Case,
    Judged,
    draw_judged,
    fit,
    judge,
    outcomes,
    paste,
    report,
)
from cliploc_ros.evaluation.trials import Query, make_queries
from cliploc_ros.evaluation.troubles import (
    Change,
    drop_detections,
    exchange_landmarks,
    invent_detections,
)


@dataclass(frozen=True)
class Round:
    """One pass over all frames.

    Parameters
    ----------
    weight : float
        Weight of a frame in the fit.
    matching : str
    change : Change
        Simulated error of map or detections.
    level : float
        Its level; 0 changes nothing.
    is_elsewhere : bool
        Whether the map shows another place, so that every pose is wrong.
    """

    weight: float
    matching: str = 'hybrid'
    change: Change = drop_detections
    level: float = 0.0
    is_elsewhere: bool = False

    @property
    def is_whole(self) -> bool:
        """Return whether labels are matched and nothing is changed; the report is on these."""
        return self.matching == 'hybrid' and self.level == 0.0


# Simulated errors provide wrong poses, but are not the task: they weigh less. The weights are
# guesses.
WHOLE = Round(1.0)
ROUNDS = (WHOLE, *(Round(0.1, level=level) for level in (0.3, 0.3, 0.5, 0.5)),
          Round(0.1, change=invent_detections, level=0.5),
          *(Round(0.1, 'class', level=level) for level in (0.0, 0.3)),
          *(Round(0.1, matching, exchange_landmarks, 1.0, True)
            for matching in ('hybrid', 'hybrid', 'hybrid', 'class', 'class')))


class Searched(NamedTuple):
    """The case of one search, and the round that it was in."""

    round: Round
    case: Case


def collect(landmark_map: LandmarkMap, queries: Sequence[Query], places: Sequence[str],
            seed: int = 0) -> Iterator[Searched | None]:
    """Localize frames in all rounds, see ROUNDS.

    Parameters
    ----------
    landmark_map : LandmarkMap
    queries : sequence of Query
    places : sequence of str
        Place of each query.
    seed : int
        Seed of the simulated errors.

    Yields
    ------
    Searched or None
        None where no pose was found.
    """
    rng = np.random.default_rng(seed)
    for one in ROUNDS:
        changed, asked = one.change(landmark_map, queries, one.level, rng)
        options = RelocalizerOptions(matching=one.matching)
        relocalizer = Relocalizer(changed, replace(options, k=min(options.k, len(changed))))
        for query, place in zip(asked, places, strict=True):
            found = relocalizer.relocalize([query.observation])
            yield Searched(one, judge(
                found, query.map_from_camera, place, Setting(len(changed)), one.weight,
                one.is_elsewhere)) if found.solved else None


def halves(searched: Sequence[Searched], seed: int = 0) -> tuple[set[str], set[str]]:
    """Return two random halves of the places."""
    places = sorted({one.case.place for one in searched})
    order = np.random.default_rng(seed).permutation(len(places))
    return ({places[row] for row in order[::2]}, {places[row] for row in order[1::2]})


def cross_fitted(searched: Sequence[Searched], seed: int = 0, elsewhere: bool = False
                 ) -> list[Judged]:
    """Return confidence and correctness of each half's frames, fitted on the other half.

    Parameters
    ----------
    searched : sequence of Searched
    seed : int
        Seed of the halves.
    elsewhere : bool
        Test on the rounds in maps of another place; else on the unchanged frames.
    """
    judged = []
    for own in halves(searched, seed):
        calibration = fit([one.case for one in searched if one.case.place not in own])
        judged.append(outcomes([one.case for one in searched if one.case.place in own
                                and (one.round.is_elsewhere if elsewhere
                                     else one.round.is_whole)], calibration))
    return judged


def _read(options: argparse.Namespace) -> list[Searched]:
    """Return the searches of all query files."""
    if len(options.queries) != len(options.map):
        raise OptionsError('give as many maps as query files, in the same order')
    searched: list[Searched | None] = []
    for number, (path, map_path) in enumerate(zip(options.queries, options.map, strict=True)):
        landmark_map = LandmarkMap.from_file(map_path)
        recorded = load_queries(path, landmark_map.landmark_ids)
        queries = make_queries(recorded, landmark_map, every_frame=True)
        searched += tqdm(collect(landmark_map, queries,
                              [f'{number}.{frame.group}' for frame in recorded], options.seed),
                      path.name, len(queries) * len(ROUNDS), disable=None)
    return [one for one in searched if one is not None]


def run(arguments: list[str]) -> int:
    """Fit, test and print."""
    parser = argparse.ArgumentParser(prog='calibration', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--queries', type=Path, required=True, nargs='+', metavar='NPZ')
    parser.add_argument('--map', type=Path, required=True, nargs='+', metavar='YAML',
                        help='of each query file')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--out', type=Path, metavar='DIR', help='draw a reliability diagram there')
    options = parser.parse_args(arguments)
    searched = _read(options)
    judged = cross_fitted(searched, options.seed)
    for number, half in enumerate(judged, start=1):
        print(report(f'half {number}, fitted on the other half', *half))
    print(report('both', *map(np.concatenate, zip(*judged, strict=True))))
    elsewhere = cross_fitted(searched, options.seed, elsewhere=True)
    print(report('another place, both', *map(np.concatenate, zip(*elsewhere, strict=True))))
    if options.out is not None:
        draw_judged(options.out, 'each half, fitted on the other half', {
            f'half {number}': half for number, half in enumerate(judged, start=1)})
    print(paste(fit([one.case for one in searched])))
    return 0


def main() -> int:
    """Run from the command line; return the exit code."""
    return run_command(lambda: run(sys.argv[1:]))


if __name__ == '__main__':
    sys.exit(main())
