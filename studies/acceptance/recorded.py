# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Precision and recall of acceptance: ``python -m studies.acceptance.recorded --help``.

Each query is localized with one image or five, with and without vertical and height, by labels
and by classes, and in the same map with all objects exchanged, where every pose is wrong. A column
gives for one ``min_confidence``: accepted poses, how many of them are wrong by more than 1 m, and
the share of the right poses that is accepted. "best" is the greatest recall that any
``min_confidence`` reaches at a precision of .99.
"""

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cliploc_ros.command import positive_int, run_command
from cliploc_ros.core.geometry.tolerances import RIGHT_M
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.errors import OptionsError
from cliploc_ros.evaluation.methods import AUTO, Method
from cliploc_ros.evaluation.output import make_folder
from cliploc_ros.evaluation.run import run_all
from cliploc_ros.evaluation.summary import wilson_interval
from cliploc_ros.evaluation.trials import Result, run_trial
from studies.acceptance.confidence_fit import best_recall, draw_judged
from studies.acceptance.places import (
    MODES,
    Place,
    Recording,
    Simulated,
    add_arguments,
    chosen_places,
)
from studies.acceptance.troubles import exchange_landmarks

_MATCHINGS = ('hybrid', 'class')
_THRESHOLDS = (0.99, 0.97, 0.95, 0.9)
# So low that only what has nothing to do with the confidence refuses a pose. All crops are
# compared: on demand, such a pose would be taken from the first of them.
_LOWEST = 1e-6
_SEED = 7


class Outcome(NamedTuple):
    """The best pose of one request.

    Parameters
    ----------
    place, mode, matching : str
        What the request was.
    is_elsewhere : bool
        Whether all objects of the map have exchanged places.
    is_right : bool
        Whether the pose is within 1 m of the truth.
    confidence : float
        0 where another rule refuses the pose, such as too few objects.
    """

    place: str
    mode: str
    matching: str
    is_elsewhere: bool
    is_right: bool
    confidence: float


class Task(NamedTuple):
    """A place to search, by what is known and by what is matched."""

    name: str
    make_place: Recording | Simulated
    mode: str
    matching: str


def search(task: Task) -> list[Outcome]:
    """Return the outcomes of all queries of a place, none where its mode is impossible."""
    place = task.make_place()
    if task.mode not in place.modes:
        return []
    return [*_search(task, place, is_elsewhere=False), *_search(task, place, is_elsewhere=True)]


def _search(task: Task, place: Place, is_elsewhere: bool) -> Iterator[Outcome]:
    landmark_map, queries = place.landmark_map, place.ask(task.mode)
    if is_elsewhere:
        rng = np.random.default_rng(_SEED)
        landmark_map = exchange_landmarks(landmark_map, queries, 1.0, rng)[0]
    options = place.options(task.mode, RelocalizerOptions(
        matching=task.matching, min_confidence=_LOWEST, crops='all'))
    method = Method(AUTO, replace(options, k=min(options.k, len(landmark_map))))
    for one in run_trial(landmark_map, method, 0, queries):
        yield Outcome(task.name, task.mode, task.matching, is_elsewhere,
                      not is_elsewhere and _is_right(one), one.confidence * one.accepted)


def _is_right(result: Result) -> bool:
    return result.error_m is not None and result.error_m < RIGHT_M


def _make_search() -> Callable[[Task], list[Outcome]]:
    return search


def table(outcomes: Sequence[Outcome], min_confidences: Sequence[float] = _THRESHOLDS) -> str:
    """Return a row for each place, matching and mode, as Markdown."""
    rows = ['| place | known | right of all | ' + ' | '.join(
        f'{least:g}' for least in min_confidences) + ' | best |',
        '|---' * (len(min_confidences) + 4) + '|']
    here = [one for one in outcomes if not one.is_elsewhere]
    for key in [*dict.fromkeys((one.place, one.matching, one.mode) for one in here), *(
            ('all', matching, mode) for matching in _MATCHINGS for mode in MODES)]:
        its = [one for one in here if one[2] == key[1] and one.mode == key[2]
               and key[0] in ('all', one.place)]
        if its:
            rows.append(f'| {key[0]}, {key[1]} | {key[2]} | {_figures(its, min_confidences)} |')
    return '\n'.join(rows)


def _figures(outcomes: Sequence[Outcome], min_confidences: Sequence[float]) -> str:
    right = np.array([one.is_right for one in outcomes])
    likely = np.array([one.confidence for one in outcomes])
    cells = [f'{right.sum()} of {len(right)}']
    for least in min_confidences:
        accepted = likely >= least
        recall = f'{accepted[right].mean():.2f}' if right.any() else '-'
        cells.append(f'{accepted.sum()}, {(accepted & ~right).sum()}; {recall}')
    # without a recall where nothing is right
    cells.append(f'{best_recall(likely, right)[0]:.2f}' if right.any() else '-')
    return ' | '.join(cells)


def elsewhere_table(outcomes: Sequence[Outcome],
                    min_confidences: Sequence[float] = _THRESHOLDS) -> str:
    """Return false accepts where all objects have exchanged places, as Markdown."""
    rows = ['| all objects exchanged | requests | ' + ' | '.join(
        f'{least:g}' for least in min_confidences) + ' |',
        '|---' * (len(min_confidences) + 2) + '|']
    there = [one for one in outcomes if one.is_elsewhere]
    parts = {one.place: [other for other in there if other.place == one.place] for one in there}
    parts |= {f'{mode}, {matching}': [
        one for one in there if (one.mode, one.matching) == (mode, matching)]
        for matching in _MATCHINGS for mode in MODES}
    for name, its in [*parts.items(), ('all', there)]:
        if its:
            rows.append(f'| {name} | {len(its)} | {_false_accepts(its, min_confidences)} |')
    return '\n'.join(rows)


def _false_accepts(outcomes: Sequence[Outcome], min_confidences: Sequence[float]) -> str:
    likely = np.array([one.confidence for one in outcomes])
    cells = []
    for least in min_confidences:
        false = int((likely >= least).sum())
        low, high = wilson_interval(false, len(likely))
        cells.append(f'{false} [{low:.4f}, {high:.4f}]')
    return ' | '.join(cells)


def run(arguments: list[str]) -> int:
    """Search and print the tables."""
    parser = argparse.ArgumentParser(prog='acceptance', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    add_arguments(parser, ('room', 'office', 'shop', 'bare room'))
    parser.add_argument('--min-confidence', type=float, nargs='+', default=_THRESHOLDS)
    parser.add_argument('--workers', type=positive_int, default=1, metavar='N')
    parser.add_argument('--out', type=Path, metavar='DIR',
                        help='write outcomes.json and draw a reliability diagram there')
    options = parser.parse_args(arguments)
    if not all(0.0 <= one <= 1.0 for one in options.min_confidence):
        raise OptionsError('--min-confidence must be from 0 to 1')
    tasks = [Task(place.name, place, mode, matching) for place in chosen_places(options)
             for matching in _MATCHINGS for mode in MODES]
    every = run_all(_make_search, tasks, 'searches', options.workers)
    print(table(every, options.min_confidence))
    print()
    print(elsewhere_table(every, options.min_confidence))
    if options.out is not None:
        make_folder(options.out)
        (options.out / 'outcomes.json').write_text(json.dumps([one._asdict() for one in every]))
        here = [one for one in every if not one.is_elsewhere]
        draw_judged(options.out, 'poses that at least three objects support', {mode: (
            np.array([one.confidence for one in here if one.mode == mode]),
            np.array([one.is_right for one in here if one.mode == mode])) for mode in MODES})
    return 0


def main() -> int:
    """Run from the command line; return the exit code."""
    return run_command(lambda: run(sys.argv[1:]))


if __name__ == '__main__':
    sys.exit(main())
