# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""False accepts in a list of troubles: ``python -m studies.acceptance.stress --help``.

Map, boxes or sensors are wrong, and the robot does not know. The table counts accepted poses that
are wrong by more than 1 m, as a share of all requests, with the 95 % interval of Wilson; recall is
the share of the right poses that is accepted.
"""

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from cliploc_ros.command import positive_int, run_command
from cliploc_ros.core.geometry.tolerances import RIGHT_M
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.errors import OptionsError
from cliploc_ros.evaluation import sensors
from cliploc_ros.evaluation.methods import AUTO, Method
from cliploc_ros.evaluation.run import run_all
from cliploc_ros.evaluation.summary import wilson_interval
from cliploc_ros.evaluation.trials import Query, run_trial
from studies.acceptance import troubles
from studies.acceptance.places import (
    ALL,
    FIVE,
    LEVEL,
    ONE,
    Place,
    add_arguments,
    chosen_places,
)

_SEED = 7

Sensor = Callable[[Sequence[Query]], Sequence[Query]]


class Trouble(NamedTuple):
    """What is wrong, in the modes in which it matters.

    Parameters
    ----------
    name : str
    modes : tuple of str
    change : callable or None
        Of map and boxes.
    level : float
        Of the change.
    sensor : callable or None
        Change of verticals and odometry.
    """

    name: str
    modes: tuple[str, ...]
    change: troubles.Change | None = None
    level: float = 0.0
    sensor: Sensor | None = None


_EVERY = (ONE, LEVEL, ALL)
TROUBLES = (
    Trouble('none', (ONE, LEVEL, FIVE, ALL)),
    *(Trouble(f'{level:g} of the landmarks have exchanged places', _EVERY,
              troubles.exchange_landmarks, level) for level in (0.2, 0.4, 0.6, 1.0)),
    Trouble('ten random boxes', _EVERY, troubles.random_detections, 10),
    Trouble('every landmark twice, 1 cm apart', _EVERY, troubles.double_landmarks, 0.01),
    Trouble('every landmark twice, 10 cm apart', _EVERY, troubles.double_landmarks, 0.1),
    Trouble('two identical rooms', _EVERY, troubles.add_equal_room, 2.0),
    Trouble('.4 of the objects moved by .3 to 3 m', _EVERY, troubles.move_objects, 0.4),
    Trouble('mount off by 5 degrees', (LEVEL, FIVE, ALL),
            sensor=lambda queries: sensors.wrong_mount(queries, 5.0)),
    Trouble('vertical off by 10 degrees', (LEVEL, ALL),
            sensor=lambda queries: sensors.tilted_vertical(queries, 10.0)),
    Trouble('odometry 20 % too long', (FIVE, ALL),
            sensor=lambda queries: sensors.scaled_odometry(queries, 1.2)),
    Trouble('odometry 20 % too short', (FIVE, ALL),
            sensor=lambda queries: sensors.scaled_odometry(queries, 0.8)))


class Outcome(NamedTuple):
    """How many requests of a trouble and mode there were, and what became of them."""

    trouble: str
    mode: str
    requests: int
    right: int
    accepted: int
    false: int


class MakeTrial(NamedTuple):
    """Makes the function that tests a place with a trouble."""

    matching: str

    def __call__(self) -> Callable[[tuple[Callable[[], Place], int]], list[Outcome]]:
        """Return the function."""
        return lambda task: list(try_place(task[0](), TROUBLES[task[1]], self.matching))


def try_place(place: Place, trouble: Trouble, matching: str) -> Iterator[Outcome]:
    """Localize all queries of a place with a trouble, in each of its modes."""
    plain = RelocalizerOptions(matching=matching)
    for mode in [one for one in trouble.modes if one in place.modes]:
        queries: Sequence[Query] = place.ask(mode)
        if trouble.sensor is not None:
            queries = trouble.sensor(queries)
        changed, options = place.landmark_map, place.options(mode, plain)
        if trouble.change is not None:
            changed, queries = trouble.change(changed, queries, trouble.level,
                                              np.random.default_rng(_SEED))
        options = replace(options, k=min(options.k, len(changed)))
        found = run_trial(changed, Method(AUTO, options), 0, queries)
        right = np.array([one.error_m is not None and one.error_m <= RIGHT_M for one in found],
                         dtype=np.bool_)
        accepted = np.array([one.accepted for one in found], dtype=np.bool_)
        yield Outcome(trouble.name, mode, len(found), int(right.sum()), int(accepted.sum()),
                      int((accepted & ~right).sum()))


def table(outcomes: Sequence[Outcome]) -> str:
    """Return the sums of each trouble and mode, as Markdown."""
    rows = ['| wrong | known | requests | within 1 m | accepted | false accepts | share (95 %) | '
            'recall |', '|---|---|---|---|---|---|---|---|']
    for trouble, mode in dict.fromkeys((one.trouble, one.mode) for one in outcomes):
        its = np.sum([one[2:] for one in outcomes if one[:2] == (trouble, mode)], axis=0)
        requests, right, accepted, false = map(int, its)
        low, high = wilson_interval(false, requests)
        recall = f'{(accepted - false) / right:.2f}' if right else ''
        rows.append(f'| {trouble} | {mode} | {requests} | {right / requests:.2f} | {accepted} | '
                    f'{false} | {false / requests:.4f} ({low:.4f} to {high:.4f}) | {recall} |')
    return '\n'.join(rows)


def run(arguments: list[str]) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog='stress', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    add_arguments(parser, ('room', 'office', 'shop'))
    parser.add_argument('--matching', choices=('hybrid', 'class'), default='hybrid')
    parser.add_argument('--only', nargs='+', default=[''], metavar='TEXT',
                        help='troubles whose name contains one of these')
    parser.add_argument('--workers', type=positive_int, default=1, metavar='N')
    options = parser.parse_args(arguments)
    places = chosen_places(options)
    tasks = [(place, row) for row, trouble in enumerate(TROUBLES) for place in places
             if any(text in trouble.name for text in options.only)]
    if not tasks:
        raise OptionsError('nothing to test: --only must name a trouble')
    print(table(run_all(MakeTrial(options.matching), tasks, 'troubles', options.workers)))
    return 0


def main() -> int:
    """Run from the command line; return the exit code."""
    return run_command(lambda: run(sys.argv[1:]))


if __name__ == '__main__':
    sys.exit(main())
