# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Searches over places, modes, matchings and troubles, and the table of what was accepted."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from math import ceil, inf
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.transforms import RIGHT_M
from cliploc_ros.core.localizer import Localizer
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.query import Query
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.offline.evaluation.figures import within_ellipsoid
from cliploc_ros.offline.evaluation.methods import AUTO, Method
from cliploc_ros.offline.evaluation.trials import PosedQuery, run_trial
from studies.acceptance.fit import best_recall
from studies.acceptance.places import SEED, AnyPlace, Place
from studies.acceptance.priors import PRIORS
from studies.acceptance.troubles import FAMILIES, TROUBLES
from studies.reports import FAR_DEG, FAR_M, SUCCESS_M, errors_of, grouped, interval, table

#: More queries than any place has.
MANY = 1_000_000
#: Looks of one localizer before it can tell that its camera is wrong.
EARLY_LOOKS = 5
_CHANGES = TROUBLES | PRIORS | FAMILIES


class Task(NamedTuple):
    """All queries of a place in a mode, with a trouble."""

    place: AnyPlace
    mode: str
    options: RelocalizerOptions = RelocalizerOptions()
    trouble: str = 'none'
    level: float = 0.0
    seed: int = SEED  # of the sensors and of the trouble
    most: int = MANY  # queries, evenly spread
    in_order: bool = False  # all frames, by one localizer


class Outcome(NamedTuple):
    """The best pose of one request."""

    place: str
    mode: str
    matching: str
    trouble: str
    level: float
    right: bool  # within 1 m of the truth, where the map shows the place
    accepted: bool
    confidence: float
    error_m: float = inf  # infinite where no pose was found
    error_deg: float = inf
    nees: float = inf
    looks: str = 'alone'  # or which of the looks of one localizer this is


def make_search() -> Callable[[Task], list[Outcome]]:
    """Return the function that searches, for a worker."""
    return search


def search(task: Task) -> list[Outcome]:
    """Return the outcomes of all queries of a place; none where its mode is impossible."""
    place = _loaded(task.place)
    if task.mode not in place.modes:
        return []
    trouble = _CHANGES[task.trouble]
    asked = place._replace(is_main=[True] * len(place.frames)) if task.in_order else place
    queries = asked.ask(task.mode, task.seed)
    landmark_map, changed = trouble.change(
        place.landmark_map, queries[::ceil(len(queries) / task.most)], task.level,
        np.random.default_rng(task.seed))
    options = place.options(task.mode, task.options)
    options = replace(options, k=min(options.k, len(landmark_map)))
    outcome = partial(Outcome, task.place.name, task.mode, options.matching, task.trouble,
                      task.level)
    if task.in_order:
        return _looks(landmark_map, options, changed, outcome)
    return [outcome(one.error_m is not None and one.error_m < RIGHT_M, one.accepted,
                    one.confidence, inf if one.error_m is None else one.error_m,
                    inf if one.error_deg is None else one.error_deg,
                    inf if one.nees is None else one.nees)
            for one in run_trial(landmark_map, Method(AUTO, options), 0, changed)]


def _looks(landmark_map: LandmarkMap, options: RelocalizerOptions, queries: Sequence[PosedQuery],
           outcome: Callable[..., Outcome]) -> list[Outcome]:
    """Return the outcomes of one localizer that has all queries in order, without odometry."""
    localizer, found = Localizer(Relocalizer(landmark_map, options)), []
    for number, query in enumerate(queries):
        result = localizer.answer(Query((query.observation,), run=None))
        errors = errors_of(result, query.map_from_camera)
        found.append(outcome(errors[0] < RIGHT_M, result.accepted, result.confidence, *errors,
                             'first five' if number < EARLY_LOOKS else 'later'))
    return found


@lru_cache(maxsize=256)
def _loaded(place: AnyPlace) -> Place:
    return place.load()


def tasks_of(places: Sequence[AnyPlace], options: RelocalizerOptions,
             names: Sequence[str], seed: int = SEED) -> list[Task]:
    """Return a task for each level of some troubles in each of their modes, at each place."""
    return [Task(place, mode, options, name, level, seed) for name in names
            for level in _CHANGES[name].levels for place in places
            for mode in _CHANGES[name].modes]


def confidences_of(outcomes: Sequence[Outcome]
                   ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the confidence of each outcome, 0 where another rule refuses it, and if right."""
    return (np.array([one.confidence * one.accepted for one in outcomes]),
            np.array([one.right for one in outcomes], dtype=np.bool_))


def acceptance_table(outcomes: Sequence[Outcome], by: Sequence[str],
                     thresholds: Sequence[float] = ()) -> str:
    """Return what was accepted, as Markdown: a row for each value of some fields.

    A cell has accepted poses, those of them that are wrong by more than 1 m, with the 95 %
    interval of their share of all requests, and the share of the right poses that is accepted.

    Parameters
    ----------
    by : sequence of str
        Fields; none for one row of all outcomes.
    thresholds : sequence of float
        A column for each ``min_confidence``, and one for the greatest recall that any of them
        reaches at a precision of .99. Without, what the search itself accepted, after the success
        at .1, .25, .5 and 1 m.
    """
    def figures(some: Sequence[Outcome]) -> Iterator[str]:
        likely, right = confidences_of(some)
        yield f'{right.sum()} of {len(right)}'
        if not thresholds:
            errors_m = np.array([one.error_m for one in some])
            yield ' '.join(f'{(errors_m < limit).mean():.2f}' for limit in SUCCESS_M)
        for accepted in [likely >= least for least in thresholds] if thresholds else [
                np.array([one.accepted for one in some])]:
            false = int((accepted & ~right).sum())
            recall = f'{accepted[right].mean():.2f}' if right.any() else '-'
            yield (f'{accepted.sum()}, {false} ({interval(false, len(some), 4)}); {recall}')
        if thresholds:
            yield f'{best_recall(likely, right)[0]:.2f}' if right.any() else '-'

    columns = [f'{least:g}' for least in thresholds] + ['best'] if thresholds \
        else ['success', 'accepted, wrong (95 % of all); recall']
    return table([*by, 'within 1 m', *columns],
                 [[*key, *figures(some)] for key, some in grouped(outcomes, by).items()])


def false_table(outcomes: Sequence[Outcome], by: Sequence[str]) -> str:
    """Return the false accepts as Markdown: a row for each value of some fields.

    With the 95 % intervals of their share of the accepted poses and of all requests, the accepted
    poses that are far off otherwise, and the share of those within their 95 % ellipsoid.
    """
    rows = []
    for key, some in grouped(outcomes, by).items():
        accepted = [one for one in some if one.accepted]
        false = sum(not one.right for one in accepted)
        rows.append([*key, len(some), sum(one.right for one in some), len(accepted), false,
                     interval(false, len(accepted)), interval(false, len(some), 3),
                     sum(one.error_m > FAR_M or one.error_deg > FAR_DEG for one in accepted),
                     f'{within_ellipsoid(np.array([one.nees for one in accepted])):.2f}'
                     if accepted else ''])
    return table([*by, 'n', 'within 1 m', 'accepted', 'false', '95 % of accepted', '95 % of n',
                  f'{FAR_M:g} m or {FAR_DEG:g} deg off', 'in 95 %'], rows)
