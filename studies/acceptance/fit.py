# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fitting the confidence to simulated worlds: ``python -m studies.acceptance.fit``.

Each group of images is localized in all modes, by labels and by classes, and in the same map with
all objects exchanged, where every pose is wrong. For the report, each kind of world is judged by
coefficients that the other kinds fitted. The coefficients printed in the end are fitted on rooms,
offices, shops and bare rooms; corridors, halls and twin rooms only judge, since their mistaken
places are the task of cliploc_ros.core.acceptance.look_alikes.
"""

import argparse
import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cliploc_ros.command import positive_int, run_command
from cliploc_ros.core.acceptance.confidence import Calibration, Setting
from cliploc_ros.core.maps.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.evaluation.run import run_all
from studies.acceptance.confidence_fit import (
    Case,
    Judged,
    draw_judged,
    fit,
    judge,
    outcomes,
    paste,
    report,
)
from studies.acceptance.troubles import exchange_landmarks
from studies.worlds.modes import MODES, Request, requests
from studies.worlds.places import KINDS
from studies.worlds.world import make_world

#: The kinds that fit; the others have places that look alike.
FITTED_KINDS = ('room', 'office', 'shop', 'bare room')
_MATCHINGS = ('hybrid', 'class')
# Deviations of the known vertical [deg], drawn for each world.
_VERTICALS_DEG = (0.5, 1.0, 2.0, 4.0)
_IN_DOUBT = 0.3
# The modes in which objects exchange places.
_ELSEWHERE = (MODES[0], MODES[-1])


class Searched(NamedTuple):
    """The case of one search, and what it was."""

    kind: str
    mode: str
    matching: str
    case: Case


def search_world(world: tuple[str, int]) -> list[Searched]:
    """Return the cases of a world (kind, seed) in all modes."""
    kind, seed = world
    made, rng = make_world(kind, seed), np.random.default_rng([seed, 7])
    vertical_deg = float(rng.choice(_VERTICALS_DEG))
    found = []
    for matching in _MATCHINGS:
        # so low that what costs time for likely poses only is computed for those in doubt, too
        options = RelocalizerOptions(matching=matching, vertical_deviation_deg=vertical_deg,
                                     min_confidence=_IN_DOUBT)
        for one in requests(made, seed, options):
            places = [(made.landmark_map, False)]
            if one.mode in _ELSEWHERE:
                places.append((exchange_landmarks(made.landmark_map, one.queries, 1.0, rng)[0],
                               True))
            found += [Searched(kind, one.mode, matching, case) for its_map, is_elsewhere in places
                      for case in _search(its_map, one, f'{kind} {seed}', is_elsewhere)]
    return found


def _search(landmark_map: LandmarkMap, request: Request, place: str, is_elsewhere: bool
            ) -> Iterator[Case]:
    relocalizer = Relocalizer(landmark_map, request.options)
    setting = Setting(len(landmark_map), request.options.vertical_deviation_deg
                      if request.knows_vertical else math.inf)
    for query in request.queries:
        found = relocalizer.relocalize([*query.neighbours, query.observation])
        if found.solved:
            yield judge(found, query.map_from_camera, place, setting, is_elsewhere=is_elsewhere)


def _make_search() -> Callable[[tuple[str, int]], list[Searched]]:
    return search_world


def cross_fitted(searched: Sequence[Searched]) -> dict[str, Calibration]:
    """Return the coefficients for each kind, fitted on the other kinds."""
    kinds = dict.fromkeys(one.kind for one in searched)
    return {kind: fit([one.case for one in searched
                       if one.kind in FITTED_KINDS and one.kind != kind]) for kind in kinds}


def judged(searched: Sequence[Searched], calibrations: Mapping[str, Calibration]) -> Judged:
    """Return confidences and outcomes, by the coefficients for each kind."""
    parts = [outcomes([one.case for one in searched if one.kind == kind], calibration)
             for kind, calibration in calibrations.items()
             if any(one.kind == kind for one in searched)]
    return (np.concatenate([part[0] for part in parts]),
            np.concatenate([part[1] for part in parts]))


def _print_report(searched: Sequence[Searched], calibrations: Mapping[str, Calibration]) -> None:
    here = [one for one in searched if not one.case.is_elsewhere]
    plain = [one for one in here if one.kind in FITTED_KINDS]
    for kind in calibrations:
        print(report(f'{kind}, left out', *judged([one for one in here if one.kind == kind],
                                                  calibrations)))
    for matching in _MATCHINGS:
        for mode in MODES:
            its = [one for one in plain if (one.mode, one.matching) == (mode, matching)]
            print(report(f'{mode}, {matching}, kinds that fit, each left out',
                         *judged(its, calibrations)))
    print(report('kinds that fit, each left out', *judged(plain, calibrations)))
    print(report('another place, all kinds', *judged(
        [one for one in searched if one.case.is_elsewhere], calibrations)))


def run(arguments: list[str]) -> int:
    """Search, fit, test and print."""
    parser = argparse.ArgumentParser(prog='fit', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--worlds', type=positive_int, default=24, metavar='N',
                        help='of each kind')
    parser.add_argument('--workers', type=positive_int, default=1, metavar='N')
    parser.add_argument('--out', type=Path, metavar='DIR', help='draw a reliability diagram there')
    options = parser.parse_args(arguments)
    tasks = [(kind, seed) for kind in KINDS for seed in range(options.worlds)]
    searched = run_all(_make_search, tasks, 'worlds', options.workers)
    calibrations = cross_fitted(searched)
    _print_report(searched, calibrations)
    if options.out is not None:
        plain = [one for one in searched if one.kind in FITTED_KINDS
                 and not one.case.is_elsewhere]
        draw_judged(options.out, 'simulated worlds, each kind left out of the fit', {
            mode: judged([one for one in plain if one.mode == mode], calibrations)
            for mode in MODES})
    print(paste(fit([one.case for one in searched if one.kind in FITTED_KINDS])))
    return 0


def main() -> int:
    """Run from the command line; return the exit code."""
    return run_command(lambda: run(sys.argv[1:]))


if __name__ == '__main__':
    sys.exit(main())
