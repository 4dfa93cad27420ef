# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Acceptance in simulated worlds: ``python -m studies.acceptance.judge --help``.

Each group of five images is localized with its last image alone and with all of them, without
and with the vertical and the height.
"""

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cliploc_ros.command import positive_int, run_command
from cliploc_ros.core.geometry.tolerances import RIGHT_M
from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.maps.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.errors import OptionsError
from cliploc_ros.evaluation.run import run_all
from cliploc_ros.evaluation.summary import wilson_interval
from studies.acceptance.confidence_fit import draw_judged
from studies.worlds.modes import MODES, Request, requests
from studies.worlds.places import KINDS
from studies.worlds.world import make_world


class Verdict(NamedTuple):
    """The outcome of one search; the error is infinite where no pose was found."""

    kind: str
    mode: str
    error_m: float
    confidence: float
    accepted: bool


class MakeJudge(NamedTuple):
    """Makes the function that judges a world."""

    matching: str
    min_confidence: float

    def __call__(self) -> Callable[[tuple[str, int]], list[Verdict]]:
        """Return the function."""
        return lambda world: judge_world(*world, *self)


def judge_world(kind: str, seed: int, matching: str, min_confidence: float) -> list[Verdict]:
    """Return the verdicts on all groups of a world in all modes."""
    world = make_world(kind, seed)
    options = RelocalizerOptions(matching=matching, min_confidence=min_confidence)
    return [verdict for one in requests(world, seed, options)
            for verdict in _localize(kind, world.landmark_map, one)]


def _localize(kind: str, landmark_map: LandmarkMap, request: Request) -> Iterator[Verdict]:
    relocalizer = Relocalizer(landmark_map, request.options)
    for query in request.queries:
        found = relocalizer.relocalize([*query.neighbours, query.observation])
        error = np.inf if found.map_from_camera is None \
            else pose_error(found.map_from_camera, query.map_from_camera)[0]
        yield Verdict(kind, request.mode, float(error), found.confidence, found.accepted)


def table(verdicts: Sequence[Verdict]) -> str:
    """Return precision and recall of each kind of world and each mode, as Markdown."""
    rows = ['| worlds | known | images | within 1 m | accepted | wrong | precision (95 %) | '
            'recall |', '|---|---|---|---|---|---|---|---|']
    for kind in [*dict.fromkeys(one.kind for one in verdicts), 'all']:
        for mode in MODES:
            its = [one for one in verdicts if one.mode == mode and kind in (one.kind, 'all')]
            if its:
                rows.append(f'| {kind} | {mode} | {_figures(its)} |')
    return '\n'.join(rows)


def _figures(verdicts: Sequence[Verdict]) -> str:
    right = np.array([one.error_m < RIGHT_M for one in verdicts])
    accepted = np.array([one.accepted for one in verdicts])
    count, false = int(accepted.sum()), int((accepted & ~right).sum())
    low, high = wilson_interval(count - false, count) if count else (0.0, 1.0)
    recall = f'{accepted[right].mean():.2f}' if right.any() else ''
    return (f'{len(verdicts)} | {right.mean():.2f} | {count} | {false} | {low:.3f} to {high:.3f} '
            f'| {recall}')


def run(arguments: list[str]) -> int:
    """Localize in worlds and print the figures."""
    parser = argparse.ArgumentParser(prog='judge', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--kinds', nargs='+', choices=KINDS, default=list(KINDS))
    parser.add_argument('--worlds', type=positive_int, default=50, metavar='N',
                        help='of each kind')
    parser.add_argument('--first-seed', type=int, default=0, metavar='N')
    parser.add_argument('--matching', choices=('hybrid', 'class'), default='hybrid')
    parser.add_argument('--min-confidence', type=float,
                        default=RelocalizerOptions().min_confidence)
    parser.add_argument('--workers', type=positive_int, default=1, metavar='N')
    parser.add_argument('--out', type=Path, metavar='DIR', help='draw reliability diagrams there')
    options = parser.parse_args(arguments)
    if options.first_seed < 0:
        raise OptionsError(f'--first-seed: {options.first_seed} is below 0')
    tasks = [(kind, options.first_seed + number) for kind in options.kinds
             for number in range(options.worlds)]
    verdicts = run_all(MakeJudge(options.matching, options.min_confidence), tasks, 'worlds',
                       options.workers)
    print(table(verdicts))
    if options.out is not None:
        draw_judged(options.out, 'simulated worlds', {mode: (
            np.array([one.confidence for one in verdicts if one.mode == mode]),
            np.array([one.error_m < RIGHT_M for one in verdicts if one.mode == mode]))
            for mode in MODES})
    return 0


def main() -> int:
    """Run from the command line; return the exit code."""
    return run_command(lambda: run(sys.argv[1:]))


if __name__ == '__main__':
    sys.exit(main())
