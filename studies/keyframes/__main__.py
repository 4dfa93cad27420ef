# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Find cases where objects and keyframes together are wrong: ``python -m studies.keyframes``.

``collect`` makes maps and layers of a part of each site, changes queries, map or layer, and stores
the results of objects and keyframes for each query. It continues after an interruption. ``judge``
applies the current acceptance to the stored records, and prints the accepted poses of each way.
``fit`` fits the sections keyframes and genuine of core/calibration.yaml to the records, and prints
the accepted poses of each room with coefficients fitted to the other rooms.
"""

import argparse
import sys
from collections import Counter
from collections.abc import Sequence
from functools import partial
from itertools import product
from pathlib import Path

from tqdm import tqdm

from cliploc_ros.command import interrupt_on_sigterm, not_negative, positive_int, run_command
from cliploc_ros.errors import OptionsError
from cliploc_ros.files.parallel import run_tasks
from studies.keyframes import verdicts
from studies.keyframes.cases import cases
from studies.keyframes.records import make_collect, read_places
from studies.reports import answer_table, draw_judged, judged_by, run_all

_FAMILIES = list(dict.fromkeys(name.partition(':')[0] for name in cases()))


def _collect(options: argparse.Namespace) -> int:
    places = tuple(place for site in options.sites
                   for place in read_places(site, options.model))
    if len({place.site for place in places}) < 2:
        raise OptionsError('--sites: give two or more; each needs images of another site')
    chosen = [place for place in places if any(text in place.name for text in options.places)]
    names = [name for name in cases() if name.partition(':')[0] in options.families]
    work = partial(make_collect, options.out, places, options.queries,
                   options.stale)
    for tasks in (product(chosen, ['']),  # built once, before several workers need it
                  ((place, name) for name, place in product(names, chosen))):
        for _ in tqdm(run_tasks(work, tasks, workers=options.workers), unit='case', disable=None):
            pass
    return 0


def _stored(options: argparse.Namespace) -> list[Path]:
    """Return the files of the chosen records, case by case."""
    order = list(cases())
    paths = [path for path in options.out.glob('cases/*/*.pickle')
             if path.stem.partition(':')[0] in options.families
             and any(text.replace('/', '.') in path.parent.name for text in options.places)]
    if not paths:
        raise OptionsError(f'{options.out} has no such records: run collect first')
    return sorted(paths, key=lambda path: (order.index(path.stem), path.parent.name))


def _fit(options: argparse.Namespace) -> int:
    found: list[tuple[list[verdicts.Row], list[verdicts.Row]]] = run_all(
        verdicts.make_rows, _stored(options), 'cases', options.workers)
    places, signs = ([row for rows in found for row in rows[part]] for part in range(2))
    if len({place.site for place in places}) < 2:
        raise OptionsError(f'{options.out} needs records of two rooms: run collect first')
    for rows in (places, signs):
        print(answer_table(verdicts.left_out(rows), ['case']), end='\n\n')
    print('\n'.join([*verdicts.paste('keyframes', verdicts.POINTS, verdicts.fit(places)),
                     *verdicts.paste('genuine', verdicts.GENUINE, verdicts.fit(signs))]))
    return 0


def _judge(options: argparse.Namespace) -> int:
    found: list[verdicts.Outcome] = run_all(
        partial(verdicts.make_judge, options.ways), _stored(options), 'cases', options.workers)
    for by in options.by or [['family'], ['case']]:
        print(answer_table(found, [*by, 'way', 'truth'], refused=_refused), end='\n\n')
    if options.figure:
        draw_judged(options.figure, '', judged_by(
            (outcome for outcome in found if outcome.confidence > 0.0 and not outcome.truth),
            'way'))
    return 0


def _refused(outcomes: Sequence[verdicts.Outcome]) -> str:
    kinds = Counter(outcome.refusal for outcome in outcomes if outcome.refusal).most_common()
    return ', '.join(f'{count} {kind}' for kind, count in kinds)


def main() -> int:
    """Run from the command line; return the exit code."""
    parser = argparse.ArgumentParser(prog='keyframes', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument('--out', type=Path, default=Path('keyframes'), metavar='DIR',
                        help='folder of the records (%(default)s)')
    common.add_argument('--families', nargs='+', default=_FAMILIES, choices=_FAMILIES,
                        metavar='FAMILY', help=f'families of cases: {", ".join(_FAMILIES)} (all)')
    common.add_argument('--places', nargs='+', default=[''], metavar='TEXT',
                        help='only places whose names contain one of these')
    common.add_argument('--workers', type=positive_int, default=1, metavar='N',
                        help='processes (%(default)s)')
    collects = commands.add_parser('collect', parents=[common], help='store records of all cases')
    collects.set_defaults(command=_collect)
    collects.add_argument('--sites', nargs='+', required=True, metavar='DIR[@METRES]',
                          help='RGB-D folders, TUM folders with the unit of their depth, and '
                               'rooms of demo.world.make_keyframe_rooms')
    collects.add_argument('--model', required=True, help='weights of YOLO for real images')
    collects.add_argument('--queries', type=positive_int, default=24, metavar='N',
                          help='most queries of a case, except the plain case (%(default)s)')
    collects.add_argument('--stale', type=not_negative, default=0.0, metavar='M',
                          help='in all cases, everything on one side of an upright plane is this '
                               'far from its place in map and layer [m] (%(default)g)')
    fits = commands.add_parser('fit', parents=[common], help='fit and print the coefficients')
    fits.set_defaults(command=_fit)
    judges = commands.add_parser('judge', parents=[common], help='judge records, and print tables')
    judges.set_defaults(command=_judge)
    judges.add_argument('--ways', nargs='+', default=verdicts.WAYS, choices=verdicts.WAYS,
                        metavar='WAY', help=f'ways to localize: {", ".join(verdicts.WAYS)} (all)')
    judges.add_argument('--by', nargs='+', action='append',
                        choices=['site', 'place', 'family', 'case'],
                        help='columns that group the rows of a table (one table by family, one by '
                             'case)')
    judges.add_argument('--figure', type=Path, metavar='FILE.png',
                        help='file for a reliability diagram of the confidence')
    options = parser.parse_args()
    interrupt_on_sigterm()
    return run_command(lambda: options.command(options))


if __name__ == '__main__':
    sys.exit(main())
