# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Measure correct and false accepts: ``python -m studies.acceptance``.

``judge`` localizes as robots do. ``recorded`` compares values of min_confidence in the mapped
place, and in a place whose objects have all exchanged places, where every pose is wrong.
``stress`` and ``families`` change map, boxes or sensors without the robot's knowledge. ``priors``
gives the robot a prior of its pose. In ``retries`` the robot looks up to 20 times. ``fit`` fits
the confidence.
"""

import argparse
import json
import sys
from collections.abc import Iterable, Sequence
from dataclasses import asdict, replace
from itertools import product
from math import ceil, inf
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from cliploc_ros.command import positive_int, run_command
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.errors import OptionsError
from cliploc_ros.files.storage import make_folder
from studies.acceptance import fit, searches
from studies.acceptance.places import MODES, ONE, Simulated, add_arguments, chosen_places
from studies.acceptance.troubles import BY_LABELS, FAMILIES, PRIORS, TROUBLES, exchange_landmarks
from studies.reports import (
    accepted_cell,
    answer_table,
    confidence_table,
    crossed_table,
    draw_judged,
    judged_by,
    print_section,
    recall_cell,
    run_all,
    success_cell,
    table,
)
from studies.worlds.cameras import GROUP_SIZE
from studies.worlds.places import KINDS

# So low that a pose is refused only for reasons other than its confidence. All crops are compared,
# because a search on demand would accept such a pose from the first few crops.
_LOWEST = 1e-6
_QUERIES = 4  # of a simulated world
_EXCHANGED = 'share of the landmarks that have exchanged places'


def _searched(options: argparse.Namespace, tasks: Sequence[searches.Task], *tables: Sequence[str]
              ) -> list[searches.Outcome]:
    """Return the outcomes of tasks; print a table of them for each tuple of fields."""
    found: list[searches.Outcome] = run_all(searches.make_search, tasks, 'searches',
                                            options.workers)
    for by in tables:
        print(answer_table(found, by), end='\n\n')
    return found


def _named(names: Iterable[str], options: argparse.Namespace) -> list[str]:
    chosen = [name for name in names if any(text in name for text in options.only)]
    if not chosen:
        raise OptionsError(f'nothing to test: no name contains --only {" ".join(options.only)}')
    return chosen


def _judge(options: argparse.Namespace) -> None:
    plain = RelocalizerOptions(matching=options.matching, crops='all',
                               min_confidence=options.min_confidence)
    found = _searched(options, [
        searches.Task(place, mode, plain, seed=place.seed)
        for place in chosen_places(options) for mode in MODES], ('place', 'mode'), ('mode',))
    print_section('At a glance', crossed_table(found, 'place', 'mode', success_cell))
    if options.out is not None:
        draw_judged(options.out / 'reliability.png', 'confidence of the best pose',
                    judged_by(found, 'mode'))


def _recorded(options: argparse.Namespace) -> None:
    if not all(0.0 <= threshold <= 1.0 for threshold in options.min_confidence):
        raise OptionsError('--min-confidence must be from 0 to 1')
    found: list[searches.Outcome] = run_all(searches.make_search, [
        searches.Task(place, mode, RelocalizerOptions(matching=matching, min_confidence=_LOWEST,
                                             crops='all'), *trouble)
        for place in chosen_places(options) for matching in fit.MATCHINGS for mode in MODES
        for trouble in (('none', 0.0), (_EXCHANGED, 1.0))], 'searches', options.workers)
    # a pose that is refused for another reason than its confidence counts as confidence 0
    found = [replace(outcome, confidence=outcome.confidence * outcome.accepted)
             for outcome in found]
    here = [outcome for outcome in found if outcome.trouble == 'none']
    # in another place no pose is correct
    there = [replace(outcome, error_m=inf, nees=inf, trouble='all objects exchanged')
             for outcome in found if outcome.trouble != 'none']
    for some, by in ((here, ('place', 'matching', 'mode')), (here, ('matching', 'mode')),
                     (there, ('trouble', 'place')), (there, ('trouble', 'matching', 'mode')),
                     (there, ('trouble',))):
        print_section(f'By {", ".join(by)}', confidence_table(some, by, options.min_confidence))
    print_section('At a glance', crossed_table(_as_asked(here), 'matching', 'mode', recall_cell))
    print_section('All objects exchanged, at a glance', crossed_table(
        _as_asked(there), 'matching', 'mode', accepted_cell))
    if options.out is not None:
        make_folder(options.out)
        (options.out / 'outcomes.json').write_text(
            json.dumps([asdict(outcome) for outcome in (*here, *there)]))
        draw_judged(options.out / 'reliability.png', 'poses that at least three objects support',
                    judged_by(here, 'mode'))


def _as_asked(outcomes: Iterable[searches.Outcome]) -> list[searches.Outcome]:
    """Return the outcomes of the default min_confidence."""
    least = RelocalizerOptions.min_confidence
    return [replace(outcome, accepted=outcome.confidence >= least) for outcome in outcomes]


def _stress(options: argparse.Namespace) -> None:
    _searched(options, searches.tasks_of(
        chosen_places(options), RelocalizerOptions(matching=options.matching),
        _named(TROUBLES, options)), ('trouble', 'level', 'mode'))


def _families(options: argparse.Namespace) -> None:
    tasks: list[searches.Task] = []
    for name in _named(FAMILIES, options):
        family = FAMILIES[name]
        searched = RelocalizerOptions(matching=options.matching or (
            'hybrid' if name in BY_LABELS else 'class'))
        recorded = chosen_places(options) if options.queries and 'room' in family.kinds else []
        share = ceil(options.requests / (1 + len(recorded)))
        worlds = [Simulated(kind, options.first_seed + number)
                  for number in range(ceil(share / (_QUERIES * len(family.kinds))))
                  for kind in family.kinds]
        own = [task for task in searches.tasks_of([*recorded, *worlds], searched, [name])
               if task.mode == ONE or not family.in_order]
        if family.in_order:
            few = worlds[:ceil(share / (_QUERIES * GROUP_SIZE))]
            own += [task._replace(in_order=True)
                    for task in searches.tasks_of([*recorded, *few], searched, [name])]
        tasks += [task._replace(seed=task.seed + task.place.seed, most=share) for task in own]
    _searched(options, tasks, ('trouble', 'level', 'mode', 'looks'), ('trouble', 'place'),
              ('trouble', 'looks'))


def _priors(options: argparse.Namespace) -> None:
    plain = RelocalizerOptions(matching=options.matching)
    _searched(options, [
        task._replace(seed=task.seed + place.seed) for place in chosen_places(options)
        for task in searches.tasks_of([place], plain, [*PRIORS])],
        ('place', 'trouble', 'level'), ('trouble', 'level'))


def _retries(options: argparse.Namespace) -> None:
    rows = []
    for chosen_place in chosen_places(options):
        place = chosen_place.load()
        queries = place.ask(ONE)
        elsewhere, _ = exchange_landmarks(place.landmark_map, queries, 1.0,
                                          np.random.default_rng(options.seed))
        for (name, its_map), least in product(
                (('true map', place.landmark_map), ('another place', elsewhere)),
                (RelocalizerOptions.min_confidence, 0.5)):
            plain = RelocalizerOptions(matching=options.matching, min_confidence=least,
                                       k=min(RelocalizerOptions.k, len(its_map)))
            robots = list(tqdm(searches.retry(its_map, queries, plain, options.seed), name,
                               len(queries), disable=None))
            rows.append(searches.retries_row(f'{chosen_place.name}, {name}', least, robots))
    print(table(['map', 'min_confidence', 'accepted at the first look',
                 f'within {searches.LOOKS} looks, each alone',
                 f'within {searches.LOOKS} looks that agree', 'more than 1 m off'], rows))


def _fit(options: argparse.Namespace) -> None:
    tasks = [Simulated(kind, seed, options.depth) for kind in KINDS
             for seed in range(options.worlds)]
    searched: list[fit.Searched] = run_all(fit.make_search_world, tasks, 'worlds',
                                           options.workers)
    calibrations = fit.cross_fitted(searched)
    fit.print_report(searched, calibrations)
    if options.out is not None:
        plain = [result for result in searched if result.kind in fit.FITTED_KINDS
                 and not result.case.is_elsewhere]
        draw_judged(options.out / 'reliability.png', 'worlds, each kind left out of the fit',
                    judged_by(fit.answers(plain, calibrations), 'mode'))
    fitted = fit.fit([result.case for result in searched if result.kind in fit.FITTED_KINDS],
                     'depth' if options.depth else '')
    print('\nfitted on all of them, for calibration.yaml, objects:\n' + ', '.join(
        f'{name}: {value:.3g}' for name, value in fitted.objects.items()))


def run(arguments: Sequence[str] | None = None) -> int:
    """Run a study; return the exit code."""
    parser = argparse.ArgumentParser(prog='python -m studies.acceptance', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)

    def add(name: str, command: object, summary: str, **places: Any) -> argparse.ArgumentParser:
        own = commands.add_parser(name, help=summary, description=summary)
        own.set_defaults(command=command)
        if command is not _fit:
            add_arguments(own, **places)
        return own

    judge = add('judge', _judge, 'precision and recall in simulated worlds or recordings',
                worlds=50)
    judge.add_argument('--min-confidence', type=float, default=RelocalizerOptions.min_confidence)
    recorded = add('recorded', _recorded, 'precision and recall for several min_confidence',
                   kinds=fit.FITTED_KINDS, first_seed=1000)
    recorded.add_argument('--min-confidence', type=float, nargs='+',
                          default=(0.99, 0.97, 0.95, 0.9))
    ordinary = ('room', 'office', 'shop')
    stress = add('stress', _stress, 'false accepts under a list of troubles', kinds=ordinary,
                 first_seed=1000)
    families = add('families', _families, 'false accepts where many objects share an error',
                   first_seed=2000)
    families.add_argument('--requests', type=positive_int, default=200, metavar='N',
                          help='approximate requests of each level and mode (%(default)s)')
    families.add_argument('--quick', dest='requests', action='store_const', const=24,
                          help='few requests')
    families.add_argument('--matching', choices=fit.MATCHINGS,
                          help='default: by labels for changed maps, by classes otherwise')
    priors = add('priors', _priors, 'the effect of a known region, correct or wrong', worlds=20,
                 first_seed=1100)
    retries = add('retries', _retries, f'{searches.LOOKS} looks of a robot that does not move',
                  kinds=ordinary, first_seed=1000)
    retries.set_defaults(frames='main')
    retries.add_argument('--seed', type=int, default=0, help='seed of the changes (%(default)s)')
    fits = add('fit', _fit, 'the fit of the confidence to simulated worlds')
    fits.add_argument('--worlds', type=positive_int, default=24, metavar='N',
                      help='worlds of each kind (%(default)s)')
    fits.add_argument('--depth', action='store_true', help='fit the coefficient of depth alone')
    fits.add_argument('--workers', type=positive_int, default=1, metavar='N')
    for own in (stress, families):
        own.add_argument('--only', nargs='+', default=[''], metavar='TEXT',
                         help='run only troubles whose name contains one of these')
    for own in (judge, recorded, fits):
        own.add_argument('--out', type=Path, metavar='DIR',
                         help='folder for a reliability diagram, with recorded also outcomes.json')
    for own in (judge, stress, priors, retries):
        own.add_argument('--matching', choices=fit.MATCHINGS, default='hybrid')
    options = parser.parse_args(arguments)
    options.command(options)
    return 0


if __name__ == '__main__':
    sys.exit(run_command(run))
